"""Lattice and dtype of a study's fields: given, or chosen for the accuracy that it requests.

A few surfaces of the study, the pilots, are compared with the reference. The most demanding of these pairs decides.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import AccuracyError, MeshError, StudyError, one_line
from sobolev_batch.geometry.surface import Extent, Similarity, Surface
from sobolev_batch.machine import available_cores
from sobolev_batch.norms.accuracy.octaves import solve_in_octaves
from sobolev_batch.norms.accuracy.problem import ESTIMATE_CAUTION, Problem, error_target
from sobolev_batch.norms.accuracy.solve import coarser_than, permits_octaves, prefers_octaves, run_pilot
from sobolev_batch.norms.accuracy.tolerance import FINER_LATTICE, Accuracy, core_lattice, good_intervals, lattice_of
from sobolev_batch.norms.budget import NormEstimate, Support
from sobolev_batch.norms.tail.sampling import FaceNormals, OctaveSampling, TailSampling
from sobolev_batch.sources.registry import Member
from sobolev_batch.study.schema import MOST_OCTAVES
from sobolev_batch.study.study import Members, Study
from sobolev_batch.transform.backends import ComplexDtype
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.transform.probe import estimate

_log = logging.getLogger(__name__)

# Largest factor by which a lattice grows at a time.
_LARGEST_GROWTH = 2.0
# Fractions of the accuracy above which the statistical error, and that beyond the last octave, are lessened.
_STATISTICAL_PART, _TRUNCATION_PART = 0.4, 0.4
# Factors by which samples of octaves multiply at a time.
_LEAST_REFINEMENT, _LARGEST_REFINEMENT = 1.5, 8.0
# Most samples of a mesh; their values take 160 MB in double precision.
_MOST_SAMPLES = 10_000_000

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

_DTYPES = ("dtype", "transform_dtype")

# The pair of each pilot with the reference, by label. All have the same orders, accuracy and sizes.
_Problems = Mapping[str, Problem]


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
    """

    lattice: Lattice
    dtype: ComplexDtype
    transform_dtype: ComplexDtype
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
        others = {name: getattr(self, name) for name in (*_DTYPES, "closest", "reasons", "basis")}
        return {"xi_max": self.lattice.xi_max, "M": self.lattice.M, **others}

    @classmethod
    def from_table(cls, table: Mapping[str, Any], octaves: Mapping[str, Any] | None) -> Self:
        """Return the choice that a table holds, with its `octaves`."""
        lattice = Lattice(table["xi_max"], table["M"])
        tail = None if octaves is None else TailSampling.from_table(octaves)
        dtype, transform_dtype = (table[name] for name in _DTYPES)
        closest, reasons = tuple(table["closest"]), tuple(table["reasons"])
        return cls(lattice, dtype, transform_dtype, closest, reasons, table["basis"], tail)

    def grown(self, distances: NormEstimate, orders: Sequence[float], accuracy: Accuracy) -> LatticeChoice | None:
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
        if self.tail is None:
            more = _larger_lattice(self.lattice, truncation, aliasing, orders, accuracy)
            before = f"xi_max {self.lattice.xi_max:.4g}, M {self.lattice.M}"
        else:
            more = _finer_octaves(
                self.lattice, self.tail, truncation.max(), aliasing.max(), statistical.max(), accuracy
            )
            before = f"{len(self.tail.octaves)} octaves with {self.tail.size:,} samples"
        if more is None:
            return None
        reason = f"grown from {before}, whose errors were too large"
        return replace(self, lattice=more[0], tail=more[1], reasons=(*self.reasons, reason))


# More frequencies: a lattice, and octaves if there were any; None where more do not help or do not fit.
_More = tuple[Lattice, TailSampling | None] | None


def _larger_lattice(
    lattice: Lattice, truncation: Reals, aliasing: Reals, orders: Sequence[float], accuracy: Accuracy
) -> _More:
    """Return a larger or finer lattice for errors (orders,) relative to distances."""
    highest, period = lattice.xi_max, 1 / lattice.spacing
    tails, folded = truncation / accuracy.truncation_parts(orders), aliasing / accuracy.aliasing_part
    for order, tail, images in zip(orders, tails.tolist(), folded.tolist(), strict=True):
        if tail > 1 and order < -1.5:
            # The squared norm beyond ξ_max of two near surfaces falls like its power 2s + 3.
            growth = min(tail ** (1 / (-2 * order - 3)) * 1.02, _LARGEST_GROWTH)
            highest = max(highest, lattice.xi_max * growth)
        if images > 1:
            period = max(period, 1 / lattice.spacing + math.log(images) / (2 * math.pi) * 1.1)
    is_same = (highest, period) == (lattice.xi_max, 1 / lattice.spacing)
    if is_same or 2 * highest * period > accuracy.largest_intervals:
        return None
    return lattice_of(highest, period, accuracy.largest_intervals), None


def _finer_octaves(
    lattice: Lattice, tail: TailSampling, truncation: float, aliasing: float, statistical: float, accuracy: Accuracy
) -> _More:
    """Return a finer lattice and more octaves or samples for errors relative to distances."""
    factor, chance = 1.0, float(statistical) / accuracy.rtol
    if chance > _STATISTICAL_PART:
        factor = min(max((chance / _STATISTICAL_PART) ** 2, _LEAST_REFINEMENT), _LARGEST_REFINEMENT)
    more_octaves = int(truncation / accuracy.rtol > _TRUNCATION_PART)
    intervals = good_intervals(FINER_LATTICE * lattice.M) if aliasing > accuracy.aliasing_part else lattice.M
    is_too_much = intervals > accuracy.largest_intervals or len(tail.octaves) + more_octaves > MOST_OCTAVES
    if is_too_much or (factor, more_octaves, intervals) == (1.0, 0, lattice.M):
        return None
    # Another seed than that of the samples before.
    refined = tail.refined(factor, more_octaves, accuracy.largest_intervals, seed=tail.size)
    return (Lattice(lattice.xi_max, intervals), refined) if refined.size <= _MOST_SAMPLES else None


def choice_basis(study: Study, accuracy: Accuracy, similarity: Similarity, reference: Mapping[str, Any]) -> str:
    """Return a digest of the data that the choice for a study is made from, except families, which may gain meshes."""
    data = {
        "accuracy": [accuracy.rtol, float(accuracy.allowed_bytes), accuracy.best_effort],
        "orders": study.orders,
        "dtype": study.dtype,
        "similarity": [similarity.scale, *similarity.origin],
        "reference": dict(reference),
    }
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Look:
    """What loading some surfaces of a study has shown, by their labels.

    Attributes:
        extents: Extents in the study's unit of length.
        set_aside: Reasons why others cannot be compared with the reference.
    """

    extents: Mapping[str, Extent] = field(default_factory=dict)
    set_aside: Mapping[str, str] = field(default_factory=dict)


def look_at_extents(members: Members, similarity: Similarity, reference: Extent) -> Look:
    """Look at quickly loaded surfaces, as memory permits."""
    extents: dict[str, Extent] = {}
    set_aside: dict[str, str] = {}
    left = _MOST_BYTES
    for label, (_, member) in members.items():
        if not member.is_quickly_loaded:
            continue
        left -= member.expected_size().projected_bytes
        if left < 0:
            break
        try:
            extents[label] = _comparable(member, similarity, reference).extent
        except Exception as error:  # its source may raise anything
            set_aside[label] = one_line(error)
    return Look(extents, set_aside)


def choose_pilots(
    members: Members, similarity: Similarity, reference: Extent
) -> tuple[dict[str, Surface], dict[str, str]]:
    """Return the coarsest and finest surface of a few families, and why others cannot be compared, by label."""
    families: dict[str, list[str]] = {}
    for label, (family, _) in members.items():
        families.setdefault(family, []).append(label)

    def fineness(label: str) -> tuple[int, int]:
        _, member = members[label]
        return member.level, 0 if member.level >= 0 else member.expected_size().triangles

    pilots: dict[str, Surface] = {}
    set_aside: dict[str, str] = {}
    for labels in list(families.values())[:_MOST_FAMILIES]:
        labels.sort(key=fineness)
        for candidates in (labels, labels[::-1]):
            for label in candidates:
                member = members[label][1]
                if label in set_aside or member.expected_size().projected_bytes > _MOST_BYTES:
                    continue
                try:
                    if label not in pilots:
                        pilots[label] = _comparable(member, similarity, reference)
                    break
                except Exception as error:
                    set_aside[label] = one_line(error)
    return pilots, set_aside


def _comparable(member: Member, similarity: Similarity, reference: Extent) -> Surface:
    """Return a surface in the study's unit, unless it reaches much farther than the reference."""
    surface = similarity.apply(member.load())
    times = surface.extent.reach / reference.reach
    if times > _FARTHEST:
        raise MeshError(f"its extent is {times:.3g} times that of the reference; are both in the same unit?")
    return surface


def choose_lattice(
    study: Study, accuracy: Accuracy, similarity: Similarity, reference: Surface, members: Members
) -> tuple[LatticeChoice, Look]:
    """Choose lattice, octaves and dtype for the accuracy that a study requests; return also what was seen for it.

    The coarsest and the finest member of each family are compared with the reference on a small lattice. Where one
    lattice would be large, octaves follow a small one. Surfaces that cannot be read, or reach much farther than the
    reference, have no say. For a best effort, neither have pairs that cannot have the accuracy, as long as others can.
    AccuracyError where it is out of reach, and StudyError where no pilot could be made.
    """
    pilots, set_aside = choose_pilots(members, similarity, reference.extent)
    others = {label: member for label, member in members.items() if label not in {*pilots, *set_aside}}
    look = look_at_extents(others, similarity, reference.extent)
    of_pilots = {label: pilot.extent for label, pilot in pilots.items()}
    look = Look({**of_pilots, **look.extents}, {**set_aside, **look.set_aside})
    for label, reason in look.set_aside.items():
        _log.warning("%s has no say in the choice of the lattice: %s", label, reason)
    if not pilots:
        examples = [f"{label}: {reason}" for label, reason in look.set_aside.items()]
        raise StudyError(
            "none of the study's surfaces can serve to choose a lattice"
            + (f" ({examples[0]})" if examples else ", since all are too large")
            + "; see what is wrong with them, or give a [lattice] instead of an [accuracy]"
        )
    extent = Extent.union([reference.extent, *look.extents.values()])
    widths, reach = _REACH_MARGIN * extent.widths, _REACH_MARGIN * extent.reach
    problems = {
        label: Problem(
            (surface, reference),
            study.orders,
            replace(accuracy, best_effort=False),
            Support(np.array(surface.area + reference.area), widths, reach),
            label,
            available_cores(),
        )
        for label, surface in pilots.items()
    }
    if not accuracy.best_effort:
        choice, shortfalls = _best(problems, study.dtype)
        if choice is None or shortfalls:
            raise _worst(shortfalls)
        return choice, look
    choice, short = _best_for_most(problems, study.dtype)
    notes = [f"{label} will miss rtol {accuracy.rtol:g}" for label in short if choice is not None]
    if choice is None:
        # Fewer digits of all of them, from the easiest on.
        for rtol in coarser_than(accuracy.rtol):
            aimed, _ = _best_for_most(_with_accuracy(problems, rtol=rtol), study.dtype)
            if aimed is None:
                break
            choice, notes = aimed, [f"all miss rtol {accuracy.rtol:g}; this is for {rtol:g}"]
    if choice is None:
        # The largest lattice that a pair may need and the memory permits.
        choice, shortfalls = _on_one_lattice(_with_accuracy(problems, best_effort=True), study.dtype)
    if choice is None:
        raise _worst(shortfalls)
    return replace(choice, reasons=(*choice.reasons, *notes)), look


# A choice, if there is one for any pair, and why each pair misses the accuracy that does, by the label of its surface.
_Outcome = tuple[LatticeChoice | None, Mapping[str, AccuracyError]]


def _worst(shortfalls: Mapping[str, AccuracyError]) -> AccuracyError:
    """Return why the pair that needs the largest rtol misses its accuracy."""
    return max(shortfalls.values(), key=lambda shortfall: shortfall.reachable)


def _with_accuracy(problems: _Problems, **changes: Any) -> _Problems:
    return {
        label: replace(problem, accuracy=replace(problem.accuracy, **changes)) for label, problem in problems.items()
    }


def _best(problems: _Problems, dtype: ComplexDtype | None) -> _Outcome:
    """Return the first choice that is enough for all pairs, else the most accurate attainable one."""
    first = next(iter(problems.values()))
    lattice = core_lattice(first.support, first.orders, first.accuracy)
    estimates = {label: estimate(problem.samples(lattice), first.orders) for label, problem in problems.items()}
    # Near-duplicates have no relative accuracy.
    distances = {label: values for label, values in estimates.items() if np.all(values > problems[label].rounding)}
    ways = [partial(_on_one_lattice, problems, dtype)]
    if distances and permits_octaves(first.accuracy):
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
        problems = {label: problem for label, problem in problems.items() if label not in shortfalls}
        if not problems:
            break
    return None, short


def _in_octaves(problems: _Problems, dtype: ComplexDtype | None, distances: Mapping[str, Reals]) -> _Outcome:
    """Choose a small lattice and the octaves beyond it, from the pairs with the smallest distances (orders,)."""
    first = next(iter(problems.values()))
    closest = ESTIMATE_CAUTION * np.min(list(distances.values()), axis=0)
    demanding = dict.fromkeys(
        min(distances, key=lambda label: distances[label][order]) for order in range(len(first.orders))
    )
    lattices: dict[str, Lattice] = {}
    samplings: list[list[OctaveSampling]] = []
    shortfalls: dict[str, AccuracyError] = {}
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
            f"{len(tail.octaves)} octaves up to |xi| {tail.highest_frequency:.4g} for the tail, from the closest of "
            f"{len(problems)} pilot pairs: {', '.join(lattices)}"
        )
    return _choice(lattice, dtype, dtypes, closest, reasons, first, tail if tail.octaves else None), shortfalls


def _on_one_lattice(problems: _Problems, dtype: ComplexDtype | None) -> _Outcome:
    """Choose a lattice that reaches far enough for every pair."""
    pilots: dict[str, tuple[Reals, Lattice, ComplexDtype]] = {}
    shortfalls: dict[str, AccuracyError] = {}
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
    distances = ", ".join(
        f"{value:.2g} at order {order:g}" for value, order in zip(closest.tolist(), problem.orders, strict=True)
    )
    dtypes = computed if stored == computed else f"{computed}, stored as {stored},"
    reason = f"{dtypes} for the smallest distance of a pilot, about {distances}"
    return LatticeChoice(lattice, stored, computed, tuple(closest.tolist()), (*reasons, reason), tail=tail)
