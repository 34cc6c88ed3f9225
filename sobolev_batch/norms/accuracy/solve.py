"""Norms and distances to an accuracy: predict settings, compute, check the result, tighten where it misses it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import ComplexDtype, Reals
from sobolev_batch.errors import AccuracyError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.accuracy.octaves import solve_in_octaves
from sobolev_batch.norms.accuracy.problem import ESTIMATE_CAUTION, Problem, error_target, only_or_difference, sums_on
from sobolev_batch.norms.accuracy.solution import Solution, SurfaceValues
from sobolev_batch.norms.accuracy.tolerance import LEAST_OF_OCTAVES, Accuracy, first_lattice, lattice_of, refined
from sobolev_batch.norms.bounds import modulus_bound
from sobolev_batch.norms.budget import Sums
from sobolev_batch.norms.estimate import NormEstimate, estimate_norms
from sobolev_batch.norms.fields import Field
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.remainder import LOWEST_ORDER
from sobolev_batch.transform.fourier import ErrorTarget
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.lattice import LARGEST_M, Lattice, SobolevWeights, shell_sums
from sobolev_batch.transform.probe import Sample, estimate

_ROUNDS = 6
# From this rtol on, octaves are cheaper than a larger lattice.
_OCTAVES_FIRST = 1e-3
# What a best effort aims at where more is out of reach, the easiest first.
COARSER = (1e-1, 1e-2, 1e-3, LEAST_OF_OCTAVES)
# Coordinates in double precision may be off by this, in radii, if the origin is some 10⁷ of these away. Of distances as
# small, relative to the norms, the digits are not worth minutes of a best effort.
_OF_COORDINATES = 1e-8
# Below this order what lies beyond a lattice is next to nothing.
_LOW_ORDER = -3.5
# The error of a pair is divided evenly between its two fields.
_PAIR = 2
# Where surfaces that agree on a lattice are compared again, in frequencies of the lattice.
_BEYOND = (4.0, 16.0, 64.0, 256.0)
# Where the areas permit less than this fraction of the allowed truncation, nothing can hide beyond a lattice.
_NEGLIGIBLE = 0.3
# Predicted processor time of random points, at least and for each triangle, and of a sample of a lattice, in seconds.
_POINTS_SECONDS, _TRIANGLE_SECONDS, _SAMPLE_SECONDS = 0.1, 1.2e-5, 4e-7
# M of the largest lattice that takes less time than octaves.
_WIDE_M = 160
# Squared errors of the values on a sparse lattice, as a fraction of the allowed truncation; the order at which these
# fields are computed; and how much too small a sum over so few frequencies may be.
_OF_VALUES, _COARSE_ORDER, _SPARSE_CAUTION = 0.1, -2.0, 2.0
# The least factor by which a lattice grows that shows more.
_LEAST_GROWTH = 1.1
# A pilot has to tell how large distances are, not more. Before an accuracy is refused, a larger one may look further.
_PILOT_RTOL, _LARGER_PILOT_M = 1e-3, 128


@dataclass(frozen=True, eq=False)
class DistanceTarget:
    """Accuracy of the distance between a surface and a reference, for which the surface's field is computed.

    Attributes:
        reference: Sample of the reference; None for the field of the reference itself.
        distances: Smallest distances (orders,) that the reference's own field has to serve.
    """

    orders: tuple[float, ...]
    accuracy: Accuracy
    reference: Sample | None
    distances: tuple[float, ...] = ()

    def error_target(self, surface: Surface) -> ErrorTarget:
        """Return the target for the field of a surface."""
        values = np.array(self.distances)
        if self.reference is not None:
            sample = Sample.from_surface(surface, self.reference.draws)
            values = ESTIMATE_CAUTION * estimate([sample, self.reference], self.orders)
        return error_target(values, self.orders, self.accuracy, surface.area).tightened(_PAIR)


def solve(problem: Problem, seed: int = 0) -> Solution:
    """Compute a norm or a distance to an accuracy.

    Where a small lattice reaches far enough, or the accuracy is high, it is computed on one lattice. Else what lies
    beyond a small lattice is measured in octaves, at random frequencies that follow from the seed. Return the first
    solution that meets the accuracy; for a best effort else the nearest one, which otherwise is an AccuracyError.
    Surfaces that are far apart are solved one by one.
    """
    if not problem.surfaces:
        return Solution.zero(problem.orders, problem.moved)
    if problem.apart is not None:
        return Solution.of_apart(problem.apart, [solve(norm, seed) for norm in problem.alone])
    strict = replace(problem, accuracy=replace(problem.accuracy, best_effort=False))
    first = first_lattice(problem.support, problem.orders, problem.accuracy)
    on_lattices, in_octaves = partial(_solve_on_lattices, strict, *first), partial(solve_in_octaves, strict, seed)
    attempts = [on_lattices]
    seem_equal = bool(_near_duplicates(strict, first[0]).any())
    if seem_equal and _differ_beyond(strict, first[0]):
        # No lattice would show it.
        attempts = [in_octaves]
    elif problem.accuracy.rtol >= LEAST_OF_OCTAVES:
        if prefers_octaves(problem) and not seem_equal:
            attempts = [in_octaves, on_lattices]
        else:
            attempts = [partial(on_lattices, before_octaves=True), in_octaves]
    nearest, refusals = [], []
    for attempt in attempts:
        try:
            solution = attempt()
        except AccuracyError as refusal:
            refusals.append(refusal)
            continue
        if solution.shortfall is None:
            return solution
        nearest.append(solution)
        refusals.append(solution.shortfall)
    if not problem.accuracy.best_effort:
        raise min(refusals, key=attrgetter("reachable"))
    nearest = nearest or [_solve_on_lattices(problem, *first)]
    if min(map(_largest_share, nearest)) > LEAST_OF_OCTAVES and not any(_is_rounding(strict, one) for one in nearest):
        nearest += _in_coarser_octaves(strict, seed)
    return min(nearest, key=_largest_share)


def _is_rounding(problem: Problem, solution: Solution) -> bool:
    """Tell whether a distance is known to be so small that coordinates of double precision alone may be its cause."""
    samples = problem.samples(cast(Lattice, solution.lattice))
    norms = np.max([estimate([sample], problem.orders) for sample in samples], axis=0)
    return bool(np.all(solution.estimate.values + solution.estimate.errors <= _OF_COORDINATES * norms))


def _largest_share(solution: Solution) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.nan_to_num(solution.estimate.errors / solution.estimate.values, nan=np.inf).max())


def _in_coarser_octaves(problem: Problem, seed: int) -> list[Solution]:
    """Return what octaves reach that aim at less than required: aiming too high, they would stop far too early."""
    found = []
    for rtol in (one for one in COARSER if one > problem.accuracy.rtol):
        try:
            solution = solve_in_octaves(problem.with_rtol(rtol), seed)
        except AccuracyError:
            break
        found.append(replace(solution, shortfall=problem.out_of_reach(solution.estimate)))
        if solution.shortfall is not None:
            break
    return found


def prefers_octaves(problem: Problem) -> bool:
    """Tell whether octaves are likely to be cheaper than one lattice that reaches far enough, or are more reliable.

    The tail of flat faces follows no law that a lattice could extrapolate, since they may repeat.
    """
    is_regular = max(problem.orders) < _LOW_ORDER or not FaceNormals.from_surfaces(problem.surfaces)
    if problem.accuracy.rtol < (_OCTAVES_FIRST if is_regular else LEAST_OF_OCTAVES):
        return False
    return not is_regular or first_lattice(problem.support, problem.orders, problem.accuracy)[1]


def _near_duplicates(problem: Problem, lattice: Lattice) -> NDArray[np.bool_]:
    """Tell at which orders exact values differ by no more than rounding, (orders,)."""
    samples = problem.samples(lattice)
    difference = only_or_difference([sample.exact for sample in samples])
    # In a large unit of length a small lattice holds next to nothing of a norm, whatever the difference.
    is_small = float(np.abs(difference).max()) <= problem.rounding
    return is_small & (estimate(samples, problem.orders) <= problem.rounding)


def _differ_beyond(problem: Problem, lattice: Lattice) -> bool:
    """Tell whether surfaces that agree on a lattice differ at higher frequencies, as two shifts of a fine grid do."""
    draws = problem.samples(lattice)[0].draws
    frequencies = np.concatenate([factor * draws.frequencies for factor in _BEYOND])
    difference = only_or_difference([kind_of(surface).exact_values(frequencies) for surface in problem.surfaces])
    # Rounding of coordinates turns the phases at high frequencies.
    phases = 2 * np.pi * problem.support.reach * np.linalg.norm(frequencies, axis=1)
    return bool(np.any(np.abs(difference) > problem.rounding * (1 + phases)))


def _solve_on_lattices(problem: Problem, lattice: Lattice, is_pilot: bool, *, before_octaves: bool = False) -> Solution:
    """Return the first solution that meets the accuracy, else the last one of a few rounds, or an AccuracyError."""
    values = ESTIMATE_CAUTION * estimate(problem.samples(lattice), problem.orders)
    # Their fields may differ by a little more.
    equal = _near_duplicates(problem, lattice)
    for rounds_left in reversed(range(_ROUNDS)):
        problem.require_above_rounding(values)
        accuracy = _of_pilot(problem.accuracy) if is_pilot else problem.accuracy
        target = error_target(values, problem.orders, accuracy, problem.area).tightened(problem.inexact_count)
        solution, sums = _compute(problem, lattice, target)
        values = solution.estimate.values
        has_no_digit = equal | (values <= problem.rounding)
        is_met = bool(np.all(problem.accuracy.met(solution.estimate) | has_no_digit))
        if not is_met and rounds_left:
            step, before = _next_lattice(problem, lattice, sums), (lattice, is_pilot)
            lattice, is_pilot = step
            if step == before and problem.accuracy.best_effort:
                break
        elif not is_met or np.all(has_no_digit):
            break
        else:
            solution, larger = _with_hidden_part(problem, solution, before_octaves)
            is_met = bool(np.all(problem.accuracy.met(solution.estimate) | has_no_digit))
            if is_met or not rounds_left or (larger is None and not is_pilot):
                break
            # The coarse fields of a pilot may have taken what the hidden part needs.
            lattice, is_pilot = larger or lattice, False
    shortfall = None if is_met else problem.out_of_reach(solution.estimate, f"on a lattice of M = {lattice.M}")
    # No error is smaller than rounding where its number is.
    found = solution.estimate
    rounding = np.where(found.values <= problem.rounding, problem.rounding, 0.0)
    found = replace(found, discretisation=np.maximum(found.discretisation, rounding))
    return replace(solution, estimate=found, shortfall=shortfall)


def _with_hidden_part(problem: Problem, solution: Solution, before_octaves: bool) -> tuple[Solution, Lattice | None]:
    """Return a solution on a lattice with the error by all that may lie beyond it, and a lattice that shows more of it.

    The law of growth extrapolates, and sees no period that begins beyond the lattice. What lies there is less than the
    areas permit. Where that is too much, it follows from close points, drawn at random. Octaves may follow, and be
    cheaper than a larger lattice. There may be no lattice that is likely to show enough.
    """
    found, lattice, orders = solution.estimate, cast(Lattice, solution.lattice), np.array(problem.orders)
    parts = problem.accuracy.truncation_parts(problem.orders)
    allowed = np.maximum(parts * problem.accuracy.scale(found.values), problem.rounding)

    def with_part(squares: Reals) -> Solution:
        truncation = np.maximum(np.sqrt(found.values**2 + squares) - found.values, found.truncation)
        return replace(solution, estimate=replace(found, truncation=truncation))

    def permitted(fraction: float) -> Reals:
        return np.asarray((found.values + fraction * allowed) ** 2 - found.values**2)

    def needed(squares: Reals, enough: Reals, powers: Reals) -> float:
        """Return the frequency beyond which squares that fall by some powers are small enough."""
        with np.errstate(over="ignore"):
            factors = (squares / enough) ** (1 / powers)
        return max(float(factors.max()), _LEAST_GROWTH) * lattice.xi_max

    largest, period = problem.accuracy.largest_intervals, 1 / lattice.spacing
    powers, has_digit = -2 * orders - 1, found.values > problem.rounding
    certain = np.where(has_digit, modulus_bound(problem.area, orders, lattice.xi_max), 0.0)
    if np.all(certain <= permitted(_NEGLIGIBLE)):
        return with_part(certain), None
    if np.all(np.isfinite(certain)):
        farther, quick = needed(certain, permitted(_NEGLIGIBLE), powers - 2), min(_quick_intervals(problem), largest)
        # The largest spacing on which surfaces fit and no peak is missed: squares have twice the bandwidth.
        room = max(2 * float(problem.support.widths.max()), problem.support.least_period)
        sparse = lattice_of(farther, room, LARGEST_M)
        if quick >= sparse.M:
            bound = _bound_up_to(problem, lattice, sparse, permitted(_OF_VALUES))
            bound += modulus_bound(problem.area, orders, sparse.xi_max)
            if np.all(np.where(has_digit, bound, 0.0) <= permitted(1.0)):
                return with_part(np.minimum(bound, certain)), None
        if 2 * farther * period <= quick:
            return with_part(certain), lattice_of(farther, period, largest)
    hidden, error = _beyond_lattice(problem, solution)
    bound = np.minimum(np.maximum(hidden, 0.0) + error, certain)
    if before_octaves:
        law = (found.values + found.truncation) ** 2 - found.values**2
        if np.any(has_digit & (hidden - error > law)):
            return with_part(bound), None
        largest = min(_WIDE_M, largest)
    farther = needed(bound, permitted(0.5), powers)
    return with_part(bound), lattice_of(farther, period, largest) if 2 * farther * period <= largest else None


def _bound_up_to(problem: Problem, lattice: Lattice, sparse: Lattice, squared_errors: Reals) -> Reals:
    """Return a bound on the squared norm (orders,) between a lattice and the end of a sparse one, measured there.

    Only these frequencies count, so coarse fields will do: their squared errors (orders,) may be larger.
    """
    # Beyond the lattice no weight of an order exceeds that of a higher one times this factor.
    orders, highest_order = np.array(problem.orders), max(_COARSE_ORDER, *problem.orders)
    factors = (1 + lattice.xi_max**2) ** (orders - highest_order)
    target = ErrorTarget((highest_order,), (float(np.sqrt(squared_errors / factors).min()),))
    fields = problem.fields(sparse, target.tightened(problem.inexact_count))
    beyond = only_or_difference([field.values for field in fields]).copy()
    beyond[np.ix_(*(np.abs(axis) <= lattice.xi_max for axis in sparse.axes))] = 0
    squares = SobolevWeights(sparse, problem.orders).per_shell @ shell_sums(beyond, None, sparse, sparse.half)
    coarse = SobolevWeights(sparse, (highest_order,))
    errors = np.sqrt(factors) * sum(float(field.quality.probe.norms(coarse)[0]) for field in fields)
    return np.asarray(_SPARSE_CAUTION * (np.sqrt(squares) + errors) ** 2)


def _quick_intervals(problem: Problem) -> int:
    """Return the M of the largest lattice that takes less time than random points."""
    triangles = sum(len(surface.triangles) for surface in problem.surfaces if isinstance(surface, Mesh))
    return int((2 * max(_POINTS_SECONDS, triangles * _TRIANGLE_SECONDS) / _SAMPLE_SECONDS) ** (1 / 3))


def _beyond_lattice(problem: Problem, solution: Solution) -> tuple[Reals, Reals]:
    """Return the squared norm beyond a solution's lattice (orders,) from close points, and how far off it may be."""
    lattice, fields = cast(Lattice, solution.lattice), [values.field for values in solution.values]
    difference = only_or_difference([field.values for field in fields])
    known = tuple(max(order, LOWEST_ORDER) for order in problem.orders)
    # What the lattice shows of the range in which the step falls.
    shown = SobolevWeights(lattice, known).per_shell - SobolevWeights(lattice, known, lattice.xi_max).per_shell
    shells = shell_sums(difference, None, lattice, lattice.half)
    values, errors = replace(problem, orders=known).beyond(lattice.xi_max).at(known)
    # No frequency beyond the lattice weighs more than this at lower orders.
    factors = (1 + lattice.xi_max**2) ** (np.array(problem.orders) - known)
    return factors * (values - shown @ shells), factors * errors


def run_pilot(problem: Problem) -> tuple[Reals, Lattice, ComplexDtype]:
    """Return rough distances (orders,) of a pair, and lattice and dtype that its accuracy needs, or AccuracyError."""
    lattice, is_pilot = first_lattice(problem.support, problem.orders, problem.accuracy)[0], True
    while is_pilot:
        values = estimate(problem.samples(lattice), problem.orders)
        target = error_target(values, problem.orders, _of_pilot(problem.accuracy), problem.area).tightened(_PAIR)
        solution, sums = _compute(problem, lattice, target, "complex128")
        values = solution.estimate.values
        problem.require_above_rounding(values)
        lattice, is_pilot = _next_lattice(problem, lattice, sums)
    target = error_target(values, problem.orders, problem.accuracy, problem.area).tightened(_PAIR)
    for rounds_left in reversed(range(_ROUNDS)):
        dtype = problem.dtype(lattice, target)
        solution, _ = _compute(problem, lattice, target, dtype)
        solution, larger = _with_hidden_part(problem, solution, problem.accuracy.rtol >= LEAST_OF_OCTAVES)
        allowed = problem.accuracy.rtol * problem.accuracy.scale(values)
        if np.all(solution.estimate.truncation <= allowed) or problem.accuracy.best_effort:
            break
        if larger is None or not rounds_left:
            raise problem.out_of_reach(solution.estimate, f"on a lattice of M = {lattice.M}")
        lattice = larger
    return values, lattice, dtype


def _next_lattice(problem: Problem, lattice: Lattice, sums: Sums) -> tuple[Lattice, bool]:
    """Return the lattice that the sums on a lattice call for, and False; or that of a larger pilot, and True."""
    weights = SobolevWeights(lattice, problem.orders)
    try:
        return refined(sums, weights, problem.support, problem.accuracy, problem.label), False
    except AccuracyError:
        intervals = min(_LARGER_PILOT_M, problem.accuracy.largest_intervals)
        if intervals <= lattice.M:
            raise
        return Lattice(intervals * lattice.spacing / 2, intervals), True


def _compute(
    problem: Problem, lattice: Lattice, target: ErrorTarget, dtype: ComplexDtype | None = None
) -> tuple[Solution, Sums]:
    """Compute the norm or distance on a lattice, from fields with an error within a target; see `Problem.fields`."""
    problem.notify(f"{problem.label}: a lattice of M = {lattice.M}")
    fields = problem.fields(lattice, target, dtype)
    found, sums = difference_on(problem, lattice, fields)
    return Solution(found, lattice, tuple(map(SurfaceValues, fields))), sums


def difference_on(problem: Problem, lattice: Lattice, fields: Sequence[Field]) -> tuple[NormEstimate, Sums]:
    """Return the norm of the only field, or of the difference of two, and the sums that it follows from."""
    weights = SobolevWeights(lattice, problem.orders)
    sums, errors = sums_on(problem, fields, weights)
    return estimate_norms(sums, weights, problem.support, errors), sums


def _of_pilot(accuracy: Accuracy) -> Accuracy:
    return replace(accuracy, rtol=max(accuracy.rtol, _PILOT_RTOL))
