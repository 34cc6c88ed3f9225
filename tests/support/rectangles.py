"""Surfaces of axis-parallel rectangles, whose distances are exact at every order.

Their heat trace G(t) = (π/t)^(3/2) ∬ exp(-π²|x-y|²/t) dm dm is a sum over pairs of rectangles of products of error
functions, one factor for each axis; and ||m||_s² = 1/Γ(-s) ∫ t^(-s-1) exp(-t) G(t) dt. There is no Fourier transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf, gamma

from sobolev_batch import Mesh

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Rectangles by their lowest and highest corners, float64 (n, 3) each; flat along one axis."""

    low: Reals
    high: Reals

    @classmethod
    def of(cls, *corners: tuple[Sequence[float], Sequence[float]]) -> Self:
        return cls(np.array([low for low, _ in corners], float), np.array([high for _, high in corners], float))

    @classmethod
    def box(cls, low: Sequence[float], high: Sequence[float]) -> Self:
        lows, highs = [], []
        for axis, value in product(range(3), (0, 1)):
            first, last = np.array(low, float), np.array(high, float)
            first[axis] = last[axis] = (low, high)[value][axis]
            lows.append(first)
            highs.append(last)
        return cls(np.array(lows), np.array(highs))

    @classmethod
    def fins(cls, count: int, width: float = 0.8) -> Self:
        """Return parallel squares, ``count`` of them over a unit of length."""
        heights = np.arange(count) / count - 0.5
        half = width / 2
        return cls.of(*(((-half, -half, z), (half, half, z)) for z in heights))

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
        return cls.of(*corners)

    def moved(self, *offset: float) -> Rectangles:
        return Rectangles(self.low + offset, self.high + offset)

    def mesh(self) -> Mesh:
        """Return two triangles for each rectangle."""
        vertices = []
        for low, high in zip(self.low, self.high, strict=True):
            i, j = np.flatnonzero(high > low)
            corners = np.tile(low, (4, 1))
            corners[[1, 2], i], corners[[2, 3], j] = high[i], high[j]
            vertices.append(corners)
        first = 4 * np.arange(len(vertices))[:, None, None]
        return Mesh(np.concatenate(vertices), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3))

    def distance(self, other: Rectangles, orders: Sequence[float], steps: int = 200) -> Reals:
        """Return the distances (orders,) of the two area measures."""
        low, high = np.concatenate([self.low, other.low]), np.concatenate([self.high, other.high])
        signs = np.concatenate([np.ones(len(self.low)), -np.ones(len(other.low))])
        logs = np.linspace(np.log(1e-9), np.log(80), steps)
        times, step = np.exp(logs), logs[1] - logs[0]
        traces = np.array([_heat_trace(low, high, signs, time) for time in times])
        squares = []
        for order in orders:
            terms = times**-order * np.exp(-times) * traces
            integral = (terms.sum() - terms[0] / 2 - terms[-1] / 2) * step
            # Below the least t, √t G is its limit.
            integral += terms[0] / (-order - 0.5)
            squares.append(integral / gamma(-order))
        return np.sqrt(squares)


def _heat_trace(low: Reals, high: Reals, signs: Reals, time: float) -> float:
    rate = np.pi / np.sqrt(time)
    products = np.outer(signs, signs)
    for axis in range(3):
        a, b = low[:, axis], high[:, axis]
        flat = a == b
        between = 0.0
        for end, start in product((0, 1), repeat=2):
            gaps = np.subtract.outer((a, b)[end], (a, b)[start])
            antiderivative = gaps * np.sqrt(np.pi) / (2 * rate) * erf(rate * gaps) + np.exp(-((rate * gaps) ** 2)) / (
                2 * rate**2
            )
            between = between + (1 if end != start else -1) * antiderivative
        from_flat = np.sqrt(np.pi) / (2 * rate) * (erf(rate * (b - a[:, None])) - erf(rate * (a - a[:, None])))
        both_flat = np.exp(-((rate * np.subtract.outer(a, a)) ** 2))
        products = products * np.select(
            [flat[:, None] & flat, flat[:, None] & ~flat, ~flat[:, None] & flat],
            [both_flat, from_flat, from_flat.T],
            between,
        )
    return float((np.pi / time) ** 1.5 * products.sum())
