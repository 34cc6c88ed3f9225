"""Spheres as closed-form surfaces: no mesh stands between them and their transform."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent

# The square of a larger one overflows.
_LARGEST_RADIUS = 1e150


def is_finite_number(value: object) -> bool:
    """Whether a value is a finite real number, and no truth value."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class Sphere:
    """The sphere of a radius and centre, in the user's unit of length.

    Raises:
        InputError: a radius that is not positive and finite, or a centre that is not three finite
            numbers.
    """

    radius: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.radius) and self.radius > 0):
            raise InputError(f"a sphere's radius must be positive and finite, found {self.radius}")
        if float(self.radius) > _LARGEST_RADIUS:
            raise InputError(f"a sphere's radius must be at most {_LARGEST_RADIUS:g}, found {self.radius}")
        if len(self.center) != 3 or not all(map(is_finite_number, self.center)):
            raise InputError(f"a sphere's center must be three finite numbers, found {self.center}")
        object.__setattr__(self, "radius", float(self.radius))
        object.__setattr__(self, "center", tuple(float(x) for x in self.center))

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
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre and radius of the sphere itself."""
        return self.center, self.radius

    def moved(self, scale: float, origin: tuple[float, float, float]) -> Sphere:
        """Return the sphere after x -> scale * (x - origin)."""
        x, y, z = (scale * (c - o) for c, o in zip(self.center, origin, strict=True))
        return Sphere(scale * self.radius, (x, y, z))
