"""Intervals of parameters, with their quadrature rules and the derivatives of interpolants."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_legendre

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import is_finite_number

Reals = NDArray[np.float64]


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
    >>> nodes, weights = sb.Interval(0.0, np.pi).rule(12)
    >>> f"{weights @ np.sin(nodes):.12f}"
    '2.000000000000'
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

        The interpolant is a trigonometric polynomial where periodic, which needs an odd number of nodes,
        and a polynomial otherwise (H. Wang, S. Xiang 2012, doi:10.1090/S0025-5718-2011-02549-4). For
        functions that the nodes resolve, the error is about n or n² roundings of the largest value.

        Args:
            values: Values at the nodes, float64, of any shape.
            axis: Axis of ``values`` that runs over the nodes.

        Returns:
            Derivatives, float64, in the shape of ``values``.
        """
        count = values.shape[axis]
        if self.periodic:
            frequencies = 2j * np.pi / self.length * np.arange(count // 2 + 1)
            spectrum = np.moveaxis(np.fft.rfft(values, axis=axis), axis, -1) * frequencies
            return np.asarray(np.moveaxis(np.fft.irfft(spectrum, count), -1, axis))
        matrix = 2 / self.length * _differentiation(count)
        return np.asarray(np.moveaxis(np.moveaxis(values, axis, -1) @ matrix.T, -1, axis))


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
