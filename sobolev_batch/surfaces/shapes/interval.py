"""Intervals that a surface's parameters run over: their quadrature rules, and derivatives of values at the nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_legendre

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.sphere import is_finite_number

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """What a parameter of a surface runs over.

    Args:
        low: where it begins.
        high: where it ends; above ``low``.
        periodic: whether the surface closes smoothly from its end to its beginning.

    Raises:
        InputError: ends that are not finite numbers in ascending order.
    """

    low: float
    high: float
    periodic: bool = False

    def __post_init__(self) -> None:
        if not (is_finite_number(self.low) and is_finite_number(self.high) and self.low < self.high):
            raise InputError(f"an interval needs two finite ends in ascending order, found {self.low} and {self.high}")
        if not isinstance(self.periodic, bool):
            raise InputError(f"an interval is periodic or not: expected True or False, found {self.periodic!r}")
        object.__setattr__(self, "low", float(self.low))
        object.__setattr__(self, "high", float(self.high))
        if not math.isfinite(self.length):
            raise InputError(f"an interval's length must be finite, found {self.low} to {self.high}")

    @property
    def length(self) -> float:
        """From one end to the other."""
        return self.high - self.low

    def rule(self, count: int) -> tuple[Reals, Reals]:
        """Nodes and weights (count,) of a quadrature rule that converges spectrally on smooth functions.

        The trapezoidal rule where periodic (L. N. Trefethen, J. A. C. Weideman 2014,
        doi:10.1137/130932132), Gauss-Legendre otherwise, whose nodes leave out the ends.
        """
        if self.periodic:
            step = self.length / count
            return np.asarray(self.low + step * np.arange(count)), np.full(count, step, dtype=np.float64)
        nodes, weights = _gauss(count)
        return self.low + self.length / 2 * (1 + nodes), self.length / 2 * weights

    def derivative(self, values: Reals, axis: int) -> Reals:
        """The derivative at the nodes of the interpolant through values there.

        Args:
            values: float64, at the nodes of the `rule` along ``axis``.
            axis: of ``values``.

        Returns:
            float64, in the shape of ``values``: of the trigonometric polynomial where periodic, which
            needs an odd number of nodes, and of the polynomial otherwise (H. Wang, S. Xiang 2012,
            doi:10.1090/S0025-5718-2011-02549-4). On what the nodes resolve its error is rounding: about
            n or n² rounding errors of the largest value.
        """
        count = values.shape[axis]
        if self.periodic:
            waves = 2j * np.pi / self.length * np.arange(count // 2 + 1)
            spectrum = np.moveaxis(np.fft.rfft(values, axis=axis), axis, -1) * waves
            return np.asarray(np.moveaxis(np.fft.irfft(spectrum, count), -1, axis))
        matrix = 2 / self.length * _differentiation(count)
        return np.asarray(np.moveaxis(np.moveaxis(values, axis, -1) @ matrix.T, -1, axis))


@lru_cache(maxsize=64)
def _gauss(count: int) -> tuple[Reals, Reals]:
    nodes = np.asarray(roots_legendre(count)[0], dtype=np.float64)
    # The weights that come with them lack four digits near the ends, which derivatives there would show.
    before, current = np.ones(count), nodes.copy()
    for degree in range(2, count + 1):
        before, current = current, ((2 * degree - 1) * nodes * current - (degree - 1) * before) / degree
    return nodes, 2 * (1 - nodes) * (1 + nodes) / (count * (before - nodes * current)) ** 2


@lru_cache(maxsize=4)
def _differentiation(count: int) -> Reals:
    """The matrix (count, count) that takes values at the Gauss-Legendre nodes on [-1, 1] to derivatives there."""
    nodes, weights = _gauss(count)
    barycentric = np.sqrt((1 - nodes**2) * weights) * (-1.0) ** np.arange(count)
    gaps = nodes[:, None] - nodes
    np.fill_diagonal(gaps, 1.0)
    matrix = barycentric / barycentric[:, None] / gaps
    np.fill_diagonal(matrix, 0.0)
    # Constants have the derivative zero, to the last digit.
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return np.asarray(matrix)
