"""The search for the lattice of a study that requests an accuracy.

A few of its surfaces, the pilots, are compared with the reference. The most demanding of these pairs decides.
"""

from __future__ import annotations

import logging
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import AccuracyError, InputError, StudyError
from sobolev_batch.machine import available_cores
from sobolev_batch.spectral.adaptive.lattice_selection import core_lattice, lattice_of
from sobolev_batch.spectral.adaptive.octaves import solve_in_octaves
from sobolev_batch.spectral.adaptive.problem import ESTIMATE_CAUTION, Problem, error_target
from sobolev_batch.spectral.adaptive.solve import Pilot, coarser_than, permits_octaves, prefers_octaves, run_pilot
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.errors.budget import Support
from sobolev_batch.spectral.errors.probe import estimate
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.surfaces.shapes.surface import Extent, Similarity, Surface
from sobolev_batch.surfaces.sources.registry import Member

Reals = NDArray[np.float64]
# Family and member of each surface, by label.
Members = Mapping[str, tuple[str, Member]]

_log = logging.getLogger(__name__)

# Pilots are the coarsest and the finest member of this many families.
_MOST_FAMILIES = 6
# A surface larger than the reference by this factor is in another unit, or another object.
_FARTHEST = 8.0
# Memory that a pilot may take to be made, and that all surfaces together may take whose extents are looked at.
_MOST_BYTES = 1e9

# Surfaces that are no pilots may reach a little further than those that are.
_REACH_MARGIN = 1.03
# Surfaces that are no pilots may need a little more than those that are: the fraction of the accuracy for pilots.
_PILOT_FRACTION = 0.7
# So often a best effort leaves out the pairs that cannot have the accuracy, and looks again.
_MOST_RETRIES = 2


class Survey:
    """A look at the surfaces of a study one after the other; their extents stay.

    Attributes:
        extents: Extent of each surface that was loaded, by label.
        set_aside: Reason for each surface that cannot be read or reaches much too far, by label.
    """

    def __init__(self, members: Members, similarity: Similarity, reference: Extent) -> None:
        self.members = members
        self.similarity = similarity
        self.reference = reference
        self.extents: dict[str, Extent] = {}
        self.set_aside: dict[str, str] = {}

    def pilots(self) -> dict[str, Surface]:
        """Return the coarsest and the finest surface of each of a few families, by label, in the study's unit."""
        families: dict[str, list[str]] = {}
        for label, (family, _) in self.members.items():
            families.setdefault(family, []).append(label)
        surfaces: dict[str, Surface] = {}
        for labels in list(families.values())[:_MOST_FAMILIES]:
            labels.sort(key=self._fineness)
            for candidates in (labels, labels[::-1]):
                surfaces |= self._first(candidates, surfaces)
        return surfaces

    def look_at_others(self, known: Container[str] = ()) -> None:
        """Note the extents of other surfaces that are quickly loaded, as long as they take little memory together."""
        left = _MOST_BYTES
        for label, (_, member) in self.members.items():
            if label in known or not member.is_quickly_loaded:
                continue
            left -= member.expected_size().projected_bytes
            if left < 0:
                return
            self._load(label)

    def _fineness(self, label: str) -> tuple[int, int]:
        _, member = self.members[label]
        return member.level, 0 if member.level >= 0 else member.expected_size().triangles

    def _first(self, labels: Sequence[str], known: Mapping[str, Surface]) -> dict[str, Surface]:
        """Return the first of some surfaces that can be a pilot; those before it are set aside."""
        for label in labels:
            if self.members[label][1].expected_size().projected_bytes <= _MOST_BYTES:
                surface = known[label] if label in known else self._load(label)
                if surface is not None:
                    return {label: surface}
        return {}

    def _load(self, label: str) -> Surface | None:
        """Return a surface whose extent is noted, or None if it is set aside."""
        if label in self.set_aside:
            return None
        try:
            surface = self.similarity.apply(self.members[label][1].load())
        except InputError as error:
            self.set_aside[label] = str(error)
            return None
        times = surface.extent.reach / self.reference.reach
        if times > _FARTHEST:
            self.set_aside[label] = f"its extent is {times:.3g} times that of the reference; are both in the same unit?"
            return None
        self.extents[label] = surface.extent
        return surface


def choose_lattice(
    study: Study, similarity: Similarity, reference: Surface, members: Members, basis: str
) -> LatticeChoice:
    """Choose lattice, octaves and dtype for the accuracy that a study requests.

    The coarsest and the finest member of each family are compared with the reference on a small lattice. Where one
    lattice would be large, octaves follow a small one. Surfaces that cannot be read, or reach much farther than the
    reference, have no say. For a best effort, neither have pairs that cannot have the accuracy, as long as others can.

    Args:
        study: Study with an accuracy.
        similarity: Similarity transform of the study.
        reference: Reference in the study's unit.
        members: Other surfaces of the study.
        basis: Digest from `choice_basis`.

    Raises:
        AccuracyError: A pilot shows that the accuracy cannot be met within the memory, and it is no best effort.
        StudyError: No pilot could be made.
    """
    accuracy = study.accuracy
    if accuracy is None:
        raise ValueError("only a study that requests an accuracy leaves a choice")
    survey = Survey(members, similarity, reference.extent)
    pilots = survey.pilots()
    survey.look_at_others(pilots)
    for label, reason in survey.set_aside.items():
        _log.warning("%s has no say in the choice of the lattice: %s", label, reason)
    if not pilots:
        examples = [f"{label}: {reason}" for label, reason in survey.set_aside.items()]
        raise StudyError(
            "none of the study's surfaces can serve to choose a lattice"
            + (f" ({examples[0]})" if examples else ", since all are too large")
            + "; see what is wrong with them, or give a [lattice] instead of an [accuracy]"
        )
    extent = Extent.union([reference.extent, *survey.extents.values()])
    widths, reach = _REACH_MARGIN * extent.widths, _REACH_MARGIN * extent.reach
    strict = replace(accuracy, best_effort=False)
    problems = {
        label: Problem(
            (surface, reference),
            study.orders,
            strict,
            Support(np.array(surface.area + reference.area), widths, reach),
            label,
            available_cores(),
        )
        for label, surface in pilots.items()
    }
    search = _Search(study, strict, problems, basis)
    if not accuracy.best_effort:
        best, shortfalls = search.best()
        if best is None or shortfalls:
            raise _worst(shortfalls)
        return best
    choice, short = search.best_for_most()
    notes = [f"{label} will miss rtol {accuracy.rtol:g}" for label in short if choice is not None]
    if choice is None:
        # Fewer digits of all of them, from the easiest on.
        for rtol in coarser_than(accuracy.rtol):
            aimed, _ = search.aiming_at(rtol).best_for_most()
            if aimed is None:
                break
            choice, notes = aimed, [f"all miss rtol {accuracy.rtol:g}; this is for {rtol:g}"]
    choice = choice or search.largest()
    return replace(choice, reasons=(*choice.reasons, *notes))


# A choice, if there is one for any pair, and why each pair misses the accuracy that does, by the label of its surface.
_Outcome = tuple[LatticeChoice | None, Mapping[str, AccuracyError]]


def _worst(shortfalls: Mapping[str, AccuracyError]) -> AccuracyError:
    """Return why the pair that needs the largest rtol misses its accuracy."""
    return max(shortfalls.values(), key=lambda shortfall: shortfall.reachable)


@dataclass(frozen=True, eq=False)
class _Search:
    """Ways to a lattice for pilot pairs.

    Attributes:
        study: Study.
        accuracy: Accuracy that it requests, and no best effort.
        problems: Pair of each pilot with the reference, by label.
        basis: Digest of what the choice is made from.
    """

    study: Study
    accuracy: Accuracy
    problems: Mapping[str, Problem]
    basis: str

    def best(self) -> _Outcome:
        """Return the first choice that is enough for all pairs, else the most accurate attainable one."""
        ways = [self._on_one_lattice]
        if self._distances and permits_octaves(self.accuracy):
            ways.insert(0 if any(map(prefers_octaves, self.problems.values())) else 1, self._in_octaves)
        outcomes: list[_Outcome] = []
        for way in ways:
            outcomes.append(way())
            if not outcomes[-1][1]:
                return outcomes[-1]
        return min(outcomes, key=lambda outcome: _worst(outcome[1]).reachable)

    def best_for_most(self) -> tuple[LatticeChoice | None, list[str]]:
        """Return a choice that is enough for all pairs but some that miss it, and their labels; None if all do."""
        search, short = self, list[str]()
        for _ in range(_MOST_RETRIES + 1):
            choice, shortfalls = search.best()
            if choice is not None and not shortfalls:
                return choice, short
            short += shortfalls
            others = {label: problem for label, problem in search.problems.items() if label not in shortfalls}
            if not others:
                break
            search = replace(search, problems=others)
        return None, short

    def aiming_at(self, rtol: float) -> Self:
        """Return the search for another accuracy."""
        accuracy = replace(self.accuracy, rtol=rtol)
        problems = {label: replace(problem, accuracy=accuracy) for label, problem in self.problems.items()}
        return replace(self, accuracy=accuracy, problems=problems)

    def largest(self) -> LatticeChoice:
        """Return the choice of the largest lattice that a pair may need and the memory permits."""
        accuracy = replace(self.accuracy, best_effort=True)
        return self._one_lattice(
            {label: run_pilot(replace(problem, accuracy=accuracy)) for label, problem in self.problems.items()}
        )

    @cached_property
    def _distances(self) -> dict[str, Reals]:
        """Estimated distance of each pair for each order (orders,), near-duplicates left out."""
        lattice = core_lattice(self._support, self.study.orders, self.accuracy)
        estimates = {
            label: estimate(problem.samples(lattice), self.study.orders) for label, problem in self.problems.items()
        }
        return {label: values for label, values in estimates.items() if np.all(values > self.problems[label].rounding)}

    @property
    def _support(self) -> Support:
        """Support of a pair; sizes are the same for all of them."""
        return next(iter(self.problems.values())).support

    def _in_octaves(self) -> _Outcome:
        """Choose a small lattice and the octaves beyond it, from the pairs that are closest to each other."""
        orders, distances = self.study.orders, self._distances
        closest = ESTIMATE_CAUTION * np.min(list(distances.values()), axis=0)
        demanding = dict.fromkeys(
            min(distances, key=lambda label: distances[label][order]) for order in range(len(orders))
        )
        lattices: dict[str, Lattice] = {}
        samplings: list[list[OctaveSampling]] = []
        shortfalls: dict[str, AccuracyError] = {}
        for label in demanding:
            try:
                solution = solve_in_octaves(self.problems[label], 0, _PILOT_FRACTION, for_others=True)
            except AccuracyError as error:
                shortfalls[label] = error
                continue
            if solution.lattice is not None:
                lattices[label] = solution.lattice
            # The values of pilots would fill the memory.
            samplings.append([octave.sampling for octave in solution.octaves])
            if solution.shortfall is not None:
                shortfalls[label] = solution.shortfall
        if not lattices:
            return None, shortfalls
        lattice = max(lattices.values(), key=lambda lattice: lattice.M)
        first = next(iter(self.problems.values()))
        surfaces = [*first.surfaces[1:], *(problem.surfaces[0] for problem in self.problems.values())]
        tail = TailSampling.joined(lattice.xi_max, samplings, FaceNormals.from_surfaces(surfaces))
        target = error_target(closest, orders, self.accuracy, first.area)
        dtype = self._dtype(problem.dtype(lattice, target) == "complex64" for problem in self.problems.values())
        reasons = (
            f"xi_max {lattice.xi_max:.4g}, spacing {lattice.spacing:.4g} for the innermost frequencies: the surfaces "
            f"reach over {self._support.widths.max():.4g} units of length",
            f"{len(tail.octaves)} octaves up to |xi| {tail.highest_frequency:.4g} for the tail, from the closest of "
            f"{len(self.problems)} pilot pairs: {', '.join(lattices)}",
            f"{dtype} for the smallest distance of a pilot, about {_listed(closest, orders)}",
        )
        return LatticeChoice(lattice, dtype, tuple(closest.tolist()), reasons, self.basis, tail), shortfalls

    def _on_one_lattice(self) -> _Outcome:
        """Choose a lattice that reaches far enough for every pair."""
        pilots: dict[str, Pilot] = {}
        shortfalls: dict[str, AccuracyError] = {}
        for label, problem in self.problems.items():
            try:
                pilots[label] = run_pilot(problem)
            except AccuracyError as error:
                shortfalls[label] = error
        return None if shortfalls else self._one_lattice(pilots), shortfalls

    def _one_lattice(self, pilots: Mapping[str, Pilot]) -> LatticeChoice:
        highest = max(pilots, key=lambda label: pilots[label].lattice.xi_max)
        finest = max(pilots, key=lambda label: 1 / pilots[label].lattice.spacing)
        xi_max, period = pilots[highest].lattice.xi_max, 1 / pilots[finest].lattice.spacing
        lattice = lattice_of(xi_max, period, self.accuracy.largest_intervals)
        dtype = self._dtype(pilot.single for pilot in pilots.values())
        closest = np.min([pilot.values for pilot in pilots.values()], axis=0)
        reasons = (
            f"xi_max {lattice.xi_max:.4g} for truncation, which {highest} needs most of {len(pilots)} pilot pairs",
            f"spacing {lattice.spacing:.4g} for aliasing: the surfaces reach over {self._support.widths.max():.4g} "
            "units of length",
            f"{dtype} for the smallest distance of a pilot, about {_listed(closest, self.study.orders)}",
        )
        return LatticeChoice(lattice, dtype, tuple(closest.tolist()), reasons, self.basis)

    def _dtype(self, singles: Iterable[bool]) -> ComplexDtype:
        """Return the dtype that was requested, or single precision where that is enough for every pair."""
        if self.study.dtype is not None:
            return self.study.dtype
        return "complex64" if all(singles) else "complex128"


def _listed(values: Reals, orders: Sequence[float]) -> str:
    return ", ".join(f"{value:.2g} at order {order:g}" for value, order in zip(values.tolist(), orders, strict=True))
