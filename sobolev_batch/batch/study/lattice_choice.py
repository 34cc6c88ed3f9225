"""Lattice and dtype of a study's fields: given, or chosen for an accuracy from a few pilot pairs."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.study.schema import MOST_OCTAVES
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import AccuracyError, InputError, StudyError
from sobolev_batch.spectral.adaptive.lattice_selection import FINER_LATTICE, core_lattice, good_intervals, lattice_of
from sobolev_batch.spectral.adaptive.octaves import solve_in_octaves
from sobolev_batch.spectral.adaptive.problem import ESTIMATE_CAUTION, Problem, Solution, error_target
from sobolev_batch.spectral.adaptive.solve import Pilot, permits_octaves, prefers_octaves, run_pilot
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.errors.budget import NormEstimate, Support
from sobolev_batch.spectral.errors.samples import estimate
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.registry import Member

_log = logging.getLogger(__name__)

# Family and member of each surface, by label.
Members = Mapping[str, tuple[str, Member]]

# Pilots are the coarsest and the finest member of this many families.
_MOST_FAMILIES = 6
# Surfaces that are no pilots may reach a little further than those that are.
_REACH_MARGIN = 1.03
# Largest factor by which a lattice grows at a time.
_LARGEST_GROWTH = 2.0
# Surfaces that are no pilots may need a little more than those that are: the fraction of the accuracy for pilots.
_PILOT_FRACTION = 0.7
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
        """Return a larger or finer lattice for distances (orders, meshes) that fall short of an accuracy.

        Return None if none of them does, if the lattice does not limit them, or if no larger one fits into the memory.
        """
        if self.tail is not None:
            return self._with_finer_octaves(self.tail, distances, accuracy)
        highest, period = self.lattice.xi_max, 1 / self.lattice.spacing
        short = ~accuracy.met(distances) & (distances.values > 0)
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
        """Return the choice with more samples or octaves, or a finer lattice, for distances that fall short."""
        short = ~accuracy.met(distances) & (distances.values > 0)
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
        # A float in stores written before, too.
        "accuracy": [study.accuracy.rtol, float(study.accuracy.allowed_bytes)],
        "orders": study.orders,
        "dtype": study.dtype,
        "similarity": [similarity.scale, *similarity.origin],
        "reference": dict(reference),
    }
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def choose_lattice(
    study: Study, similarity: Similarity, reference: Surface, members: Members, basis: str
) -> LatticeChoice:
    """Choose lattice, octaves and dtype for the accuracy that a study asks for.

    The coarsest and the finest member of each family are compared with the reference on a small lattice. The most
    demanding of these pairs determines the choice. Where one lattice would be large, octaves follow a small one.

    Args:
        study: Study with an accuracy.
        similarity: Similarity transform of the study.
        reference: Reference in the study's unit.
        members: Other surfaces of the study.
        basis: Digest from `choice_basis`.

    Raises:
        AccuracyError: A pilot shows that the accuracy cannot be met within the memory.
        StudyError: No pilot could be made.
    """
    accuracy = study.accuracy
    if accuracy is None:
        raise ValueError("only a study that asks for an accuracy leaves a choice")
    surfaces = _pilots(members, similarity)
    if not surfaces:
        raise StudyError(
            "no surface of the study's families can be made, so there is nothing to choose a lattice from; "
            "see what is wrong with them, or give a [lattice] instead of an [accuracy]"
        )
    extent = Extent.union([surface.extent for surface in (reference, *surfaces.values())])
    widths, reach = _REACH_MARGIN * extent.widths, _REACH_MARGIN * extent.reach
    problems = {
        label: Problem(
            (surface, reference),
            study.orders,
            accuracy,
            Support(np.array(surface.area + reference.area), widths, reach),
            label,
            os.cpu_count() or 1,
        )
        for label, surface in surfaces.items()
    }
    distances = _distances_of_pilots(study, problems)
    if distances and any(map(prefers_octaves, problems.values())):
        return _choose_octaves(study, problems, distances, basis)
    try:
        return _choose_one_lattice(study, accuracy, problems, basis)
    except AccuracyError:
        if not (distances and permits_octaves(accuracy)):
            raise
    return _choose_octaves(study, problems, distances, basis)


def _distances_of_pilots(study: Study, problems: Mapping[str, Problem]) -> dict[str, NDArray[np.float64]]:
    """Estimate the distance of each pair for each order (orders,), near-duplicates left out."""
    first = next(iter(problems.values()))
    lattice = core_lattice(first.support, study.orders, first.accuracy)
    estimates = {label: estimate(problem.samples(lattice), study.orders) for label, problem in problems.items()}
    return {label: values for label, values in estimates.items() if np.all(values > problems[label].rounding)}


def _choose_octaves(
    study: Study, problems: Mapping[str, Problem], distances: Mapping[str, NDArray[np.float64]], basis: str
) -> LatticeChoice:
    """Choose a small lattice and the octaves beyond it, from the pairs that are closest to each other."""
    first = next(iter(problems.values()))
    closest = ESTIMATE_CAUTION * np.min(list(distances.values()), axis=0)
    demanding = dict.fromkeys(
        min(distances, key=lambda label: distances[label][order]) for order in range(len(study.orders))
    )
    solutions: dict[str, Solution] = {}
    for label in demanding:
        problem = problems[label]
        accuracy = replace(problem.accuracy, rtol=_PILOT_FRACTION * problem.accuracy.rtol)
        solutions[label] = solve_in_octaves(replace(problem, accuracy=accuracy), 0, problem.accuracy)
    lattices = (solution.lattice for solution in solutions.values() if solution.lattice is not None)
    lattice = max(lattices, key=lambda one: one.M)
    surfaces = [*first.surfaces[1:], *(problem.surfaces[0] for problem in problems.values())]
    samplings = [solution.octaves for solution in solutions.values()]
    tail = TailSampling.joined(lattice.xi_max, samplings, FaceNormals.of(surfaces))
    target = error_target(closest, study.orders, first.accuracy, first.area)
    single = study.dtype is None and all(problem.dtype(lattice, target) == "complex64" for problem in problems.values())
    dtype: ComplexDtype = "complex64" if single else study.dtype or "complex128"
    widest = float(first.support.widths.max())
    reasons = (
        f"xi_max {lattice.xi_max:.4g}, spacing {lattice.spacing:.4g} for the innermost frequencies: the surfaces reach "
        f"over {widest:.4g} units of length",
        f"{len(tail.octaves)} octaves up to |xi| {tail.highest_frequency:.4g} for the tail, from the closest of "
        f"{len(problems)} pilot pairs: {', '.join(demanding)}",
        f"{dtype} for the smallest distance of a pilot, about {_listed(closest, study.orders)}",
    )
    return LatticeChoice(lattice, dtype, tuple(closest.tolist()), reasons, basis, tail)


def _choose_one_lattice(study: Study, accuracy: Accuracy, problems: Mapping[str, Problem], basis: str) -> LatticeChoice:
    """Choose a lattice that reaches far enough for every pair."""
    pilots: dict[str, Pilot] = {label: run_pilot(problem) for label, problem in problems.items()}
    widths = next(iter(problems.values())).support.widths
    highest = max(pilots, key=lambda label: pilots[label].lattice.xi_max)
    finest = max(pilots, key=lambda label: 1 / pilots[label].lattice.spacing)
    xi_max, period = pilots[highest].lattice.xi_max, 1 / pilots[finest].lattice.spacing
    # A pair that does not fit into the memory by itself was refused above.
    lattice = lattice_of(xi_max, period, accuracy.largest_intervals)
    single = study.dtype is None and all(pilot.single for pilot in pilots.values())
    dtype: ComplexDtype = "complex64" if single else study.dtype or "complex128"
    closest = np.min([pilot.values for pilot in pilots.values()], axis=0)
    reasons = (
        f"xi_max {lattice.xi_max:.4g} for truncation, which {highest} needs most of {len(pilots)} pilot pairs",
        f"spacing {lattice.spacing:.4g} for aliasing: the surfaces reach over {widths.max():.4g} units of length",
        f"{dtype} for the smallest distance of a pilot, about {_listed(closest, study.orders)}",
    )
    return LatticeChoice(lattice, dtype, tuple(closest.tolist()), reasons, basis)


def _pilots(members: Members, similarity: Similarity) -> dict[str, Surface]:
    families: dict[str, list[str]] = {}
    for label, (family, _) in members.items():
        families.setdefault(family, []).append(label)
    surfaces: dict[str, Surface] = {}
    for labels in list(families.values())[:_MOST_FAMILIES]:
        by_level = sorted(labels, key=lambda label: members[label][1].level)
        for label in dict.fromkeys((by_level[0], by_level[-1])):
            try:
                surfaces[label] = similarity.apply(members[label][1].load())
            except InputError as error:
                _log.warning("%s serves as no pilot: %s", label, error)
    return surfaces


def _listed(values: NDArray[np.float64], orders: Sequence[float]) -> str:
    return ", ".join(f"{value:.2g} at order {order:g}" for value, order in zip(values.tolist(), orders, strict=True))
