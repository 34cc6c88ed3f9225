"""Lattice and dtype of a study's fields: given, or chosen for an accuracy."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.study.schema import MOST_OCTAVES
from sobolev_batch.batch.study.study import Study
from sobolev_batch.spectral.adaptive.lattice_selection import FINER_LATTICE, good_intervals, lattice_of
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.surfaces.shapes.surface import Similarity

# Largest factor by which a lattice grows at a time.
_LARGEST_GROWTH = 2.0
# Fractions of the accuracy above which the statistical error, and that beyond the last octave, are lessened.
_STATISTICAL_PART, _TRUNCATION_PART = 0.4, 0.4
# Factors by which samples of octaves multiply at a time.
_LEAST_REFINEMENT, _LARGEST_REFINEMENT = 1.5, 8.0
# Most samples of a mesh; their values take 160 MB in double precision.
_MOST_SAMPLES = 10_000_000


@dataclass(frozen=True)
class LatticeChoice:
    """Lattice and dtype of all fields of a study.

    Attributes:
        lattice: Lattice of all fields.
        dtype: Dtype of all fields.
        closest: Smallest distance to the reference among the pilots, for each order; empty if the lattice was given.
        reasons: Reasons of the choice, one line each.
        basis: Digest of the data that the choice was made from; empty if the lattice was given.
        tail: Sampling of the octaves beyond the lattice; None without octaves.
    """

    lattice: Lattice
    dtype: ComplexDtype
    closest: tuple[float, ...] = ()
    reasons: tuple[str, ...] = ()
    basis: str = ""
    tail: TailSampling | None = None

    @property
    def octaves(self) -> dict[str, Any] | None:
        """The sampling of the octaves as a table; None without octaves."""
        return None if self.tail is None else self.tail.to_table()

    def to_table(self) -> dict[str, Any]:
        """Return the choice as a table, without the octaves."""
        return {
            "xi_max": self.lattice.xi_max,
            "M": self.lattice.M,
            "dtype": self.dtype,
            "closest": list(self.closest),
            "reasons": list(self.reasons),
            "basis": self.basis,
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any], octaves: Mapping[str, Any] | None) -> Self:
        """Return the choice that a table holds, with its `octaves`."""
        lattice = Lattice(table["xi_max"], table["M"])
        tail = None if octaves is None else TailSampling.from_table(octaves)
        return cls(lattice, table["dtype"], tuple(table["closest"]), tuple(table["reasons"]), table["basis"], tail)

    def grown(self, distances: NormEstimate, orders: Sequence[float], accuracy: Accuracy) -> LatticeChoice | None:
        """Return a larger or finer lattice for distances (orders, meshes) that miss an accuracy.

        Return None if none of them does, if the lattice does not limit them, or if no larger one fits into the memory.
        """
        if self.tail is not None:
            return self._with_finer_octaves(self.tail, distances, accuracy)
        highest, period = self.lattice.xi_max, 1 / self.lattice.spacing
        short = _short_by_frequencies(distances, accuracy)
        for k, order in enumerate(orders):
            if not short[k].any():
                continue
            values = distances.values[k][short[k]]
            tail = float(np.max(distances.truncation[k][short[k]] / values)) / accuracy.truncation_part(order)
            images = float(np.max(distances.aliasing[k][short[k]] / values)) / accuracy.aliasing_part
            if tail > 1 and order < -1.5:
                # The squared norm beyond ξ_max of two near surfaces falls like its power 2s + 3.
                growth = min(tail ** (1 / (-2 * order - 3)) * 1.02, _LARGEST_GROWTH)
                highest = max(highest, self.lattice.xi_max * growth)
            if images > 1:
                period = max(period, 1 / self.lattice.spacing + math.log(images) / (2 * math.pi) * 1.1)
        if (highest, period) == (self.lattice.xi_max, 1 / self.lattice.spacing):
            return None
        if 2 * highest * period > accuracy.largest_intervals:
            return None
        lattice = lattice_of(highest, period, accuracy.largest_intervals)
        reason = f"grown from xi_max {self.lattice.xi_max:.4g}, M {self.lattice.M}, whose errors were too large"
        return replace(self, lattice=lattice, reasons=(*self.reasons, reason))

    def _with_finer_octaves(
        self, tail: TailSampling, distances: NormEstimate, accuracy: Accuracy
    ) -> LatticeChoice | None:
        """Return the choice with more samples or octaves, or a finer lattice, for distances that miss an accuracy."""
        short = _short_by_frequencies(distances, accuracy)
        if not short.any():
            return None
        values = distances.values[short]
        parts = (distances.statistical, distances.truncation, distances.aliasing)
        statistical, truncation, aliasing = (float(np.max(part[short] / values)) / accuracy.rtol for part in parts)
        factor = 1.0
        if statistical > _STATISTICAL_PART:
            factor = min(max((statistical / _STATISTICAL_PART) ** 2, _LEAST_REFINEMENT), _LARGEST_REFINEMENT)
        more_octaves = int(truncation > _TRUNCATION_PART)
        if len(tail.octaves) + more_octaves > MOST_OCTAVES:
            return None
        lattice = self.lattice
        if aliasing * accuracy.rtol > accuracy.aliasing_part:
            intervals = good_intervals(FINER_LATTICE * lattice.M)
            if intervals > accuracy.largest_intervals:
                return None
            lattice = Lattice(lattice.xi_max, intervals)
        if factor == 1.0 and not more_octaves and lattice == self.lattice:
            return None
        # Another seed than that of the samples before.
        refined = tail.refined(factor, more_octaves, accuracy.largest_intervals, seed=tail.size)
        if refined.size > _MOST_SAMPLES:
            return None
        reason = f"grown from {len(tail.octaves)} octaves with {tail.size:,} samples, whose errors were too large"
        return replace(self, lattice=lattice, tail=refined, reasons=(*self.reasons, reason))


def choice_basis(study: Study, similarity: Similarity, reference: Mapping[str, Any]) -> str:
    """Return a digest of the data that the choice for a study is made from, except families, which may gain meshes."""
    if study.accuracy is None:
        return ""
    data = {
        "accuracy": [study.accuracy.rtol, float(study.accuracy.allowed_bytes), study.accuracy.best_effort],
        "orders": study.orders,
        "dtype": study.dtype,
        "similarity": [similarity.scale, *similarity.origin],
        "reference": dict(reference),
    }
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _short_by_frequencies(distances: NormEstimate, accuracy: Accuracy) -> NDArray[np.bool_]:
    """Tell which distances miss an accuracy that other frequencies could give them.

    The distance of a copy up to rounding is lost in the errors of the fields themselves.
    """
    return np.asarray(~accuracy.met(distances) & (distances.values > distances.discretisation))
