"""Surfaces of axis-parallel rectangles, whose distances are exact at every order.

Their heat trace G(t) = (π/t)^(3/2) ∬ exp(-π²|x-y|²/t) dm dm is a sum over pairs of rectangles of products of error
functions, one factor for each axis; and ||m||_s² = 1/Γ(-s) ∫ t^(-s-1) exp(-t) G(t) dt. There is no Fourier transform.
Rectangles that share intervals of an axis share its factors, so the sum is a product of small matrices with a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, gamma

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals

# Times of the finer of two rules. The least resolves gaps from some 1e-6 on.
TIMES: Reals = np.geomspace(1e-12, 80.0, 481)
_STEP = float(np.log(TIMES[1] / TIMES[0]))
# Rounding of a trace, relative to the one without signs. Where all rectangles are narrower than a length, their factors
# lose digits by the square of what they are narrower by.
_ROUNDING, _SHORT = 1e-14, 0.1


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Rectangles by their lowest and highest corners, float64 (n, 3) each; flat along one axis."""

    low: Reals
    high: Reals

    @classmethod
    def from_corners(cls, *corners: tuple[Sequence[float], Sequence[float]]) -> Self:
        return cls(np.array([low for low, _ in corners], float), np.array([high for _, high in corners], float))

    @classmethod
    def box(cls, low: Sequence[float] | Reals, high: Sequence[float] | Reals) -> Self:
        lows, highs = [], []
        for axis, value in product(range(3), (0, 1)):
            first, last = np.array(low, float), np.array(high, float)
            first[axis] = last[axis] = (low, high)[value][axis]
            lows.append(first)
            highs.append(last)
        return cls(np.array(lows), np.array(highs))

    @classmethod
    def cells(cls, edges: Sequence[Reals], filled: NDArray[np.bool_]) -> Self:
        """Return the boundary of the filled cells of a grid, whose edges are given for each axis."""
        lows, highs = [], []
        for axis in range(3):
            width = [(1, 1) if other == axis else (0, 0) for other in range(3)]
            change = np.diff(np.pad(filled, width).astype(int), axis=axis) != 0
            first = np.argwhere(change)
            last = first + (np.arange(3) != axis)
            lows.append(np.stack([edges[other][first[:, other]] for other in range(3)], axis=1))
            highs.append(np.stack([edges[other][last[:, other]] for other in range(3)], axis=1))
        return cls(np.concatenate(lows), np.concatenate(highs))

    @classmethod
    def sheets(cls, count: int, gap: float, height: float, sides: ArrayLike = (1.0, 1.0)) -> Self:
        """Return parallel rectangles at a gap, the lowest one at a height."""
        low, high = -np.array(sides) / 2, np.array(sides) / 2
        return cls.from_corners(*(((*low, z), (*high, z)) for z in height + gap * np.arange(count)))

    @classmethod
    def fins(cls, count: int, width: float = 0.8) -> Self:
        """Return parallel squares, ``count`` of them over a unit of length."""
        half = width / 2
        return cls.from_corners(*(((-half, -half, z), (half, half, z)) for z in np.arange(count) / count - 0.5))

    @classmethod
    def strips(cls, count: int, offset: float, length: float, filled: float) -> Self:
        """Return long strips over a unit of length, which fill a part of it, moved across by a part of their pitch."""
        lefts = (np.arange(count) + offset) / count - 0.5
        return cls.from_corners(*(((x, -length / 2, 0), (x + filled / count, length / 2, 0)) for x in lefts))

    @classmethod
    def tapered(cls, count: int, pitch: float, half: float, offset: float = 0.0) -> Self:
        """Return parallel squares, smaller towards both ends, moved along their stack by a part of the pitch."""
        heights = pitch * (np.arange(count) + 0.5 - count / 2 + offset)
        halves = half * np.cos(np.pi * heights / (count * pitch)) ** 2
        return cls.from_corners(*(((-a, -a, z), (a, a, z)) for a, z in zip(halves, heights, strict=True)))

    @classmethod
    def perforated(cls, count: int, thickness: float = 0.05) -> Self:
        """Return a unit plate with a grid of square holes, each half as wide as its cell."""
        pitch, half = 1 / count, thickness / 2
        corners: list[tuple[Sequence[float], Sequence[float]]] = []
        for i, j in product(range(count), repeat=2):
            x, y = i * pitch - 0.5, j * pitch - 0.5
            xs, ys = (x, x + pitch / 4, x + 3 * pitch / 4, x + pitch), (y, y + pitch / 4, y + 3 * pitch / 4, y + pitch)
            for z in (-half, half):
                corners += [((xs[0], ys[0], z), (xs[3], ys[1], z)), ((xs[0], ys[2], z), (xs[3], ys[3], z))]
                corners += [((xs[0], ys[1], z), (xs[1], ys[2], z)), ((xs[2], ys[1], z), (xs[3], ys[2], z))]
            corners += [((x0, ys[1], -half), (x0, ys[2], half)) for x0 in xs[1:3]]
            corners += [((xs[1], y0, -half), (xs[2], y0, half)) for y0 in ys[1:3]]
        return cls.from_corners(*corners)

    def moved(self, *offset: float) -> Rectangles:
        return Rectangles(self.low + offset, self.high + offset)

    def joined(self, other: Rectangles) -> Rectangles:
        return Rectangles(np.concatenate([self.low, other.low]), np.concatenate([self.high, other.high]))

    def mesh(self) -> Mesh:
        vertices = []
        for low, high in zip(self.low, self.high, strict=True):
            i, j = np.flatnonzero(high > low)
            corners = np.tile(low, (4, 1))
            corners[[1, 2], i], corners[[2, 3], j] = high[i], high[j]
            vertices.append(corners)
        first = 4 * np.arange(len(vertices))[:, None, None]
        return Mesh(np.concatenate(vertices), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3))

    def distance(self, other: Rectangles, orders: Sequence[float]) -> Reals:
        return np.asarray(np.sqrt(self.squared_distance(other, orders)[0]))

    def squared_distance(self, other: Rectangles, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the squared distances (orders,) of the two area measures, and their uncertainties."""
        both = self.joined(other)
        signs = np.concatenate([np.ones(len(self.low)), -np.ones(len(other.low))])
        widest = np.sort(both.high - both.low, axis=1)[:, 1].max()
        traces, scales = _heat_traces(*_intervals(both), signs)
        return integrals_of_traces(traces, scales * max(1.0, _SHORT / widest) ** 2, orders)


def integrals_of_traces(traces: Reals, scales: Reals, orders: Sequence[float]) -> tuple[Reals, Reals]:
    """Return the squared norms (orders,) of heat traces at `TIMES`, and their uncertainties.

    `scales` are sums of the sizes of the terms of the traces, times what rounding exceeds that of one by.
    """
    squares, slacks = [], []
    for order in orders:
        factors = TIMES**-order * np.exp(-TIMES) / gamma(-order)
        fine = _integral(factors * traces, _STEP, -order)
        coarse = _integral((factors * traces)[::2], 2 * _STEP, -order)
        rounding = _ROUNDING * _integral(factors * scales, _STEP, -order)
        # The limit of √t G is off by terms in √t, which a change of √t by half shows.
        later = int(np.ceil(np.log(4) / _STEP))
        limits = np.sqrt(TIMES) * traces
        unlimited = abs(limits[later] - limits[0]) / np.sqrt(TIMES[0]) * factors[0] / (-order - 0.5)
        squares.append(fine)
        slacks.append(abs(fine - coarse) + rounding + unlimited)
    return np.array(squares), np.array(slacks)


def _integral(terms: Reals, step: float, power: float) -> float:
    """Return the integral over all times of terms t^power G(t): trapezoidal, by √t G's limit below the least t."""
    slope = (power - 0.5) * terms[0]
    inner = (terms.sum() - terms[0] / 2 - terms[-1] / 2) * step + step**2 / 12 * slope
    return float(inner + terms[0] / (power - 0.5))


def _intervals(rectangles: Rectangles) -> tuple[list[Reals], list[NDArray[np.int64]]]:
    """Return the different intervals (n, 2) of each axis, and which of them each rectangle has."""
    intervals, places = [], []
    for axis in range(3):
        ends = np.stack([rectangles.low[:, axis], rectangles.high[:, axis]], axis=1)
        different, place = np.unique(ends, axis=0, return_inverse=True)
        intervals.append(different)
        places.append(place.ravel())
    return intervals, places


def _heat_traces(intervals: Sequence[Reals], places: Sequence[NDArray[np.int64]], signs: Reals) -> tuple[Reals, Reals]:
    """Return the heat trace at each of the times, and what it would be if all signs were positive."""
    grids = [np.zeros([len(different) for different in intervals]) for _ in range(2)]
    for grid, weights in zip(grids, (signs, np.ones(len(signs))), strict=True):
        np.add.at(grid, tuple(places), weights)
    traces = []
    for time in TIMES:
        factors = [_axis_factors(ends[:, 0], ends[:, 1], np.pi / np.sqrt(time)) for ends in intervals]
        if len(signs) ** 2 < grids[0].size:
            # Few rectangles with many intervals: all pairs of them.
            x, y, z = (factor[np.ix_(place, place)] for factor, place in zip(factors, places, strict=True))
            pairs = x * y * z
            traces.append([signs @ pairs @ signs, pairs.sum()])
        else:
            sums = (np.einsum("ai,bj,ck,ijk->abc", *factors, grid, optimize=True) for grid in grids)
            traces.append([np.vdot(grid, inner) for grid, inner in zip(grids, sums, strict=True)])
    signed, positive = (np.pi / TIMES) ** 1.5 * np.array(traces).T
    return signed, positive


def _axis_factors(a: Reals, b: Reals, rate: float) -> Reals:
    """Return ∬ exp(-(rate (x-y))²) dx dy over each two intervals from a to b, in which flat ones count as points."""
    flat = a == b
    between = 0.0
    for end, start in product((0, 1), repeat=2):
        gaps = rate * np.subtract.outer((a, b)[end], (a, b)[start])
        antiderivative = (gaps * np.sqrt(np.pi) * erf(gaps) + np.exp(-(gaps**2))) / (2 * rate**2)
        between = between + (1 if end != start else -1) * antiderivative
    from_flat = np.sqrt(np.pi) / (2 * rate) * (erf(rate * (b - a[:, None])) - erf(rate * (a - a[:, None])))
    both_flat = np.exp(-((rate * np.subtract.outer(a, a)) ** 2))
    cases = [flat[:, None] & flat, flat[:, None] & ~flat, ~flat[:, None] & flat]
    return np.asarray(np.select(cases, [both_flat, from_flat, from_flat.T], between))
