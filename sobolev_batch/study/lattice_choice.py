"""The choice of a lattice and a dtype for a study's fields, and how it grows where distances miss an accuracy."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import ComplexDtype, Reals
from sobolev_batch.norms.accuracy.tolerance import FINER_LATTICE, Accuracy, good_intervals, lattice_of
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.norms.tail.sampling import TailSampling
from sobolev_batch.study.schema import MOST_OCTAVES
from sobolev_batch.transform.lattice import Lattice

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
        dtype: Dtype of the fields in the store.
        transform_dtype: Dtype in which they are computed.
        closest: Smallest distance to the reference among the pilots, for each order; empty if the lattice was given.
        reasons: Reasons of the choice, one line each.
        basis: Digest of the data that the choice was made from; empty if the lattice was given.
        tail: Sampling of the octaves beyond the lattice; None without octaves.
        compared_with: Digest of the reference beyond a given lattice, where it has flat faces or octaves; else empty.
    """

    lattice: Lattice
    dtype: ComplexDtype
    transform_dtype: ComplexDtype
    closest: tuple[float, ...] = ()
    reasons: tuple[str, ...] = ()
    basis: str = ""
    tail: TailSampling | None = None
    compared_with: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the choice as a dictionary, without the octaves."""
        others = {name: getattr(self, name) for name in ("dtype", "transform_dtype", "closest", "reasons", "basis")}
        return {"xi_max": self.lattice.xi_max, "M": self.lattice.M, **others}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], octaves: Mapping[str, Any] | None) -> Self:
        """Return the choice that a dictionary holds, with its `octaves`."""
        known: dict[str, Any] = {name: values[name] for name in ("dtype", "transform_dtype", "basis")}
        known |= {name: tuple(values[name]) for name in ("closest", "reasons")}
        tail = None if octaves is None else TailSampling.from_dict(octaves)
        return cls(Lattice(values["xi_max"], values["M"]), **known, tail=tail)

    def grown(self, distances: NormEstimate, orders: Sequence[float], accuracy: Accuracy) -> Self | None:
        """Return a choice of more frequencies for distances (orders, meshes) that miss an accuracy; NaN do not count.

        That is a larger or finer lattice; with octaves, more samples, one more octave or a finer lattice. Return None
        if all distances meet the accuracy, if frequencies do not limit them, or if no more of them fit into the memory.
        """
        # The distance of a copy up to rounding is lost in the errors of the fields themselves.
        short = ~accuracy.met(distances) & (distances.values > distances.discretisation)
        if not short.any():
            return None
        values = np.where(short, distances.values, 1.0)
        parts = (distances.truncation, distances.aliasing, distances.statistical)
        truncation, aliasing, statistical = (np.max(np.where(short, part, 0.0) / values, axis=1) for part in parts)
        more: tuple[Lattice, TailSampling | None] | None
        if self.tail is None:
            more = _larger_lattice(self.lattice, truncation, aliasing, orders, accuracy)
            before = f"xi_max {self.lattice.xi_max:.4g}, M {self.lattice.M}"
        else:
            largest = truncation.max(), aliasing.max(), statistical.max()
            more = _finer_octaves(self.lattice, self.tail, *largest, accuracy)
            before = f"{len(self.tail.octaves)} octaves with {self.tail.size:,} samples"
        if more is None:
            return None
        reason = f"grown from {before}, whose errors were too large"
        return replace(self, lattice=more[0], tail=more[1], reasons=(*self.reasons, reason))


def _larger_lattice(
    lattice: Lattice, truncation: Reals, aliasing: Reals, orders: Sequence[float], accuracy: Accuracy
) -> tuple[Lattice, None] | None:
    """Return a larger or finer lattice for errors (orders,) relative to distances, if that helps and fits."""
    tails = (truncation / accuracy.truncation_parts(orders)).tolist()
    # The squared norm beyond ξ_max of two near surfaces falls like its power 2s + 3.
    needed = [tail ** (1 / (-2 * s - 3)) * 1.02 for s, tail in zip(orders, tails, strict=True) if tail > 1 and s < -1.5]
    highest = lattice.xi_max * min(max(needed, default=1.0), _LARGEST_GROWTH)
    images = max(1.0, *(aliasing / accuracy.aliasing_part).tolist())
    period = 1 / lattice.spacing + math.log(images) / (2 * math.pi) * 1.1
    if (highest, period) == (lattice.xi_max, 1 / lattice.spacing) or 2 * highest * period > accuracy.largest_intervals:
        return None
    return lattice_of(highest, period, accuracy.largest_intervals), None


def _finer_octaves(
    lattice: Lattice, tail: TailSampling, truncation: float, aliasing: float, statistical: float, accuracy: Accuracy
) -> tuple[Lattice, TailSampling] | None:
    """Return a finer lattice and more octaves or samples for errors relative to distances, if that helps and fits."""
    factor, chance = 1.0, float(statistical) / accuracy.rtol
    if chance > _STATISTICAL_PART:
        factor = min(max((chance / _STATISTICAL_PART) ** 2, _LEAST_REFINEMENT), _LARGEST_REFINEMENT)
    more_octaves = int(truncation / accuracy.rtol > _TRUNCATION_PART)
    intervals = good_intervals(FINER_LATTICE * lattice.M) if aliasing > accuracy.aliasing_part else lattice.M
    is_too_much = intervals > accuracy.largest_intervals or len(tail.octaves) + more_octaves > MOST_OCTAVES
    if is_too_much or (factor, more_octaves, intervals) == (1.0, 0, lattice.M):
        return None
    # The seed differs from that of the samples before.
    refined = tail.refined(factor, more_octaves, accuracy.largest_intervals, seed=tail.size)
    return (Lattice(lattice.xi_max, intervals), refined) if refined.size <= _MOST_SAMPLES else None
