"""Squared distances between many fields at once, as weighted matrix products.

Fields enter as differences to one common center, so that the product |a|² + |b|² - 2<a, b> loses
only the digits by which a pair is closer to each other than to the center; pairs for which that is
too many are reported, to be measured directly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.budget import Sums, outer_windows
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.shells import shell_weights

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A squared distance this much smaller than the squared distances to the center has lost six of its
# sixteen digits.
_CANCELLATION = 1e-6
# Columns of one product: 8 rows of a few hundred fields of this many samples stay in cache.
_COLUMNS = 1 << 15
_SPARING = 8


def gram_blocks(first: Complexes, second: Complexes, lattice: Lattice, block: Block, orders: Sequence[float]) -> Sums:
    """Inner products Re <a_i, b_j>_s of the parts of fields on one block of the half lattice.

    Args:
        first: a, complex128 (m, block.size).
        second: b, complex128 (n, block.size).
        lattice: where the samples lie.
        block: which part of it they are.
        orders: s, each.

    Returns:
        The inner products in the form that `Sums` has for squares: (orders, 4, m, n) and (2, m, n).
        What all blocks of the half lattice give adds up to the whole. The outer ranges are taken
        from one sample in eight.
    """
    by_order = shell_weights(lattice, orders)
    shells = lattice.shells(block).ravel()
    trapezoid = lattice.trapezoid_weights(block).ravel()
    squares = np.zeros((len(orders), 4, len(first), len(second)))
    for residue in range(4):
        members = np.flatnonzero(shells % 4 == residue)
        for start in range(0, len(members), _COLUMNS):
            part = members[start : start + _COLUMNS]
            left, right = np.take(first, part, axis=1), np.take(second, part, axis=1).view(np.float64).T
            for i in range(len(orders)):
                weighted = left * (trapezoid[part] * by_order[i][shells[part]])
                squares[i, residue] += weighted.view(np.float64) @ right
    outer = np.zeros((2, len(first), len(second)))
    for i, window in enumerate(outer_windows(lattice)):
        members = np.flatnonzero(window[shells])
        # Drawn, not strided: strides would follow the lattice's rows. The same for every tile.
        count = -(-len(members) // _SPARING)
        part = np.sort(np.random.default_rng(i).choice(members, count, replace=False))
        weights = trapezoid[part] * window[shells[part]] * (len(members) / max(count, 1))
        left, right = np.take(first, part, axis=1), np.take(second, part, axis=1).view(np.float64).T
        outer[i] = (left * weights).view(np.float64) @ right
    return Sums(squares, outer)


def differences(products: Sums, first: Sums, second: Sums) -> tuple[Sums, NDArray[np.bool_]]:
    """Squared differences of pairs from their inner products, and which of them cancelled.

    Args:
        products: of the differences to the center, (orders, 4, m, n) and (2, m, n).
        first: squares of the differences a to the center, (orders, 4, m) and (2, m).
        second: those of b, (orders, 4, n) and (2, n).

    Returns:
        The squares of a - b; and whether any order of a pair (m, n) has lost more than about six
        digits.
    """
    sums = first.squares[..., :, None] + second.squares[..., None, :]
    squares = sums - 2 * products.squares
    total, scale = squares.sum(axis=1), sums.sum(axis=1)
    outer = np.maximum(first.outer[:, :, None] + second.outer[:, None, :] - 2 * products.outer, 0.0)
    cancelled: NDArray[np.bool_] = np.any(total <= _CANCELLATION * scale, axis=0)
    return Sums(squares, outer), cancelled
