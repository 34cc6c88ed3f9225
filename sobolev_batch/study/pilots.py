"""The lattice for the accuracy that a study requests, chosen from a few of its surfaces: the pilots.

They are compared with the reference, and the most demanding of these pairs decides.
"""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np

from sobolev_batch.arrays import ComplexDtype, Reals
from sobolev_batch.errors import AccuracyError, StudyError, one_line
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Extent, Similarity, Surface
from sobolev_batch.machine import available_cores
from sobolev_batch.norms.accuracy.octaves import solve_in_octaves
from sobolev_batch.norms.accuracy.problem import ESTIMATE_CAUTION, Problem, error_target
from sobolev_batch.norms.accuracy.solve import COARSER, prefers_octaves, run_pilot
from sobolev_batch.norms.accuracy.tolerance import LEAST_OF_OCTAVES, Accuracy, core_lattice, lattice_of
from sobolev_batch.norms.budget import Support
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.sampling import OctaveSampling, TailSampling
from sobolev_batch.sources.registry import Member
from sobolev_batch.study.lattice_choice import LatticeChoice
from sobolev_batch.study.study import Members, Study
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.transform.probe import estimate

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
# A best effort leaves out the pairs that cannot have the accuracy and chooses again, at most this often.
_MOST_RETRIES = 2

# The pair of each pilot with the reference, by label. All have the same orders, accuracy and sizes.
_Problems = Mapping[str, Problem]
# A choice or None, and why pairs miss the accuracy, by the labels of their surfaces.
_Outcome = tuple[LatticeChoice | None, Mapping[str, AccuracyError]]


@dataclass(frozen=True)
class Look:
    """Findings from loading some surfaces of a study, by their labels.

    Attributes:
        extents: Extents in the study's unit of length.
        set_aside: Reasons why others cannot be compared with the reference.
        failing: Reasons why some of these cannot be read or made.
        notes: What was noted where files were read, see `Mesh`.
    """

    extents: dict[str, Extent] = field(default_factory=dict)
    set_aside: dict[str, str] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    failing: dict[str, str] = field(default_factory=dict)

    def at(self, label: str, member: Member, similarity: Similarity, reference: Extent) -> Surface | None:
        """Return a surface in the study's unit; None where it cannot be made, or reaches far beyond the reference."""
        try:
            surface = similarity.apply(member.pilot())
        except Exception as error:  # its source may raise anything
            self.set_aside[label] = self.failing[label] = one_line(error)
            return None
        if (times := surface.extent.reach / reference.reach) > _FARTHEST:
            self.set_aside[label] = f"its extent is {times:.3g} times that of the reference; are both in the same unit?"
            return None
        self.extents[label] = surface.extent
        self.take_notes(label, surface)
        return surface

    def take_notes(self, label: str, surface: Surface) -> None:
        """Keep the notes of a mesh, if it has any."""
        if isinstance(surface, Mesh) and surface.notes:
            self.notes[label] = "; ".join(surface.notes)

    def at_all(self, members: Members, similarity: Similarity, reference: Extent) -> None:
        """Look at the quickly loaded surfaces that were not looked at yet, as memory permits."""
        left = _MOST_BYTES
        for label, (_, member) in members.items():
            if label in self.extents or label in self.set_aside or not member.is_quickly_loaded:
                continue
            if (left := left - member.expected_size().projected_bytes) < 0:
                break
            self.at(label, member, similarity, reference)


def choose_pilots(members: Members, similarity: Similarity, reference: Extent, look: Look) -> dict[str, Surface]:
    """Return the coarsest and the finest surface of a few families, by label."""
    families = [list(labels) for _, labels in groupby(members, key=lambda label: members[label][0])]

    def fineness(label: str) -> tuple[int, int]:
        _, member = members[label]
        return member.level, 0 if member.level >= 0 else member.expected_size().triangles

    pilots: dict[str, Surface] = {}
    for labels in families[:_MOST_FAMILIES]:
        labels.sort(key=fineness)
        for candidates in (labels, labels[::-1]):
            for label in candidates:
                member = members[label][1]
                if label in pilots:
                    break
                if label in look.set_aside or member.expected_size().projected_bytes > _MOST_BYTES:
                    continue
                if (surface := look.at(label, member, similarity, reference)) is not None:
                    pilots[label] = surface
                    break
    return pilots


def choose_lattice(
    study: Study, accuracy: Accuracy, similarity: Similarity, reference: Surface, members: Members
) -> tuple[LatticeChoice, Look]:
    """Choose lattice, octaves and dtype for the accuracy that a study requests; return also what was seen for it.

    The coarsest and the finest member of each family are compared with the reference on a small lattice. Where one
    lattice would be large, octaves follow a small one. Surfaces that cannot be read, or reach much farther than the
    reference, have no say. For a best effort, neither have pairs that cannot have the accuracy, as long as others can.
    AccuracyError where it is out of reach, and StudyError where no pilot could be made.
    """
    look = Look()
    pilots = choose_pilots(members, similarity, reference.extent, look)
    look.at_all(members, similarity, reference.extent)
    for label, reason in look.set_aside.items():
        _log.warning("the lattice is chosen without %s: %s", label, reason)
    if not pilots:
        why = next((f" ({label}: {reason})" for label, reason in look.set_aside.items()), ", since all are too large")
        raise StudyError(
            f"none of the study's surfaces can serve to choose a lattice{why}; mend what is wrong with them. If they "
            "are sound, give a [lattice] instead of an [accuracy]"
        )
    extent = Extent.union([reference.extent, *look.extents.values()])
    widths, reach = _REACH_MARGIN * extent.widths, _REACH_MARGIN * extent.reach
    strict, problems = replace(accuracy, best_effort=False), dict[str, Problem]()
    for label, surface in pilots.items():
        support = Support(np.array(surface.area + reference.area), widths, reach)
        problems[label] = Problem((surface, reference), study.orders, strict, support, label, available_cores())
    if not accuracy.best_effort:
        choice, shortfalls = _best(problems, study.dtype)
        if choice is None or shortfalls:
            raise _worst(shortfalls)
        return choice, look
    choice, short = _best_for_most(problems, study.dtype)
    notes = [f"{label} will miss rtol {accuracy.rtol:g}" for label in short if choice is not None]
    if choice is None:
        # Fewer digits are sought for all of them, from the easiest accuracy on.
        for rtol in (one for one in COARSER if one > accuracy.rtol):
            aimed, _ = _best_for_most(_with_accuracy(problems, rtol=rtol), study.dtype)
            if aimed is None:
                break
            choice, notes = aimed, [f"all miss rtol {accuracy.rtol:g}; this is for {rtol:g}"]
    if choice is None:
        # Take the largest lattice that a pair may need and the memory permits.
        choice, shortfalls = _on_one_lattice(_with_accuracy(problems, best_effort=True), study.dtype)
    if choice is None:
        raise _worst(shortfalls)
    return replace(choice, reasons=(*choice.reasons, *notes)), look


def _worst(shortfalls: Mapping[str, AccuracyError]) -> AccuracyError:
    return max(shortfalls.values(), key=lambda shortfall: shortfall.reachable)


def _with_accuracy(problems: _Problems, **changes: Any) -> _Problems:
    return {label: replace(one, accuracy=replace(one.accuracy, **changes)) for label, one in problems.items()}


def _best(problems: _Problems, dtype: ComplexDtype | None) -> _Outcome:
    """Return the first choice that is enough for all pairs, else the most accurate attainable one."""
    first = next(iter(problems.values()))
    lattice = core_lattice(first.support, first.orders, first.accuracy)
    estimates = {label: estimate(problem.samples(lattice), first.orders) for label, problem in problems.items()}
    # Near-duplicates have no relative accuracy.
    distances = {label: values for label, values in estimates.items() if np.all(values > problems[label].rounding)}
    ways = [partial(_on_one_lattice, problems, dtype)]
    if distances and first.accuracy.rtol >= LEAST_OF_OCTAVES:
        octaves_first = any(map(prefers_octaves, problems.values()))
        ways.insert(0 if octaves_first else 1, partial(_in_octaves, problems, dtype, distances))
    outcomes: list[_Outcome] = []
    for way in ways:
        outcomes.append(way())
        if not outcomes[-1][1]:
            return outcomes[-1]
    return min(outcomes, key=lambda outcome: _worst(outcome[1]).reachable)


def _best_for_most(problems: _Problems, dtype: ComplexDtype | None) -> tuple[LatticeChoice | None, list[str]]:
    """Return a choice that is enough for all pairs but some that miss it, and their labels; None if all do."""
    short: list[str] = []
    for _ in range(_MOST_RETRIES + 1):
        choice, shortfalls = _best(problems, dtype)
        if choice is not None and not shortfalls:
            return choice, short
        short += shortfalls
        if not (problems := {label: problem for label, problem in problems.items() if label not in shortfalls}):
            break
    return None, short


def _in_octaves(problems: _Problems, dtype: ComplexDtype | None, distances: Mapping[str, Reals]) -> _Outcome:
    """Choose a small lattice and the octaves beyond it, from the pairs with the smallest distances (orders,)."""
    first = next(iter(problems.values()))
    closest = ESTIMATE_CAUTION * np.min(list(distances.values()), axis=0)
    numbers = range(len(first.orders))
    demanding = dict.fromkeys(min(distances, key=lambda label: distances[label][order]) for order in numbers)
    lattices, samplings, shortfalls = dict[str, Lattice](), list[list[OctaveSampling]](), dict[str, AccuracyError]()
    for label in demanding:
        try:
            solution = solve_in_octaves(problems[label], 0, _PILOT_FRACTION, for_others=True)
        except AccuracyError as error:
            shortfalls[label] = error
            continue
        if solution.lattice is not None:
            lattices[label] = solution.lattice
        # Copies make their samples anew: those of pilots would fill the memory.
        samplings.append([replace(octave) for octave in solution.octaves])
        if solution.shortfall is not None:
            shortfalls[label] = solution.shortfall
    if not lattices:
        return None, shortfalls
    lattice = max(lattices.values(), key=lambda lattice: lattice.M)
    surfaces = [*first.surfaces[1:], *(problem.surfaces[0] for problem in problems.values())]
    tail = TailSampling.joined(lattice.xi_max, samplings, FaceNormals.from_surfaces(surfaces))
    target = error_target(closest, first.orders, first.accuracy, first.area)
    dtypes = (problem.dtype(lattice, target) for problem in problems.values())
    reasons = [
        f"xi_max {lattice.xi_max:.4g}, spacing {lattice.spacing:.4g} for the innermost frequencies: the surfaces "
        f"reach over {first.support.widths.max():.4g} units of length"
    ]
    if tail.octaves:
        reasons.append(
            f"octaves up to |xi| {tail.highest_frequency:.4g} for the tail ({len(tail.octaves)}), from the closest of "
            f"{len(problems)} pilot pairs: {', '.join(lattices)}"
        )
    return _choice(lattice, dtype, dtypes, closest, reasons, first, tail if tail.octaves else None), shortfalls


def _on_one_lattice(problems: _Problems, dtype: ComplexDtype | None) -> _Outcome:
    """Choose a lattice that reaches far enough for every pair."""
    pilots, shortfalls = dict[str, tuple[Reals, Lattice, ComplexDtype]](), dict[str, AccuracyError]()
    for label, problem in problems.items():
        try:
            pilots[label] = run_pilot(problem)
        except AccuracyError as error:
            shortfalls[label] = error
    if shortfalls:
        return None, shortfalls
    first = next(iter(problems.values()))
    distances, lattices, dtypes = zip(*pilots.values(), strict=True)
    label, largest = max(zip(pilots, lattices, strict=True), key=lambda pilot: pilot[1].xi_max)
    period = max(1 / lattice.spacing for lattice in lattices)
    lattice = lattice_of(largest.xi_max, period, first.accuracy.largest_intervals)
    reasons = (
        f"xi_max {lattice.xi_max:.4g} for truncation, which {label} needs most of {len(pilots)} pilot pairs",
        f"spacing {lattice.spacing:.4g} for aliasing: the surfaces reach over {first.support.widths.max():.4g} units "
        "of length",
    )
    return _choice(lattice, dtype, dtypes, np.min(distances, axis=0), reasons, first, None), {}


def _choice(
    lattice: Lattice,
    dtype: ComplexDtype | None,
    needed: Iterable[ComplexDtype],
    closest: Reals,
    reasons: Iterable[str],
    problem: Problem,
    tail: TailSampling | None,
) -> LatticeChoice:
    """Return a choice in the dtype that was requested, or in single precision where no pair needs more.

    Rounding a value once takes fewer digits than a transform in single precision.
    """
    computed = dtype or ("complex128" if "complex128" in needed else "complex64")
    target = error_target(closest, problem.orders, problem.accuracy, problem.area)
    stored = dtype or ("complex64" if problem.permits_single_storage(lattice, target) else computed)
    at_orders = zip(closest.tolist(), problem.orders, strict=True)
    distances = ", ".join(f"{value:.2g} at order {order:g}" for value, order in at_orders)
    dtypes = computed if stored == computed else f"{computed}, stored as {stored},"
    reason = f"{dtypes} for the smallest distance of a pilot, about {distances}"
    return LatticeChoice(lattice, stored, computed, tuple(closest.tolist()), (*reasons, reason), tail=tail)
