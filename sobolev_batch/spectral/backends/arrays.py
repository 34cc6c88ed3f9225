"""Operations on the arrays of any backend that NumPy's own functions do not serve equally well everywhere.

Arrays of the processor are NumPy's, those of a GPU are CuPy's. NumPy's functions dispatch on their
arguments, and those that create arrays on ``like=``, so that the same expressions compute on both; what
follows are the exceptions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# NumPy's or CuPy's; CuPy has no types.
Array = Any


def combine(coefficients: NDArray[np.float64], rows: Array, out: Array | None = None) -> Array:
    """The matrix product of a few coefficients (..., k), on the host, with rows (k, n) of a backend.

    CuPy's product needs cuBLAS, which takes more room than everything else together; sums of a few
    rows do not.
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
    """The sum of each run of values (n,), from the index at which each begins; the first is zero.

    CuPy's reduceat takes differences of a cumulative sum, which loses digits where that has grown large.
    """
    if isinstance(values, np.ndarray):
        return np.add.reduceat(values, starts)
    firsts = np.zeros(len(values), dtype=np.int64, like=values)
    firsts[starts] = 1
    return np.bincount(np.cumsum(firsts) - 1, weights=values)
