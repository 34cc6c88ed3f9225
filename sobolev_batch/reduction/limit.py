"""How far a mesh may be from the one that it was made of, and how a mesh is made and judged.

A question that is clear is answered early: bounds are only as close as it needs.
"""

import math
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

from sobolev_batch.errors import InputError, one_line
from sobolev_batch.geometry.deviation import largest_deviation
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.threshold import relative_distance
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.parameters import fraction, length_in
from sobolev_batch.reduction.search import Trial
from sobolev_batch.sources.registry import Member, load_mesh
from sobolev_batch.transform.lattice import single_order

# The accuracy of a distance follows from its limit; only the memory of this one counts.
_ANY_ACCURACY = Accuracy(1e-2)
# Each trial computes in one thread, and random frequencies are the same for all.
_THREADS, _SEED = 1, 0
# A limit that is met up to this fraction is met.
_EQUAL = 1e-9


@dataclass(frozen=True)
class Limit:
    """Largest distance of a mesh from the one that it was made of.

    Attributes:
        value: Largest deviation, of each point of either mesh from the closest one of the other, in the unit of the
            meshes. With an order, largest Sobolev distance over the norm of the original, in the unit in which its
            bounding sphere has the radius 1.
        order: Order s < -1/2 of the Sobolev distance; None for the deviation.
    """

    value: float
    order: float | None = None

    @classmethod
    def parse(cls, within: float | str, order: float | None = None, unit: str | None = None) -> Self:
        """Return the limit that is meant: a length, or with a per cent sign or an order a fraction of the norm.

        >>> Limit.parse("0.1 mm", unit="m"), Limit.parse("1%")
        (Limit(value=0.0001, order=None), Limit(value=0.01, order=-2.0))
        """
        if order is None and not str(within).rstrip().endswith("%"):
            return cls(length_in(within, unit))
        value = math.inf
        with suppress(InputError):
            value = fraction(within)
        if value >= 1:
            raise InputError(
                "in per cent or with an order, a tolerance is a fraction of the norm below 1, such as 1%, found "
                f"{within!r}; a length has no order"
            )
        return cls(value, single_order(DEFAULT_ORDER if order is None else order))

    def bounds(self, mesh: Mesh, reference: Mesh) -> tuple[float, float, float]:
        """Return an estimate of the distance of a mesh from a reference, a lower and an upper bound."""
        if self.order is None:
            deviation = largest_deviation(mesh, reference, within=self.value).both
            # The lower bound is the largest distance of a vertex at least; the upper one is hardly below the limit.
            return deviation.lower, deviation.lower, deviation.upper
        to_unit = Similarity.to_unit_ball(reference)
        pair = to_unit.apply(mesh), to_unit.apply(reference)
        found, _ = relative_distance(*pair, self.order, self.value, _ANY_ACCURACY, _THREADS, _SEED)
        # Of a distance that is too large, hardly any lies beyond the lattice.
        guess = found.upper if found.upper > self.value else (found.lower + found.upper) / 2
        return found.lower if found.lower > self.value else guess, found.lower, found.upper


def tried(reference_member: Member, member: Member, limit: Limit, size: float) -> tuple[Trial, Mesh | None]:
    """Make a mesh and judge it against a reference.

    Return the trial, and the mesh where it is within the limit. What goes wrong with the mesh is the reason of a trial
    that failed; what is wrong with the reference is raised as a MeshError.
    """
    reference, started = load_mesh(reference_member), time.perf_counter()
    mesh, reason, bounds = None, "", (math.inf,) * 3
    try:
        mesh = load_mesh(member)
        bounds = limit.bounds(mesh, reference)
    except InputError as error:
        reason = one_line(error)
    is_within, triangles = bounds[2] <= limit.value * (1 + _EQUAL), 0 if mesh is None else len(mesh.triangles)
    trial = Trial(float(size), triangles, *bounds, is_within, time.perf_counter() - started, reason)
    return trial, mesh if is_within else None
