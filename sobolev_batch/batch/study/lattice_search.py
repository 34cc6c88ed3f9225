"""The search for the lattice of a study that asks for an accuracy, among a few pilot pairs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.study.pilots import Members, Pilots
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import AccuracyError, StudyError
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
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Surfaces that are no pilots may reach a little further than those that are.
_REACH_MARGIN = 1.03
# Surfaces that are no pilots may need a little more than those that are: the fraction of the accuracy for pilots.
_PILOT_FRACTION = 0.7
# So often a best effort leaves out the pairs that cannot have the accuracy, and looks again.
_MOST_RETRIES = 2


def choose_lattice(
    study: Study, similarity: Similarity, reference: Surface, members: Members, basis: str
) -> LatticeChoice:
    """Choose lattice, octaves and dtype for the accuracy that a study asks for.

    The coarsest and the finest member of each family are compared with the reference on a small lattice. The most
    demanding of these pairs determines the choice. Where one lattice would be large, octaves follow a small one.
    Surfaces that cannot be read, or reach much farther than the reference, have no say. For a best effort, neither
    have pairs that cannot have the accuracy, as long as others can.

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
        raise ValueError("only a study that asks for an accuracy leaves a choice")
    pilots = Pilots.from_members(members, similarity, reference)
    for label, reason in pilots.set_aside.items():
        _log.warning("%s has no say in the choice of the lattice: %s", label, reason)
    if not pilots.surfaces:
        examples = [f"{label}: {reason}" for label, reason in pilots.set_aside.items()]
        raise StudyError(
            "none of the study's surfaces can serve to choose a lattice"
            + (f" ({examples[0]})" if examples else ", since all are too large")
            + "; see what is wrong with them, or give a [lattice] instead of an [accuracy]"
        )
    widths, reach = _REACH_MARGIN * pilots.extent.widths, _REACH_MARGIN * pilots.extent.reach
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
        for label, surface in pilots.surfaces.items()
    }
    search = _Search(study, strict, problems, basis)
    if not accuracy.best_effort:
        outcome = search.best()
        if outcome.choice is None or outcome.shortfalls:
            raise outcome.worst
        return outcome.choice
    choice, short = search.best_for_most()
    notes = [f"{label} will fall short of rtol {accuracy.rtol:g}" for label in short if choice is not None]
    if choice is None:
        # Fewer digits of all of them, from the easiest on.
        for rtol in coarser_than(accuracy.rtol):
            aimed, _ = search.aiming_at(rtol).best_for_most()
            if aimed is None:
                break
            choice, notes = aimed, [f"all fall short of rtol {accuracy.rtol:g}; this is for {rtol:g}"]
    choice = choice or search.largest()
    return replace(choice, reasons=(*choice.reasons, *notes))


@dataclass(frozen=True, eq=False)
class _Outcome:
    """A choice from pilot pairs, and why it is too little for some of them.

    Attributes:
        choice: Choice; None where there is none for those that fall short.
        shortfalls: Why each pair that falls short does, by the label of its surface.
    """

    choice: LatticeChoice | None
    shortfalls: Mapping[str, AccuracyError] = field(default_factory=dict)

    @property
    def worst(self) -> AccuracyError:
        """Why the pair falls short that needs the largest rtol."""
        return max(self.shortfalls.values(), key=lambda shortfall: shortfall.reachable)


@dataclass(frozen=True, eq=False)
class _Search:
    """Ways to a lattice for pilot pairs.

    Attributes:
        study: Study.
        accuracy: Accuracy that it asks for, and no best effort.
        problems: Pair of each pilot with the reference, by label.
        basis: Digest of what the choice is made from.
    """

    study: Study
    accuracy: Accuracy
    problems: Mapping[str, Problem]
    basis: str

    def best(self) -> _Outcome:
        """Return the first choice that is enough for all pairs, else the one of which most can be had."""
        ways: list[Callable[[], _Outcome]] = [self._on_one_lattice]
        if self._distances and permits_octaves(self.accuracy):
            ways.insert(0 if any(map(prefers_octaves, self.problems.values())) else 1, self._in_octaves)
        outcomes: list[_Outcome] = []
        for way in ways:
            outcomes.append(way())
            if not outcomes[-1].shortfalls:
                return outcomes[-1]
        return min(outcomes, key=lambda outcome: outcome.worst.reachable)

    def best_for_most(self) -> tuple[LatticeChoice | None, tuple[str, ...]]:
        """Return a choice that is enough for all pairs but some that fall short, and their labels; None if all do."""
        search, short = self, list[str]()
        for _ in range(_MOST_RETRIES + 1):
            outcome = search.best()
            if outcome.choice is not None and not outcome.shortfalls:
                return outcome.choice, tuple(short)
            short += outcome.shortfalls
            others = {label: one for label, one in search.problems.items() if label not in outcome.shortfalls}
            if not others:
                break
            search = replace(search, problems=others)
        return None, tuple(short)

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
                solution = solve_in_octaves(self.problems[label], 0, _PILOT_FRACTION)
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
            return _Outcome(None, shortfalls)
        lattice = max(lattices.values(), key=lambda one: one.M)
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
        return _Outcome(LatticeChoice(lattice, dtype, tuple(closest.tolist()), reasons, self.basis, tail), shortfalls)

    def _on_one_lattice(self) -> _Outcome:
        """Choose a lattice that reaches far enough for every pair."""
        pilots: dict[str, Pilot] = {}
        shortfalls: dict[str, AccuracyError] = {}
        for label, problem in self.problems.items():
            try:
                pilots[label] = run_pilot(problem)
            except AccuracyError as error:
                shortfalls[label] = error
        return _Outcome(None, shortfalls) if shortfalls else _Outcome(self._one_lattice(pilots))

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
        """Return the dtype that was asked for, or single precision where that is enough for every pair."""
        if self.study.dtype is not None:
            return self.study.dtype
        return "complex64" if all(singles) else "complex128"


def _listed(values: Reals, orders: Sequence[float]) -> str:
    return ", ".join(f"{value:.2g} at order {order:g}" for value, order in zip(values.tolist(), orders, strict=True))
