"""The exact transform of a sum of Dirac measures, at single frequencies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends.arrays import cosine_and_sine

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Pairs of a point and a frequency at a time: their temporaries stay in cache.
_PAIRS = 1 << 16


def point_transform(points: Reals, weights: Reals, frequencies: Reals) -> Complexes:
    """Return Σ w_j exp(-2πi ξ·x_j), summed one by one.

    Args:
        points: x_j, float64 (n, 3), n > 0, in units of length.
        weights: w_j, float64 (n,), in squared units of length.
        frequencies: ξ, float64 (P, 3), in cycles per unit length.

    Returns:
        complex128 (P,). The error is a rounding error of the phases, about 1e-16 times 2π |ξ| |x|, for each weight.
    """
    wave_vectors = -2 * np.pi * np.asarray(frequencies, dtype=np.float64)
    values = np.zeros(len(wave_vectors), dtype=np.complex128)
    rows = max(1, _PAIRS // len(points))
    columns = max(1, _PAIRS // rows)
    for row in range(0, len(wave_vectors), rows):
        group = wave_vectors[row : row + rows]
        for column in range(0, len(points), columns):
            batch = slice(column, column + columns)
            cosines, sines = cosine_and_sine(group @ points[batch].T)
            values[row : row + rows] += cosines @ weights[batch] + 1j * (sines @ weights[batch])
    return values
