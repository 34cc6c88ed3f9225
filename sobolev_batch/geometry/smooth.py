"""Smooth surfaces given by a parametrisation x(u, v) over two intervals, whose rules integrate over them.

At a pole, one end of a parameter is a single point. The area element |x_u × x_v| vanishes there, which does no harm.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
from scipy.special import roots_legendre

from sobolev_batch.arrays import Reals, slices
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.mesh import cross_lengths
from sobolev_batch.geometry.surface import DIRECTIONS, Extent, Point, Similarity, is_finite_number
from sobolev_batch.parameters import check_flags

Counts = tuple[int, int]

# Nodes of any one rule: about 1,000 by 4,000.
MOST_NODES = 1 << 22
# Nodes along a parameter that is not periodic: a Gauss rule and its derivatives cost the square of them.
MOST_GAUSS_NODES = 1 << 11
# Nodes that are computed at a time, where derivatives are given.
_BATCH = 1 << 16
# Relative changes of the area when the nodes are doubled: one that ends the doubling, and one too large at its end.
_SETTLED, _UNSETTLED = 1e-12, 1e-3
_FIRST_NODES = 31
_MOST_AREA_NODES = 1 << 20
# Extents are sought on a grid of this many points along each parameter, then on small ones around the best.
_GRID, _ZOOM_GRID, _ZOOMS = 65, 9, 12
# x, y and z at each pair of parameters; numbers stand for constants.
Vectors = Reals | Sequence[Reals | float]

# Largest gap between the ends of a periodic parameter, relative to the extent of the surface.
_CLOSED = 1e-9
# Parameters along an interval at which it is measured.
_CHECKS = 7


@dataclass(frozen=True)
class Interval:
    """The interval of a parameter of a surface.

    Args:
        low: Beginning.
        high: End, above ``low``.
        periodic: True where the surface closes smoothly from the end to the beginning.

    Raises:
        InputError: The ends are not finite numbers in ascending order.

    >>> import numpy as np
    >>> import sobolev_batch as sb
    >>> nodes, weights = sb.shapes.Interval(0.0, np.pi).rule(12)
    >>> f"{weights @ np.sin(nodes):.12f}"
    '2.000000000000'
    """

    low: float
    high: float
    periodic: bool = False

    def __post_init__(self) -> None:
        ends = self.low, self.high
        if not (all(map(is_finite_number, ends)) and 0 < float(self.high) - float(self.low) < math.inf):
            raise InputError(f"an interval needs two finite ends in ascending order, found {self.low} and {self.high}")
        check_flags(periodic=self.periodic)
        vars(self).update(low=float(self.low), high=float(self.high))

    @property
    def length(self) -> float:
        """Distance between the ends."""
        return self.high - self.low

    def rule(self, count: int) -> tuple[Reals, Reals]:
        """Return nodes and weights (count,) of a quadrature rule that converges spectrally on smooth functions.

        Periodic intervals have the trapezoidal rule (L. N. Trefethen, J. A. C. Weideman 2014,
        doi:10.1137/130932132). Others have Gauss-Legendre, whose nodes leave out the ends.
        """
        if self.periodic:
            step = self.length / count
            return np.asarray(self.low + step * np.arange(count)), np.full(count, step, dtype=np.float64)
        nodes, weights = _gauss_legendre(count)
        return self.low + self.length / 2 * (1 + nodes), self.length / 2 * weights

    def derivative(self, values: Reals, axis: int) -> Reals:
        """Return the derivative, at the nodes of the `rule`, of the interpolant through values at them.

        The interpolant is a trigonometric polynomial where periodic, which needs an odd number of nodes, and a
        polynomial otherwise (H. Wang, S. Xiang 2012, doi:10.1090/S0025-5718-2011-02549-4). For functions that the nodes
        resolve, the error is about n or n² roundings of the largest value. One axis of the values runs over the nodes.
        """
        count = values.shape[axis]
        if self.periodic:
            frequencies = 2j * np.pi / self.length * np.arange(count // 2 + 1)
            spectrum = np.moveaxis(np.fft.rfft(values, axis=axis), axis, -1) * frequencies
            return np.asarray(np.moveaxis(np.fft.irfft(spectrum, count), -1, axis))
        matrix = 2 / self.length * _differentiation(count)
        return np.asarray(np.moveaxis(np.moveaxis(values, axis, -1) @ matrix.T, -1, axis))


class Smooth(ABC):
    """A surface with a smooth parametrisation x(u, v), in units of length."""

    @property
    @abstractmethod
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of u and v."""

    @abstractmethod
    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...), at parameters that are broadcast to one shape (...)."""

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals] | None:
        """Return x_u and x_v, float64 (3, ...) each; None where they are computed from positions."""
        return None

    @abstractmethod
    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""

    def nodes(self, counts: Counts, most: int = _BATCH) -> Iterator[tuple[Reals, Reals]]:
        """Yield batches of at most a number of nodes x (3, k) and weights (k,) of the product rule of both intervals.

        The counts of nodes along u and v are odd where periodic. The weights include the area elements. Where
        `tangents` is None, these are those of the interpolant through all nodes: see `Interval.derivative`.
        """
        rules = (interval.rule(count) for interval, count in zip(self.intervals, counts, strict=True))
        (u, along_u), (v, along_v) = rules
        whole = self._on_grid(u, v) if self.tangents(u[:1], v[:1]) is None else None
        for batch in slices(counts[0], max(1, most // counts[1])):
            positions, *tangents = self._on_grid(u[batch], v) if whole is None else (one[:, batch] for one in whole)
            weights = cross_lengths(*tangents)
            weights *= along_u[batch, None]
            weights *= along_v
            points, flat_weights = positions.reshape(3, -1), weights.ravel()
            for part in slices(len(flat_weights), most):
                yield np.ascontiguousarray(points[:, part]), flat_weights[part]

    def _on_grid(self, u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
        """Return positions and their derivatives (3, n, m) on a grid; those of an interpolant need it whole."""
        grid = np.meshgrid(u, v, indexing="ij", sparse=True)
        positions, tangents = self.positions(*grid), self.tangents(*grid)
        if tangents is None:
            along_u, along_v = self.intervals
            tangents = along_u.derivative(positions, 1), along_v.derivative(positions, 2)
        return positions, *tangents

    @cached_property
    def area(self) -> float:
        """Area, in squared units of length: by quadrature, doubled until it settles to 1e-12, or InputError."""
        counts = _FIRST_NODES, _FIRST_NODES
        area, before = self._area(counts), math.inf
        while abs(area - before) > _SETTLED * area and math.prod(doubled(counts)) <= _MOST_AREA_NODES:
            counts = doubled(counts)
            area, before = self._area(counts), area
        if not (math.isfinite(area) and area > 0):
            raise InputError(f"a surface needs an area that is positive and finite, found {area:g}")
        if abs(area - before) > _UNSETTLED * area:
            both = f"{before:.6g} and, with twice the nodes, {area:.6g}"
            raise InputError(f"the area of the surface seems to be {both}: it is not smooth, or oscillates too fast")
        return area

    def _area(self, counts: Counts) -> float:
        return math.fsum(float(weights.sum()) for _, weights in self.nodes(counts))

    def highest_along(self, directions: Reals) -> Reals:
        """Return the greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length.

        The error is about 1e-12 of the extent, unless the surface has details that a grid of 65 by 65 misses.
        """

        def heights(points: Reals) -> Reals:
            # A sum of products instead of one of matrices: all directions may share the points, or not.
            return np.asarray(sum(directions[:, axis, None, None] * points[axis] for axis in range(3)))

        return self._greatest(heights, len(directions))

    @cached_property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""
        lowest, highest = -self.highest_along(-DIRECTIONS), self.highest_along(DIRECTIONS)
        return Extent(tuple(lowest.tolist()), tuple(highest.tolist()))

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre of the bounding box, and radius of the smallest sphere around it that holds the surface."""
        lower, upper = self.extent.box
        center = (lower + (upper - lower) / 2).reshape(3, 1, 1, 1)
        x, y, z = center.ravel().tolist()
        return (x, y, z), float(self._greatest(lambda points: np.linalg.norm(points - center, axis=0), 1)[0])

    def _greatest(self, heights: Callable[[Reals], Reals], count: int) -> Reals:
        """Return the maxima over the surface (count,) of as many functions of position."""
        grids = [np.linspace(interval.low, interval.high, _GRID) for interval in self.intervals]
        values = heights(self.positions(*np.meshgrid(*grids, indexing="ij"))[:, None]).reshape(count, -1)
        best = np.unravel_index(values.argmax(axis=1), (_GRID, _GRID))
        centers = [grid[index] for grid, index in zip(grids, best, strict=True)]
        widths = [interval.length / (_GRID - 1) for interval in self.intervals]
        greatest: Reals = values.max(axis=1)
        steps = np.linspace(-1, 1, _ZOOM_GRID)
        for _ in range(_ZOOMS):
            around = zip(self.intervals, centers, widths, strict=True)
            lines = [_brought_back(interval, center[:, None] + width * steps) for interval, center, width in around]
            u, v = np.broadcast_arrays(lines[0][:, :, None], lines[1][:, None, :])
            values = heights(self.positions(u, v)).reshape(count, -1)
            np.maximum(greatest, values.max(axis=1), out=greatest)
            best = np.unravel_index(values.argmax(axis=1), (_ZOOM_GRID, _ZOOM_GRID))
            centers = [line[np.arange(count), index] for line, index in zip(lines, best, strict=True)]
            widths = [width / 3 for width in widths]
        return greatest


@dataclass(frozen=True, eq=False)
class ParametrisedSurface(Smooth):
    """A surface x(u, v), as a reference or for comparison; its transform is good to the ``eps`` requested.

    The parametrisation must cover the surface once, and be smooth: at the ends of parameters too, and across
    those of periodic ones. Poles are allowed: an end of u or v may be one point, as on a sphere in its angles.
    The quadrature is the trapezoidal rule in periodic parameters and Gauss-Legendre in others, with as many
    nodes as it takes. Derivatives are those of the interpolant through the nodes, which costs at most 1e-13 of the
    area, and 120 bytes of memory for each node; see docs/numerics.md. In studies the function travels to workers,
    so it must be picklable: a function of a module, or a value with ``__call__``.

    Args:
        position: Function of u and v, float64 arrays of one shape (...), that returns x, y and z: three
            arrays (...) or numbers, in the user's unit of length.
        u: Interval of the first parameter.
        v: Interval of the second parameter.
        scale: Scale of the similarity x -> scale * (x - origin) that is applied to positions.
        origin: Origin of that similarity, in the unit of ``position``.

    Raises:
        InputError: The function returns something else or values that are not finite; the ends of a periodic
            parameter are apart; or there is no area.

    >>> import sobolev_batch as sb
    >>> def saddle(u, v):
    ...     return u, v, 0.5 * (u**2 - v**2)
    >>> side = sb.shapes.Interval(-0.8, 0.8)
    >>> surface = sb.shapes.ParametrisedSurface(saddle, u=side, v=side)
    >>> f"{surface.area:.6f}"
    '3.044304'
    """

    position: Callable[[Reals, Reals], Vectors]
    u: Interval
    v: Interval
    scale: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not callable(self.position):
            raise InputError(f"position must be a function, found {self.position!r}")
        for name, interval in (("u", self.u), ("v", self.v)):
            if not isinstance(interval, Interval):
                raise InputError(f"{name} must run over an Interval, found {interval!r}")
        Similarity(self.scale, self.origin)  # refuses what is none
        self._check_closed()
        _ = self.area

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of u and v."""
        return self.u, self.v

    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...)."""
        # A function of the user may write into what it gets.
        u, v = map(np.array, np.broadcast_arrays(u, v))
        positions = _vectors(self.position(u, v), u.shape)
        positions -= np.reshape(self.origin, (3, *[1] * u.ndim))
        positions *= self.scale
        return positions

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""
        x, y, z = (old + shift / self.scale for old, shift in zip(self.origin, origin, strict=True))
        return replace(self, scale=scale * self.scale, origin=(x, y, z))

    def _check_closed(self) -> None:
        size = float(np.ptp(self.extent.box, axis=0).max())
        lines = [np.linspace(interval.low, interval.high, _CHECKS) for interval in self.intervals]
        grid = self.positions(*np.meshgrid(*lines, indexing="ij"))
        for axis, (name, interval) in enumerate({"u": self.u, "v": self.v}.items(), 1):
            gap = float(np.abs(grid.take(0, axis) - grid.take(-1, axis)).max())
            if interval.periodic and not gap <= _CLOSED * size:
                raise InputError(
                    f"the surface is said to be periodic in {name}, but its positions at the ends {interval.low:g} and "
                    f"{interval.high:g} are up to {gap / self.scale:.3g} apart"
                )


def doubled(counts: Counts) -> Counts:
    """Return twice as many nodes each way plus one: coprime to before, so that both rules rarely alias alike."""
    return 2 * counts[0] + 1, 2 * counts[1] + 1


def _brought_back(interval: Interval, values: Reals) -> Reals:
    if interval.periodic:
        return np.asarray(values - np.floor((values - interval.low) / interval.length) * interval.length)
    return np.asarray(np.clip(values, interval.low, interval.high))


@lru_cache(maxsize=64)
def _gauss_legendre(count: int) -> tuple[Reals, Reals]:
    """Return nodes and weights (count,) on [-1, 1]."""
    nodes = np.asarray(roots_legendre(count)[0], dtype=np.float64)
    # SciPy's weights lack four digits near the ends, where derivatives would show it.
    before, current = np.ones(count), nodes.copy()
    for degree in range(2, count + 1):
        before, current = current, ((2 * degree - 1) * nodes * current - (degree - 1) * before) / degree
    return nodes, 2 * (1 - nodes) * (1 + nodes) / (count * (before - nodes * current)) ** 2


@lru_cache(maxsize=4)
def _differentiation(count: int) -> Reals:
    """Return the matrix (count, count) from values at the Gauss-Legendre nodes on [-1, 1] to derivatives there."""
    nodes, weights = _gauss_legendre(count)
    barycentric = np.sqrt((1 - nodes**2) * weights) * (-1.0) ** np.arange(count)
    differences = nodes[:, None] - nodes
    np.fill_diagonal(differences, 1.0)
    matrix = barycentric / barycentric[:, None] / differences
    np.fill_diagonal(matrix, 0.0)
    # Constants have the derivative zero, to the last digit.
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return np.asarray(matrix)


def _vectors(returned: object, shape: tuple[int, ...]) -> Reals:
    """Return the result of a user's function as float64 (3, *shape)."""
    try:
        coordinates = [np.asarray(coordinate) for coordinate in returned]  # type: ignore[attr-defined]
        if len(coordinates) != 3 or any(coordinate.dtype.kind not in "fiu" for coordinate in coordinates):
            raise ValueError
        vectors = np.stack([np.broadcast_to(coordinate, shape) for coordinate in coordinates]).astype(np.float64)
    except (TypeError, ValueError) as error:
        parts: Sequence[Any] = returned if isinstance(returned, tuple | list) else [returned]
        kinds = ", ".join(f"{getattr(part, 'dtype', type(part).__name__)} {np.shape(part)}" for part in parts[:4])
        expected = f"three arrays of real numbers in the shape of u and v, {shape}"
        raise InputError(f"position must return {expected}, found {len(parts)}: {kinds}") from error
    if not np.isfinite(vectors).all():
        raise InputError("position is not finite everywhere on the surface")
    return vectors
