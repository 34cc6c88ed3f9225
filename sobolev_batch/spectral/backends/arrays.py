"""The dtypes of fields, and array operations for which NumPy's own functions are not the best choice on every backend.

Arrays on the processor are NumPy's, arrays on a GPU are CuPy's. NumPy's functions dispatch on their arguments,
or on ``like=`` where they create an array, so the same expressions run on both. The exceptions are here.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ComplexDtype = Literal["complex128", "complex64"]
Complexes = NDArray[np.complexfloating[Any, Any]]


# NumPy's or CuPy's; CuPy has no types.
Array = Any


def combine(coefficients: NDArray[np.float64], rows: Array, out: Array | None = None) -> Array:
    """Return the matrix product of a few coefficients (..., k), on the host, with rows (k, n) of a backend.

    CuPy's product needs cuBLAS, which takes more memory than everything else together.
    """
    if isinstance(rows, np.ndarray):
        return np.matmul(coefficients, rows, out=out)
    factors = np.asarray(coefficients, like=rows)[..., None]
    total = factors[..., 0, :] * rows[0]
    for index in range(1, len(rows)):
        total += factors[..., index, :] * rows[index]
    if out is None:
        return total
    out[...] = total
    return out


def sums_of_runs(values: Array, starts: Array) -> Array:
    """Return the sum of each run of values (n,), given the index at which each run starts; the first is zero.

    CuPy's reduceat takes differences of a cumulative sum, which loses digits where the sum is large.
    """
    if isinstance(values, np.ndarray):
        return np.add.reduceat(values, starts)
    firsts = np.zeros(len(values), dtype=np.int64, like=values)
    firsts[starts] = 1
    return np.bincount(np.cumsum(firsts) - 1, weights=values)


def cosine_and_sine(angles: Array) -> tuple[Array, Array]:
    """Return cosine and sine of angles in radians, to two or three rounding errors of 1.

    Both come from the tangent of half the angle: NumPy vectorises the tangent of doubles, but neither
    cosine nor sine, which each take seven times as long.
    """
    tangents = np.tan(0.5 * angles)
    squares = tangents * tangents
    inverses = 1 / (1 + squares)
    return (1 - squares) * inverses, 2 * tangents * inverses
