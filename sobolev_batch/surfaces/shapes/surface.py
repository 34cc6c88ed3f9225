"""The protocol of surfaces, their extents along fixed directions, and checks of the numbers that define them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from numbers import Real
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError

Point = tuple[float, float, float]
Reals = NDArray[np.float64]

# Squares of larger lengths overflow, squares of the reciprocal vanish.
LARGEST_LENGTH = 1e150

_NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)], dtype=np.float64)
# The axes, the diagonals of the faces and those of the cube: unit vectors (13, 3).
DIRECTIONS: Reals = _NEIGHBOURS / np.linalg.norm(_NEIGHBOURS, axis=1, keepdims=True)
# Points that are measured at a time: their temporaries stay in cache.
_BATCH = 1 << 14
_AXES = [int(np.argmax(np.abs(DIRECTIONS[:, axis]))) for axis in range(3)]


@dataclass(frozen=True)
class Extent:
    """The least and the greatest x · direction over a surface, for each of `DIRECTIONS`.

    Attributes:
        lowest: Least values (13,), in units of length.
        highest: Greatest values (13,), in units of length.
    """

    lowest: tuple[float, ...]
    highest: tuple[float, ...]

    @classmethod
    def union(cls, extents: Sequence[Extent]) -> Self:
        """Return the extent of several surfaces together."""
        lowest = np.min([extent.lowest for extent in extents], axis=0)
        highest = np.max([extent.highest for extent in extents], axis=0)
        return cls(tuple(lowest.tolist()), tuple(highest.tolist()))

    @classmethod
    def of_points(cls, coordinates: Reals) -> Self:
        """Return the extent of points (3, n), n > 0, one contiguous row an axis."""
        lowest, highest = np.full(len(DIRECTIONS), np.inf), np.full(len(DIRECTIONS), -np.inf)
        for start in range(0, coordinates.shape[1], _BATCH):
            along = DIRECTIONS @ coordinates[:, start : start + _BATCH]
            np.minimum(lowest, along.min(axis=1), out=lowest)
            np.maximum(highest, along.max(axis=1), out=highest)
        return cls(tuple(lowest.tolist()), tuple(highest.tolist()))

    @property
    def widths(self) -> Reals:
        """Width along each direction (13,), in units of length."""
        return np.subtract(self.highest, self.lowest)

    @property
    def box(self) -> tuple[Reals, Reals]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        return np.array(self.lowest)[_AXES], np.array(self.highest)[_AXES]

    @property
    def reach(self) -> float:
        """Largest |coordinate|, in units of length."""
        return float(np.abs(self.box).max())


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
