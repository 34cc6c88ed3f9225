"""How far a mesh may be from the one that it was made of, and how a mesh is made and judged.

A question that is clear is answered early: bounds are only as close as it needs.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

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

# The accuracy of a verdict follows from its limit; only the memory of this one counts.
_ANY_ACCURACY = Accuracy(1e-2)
# Each trial computes in one thread, and random frequencies are the same for all.
_THREADS, _SEED = 1, 0


@dataclass(frozen=True)
class Limit(ABC):
    """Largest distance of a mesh from the one that it was made of.

    Attributes:
        value: The distance, in the unit of the meshes or as a fraction of a norm.
    """

    value: float

    @abstractmethod
    def bounds(self, mesh: Mesh, reference: Mesh) -> tuple[float, float, float]:
        """Return an estimate of the distance of a mesh from a reference, a lower and an upper bound."""

    def is_met(self, upper: float) -> bool:
        """Tell whether a distance of at most an upper bound is within the limit, up to rounding of the limit."""
        return upper <= self.value * (1 + 1e-9)


@dataclass(frozen=True)
class DeviationLimit(Limit):
    """Largest deviation, from each point of either mesh to the closest one of the other, in the unit of the meshes."""

    def bounds(self, mesh: Mesh, reference: Mesh) -> tuple[float, float, float]:
        """Return bounds that tell whether the deviation is within the limit."""
        found = largest_deviation(mesh, reference, within=self.value).both
        # The largest distance of a vertex, where the upper bound is hardly below the limit.
        return found.lower, found.lower, found.upper


@dataclass(frozen=True)
class DistanceLimit(Limit):
    """Largest Sobolev distance over the norm of the reference, in the unit in which its bounding sphere has radius 1.

    Attributes:
        order: Order s < -1/2 of the norm.
    """

    order: float = DEFAULT_ORDER

    def __post_init__(self) -> None:
        single_order(self.order)
        if self.value >= 1:
            raise InputError(
                f"a Sobolev distance is a fraction of the norm below 1, such as '1%', found {self.value:g}"
            )

    def bounds(self, mesh: Mesh, reference: Mesh) -> tuple[float, float, float]:
        """Return bounds that tell whether the distance is within the limit, where it is not next to it."""
        to_unit = Similarity.to_unit_ball(reference)
        pair = to_unit.apply(mesh), to_unit.apply(reference)
        found, _ = relative_distance(*pair, self.order, self.value, _ANY_ACCURACY, _THREADS, _SEED)
        return (found.lower + found.upper) / 2, found.lower, found.upper


def as_limit(within: float | str, order: float | None = None, unit: str | None = None) -> Limit:
    """Return the limit that is meant: a length, or a fraction of the norm where there is an order or a per cent sign.

    >>> as_limit("0.1 mm", unit="m"), as_limit("1%")
    (DeviationLimit(value=0.0001), DistanceLimit(value=0.01, order=-2.0))
    """
    if order is None and not str(within).rstrip().endswith("%"):
        return DeviationLimit(length_in(within, unit))
    return DistanceLimit(fraction(within), DEFAULT_ORDER if order is None else order)


def tried(original: Member, member: Member | None, limit: Limit, size: float) -> tuple[Trial, Mesh | None]:
    """Make a mesh and judge it against its original; None stands for the original itself.

    Return the trial, and the mesh where it is within the limit. What goes wrong with the mesh is the reason of a trial
    that failed; what is wrong with the original is raised as a MeshError.
    """
    reference, started = load_mesh(original), time.perf_counter()
    mesh, reason, found = None, "", (float("nan"),) * 3
    try:
        mesh = reference if member is None else load_mesh(member)
        found = limit.bounds(mesh, reference)
    except InputError as error:
        reason = one_line(error)
    is_within, count = not reason and limit.is_met(found[2]), 0 if mesh is None else len(mesh.triangles)
    trial = Trial(float(size), count, *found, is_within, time.perf_counter() - started, reason)
    return trial, mesh if is_within else None
