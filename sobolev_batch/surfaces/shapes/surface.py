"""What every surface can tell of itself, whether it is a mesh or given by a formula."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.surfaces.shapes.extent import Extent

Point = tuple[float, float, float]


class Surface(Protocol):
    """A surface in three-dimensional space, in the user's unit of length: a `Mesh`, a `Sphere` or a `Smooth` one."""

    @property
    def area(self) -> float:
        """Total area, in squared units of length."""

    @property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre and radius of the sphere around the centre of the bounding box that holds the surface."""

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""
