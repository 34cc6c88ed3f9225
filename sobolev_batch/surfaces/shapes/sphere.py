"""Spheres as closed-form surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import (
    DIRECTIONS,
    LARGEST_LENGTH,
    Extent,
    Point,
    checked_point,
    is_finite_number,
    moved_point,
)


@dataclass(frozen=True)
class Sphere:
    """A sphere, in the user's unit of length. Its Fourier transform has a closed form.

    Args:
        radius: Radius.
        center: Centre.

    Raises:
        InputError: The radius is not positive and finite, or the centre is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> sphere = sb.Sphere(2.0, center=(1.0, 0.0, 0.0))
    >>> f"{sphere.area:.4f}"
    '50.2655'
    """

    radius: float = 1.0
    center: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.radius) and self.radius > 0):
            raise InputError(f"a sphere's radius must be positive and finite, found {self.radius}")
        if float(self.radius) > LARGEST_LENGTH:
            raise InputError(f"a sphere's radius must be at most {LARGEST_LENGTH:g}, found {self.radius}")
        object.__setattr__(self, "radius", float(self.radius))
        object.__setattr__(self, "center", checked_point(self.center, "a sphere's center"))

    @property
    def area(self) -> float:
        """Area, in squared units of length."""
        return 4 * math.pi * self.radius**2

    @cached_property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""
        along = DIRECTIONS @ np.asarray(self.center)
        return Extent(tuple((along - self.radius).tolist()), tuple((along + self.radius).tolist()))

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        return self.extent.box

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre and radius of the sphere."""
        return self.center, self.radius

    def moved(self, scale: float, origin: Point) -> Sphere:
        """Return the sphere after x -> scale * (x - origin)."""
        return Sphere(scale * self.radius, moved_point(self.center, scale, origin))
