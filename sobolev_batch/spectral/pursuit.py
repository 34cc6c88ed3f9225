"""Computing until an accuracy is met: settings from forecasts, results checked, what falls short tightened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.accuracy import Accuracy, discretisation_share, first_lattice, refined
from sobolev_batch.spectral.budget import Assessed, Sums, assess, sums_of_shells, support_widths
from sobolev_batch.spectral.fields import USUAL_DEGREE, Field, field_for
from sobolev_batch.spectral.forecast import Goal, permits_single
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.nufft import Precision
from sobolev_batch.spectral.probe import Probe
from sobolev_batch.spectral.quality import Quality
from sobolev_batch.spectral.samples import Sample, draws_for, estimate
from sobolev_batch.spectral.shells import shell_sums
from sobolev_batch.spectral.transform import Transform
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Surface

Reals = NDArray[np.float64]

_ROUNDS = 4
# A distance is first estimated from a few frequencies; it is seldom less than this part of that.
_ESTIMATE_CAUTION = 0.7
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

    assessed: Assessed
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
    extents = [Quality.of_surface(surface, Probe()) for surface in surfaces]
    widths = support_widths(extents)
    areas = np.array(sum(extent.area for extent in extents))
    lattice, pilot = first_lattice(widths, orders, accuracy)
    meshes = max(1, sum(isinstance(surface, Mesh) for surface in surfaces))
    values: Reals | None = None
    strictness = 1.0
    for _ in range(_ROUNDS):
        samples = _samples(surfaces, lattice, orders)
        if values is None:
            values = _ESTIMATE_CAUTION * estimate(samples, orders)
        asked = max(accuracy.rtol, _PILOT_RTOL) if pilot else accuracy.rtol
        goal = goal_of(values, orders, asked).tightened(strictness * meshes)
        precision: Precision = "complex64" if all(permits_single(s, lattice, goal) for s in surfaces) else "complex128"
        fields = tuple(
            field_for(
                surface, lattice, goal, Transform(precision=precision), sample=sample, extent=extent, threads=threads
            )
            for surface, sample, extent in zip(surfaces, samples, extents, strict=True)
        )
        found = _assessed(fields, lattice, orders, areas, widths)
        values = found.assessed.values
        if accuracy.met(found.assessed).all():
            break
        lattice = refined(lattice, found.sums, orders, accuracy, areas=areas, widths=widths, what=what)
        if not pilot:
            excess = found.assessed.discretisation / (np.array(goal_of(values, orders, asked).norms))
            strictness *= max(1.0, 2 * float(excess.max()))
        pilot = False
    return found


def goal_of(values: Reals, orders: Sequence[float], rtol: float) -> Goal:
    """What the fields of a pair at these distances (orders,) may err, both together."""
    shares = np.array([discretisation_share(order) for order in orders])
    # Twins have no distance that could be kept to a relative accuracy: rounding is all there is.
    norms = np.maximum(shares * rtol * values, 1e-300)
    return Goal(tuple(orders), tuple(norms.tolist()))


def _samples(surfaces: Sequence[Surface], lattice: Lattice, orders: Sequence[float]) -> tuple[Sample, ...]:
    """Samples of all surfaces at the same frequencies."""
    draws = draws_for(surfaces, lattice, orders, USUAL_DEGREE)
    return tuple(Sample.of(surface, draws) for surface in surfaces)


def _assessed(fields: Sequence[Field], lattice: Lattice, orders: Sequence[float], areas: Reals, widths: Reals) -> Found:
    whole = fields[0].values if len(fields) == 1 else fields[0].values - fields[1].values
    sums = sums_of_shells(shell_sums(whole, None, lattice, lattice.half), lattice, orders)
    errors = np.sum([field.quality.probe.norms(lattice, orders) for field in fields], axis=0)
    assessed = assess(sums, lattice, orders, areas=areas, widths=widths, discretisation=errors)
    return Found(assessed, lattice, tuple(fields), sums)
