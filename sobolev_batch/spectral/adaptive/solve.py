"""Norms and distances to an accuracy: predict settings, compute, check the result, tighten where it falls short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import AccuracyError
from sobolev_batch.spectral.adaptive.lattice_selection import first_lattice, larger_pilot, refined
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.errors.a_priori import ErrorTarget, permits_single
from sobolev_batch.spectral.errors.budget import NormEstimate, Sums, Support, estimate_norms, sums_of_shells
from sobolev_batch.spectral.errors.samples import Sample, draws_for, estimate, needs_probe
from sobolev_batch.spectral.fields import USUAL_DEGREE, Field, field_for
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import SobolevWeights, shell_sums
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]
Samples = tuple[Sample, ...]

_ROUNDS = 4
# A distance is first estimated from a few frequencies; it is seldom less than this fraction of the estimate.
_ESTIMATE_CAUTION = 0.7
# The error of a pair is divided evenly between its two fields.
_PAIR = 2
# No field is exact to less than this fraction of its area. Near-duplicates are that close, and have no
# relative accuracy.
_ROUNDING = 1e-13
# Surfaces whose common centre is no further from the origin, relative to their extent, stay where they are.
_OFF_CENTER = 1e-3
# A pilot has to tell how large distances are, not more.
_PILOT_RTOL = 1e-3


@dataclass(frozen=True, eq=False)
class Problem:
    """A norm of a surface, or a distance of two, and the accuracy to compute it to.

    Attributes:
        surfaces: One surface, or two.
        orders: Orders s.
        accuracy: Accuracy of the norm or distance.
        support: Area of the surfaces together, and sizes of all surfaces that share the lattice.
        label: Name of the norm or distance in messages.
        threads: Threads to compute with.
    """

    surfaces: Sequence[Surface]
    orders: tuple[float, ...]
    accuracy: Accuracy
    support: Support
    label: str
    threads: int = 1

    @classmethod
    def of(
        cls, surfaces: Sequence[Surface], orders: tuple[float, ...], accuracy: Accuracy, label: str, threads: int
    ) -> Self:
        """Return the problem for surfaces alone, moved together to the centre of the lattice's period."""
        surfaces = _centered(surfaces)
        extent = Extent.union([surface.extent for surface in surfaces])
        area = np.array(sum(surface.area for surface in surfaces))
        return cls(surfaces, orders, accuracy, Support(area, extent.widths, extent.reach), label, threads)

    @property
    def area(self) -> float:
        """Area of the surfaces together."""
        return float(self.support.areas)

    @property
    def rounding(self) -> float:
        """Smallest norm that differs from zero by more than rounding."""
        return _ROUNDING * self.area

    def samples(self, lattice: Lattice) -> Samples:
        """Return samples of all surfaces at the same frequencies."""
        draws = draws_for(self.surfaces, lattice, self.orders, USUAL_DEGREE)
        return tuple(Sample.of(surface, draws) for surface in self.surfaces)

    def dtype(self, lattice: Lattice, target: ErrorTarget) -> ComplexDtype:
        """Return the cheapest dtype that meets a target."""
        single = all(permits_single(surface, lattice, target) for surface in self.surfaces)
        return "complex64" if single else "complex128"

    def require_above_rounding(self, values: Reals) -> None:
        """Refuse an accuracy of norms or distances (orders,) that lies below the rounding of fields.

        Raises:
            AccuracyError: The accuracy lies below rounding; the message gives the reachable rtol.
        """
        parts, floor = _discretisation_parts(self.orders, self.accuracy), self.rounding
        # A distance of no more than rounding is that of near-duplicates, and has no relative accuracy.
        below = (parts * values < floor) & (values > floor)
        if below.any():
            worst = int(np.argmax(below * floor / (parts * np.maximum(values, floor))))
            rtol = self.accuracy.rtol
            reachable = 2 * rtol * floor / float(parts[worst] * values[worst])
            raise AccuracyError(
                f"{self.label}: rtol {rtol:g} of about {values[worst]:.2g} at order {self.orders[worst]:g} is below "
                f"the rounding of double precision; about {reachable:.1g} can be reached",
                rtol,
                reachable,
            )


@dataclass(frozen=True, eq=False)
class Solution:
    """Norms or distances on one lattice.

    Attributes:
        estimate: Numbers with their errors, each (orders,).
        lattice: Lattice of the fields.
        fields: Fields of the surfaces.
        sums: Sums of the difference of the fields.
    """

    estimate: NormEstimate
    lattice: Lattice
    fields: tuple[Field, ...]
    sums: Sums


@dataclass(frozen=True, eq=False)
class Pilot:
    """Requirements of a pair of surfaces.

    Attributes:
        values: Rough distances (orders,).
        lattice: Lattice that the accuracy needs.
        single: True if single precision suffices.
    """

    values: Reals
    lattice: Lattice
    single: bool


@dataclass(frozen=True, eq=False)
class DistanceTarget:
    """Accuracy of the distance between a surface and a reference, for which the surface's field is computed.

    Attributes:
        orders: Orders s.
        accuracy: Accuracy of the distance.
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
            sample = Sample.of(surface, self.reference.draws)
            values = _ESTIMATE_CAUTION * estimate([sample, self.reference], self.orders)
        return error_target(values, self.orders, self.accuracy, surface.area).tightened(_PAIR)


@dataclass(frozen=True)
class _Step:
    """A lattice to compute on, and True if it is a small one that only shows how large distances are."""

    lattice: Lattice
    is_pilot: bool


def solve(problem: Problem) -> Solution:
    """Compute a norm or a distance to an accuracy.

    Returns:
        The solution of the first of a few rounds that meets the accuracy, or of the last.

    Raises:
        AccuracyError: A pilot shows that the accuracy cannot be met within the memory.
    """
    inexact = max(1, sum(needs_probe(surface, TransformSettings()) for surface in problem.surfaces))
    step = _first_step(problem)
    values: Reals | None = None
    for rounds_left in reversed(range(_ROUNDS)):
        samples = problem.samples(step.lattice)
        if values is None:
            values = _ESTIMATE_CAUTION * estimate(samples, problem.orders)
        problem.require_above_rounding(values)
        accuracy = _of_pilot(problem.accuracy) if step.is_pilot else problem.accuracy
        target = error_target(values, problem.orders, accuracy, problem.area).tightened(inexact)
        solution = _compute(problem, step.lattice, samples, target, problem.dtype(step.lattice, target))
        values = solution.estimate.values
        near_duplicates = values <= problem.rounding
        if not rounds_left or np.all(problem.accuracy.met(solution.estimate) | near_duplicates):
            break
        step = _next_step(problem, step, solution.sums)
    return solution


def run_pilot(problem: Problem) -> Pilot:
    """Find out on a small lattice what a pair of surfaces needs for an accuracy.

    Raises:
        AccuracyError: The accuracy cannot be met within the memory.
    """
    step = _first_step(problem)
    while True:
        samples = problem.samples(step.lattice)
        values = estimate(samples, problem.orders)
        target = error_target(values, problem.orders, _of_pilot(problem.accuracy), problem.area).tightened(_PAIR)
        solution = _compute(problem, step.lattice, samples, target, "complex128")
        values = solution.estimate.values
        problem.require_above_rounding(values)
        step = _next_step(problem, step, solution.sums)
        if not step.is_pilot:
            break
    target = error_target(values, problem.orders, problem.accuracy, problem.area).tightened(_PAIR)
    return Pilot(values, step.lattice, problem.dtype(step.lattice, target) == "complex64")


def _first_step(problem: Problem) -> _Step:
    return _Step(*first_lattice(problem.support, problem.orders, problem.accuracy))


def _next_step(problem: Problem, step: _Step, sums: Sums) -> _Step:
    """Return the step on the lattice that the sums of a step call for, or on a larger pilot's."""
    weights = SobolevWeights(step.lattice, problem.orders)
    try:
        lattice = refined(sums, weights, problem.support, problem.accuracy, problem.label)
    except AccuracyError:
        larger = larger_pilot(step.lattice, problem.accuracy) if step.is_pilot else None
        if larger is None:
            raise
        return _Step(larger, is_pilot=True)
    return _Step(lattice, is_pilot=False)


def _compute(
    problem: Problem, lattice: Lattice, samples: Samples, target: ErrorTarget, dtype: ComplexDtype
) -> Solution:
    """Compute the norm or distance on a lattice, from fields with an error within a target."""
    settings, execution = TransformSettings(dtype=dtype), Execution(threads=problem.threads)
    fields = tuple(
        field_for(surface, lattice, target, settings, execution, sample=sample)
        for surface, sample in zip(problem.surfaces, samples, strict=True)
    )
    weights = SobolevWeights(lattice, problem.orders)
    difference = fields[0].values if len(fields) == 1 else fields[0].values - fields[1].values
    sums = sums_of_shells(shell_sums(difference, None, lattice, lattice.half), weights)
    errors = np.sum([field.quality.probe.norms(weights) for field in fields], axis=0)
    return Solution(estimate_norms(sums, weights, problem.support, errors), lattice, fields, sums)


def _centered(surfaces: Sequence[Surface]) -> Sequence[Surface]:
    """Return the surfaces moved together to the centre of a lattice's period, which changes no distance."""
    lowest, highest = Extent.union([surface.extent for surface in surfaces]).box
    if np.all(np.abs(lowest + highest) <= _OFF_CENTER * (highest - lowest).max()):
        return surfaces
    x, y, z = ((lowest + highest) / 2).tolist()
    move = Similarity(1.0, (x, y, z))
    return [move.apply(surface) for surface in surfaces]


def error_target(values: Reals, orders: tuple[float, ...], accuracy: Accuracy, area: float) -> ErrorTarget:
    """Return the target of both fields of a pair together at these distances (orders,): never below rounding."""
    errors = np.maximum(_discretisation_parts(orders, accuracy) * values, _ROUNDING * area)
    return ErrorTarget(orders, tuple(errors.tolist()))


def _discretisation_parts(orders: Sequence[float], accuracy: Accuracy) -> Reals:
    return np.array([accuracy.discretisation_part(order) for order in orders])


def _of_pilot(accuracy: Accuracy) -> Accuracy:
    return replace(accuracy, rtol=max(accuracy.rtol, _PILOT_RTOL))
