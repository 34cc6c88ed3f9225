"""Smooth surfaces given by a parametrisation: their area elements, areas and extents.

A surface is x(u, v) over a rectangle, each parameter periodic or not. At poles, where the ends of a
parameter are one point of the surface, the area element |x_u × x_v| vanishes, which is no harm.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent
from sobolev_batch.surfaces.shapes.interval import Interval

Reals = NDArray[np.float64]
Counts = tuple[int, int]

# Nodes of any one rule: about 1,000 by 4,000.
MOST_NODES = 1 << 22
# Along a parameter that is not periodic: making a Gauss rule takes the square of its nodes, and so do derivatives.
MOST_GAUSS_NODES = 1 << 11
# Nodes that are made at a time, where the area element is known at each.
_BATCH = 1 << 16
# An area that changes by no more, relatively, when the nodes are doubled is settled; one that still
# changes by that much at the last is none.
_SETTLED, _UNSETTLED = 1e-12, 1e-3
_FIRST_NODES = 31
_MOST_AREA_NODES = 1 << 20
# Extents are sought on a grid of so many points along each parameter, then on small ones around the best.
_GRID, _ZOOM_GRID, _ZOOMS = 65, 9, 12


class Smooth(ABC):
    """A surface with a smooth parametrisation x(u, v), in units of length."""

    @property
    @abstractmethod
    def intervals(self) -> tuple[Interval, Interval]:
        """What u and v run over."""

    @abstractmethod
    def positions(self, u: Reals, v: Reals) -> Reals:
        """x(u, v), float64 (3, ...), at parameters of one shape (...)."""

    @abstractmethod
    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals] | None:
        """x_u and x_v, float64 (3, ...) each; None where they are to be computed from positions."""

    @abstractmethod
    def moved(self, scale: float, origin: tuple[float, float, float]) -> Self:
        """The surface after x -> scale * (x - origin)."""

    def nodes(self, counts: Counts, most: int = _BATCH) -> Iterator[tuple[Reals, Reals]]:
        """Nodes x (3, k) and weights (k,) of the product rule of both intervals, area elements included.

        Without derivatives these are those of the interpolant through all nodes: see `Interval.derivative`.

        Args:
            counts: nodes along u and v, odd where periodic.
            most: bound on k.
        """
        (u, along_u), (v, along_v) = (
            interval.rule(count) for interval, count in zip(self.intervals, counts, strict=True)
        )
        everything = self._interpolated(u, v)
        rows = max(1, most // counts[1])
        for first in range(0, counts[0], rows):
            part = slice(first, first + rows)
            if everything is None:
                positions, tangents = self._given(u[part], v)
            else:
                positions, tangents = everything[0][:, part], (everything[1][:, part], everything[2][:, part])
            weights = _cross_lengths(*tangents)
            weights *= along_u[part, None]
            weights *= along_v
            points, flat = positions.reshape(3, -1), weights.ravel()
            for start in range(0, len(flat), most):
                yield np.ascontiguousarray(points[:, start : start + most]), flat[start : start + most]

    def _given(self, u: Reals, v: Reals) -> tuple[Reals, tuple[Reals, Reals]]:
        """Positions and derivatives (3, n, m) on a grid."""
        first, second = np.meshgrid(u, v, indexing="ij")
        tangents = self.tangents(first, second)
        if tangents is None:
            raise TypeError(f"{type(self).__name__} has derivatives at some places and none at others")
        return self.positions(first, second), tangents

    def _interpolated(self, u: Reals, v: Reals) -> tuple[Reals, Reals, Reals] | None:
        """Positions and derivatives (3, n, m) from values at all nodes; None where derivatives are known."""
        if self.tangents(u[:1], v[:1]) is not None:
            return None
        first, second = np.meshgrid(u, v, indexing="ij")
        positions = self.positions(first, second)
        along_u, along_v = self.intervals
        return positions, along_u.derivative(positions, 1), along_v.derivative(positions, 2)

    @cached_property
    def area(self) -> float:
        """Area, in squared units of length: by quadrature, doubled until it changes by 1e-12 of it or less.

        Raises:
            InputError: it is zero, or does not settle.
        """
        counts = _FIRST_NODES, _FIRST_NODES
        area = self._area(counts)
        change = math.inf
        while change > _SETTLED * area and math.prod(doubled(counts)) <= _MOST_AREA_NODES:
            counts = doubled(counts)
            area, before = self._area(counts), area
            change = abs(area - before)
        if not (math.isfinite(area) and area > 0):
            raise InputError(f"a surface needs an area that is positive and finite, found {area:g}")
        if change > _UNSETTLED * area:
            raise InputError(
                f"the area of the surface changes from {before:.6g} to {area:.6g} when the nodes are doubled to "
                f"{counts[0]} x {counts[1]}: its parametrisation is not smooth, or oscillates too fast"
            )
        return area

    def _area(self, counts: Counts) -> float:
        return math.fsum(float(weights.sum()) for _, weights in self.nodes(counts))

    def highest_along(self, directions: Reals) -> Reals:
        """The greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length.

        Good to about 1e-12 of the extent, unless the surface has details that a grid of 65 by 65 misses.
        """

        def heights(points: Reals) -> Reals:
            # A sum of products instead of one of matrices: points may be shared by all directions, or not.
            return np.asarray(sum(directions[:, axis, None, None] * points[axis] for axis in range(3)))

        return self._greatest(heights, len(directions))

    @cached_property
    def bounds(self) -> tuple[Reals, Reals]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        axes = np.concatenate([-np.eye(3), np.eye(3)])
        highest = self.highest_along(axes)
        return -highest[:3], highest[3:]

    @cached_property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""
        lowest, highest = -self.highest_along(-DIRECTIONS), self.highest_along(DIRECTIONS)
        return Extent(tuple(lowest.tolist()), tuple(highest.tolist()))

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre and radius of the sphere around the centre of the bounding box that holds the surface."""
        lower, upper = self.bounds
        center = lower + (upper - lower) / 2

        def distances(points: Reals) -> Reals:
            return np.asarray(np.sqrt(sum((points[axis] - center[axis]) ** 2 for axis in range(3))))

        return (float(center[0]), float(center[1]), float(center[2])), float(self._greatest(distances, 1)[0])

    def _greatest(self, heights: Callable[[Reals], Reals], count: int) -> Reals:
        """The greatest of several functions of position over the surface (count,)."""
        grids = [np.linspace(interval.low, interval.high, _GRID) for interval in self.intervals]
        found = heights(self.positions(*np.meshgrid(*grids, indexing="ij"))[:, None])
        best = np.unravel_index(found.reshape(count, -1).argmax(axis=1), (_GRID, _GRID))
        centers = [grid[index] for grid, index in zip(grids, best, strict=True)]
        widths = [interval.length / (_GRID - 1) for interval in self.intervals]
        greatest: Reals = found.reshape(count, -1).max(axis=1)
        steps = np.linspace(-1, 1, _ZOOM_GRID)
        for _ in range(_ZOOMS):
            lines = [
                _held(interval, center[:, None] + width * steps)
                for interval, center, width in zip(self.intervals, centers, widths, strict=True)
            ]
            u, v = np.broadcast_arrays(lines[0][:, :, None], lines[1][:, None, :])
            found = heights(self.positions(u, v)).reshape(count, -1)
            np.maximum(greatest, found.max(axis=1), out=greatest)
            best = np.unravel_index(found.argmax(axis=1), (_ZOOM_GRID, _ZOOM_GRID))
            centers = [line[np.arange(count), index] for line, index in zip(lines, best, strict=True)]
            widths = [width / 3 for width in widths]
        return greatest


def doubled(counts: Counts) -> Counts:
    """Twice as many nodes each way, and one more: no wave that is a constant to both is below their product."""
    return 2 * counts[0] + 1, 2 * counts[1] + 1


def _held(interval: Interval, values: Reals) -> Reals:
    """Parameters brought back into their interval."""
    if interval.periodic:
        turns = np.floor((values - interval.low) / interval.length)
        return np.asarray(values - turns * interval.length)
    return np.asarray(np.clip(values, interval.low, interval.high))


def _cross_lengths(first: Reals, second: Reals) -> Reals:
    """|x_u × x_v| of vectors (3, ...)."""
    (ux, uy, uz), (vx, vy, vz) = first, second
    return np.asarray(np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2))
