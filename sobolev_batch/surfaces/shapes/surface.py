"""The protocol of surfaces, and checks of the numbers that define them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.extent import Extent

Point = tuple[float, float, float]

# Squares of larger lengths overflow, squares of the reciprocal vanish.
LARGEST_LENGTH = 1e150


class Surface(Protocol):
    """A surface in three-dimensional space, in the user's unit of length: a mesh or a closed form."""

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
        """Centre of the bounding box, and radius of the smallest sphere around it that holds the surface."""

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""


def is_finite_number(value: object) -> bool:
    """Return whether a value is a finite real number other than True and False."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def checked_point(point: Sequence[float], label: str) -> Point:
    """Return a point as three floats.

    Raises:
        InputError: Anything but three finite numbers; the message starts with the label.
    """
    if len(point) != 3 or not all(map(is_finite_number, point)):
        raise InputError(f"{label} must be three finite numbers, found {point!r}")
    x, y, z = map(float, point)
    return x, y, z


def moved_point(point: Point, scale: float, origin: Point) -> Point:
    """Return scale * (point - origin)."""
    x, y, z = (scale * (coordinate - shift) for coordinate, shift in zip(point, origin, strict=True))
    return x, y, z
