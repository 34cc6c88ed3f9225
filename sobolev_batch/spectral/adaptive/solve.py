"""Computing until an accuracy is met: settings from forecasts, results checked, what falls short tightened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import AccuracyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy, first_lattice, larger_pilot, refined
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.errors.a_priori import Goal, permits_single
from sobolev_batch.spectral.errors.budget import NormEstimate, Sums, estimate_norms, sums_of_shells
from sobolev_batch.spectral.errors.samples import Sample, draws_for, estimate
from sobolev_batch.spectral.fields import USUAL_DEGREE, Field, field_for
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import shell_sums
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]

_ROUNDS = 4
# A distance is first estimated from a few frequencies; it is seldom less than this part of that.
_ESTIMATE_CAUTION = 0.7
# The surfaces of a pair have equal parts in what both fields may err.
_PAIR = 2
# No field is exact to less than this part of its area. Twins are that close: no relative accuracy is theirs.
_ROUNDING = 1e-13
# Surfaces whose common centre is no further from the origin, relative to their extent, stay where they are.
_OFF_CENTER = 1e-3
# A pilot has to tell how large distances are, not more.
_PILOT_RTOL = 1e-3


@dataclass(frozen=True, eq=False)
class Found:
    """Norms or distances that were computed for an accuracy.

    Attributes:
        assessed: the numbers, each (orders,).
        lattice: the last one used.
        fields: of the surfaces, on that lattice.
        sums: of the difference of the fields.
    """

    assessed: NormEstimate
    lattice: Lattice
    fields: tuple[Field, ...]
    sums: Sums


def pursue(
    surfaces: Sequence[Surface],
    orders: Sequence[float],
    accuracy: Accuracy,
    *,
    threads: int = 1,
    what: str = "the distance",
) -> Found:
    """The norm of a surface, or the distance of two, to an accuracy.

    Args:
        surfaces: one or two.
        orders: s, each.
        accuracy: what is asked for.
        threads: to compute with.
        what: names the surfaces in messages.

    Returns:
        What was found in the last of a few rounds: in most cases the first that meets the accuracy.

    Raises:
        AccuracyError: a pilot shows that it cannot be met within the memory.
    """
    surfaces = _centered(surfaces)
    extent = Extent.union([surface.extent for surface in surfaces])
    widths = extent.widths
    areas = np.array(sum(surface.area for surface in surfaces))
    lattice, pilot = first_lattice(widths, extent.reach, orders, accuracy)
    inexact = max(1, sum(not isinstance(surface, Sphere) for surface in surfaces))
    values: Reals | None = None
    for remaining in reversed(range(_ROUNDS)):
        samples = _samples(surfaces, lattice, orders)
        if values is None:
            values = _ESTIMATE_CAUTION * estimate(samples, orders)
        _refuse_below_rounding(values, orders, accuracy, float(areas), what)
        goal = goal_of(values, orders, _of_pilot(accuracy) if pilot else accuracy, float(areas)).tightened(inexact)
        dtype = _precision(surfaces, lattice, goal)
        fields = tuple(
            field_for(surface, lattice, goal, TransformSettings(dtype=dtype), Execution(threads=threads), sample=sample)
            for surface, sample in zip(surfaces, samples, strict=True)
        )
        found = _assessed(fields, lattice, orders, areas, widths)
        values = found.assessed.values
        twins = values <= _ROUNDING * areas
        if not remaining or np.all(accuracy.met(found.assessed) | twins):
            break
        lattice, pilot = _next(lattice, pilot, found.sums, orders, accuracy, areas=areas, widths=widths, what=what)
    return found


def _next(
    lattice: Lattice,
    pilot: bool,
    sums: Sums,
    orders: Sequence[float],
    accuracy: Accuracy,
    *,
    areas: Reals,
    widths: Reals,
    what: str,
) -> tuple[Lattice, bool]:
    """The lattice of the next round, and whether it is but a larger pilot."""
    try:
        return refined(lattice, sums, orders, accuracy, areas=areas, widths=widths, what=what), False
    except AccuracyError:
        larger = larger_pilot(lattice, accuracy) if pilot else None
        if larger is None:
            raise
        return larger, True


def _centered(surfaces: Sequence[Surface]) -> Sequence[Surface]:
    """Return the surfaces moved together to the centre of a lattice's period, which no distance notices."""
    lowest, highest = Extent.union([surface.extent for surface in surfaces]).box
    if np.all(np.abs(lowest + highest) <= _OFF_CENTER * (highest - lowest).max()):
        return surfaces
    x, y, z = ((lowest + highest) / 2).tolist()
    move = Similarity(1.0, (x, y, z))
    return [move.apply(surface) for surface in surfaces]


def _refuse_below_rounding(values: Reals, orders: Sequence[float], accuracy: Accuracy, area: float, what: str) -> None:
    parts = np.array([accuracy.discretisation_part(order) for order in orders])
    floor = _ROUNDING * area
    # A distance of no more than rounding is that of twins, for whom no relative accuracy exists.
    below = (parts * values < floor) & (values > floor)
    if below.any():
        worst = int(np.argmax(below * floor / (parts * np.maximum(values, floor))))
        reachable = 2 * accuracy.rtol * floor / float(parts[worst] * values[worst])
        raise AccuracyError(
            f"{what}: rtol {accuracy.rtol:g} of about {values[worst]:.2g} at order {orders[worst]:g} is below the "
            f"rounding of double precision; about {reachable:.1g} can be reached",
            accuracy.rtol,
            reachable,
        )


@dataclass(frozen=True, eq=False)
class Pilot:
    """What a pair of surfaces needs.

    Attributes:
        values: the distances (orders,), roughly.
        lattice: that the accuracy needs.
        single: whether single precision is enough.
    """

    values: Reals
    lattice: Lattice
    single: bool


def pilot_of(
    surface: Surface,
    reference: Surface,
    orders: Sequence[float],
    accuracy: Accuracy,
    widths: Reals,
    reach: float,
    *,
    what: str,
    threads: int = 1,
) -> Pilot:
    """What a pair of surfaces needs for an accuracy, found out on a small lattice.

    Args:
        surface: one of them.
        reference: the other.
        orders: s, each.
        accuracy: what is asked for.
        widths: extents (13,) of all surfaces that share the lattice.
        reach: their largest |coordinate|.
        what: names the surface in messages.
        threads: to compute with.

    Raises:
        AccuracyError: it cannot be met within the memory.
    """
    lattice, pilot = first_lattice(widths, reach, orders, accuracy)
    area = surface.area + reference.area
    while True:
        samples = _samples((surface, reference), lattice, orders)
        goal = goal_of(estimate(samples, orders), orders, _of_pilot(accuracy), area).tightened(_PAIR)
        fields = [
            field_for(each, lattice, goal, TransformSettings(), Execution(threads=threads), sample=sample)
            for each, sample in zip((surface, reference), samples, strict=True)
        ]
        found = _assessed(fields, lattice, orders, np.array(area), widths)
        values = found.assessed.values
        _refuse_below_rounding(values, orders, accuracy, area, what)
        needed, larger = _next(
            lattice, pilot, found.sums, orders, accuracy, areas=np.array(area), widths=widths, what=what
        )
        if not larger:
            break
        lattice = needed
    final = goal_of(values, orders, accuracy, area).tightened(_PAIR)
    single = all(permits_single(each, needed, final) for each in (surface, reference))
    return Pilot(values, needed, single)


@dataclass(frozen=True, eq=False)
class Aim:
    """What the field of a surface is computed for: its distance to a reference, to an accuracy.

    Attributes:
        orders: s, each.
        accuracy: what is asked for.
        reference: a sample of the reference; None for the reference itself, then
        distances: are the smallest (orders,) that its field has to serve.
    """

    orders: tuple[float, ...]
    accuracy: Accuracy
    reference: Sample | None
    distances: tuple[float, ...] = ()

    def goal(self, surface: Surface) -> Goal:
        """What the field of a surface may err."""
        values = np.array(self.distances)
        if self.reference is not None:
            sample = Sample.of(surface, self.reference.draws)
            values = _ESTIMATE_CAUTION * estimate([sample, self.reference], self.orders)
        return goal_of(values, self.orders, self.accuracy, surface.area).tightened(_PAIR)


def goal_of(values: Reals, orders: Sequence[float], accuracy: Accuracy, area: float) -> Goal:
    """What the fields of a pair at these distances (orders,) may err, both together: never below rounding."""
    parts = np.array([accuracy.discretisation_part(order) for order in orders])
    return Goal(tuple(orders), tuple(np.maximum(parts * values, _ROUNDING * area).tolist()))


def _of_pilot(accuracy: Accuracy) -> Accuracy:
    return replace(accuracy, rtol=max(accuracy.rtol, _PILOT_RTOL))


def _precision(surfaces: Sequence[Surface], lattice: Lattice, goal: Goal) -> ComplexDtype:
    return "complex64" if all(permits_single(surface, lattice, goal) for surface in surfaces) else "complex128"


def _samples(surfaces: Sequence[Surface], lattice: Lattice, orders: Sequence[float]) -> tuple[Sample, ...]:
    """Samples of all surfaces at the same frequencies."""
    draws = draws_for(surfaces, lattice, orders, USUAL_DEGREE)
    return tuple(Sample.of(surface, draws) for surface in surfaces)


def _assessed(fields: Sequence[Field], lattice: Lattice, orders: Sequence[float], areas: Reals, widths: Reals) -> Found:
    whole = fields[0].values if len(fields) == 1 else fields[0].values - fields[1].values
    sums = sums_of_shells(shell_sums(whole, None, lattice, lattice.half), lattice, orders)
    errors = np.sum([field.quality.probe.norms(lattice, orders) for field in fields], axis=0)
    assessed = estimate_norms(sums, lattice, orders, areas=areas, widths=widths, discretisation=errors)
    return Found(assessed, lattice, tuple(fields), sums)
