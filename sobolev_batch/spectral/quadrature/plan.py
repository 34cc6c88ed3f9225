"""Quadrature plans: the points of any surface, chosen once and made batch by batch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, singledispatch
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends.backends import CPU, Backend
from sobolev_batch.spectral.quadrature.meshes import AUTO, Faces, Quadrature, RuleAssignment, WeightedPoints
from sobolev_batch.spectral.quadrature.smooth import Resolution, resolution_of
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.smooth.smooth import Smooth

# Nodes of a parametrised surface that are made at a time: their temporaries take 4 MB.
_NODES = 1 << 14
# The error of a parametrised surface's nodes grows with the frequency like that of a rule of a high degree: of the
# degrees tried on tori and ellipsoids with too few nodes, 8 and 16 drew frequencies that showed most of it.
_SMOOTH_DEGREE = 16


class PointCount(NamedTuple):
    """Number of points: the expected one, and a bound before shared points are merged."""

    expected: float
    largest: int


class QuadraturePlan(ABC):
    """Points that stand for a surface up to a frequency: chosen when first asked for, made batch by batch."""

    @staticmethod
    def of(
        surface: Surface,
        highest_frequency: float,
        tolerance: float,
        quadrature: Quadrature = AUTO,
    ) -> QuadraturePlan:
        """Return the plan of a surface.

        Args:
            surface: Surface in units of length.
            highest_frequency: Largest |ξ| at which the points stand for the surface, in cycles per unit length.
            tolerance: Largest quadrature error at any such frequency, relative to the area. Only "auto" and
                parametrised surfaces observe it.
            quadrature: Method to choose the rules of triangles.

        Raises:
            InputError: A surface of an unknown kind.
        """
        return _plan_of(surface, highest_frequency, tolerance, quadrature)

    @property
    @abstractmethod
    def size(self) -> PointCount:
        """Number of points."""

    @property
    @abstractmethod
    def lowest_degree(self) -> int:
        """Lowest degree among the rules, whose error shows first; 0 for a closed form."""

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return 0

    @abstractmethod
    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        """Yield the points in batches, which are nearly equal for a mesh.

        Args:
            capacity: Largest number of points of a batch; at least 8 times that of the largest rule (3,624).
            backend: Backend to make the points on.

        Raises:
            InputError: A parametrised surface whose quadrature does not converge.
        """


class _ClosedFormPlan(QuadraturePlan):
    """Plan of a surface whose transform has a closed form: no points."""

    size = PointCount(0.0, 0)
    lowest_degree = 0

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        yield from ()


@dataclass(frozen=True, eq=False)
class _MeshPlan(QuadraturePlan):
    """Plan of a mesh, which holds two bytes for each triangle."""

    mesh: Mesh
    highest_frequency: float
    tolerance: float
    quadrature: Quadrature

    @cached_property
    def assignment(self) -> RuleAssignment:
        """Rules of the triangles."""
        return RuleAssignment.of(self.mesh, self.highest_frequency, self.tolerance, self.quadrature)

    @property
    def size(self) -> PointCount:
        uses = self.assignment.uses
        return PointCount(sum((use.expected_points for use in uses), 0.0), sum(use.largest_points for use in uses))

    @property
    def lowest_degree(self) -> int:
        return min(use.rule.degree for use in self.assignment.uses)

    @property
    def triangles(self) -> int:
        return len(self.mesh.triangles)

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        # Nodes are merged within a batch of triangles: these are large where nodes are shared.
        triangles = [
            batch
            for whole in self.assignment.batches()
            for batch in whole.split(capacity // (2 if whole.rule.sharing > 1 else 8))
        ]
        ends = np.cumsum([batch.largest_points for batch in triangles])
        total = int(ends[-1])
        count = -(-total // (capacity - max(batch.largest_points for batch in triangles)))
        # A batch of triangles goes where its first point goes, so that each batch of points exceeds its equal
        # number by at most one batch of triangles.
        numbers = (np.concatenate([[0], ends[:-1]]) * count // total).tolist()
        faces = Faces.of(self.mesh, backend)
        for _, group in groupby(zip(numbers, triangles, strict=True), key=itemgetter(0)):
            yield WeightedPoints.concatenated([batch.points(faces, backend) for _, batch in group])


@dataclass(frozen=True, eq=False)
class _SmoothPlan(QuadraturePlan):
    """Plan of a parametrised surface."""

    surface: Smooth
    highest_frequency: float
    tolerance: float

    lowest_degree = _SMOOTH_DEGREE

    @property
    def resolution(self) -> Resolution:
        """Nodes along both parameters, and the change of the transform when they are doubled."""
        return resolution_of(self.surface, self.highest_frequency, self.tolerance)

    @property
    def size(self) -> PointCount:
        return PointCount(float(self.resolution.size), self.resolution.size)

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        gathered: list[WeightedPoints] = []
        count = 0
        for coordinates, weights in self.surface.nodes(self.resolution.counts, min(capacity, _NODES)):
            if count + len(weights) > capacity:
                yield WeightedPoints.concatenated(gathered)
                gathered, count = [], 0
            gathered.append(WeightedPoints(backend.upload(coordinates), backend.upload(weights)))
            count += len(weights)
        yield WeightedPoints.concatenated(gathered)


def unknown_surface(surface: object) -> InputError:
    """Return the error that names the kinds of surfaces that are known."""
    return InputError(
        "a surface must be a Mesh, a Sphere or a parametrised surface (Ellipsoid, Torus, ParametrisedSurface), "
        f"found {type(surface).__name__}"
    )


@singledispatch
def _plan_of(surface: object, highest_frequency: float, tolerance: float, quadrature: Quadrature) -> QuadraturePlan:
    raise unknown_surface(surface)


@_plan_of.register
def _(surface: Sphere, highest_frequency: float, tolerance: float, quadrature: Quadrature) -> QuadraturePlan:
    return _ClosedFormPlan()


@_plan_of.register
def _(surface: Mesh, highest_frequency: float, tolerance: float, quadrature: Quadrature) -> QuadraturePlan:
    return _MeshPlan(surface, highest_frequency, tolerance, quadrature)


@_plan_of.register
def _(surface: Smooth, highest_frequency: float, tolerance: float, quadrature: Quadrature) -> QuadraturePlan:
    return _SmoothPlan(surface, highest_frequency, tolerance)
