"""Distances beside a threshold, computed as exactly as it takes to tell on which side of it they lie."""

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Literal, Self

import numpy as np

from sobolev_batch.arrays import Complexes
from sobolev_batch.errors import SobolevBatchError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.accuracy.octaves import solve_in_octaves
from sobolev_batch.norms.accuracy.problem import Problem, error_target
from sobolev_batch.norms.accuracy.solve import difference_on, solve
from sobolev_batch.norms.accuracy.tolerance import Accuracy, core_lattice, lattice_of
from sobolev_batch.norms.bounds import area_bounds
from sobolev_batch.norms.budget import outer_windows
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.norms.fields import USUAL_DEGREE, Field, compute_field
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, choose_settings, transform_block
from sobolev_batch.transform.lattice import Lattice, SobolevWeights, shell_sums, shell_volumes
from sobolev_batch.transform.probe import Sample, draws_for

Method = Literal["identical", "lattice", "octaves"]

# Fraction of the threshold that may lie beyond the first lattice, and the relative error of its fields there.
_BEYOND, _FIRST_RTOL = 0.7, 0.2
# M of the first lattice at most, enough for surfaces that differ clearly, and M beyond which octaves are cheaper.
_FIRST_M, _LARGEST_M = 96, 320
# Shortest wavelengths of a lattice in the radius of the smallest surface, at least.
_WAVES = 4.0
_ROUNDS = 4
# Most triangles of two meshes that are clipped before a lattice, which takes 0.1 to 0.5 s: clipping takes 15 to 50 µs a
# triangle where both are one surface cut anew, and ten times that where flat faces also differ.
_MOST_CLIPPED = 10_000
# A distance nearer to the threshold than this fraction of it is left undecided. What errors are brought down to, as a
# fraction of the distance between the two, and the least rtol of octaves, which take long for a small one.
_NARROWEST, _OF_MARGIN, _LEAST_RTOL_OF_OCTAVES = 3e-3, 0.4, 0.01
# Errors of octaves are partly estimates: the law of energies, and random frequencies. Of a hundred verdicts that took
# the side which they permit, two had errors that were too small, by a factor below 2.
_OCTAVES_CAUTION = 3.0
# The rtol of the distance between surfaces that are far apart, which is beyond every threshold.
_APART_RTOL = 0.01
# The prediction of a field's error may be too small by this factor.
_PREDICTION_CAUTION = 4.0
# M, eps and tolerance for the norm of the reference, the relative error that it may have, and that of a second attempt.
_NORM_M, _NORM_EPS, _NORM_RTOL, _EXACT_NORM_RTOL = 40, 1e-3, 0.01, 1e-3


@dataclass(frozen=True)
class Interval:
    """Bounds on a number that is not negative."""

    lower: float
    upper: float

    @classmethod
    def around(cls, value: float, below: float, above: float) -> Self:
        """Return the numbers from ``value - below``, or zero, to ``value + above``."""
        return cls(max(value - below, 0.0), value + above)

    @classmethod
    def of(cls, found: NormEstimate, caution: float = 1.0) -> Self:
        """Return the bounds that the only number of an estimate has by its error, widened by a factor."""
        value, error = float(found.values[0]), caution * float(found.errors[0])
        return cls.around(value, error, error)

    def times(self, factor: float) -> Self:
        """Return the bounds on a multiple."""
        return type(self)(factor * self.lower, factor * self.upper)

    def over(self, divisor: Self) -> Self:
        """Return the bounds on a quotient."""
        return type(self)(self.lower / divisor.upper, self.upper / divisor.lower)


def relative_distance(
    surface: Surface, reference: Surface, order: float, threshold: float, accuracy: Accuracy, threads: int, seed: int
) -> tuple[Interval, Method]:
    """Bound a distance over the norm of its reference closely enough to tell on which side of a threshold it is.

    One lattice decides, or two, where the areas alone bound what lies beyond them; else octaves measure it, at random
    frequencies that follow from the seed. What two meshes of many triangles both cover of flat faces is left out after
    the first lattice, if that leaves the answer open. The memory of the accuracy counts, and its rtol does not. Return
    the bounds, and what they follow from. LatticeError where a surface is too large or too small for any lattice.
    """
    accuracy = replace(accuracy, rtol=_FIRST_RTOL, best_effort=True)
    pair, settings = (surface, reference), ((order,), accuracy, "the relative distance", threads)
    problem, first = Problem.from_surfaces(pair, *settings, most_clipped=_MOST_CLIPPED), None
    if problem.apart is not None:
        return _of_apart(problem, seed)
    of_norm = Problem.from_surfaces([reference], (order,), accuracy, "the norm of the reference", threads)
    known = _Reference(reference.digest if isinstance(reference, Mesh) else reference, order, accuracy, of_norm)
    if not problem.is_clipped:
        # Equal surfaces are known as such in any unit of length, also where lattices fail.
        with suppress(SobolevBatchError):
            norm = _norm_on_lattice(known)[1]
            search = _Search(problem, norm.times(threshold))
            first = search.on_first_lattice() if norm.lower > 0 else None
            if first and search.is_decided(first[1]):
                return first[1].over(norm), "lattice"
        whole, problem = problem, Problem.from_surfaces(pair, *settings)
        first = first if problem.area == whole.area else None
    if not problem.surfaces:
        return Interval(0.0, 0.0), "identical"
    value, norm = _norm_on_lattice(known)
    norm = norm if norm.upper <= (1 + _NORM_RTOL) * value else _exact_norm(known)
    search = _Search(problem, norm.times(threshold))
    bounds, method = search.bounds(seed, first)
    if not search.is_decided(bounds) and (exact := _exact_norm(known)) != norm:
        norm = exact
        bounds, method = _Search(problem, norm.times(threshold)).bounds(seed, first)
    return bounds.over(norm), method


@dataclass(frozen=True, eq=False)
class _Search:
    """A distance to bound, and the range of its threshold: the norm of the reference has an error."""

    problem: Problem
    threshold: Interval

    def bounds(self, seed: int, first: tuple[float, Interval] | None = None) -> tuple[Interval, Method]:
        """Return bounds on the distance, and what they follow from; what the first lattice says may be known."""
        (value, bounds), beyond, rtol = first or self.on_first_lattice(), _BEYOND, _FIRST_RTOL
        largest = min(_LARGEST_M, self.problem.accuracy.largest_intervals)
        for number in range(_ROUNDS):
            if number:
                value, bounds = self._on_lattice(self._lattice(beyond, largest), rtol)
            if self.is_decided(bounds) or self._is_hopeless(value, bounds):
                return bounds, "lattice"
            fraction, margin = value / self.threshold.lower, max(self._margin(value), _NARROWEST)
            # Only what lies beyond the lattice can bring a smaller distance to the threshold.
            beyond = min(beyond, _BEYOND * max(1 - fraction**2, margin) ** 0.5)
            rtol = min(rtol, _OF_MARGIN * margin)
            if 2 * self._frequency(beyond) * self._period > largest:
                break
        return self._in_octaves(seed), "octaves"

    def on_first_lattice(self) -> tuple[float, Interval]:
        most = min(_FIRST_M, self.problem.accuracy.largest_intervals)
        return self._on_lattice(self._lattice(_BEYOND, most), _FIRST_RTOL)

    def _lattice(self, beyond: float, most: int) -> Lattice:
        """Return a lattice beyond which no more can lie than a fraction of the threshold, with an M of at most so many.

        The smallest surface spans some wavelengths of it, since longer ones do not show how many layers it has.
        """
        smallest = min(surface.bounding_sphere[1] for surface in self.problem.surfaces)
        return lattice_of(max(self._frequency(beyond), _WAVES / smallest), self._period, most)

    @cached_property
    def _period(self) -> float:
        """Period of lattices that hold the surfaces and their images apart."""
        return 1 / core_lattice(self.problem.support, self.problem.orders, self.problem.accuracy).spacing

    def _frequency(self, beyond: float) -> float:
        """Return the frequency beyond which no more can lie than a fraction of the threshold."""
        (order,), norm = self.problem.orders, beyond * self.threshold.lower
        bounds = area_bounds(self.problem.area, order)
        return float(min((factor / norm**2) ** (1 / power) for factor, power in bounds))

    def _on_lattice(self, lattice: Lattice, rtol: float) -> tuple[float, Interval]:
        """Return the part of the distance on a lattice, and bounds on all of it."""
        problem = self.problem.with_rtol(rtol)
        target = error_target(np.array([self.threshold.lower]), problem.orders, problem.accuracy, problem.area)
        fields = _fields(problem, lattice, target.tightened(problem.inexact_count))
        found = difference_on(problem, lattice, fields)[0]
        value, error = float(found.values[0]), float((found.aliasing + found.discretisation)[0])
        return value, _with_beyond(problem, value, error, lattice, [field.values for field in fields])

    def _in_octaves(self, seed: int) -> Interval:
        rtol = _FIRST_RTOL
        for _ in range(_ROUNDS):
            accuracy = replace(self.problem.accuracy, rtol=rtol, floor=self.threshold.lower)
            solution = solve_in_octaves(replace(self.problem, accuracy=accuracy), seed)
            bounds = Interval.of(solution.estimate, _OCTAVES_CAUTION)
            rtol = min(rtol / 2, _OF_MARGIN * self._margin(float(solution.estimate.values[0])))
            if self.is_decided(bounds) or rtol < _LEAST_RTOL_OF_OCTAVES or solution.shortfall is not None:
                break
        return bounds

    def is_decided(self, bounds: Interval) -> bool:
        """Tell whether bounds lie on one side of the threshold."""
        return bounds.upper <= self.threshold.lower or bounds.lower > self.threshold.upper

    def _is_hopeless(self, value: float, bounds: Interval) -> bool:
        """Tell whether a closer look at the distance is in vain: it may equal the threshold, within its errors."""
        narrowest = _NARROWEST * self.threshold.lower
        widths = bounds.upper - bounds.lower, self.threshold.upper - self.threshold.lower
        return self._margin(value) < _NARROWEST and (widths[0] < narrowest or widths[1] > narrowest)

    def _margin(self, value: float) -> float:
        """Return how far a distance is from the threshold, relative to it."""
        below, above = self.threshold.lower - value, value - self.threshold.upper
        return max(below, above, 0.0) / self.threshold.lower


def _fields(problem: Problem, lattice: Lattice, target: ErrorTarget) -> tuple[Field, ...]:
    """Return the fields of the surfaces, at the same time, with errors that are predicted to be within a target."""
    draws = draws_for(problem.surfaces, lattice, problem.orders, USUAL_DEGREE)
    dtype = problem.dtype(lattice, target)
    execution = Execution(threads=max(1, problem.threads // len(problem.surfaces)))

    def computed(surface: Surface) -> Field:
        sample, settings = Sample.from_surface(surface, draws), TransformSettings(dtype=dtype)
        # Where the prediction fails, bounds are wider, and the next lattice gets a stricter target.
        settings = choose_settings(surface, lattice, target.tightened(_PREDICTION_CAUTION), settings)
        return compute_field(surface, lattice, settings, problem.orders, execution, sample=sample)

    with ThreadPoolExecutor(len(problem.surfaces)) as pool:
        return tuple(pool.map(computed, problem.surfaces))


def _of_apart(problem: Problem, seed: int) -> tuple[Interval, Method]:
    """Return bounds on the relative distance of surfaces far apart, which exceeds one, and what they follow from."""
    solution = solve(problem.with_rtol(_APART_RTOL), seed)
    caution = _OCTAVES_CAUTION if any(one.remainders for one in solution.alone) else 1.0
    distance, norm = (Interval.of(one.estimate, caution) for one in (solution, solution.alone[1]))
    return distance.over(norm), "lattice" if caution == 1.0 else "octaves"


@dataclass(frozen=True)
class _Reference:
    """A reference, told from others by its digest or, of a closed form, by itself, and by what its norm depends on.

    Searches and suites of tests compare many surfaces with one, whose norm is then computed once in each process.
    """

    identity: object
    order: float
    accuracy: Accuracy
    problem: Problem = field(compare=False)


@lru_cache(maxsize=2)  # references stay in memory
def _norm_on_lattice(reference: _Reference) -> tuple[float, Interval]:
    """Return the part of the norm of a reference on a small lattice, and bounds on all of it."""
    problem, order = reference.problem, reference.order
    (surface,) = problem.surfaces
    core = core_lattice(problem.support, problem.orders, problem.accuracy)
    lattice = lattice_of(core.xi_max, 1 / core.spacing, min(core.M, _NORM_M))
    settings = TransformSettings(_NORM_EPS, "complex64", tolerance=_NORM_EPS)
    field = transform_block(surface, lattice, lattice.half, settings, Execution(threads=problem.threads)).values
    weights = SobolevWeights(lattice, (order,)).per_shell[0]
    value = float(weights @ shell_sums(field, None, lattice, lattice.half)) ** 0.5
    # The rules keep the tolerance at every frequency, and so does the NUFFT.
    error = 2 * _NORM_EPS * surface.area * float(weights @ shell_volumes(lattice)) ** 0.5
    return value, _with_beyond(problem, value, error, lattice, [field])


@lru_cache(maxsize=2)  # references stay in memory
def _exact_norm(reference: _Reference) -> Interval:
    return Interval.of(solve(reference.problem.with_rtol(_EXACT_NORM_RTOL)).estimate)


def _with_beyond(problem: Problem, value: float, error: float, lattice: Lattice, fields: list[Complexes]) -> Interval:
    """Return bounds on a norm by its part on a lattice, all that may lie beyond it, and the fields of its surfaces."""
    (order,) = problem.orders
    windows = outer_windows(SobolevWeights(lattice, problem.orders))
    # One layer has twice its area. The faces of a box have much of it on a few lines of a lattice.
    energy = sum(float((windows @ shell_sums(values, None, lattice, lattice.half)).max()) for values in fields)
    layers = max(energy / (2 * problem.area), 1.0)
    beyond = min(factor * lattice.xi_max**-power for factor, power in area_bounds(problem.area, order, layers))
    highest = math.sqrt(value**2 + beyond)
    return Interval.around(value, error, highest - value + error)
