"""Squared distances between many fields at once, as weighted matrix products.

Fields enter as differences to one common center, so that the product |a|² + |b|² - 2<a, b> loses
only the digits by which a pair is closer to each other than to the center; pairs for which that is
too many are reported, to be measured directly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.norms import shell_weights

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A squared distance this much smaller than the squared distances to the center has lost six of its
# sixteen digits.
_CANCELLATION = 1e-6
# Columns of one product: 8 rows of a few hundred fields of this many samples stay in cache.
_COLUMNS = 1 << 15


def gram_blocks(first: Complexes, second: Complexes, lattice: Lattice, block: Block, orders: Sequence[float]) -> Reals:
    """Inner products Re <a_i, b_j>_s of the parts of fields on one block of the half lattice.

    Args:
        first: a, complex128 (m, block.size).
        second: b, complex128 (n, block.size).
        lattice: where the samples lie.
        block: which part of it they are.
        orders: s, each.

    Returns:
        float64 (orders, m, n); the sum over all blocks of the half lattice is that over the whole.
    """
    by_order = shell_weights(lattice, orders)
    shells = lattice.shells(block).ravel()
    trapezoid = lattice.trapezoid_weights(block).ravel()
    products = np.zeros((len(orders), len(first), len(second)))
    for start in range(0, block.size, _COLUMNS):
        part = slice(start, start + _COLUMNS)
        right = np.ascontiguousarray(second[:, part]).view(np.float64).T
        left = np.ascontiguousarray(first[:, part])
        for i in range(len(orders)):
            weighted = left * (trapezoid[part] * by_order[i][shells[part]])
            products[i] += weighted.view(np.float64) @ right
    return products


def squared_distances(products: Reals, first: Reals, second: Reals) -> tuple[Reals, NDArray[np.bool_]]:
    """Squared distances of pairs from their inner products, and which of them cancelled.

    Args:
        products: (orders, m, n) inner products of the differences to the center.
        first: squared distances of a to the center, (orders, m).
        second: those of b, (orders, n).

    Returns:
        (orders, m, n) squared distances, not negative; and whether any order of a pair (m, n) has
        lost more than about six digits.
    """
    sums = first[:, :, None] + second[:, None, :]
    squares: Reals = np.maximum(sums - 2 * products, 0.0)
    cancelled: NDArray[np.bool_] = np.any(squares < _CANCELLATION * sums, axis=0)
    return squares, cancelled
