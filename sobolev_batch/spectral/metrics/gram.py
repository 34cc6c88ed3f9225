"""Squared distances between many fields at once, as weighted matrix products.

Fields enter as differences to one common center, so that the product |a|² + |b|² - 2<a, b> loses
only the digits by which a pair is closer to each other than to the center; pairs for which that is
too many are reported, to be measured directly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.budget import Sums, outer_windows
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.shells import shell_weights

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A squared distance this much smaller than the squared distances to the center has lost six of its
# sixteen digits.
_CANCELLATION = 1e-6
# Columns of one product: this many samples of a few dozen fields, weighted for a few orders, stay in cache.
_COLUMNS = 1 << 12
# The outer ranges are known well enough from one sample in eight, or from so many where that is more.
_SPARING = 8
_ENOUGH = 1 << 10


@dataclass(frozen=True, eq=False)
class Piece:
    """Neighbouring samples of an arrangement that count towards the same sums.

    Attributes:
        samples: which, by their place in the arrangement.
        residue: their |k|² mod 4.
        window: the outer range that they stand for, or None.
    """

    samples: slice
    residue: int
    window: int | None


@dataclass(frozen=True, eq=False)
class Arrangement:
    """The samples of a block of the half lattice in the order of the sums that they count towards.

    A matrix product then runs over one contiguous piece of all fields after the other, with the
    weights of all orders at once, instead of gathering samples for each.

    Attributes:
        order: the place in the block of each sample, int64 (block.size,).
        pieces: cover all of them.
        shells: |k|² of each sample, int32 (block.size,).
        trapezoid: their weights in the sum over the lattice (block.size,).
        by_order: (orders, lattice.shell_count) what each shell counts for.
        by_window: (2, lattice.shell_count) likewise; the samples left out are made up for.
    """

    order: NDArray[np.intp]
    pieces: tuple[Piece, ...]
    shells: NDArray[np.int32]
    trapezoid: Reals
    by_order: Reals
    by_window: Reals

    @classmethod
    def of(cls, lattice: Lattice, block: Block, orders: Sequence[float]) -> Arrangement:
        """The arrangement of a block for some orders."""
        shells = lattice.shells(block).ravel()
        windows = outer_windows(lattice)
        kinds = (shells % 4 * 3).astype(np.uint8)
        for i, window in enumerate(windows):
            members = np.flatnonzero(window[shells])
            # Drawn, not strided: strides would follow the lattice's rows. The same for every tile.
            count = min(len(members), max(-(-len(members) // _SPARING), _ENOUGH))
            kinds[np.random.default_rng(i).choice(members, count, replace=False)] += i + 1
            window *= len(members) / max(count, 1)
        order = np.argsort(kinds, kind="stable")
        ends = np.cumsum(np.bincount(kinds, minlength=12)).tolist()
        pieces = tuple(
            Piece(slice(start, end), kind // 3, kind % 3 - 1 if kind % 3 else None)
            for kind, (start, end) in enumerate(zip([0, *ends], ends, strict=False))
            if end > start
        )
        trapezoid = lattice.trapezoid_weights(block).ravel()[order]
        return cls(order, pieces, shells[order], trapezoid, shell_weights(lattice, orders), windows)

    def zeros(self, *shape: int) -> Sums:
        """Room for squares or products of so many fields."""
        return Sums.zeros(len(self.by_order), *shape)

    def products(self, first: Complexes, second: Complexes) -> Sums:
        """Inner products Re <a_i, b_j>_s of the parts of fields on this block.

        Args:
            first: a, complex128 (m, block.size), arranged, each row contiguous.
            second: b, complex128 (n, block.size), likewise; better the shorter one.

        Returns:
            The inner products in the form that `Sums` has for squares: (orders, 4, m, n) and
            (2, m, n). What all blocks of the half lattice give adds up to the whole.
        """
        m, n = len(first), len(second)
        left, right = first.view(np.float64), second.view(np.float64)
        sums = self.zeros(m, n)
        # Made once: large arrays that come and go cost as much as the arithmetic on them.
        room = np.empty((len(self.by_order) + 1) * n * 2 * _COLUMNS)
        for piece, columns, weights in self._parts():
            weighted = room[: weights.size * n].reshape(len(weights), n, -1)
            np.multiply(right[:, columns], weights[:, None], out=weighted)
            found = left[:, columns] @ weighted.reshape(len(weights) * n, -1).T
            self._add(sums, piece, np.moveaxis(found.reshape(m, len(weights), n), 1, 0))
        return sums

    def squares(self, fields: Complexes) -> Sums:
        """The products of fields (m, block.size) with themselves: (orders, 4, m) and (2, m)."""
        parts = fields.view(np.float64)
        sums = self.zeros(len(fields))
        room = np.empty(len(fields) * 2 * _COLUMNS)
        for piece, columns, weights in self._parts():
            squared = room[: len(fields) * weights.shape[1]].reshape(len(fields), -1)
            np.square(parts[:, columns], out=squared)
            self._add(sums, piece, weights @ squared.T)
        return sums

    def _parts(self) -> Iterator[tuple[Piece, slice, Reals]]:
        """Columns of real and imaginary parts that stay in cache, with their weights (orders or one more, columns)."""
        for piece in self.pieces:
            rows = self.by_order if piece.window is None else np.vstack([self.by_order, self.by_window[piece.window]])
            for start in range(piece.samples.start, piece.samples.stop, _COLUMNS):
                stop = min(start + _COLUMNS, piece.samples.stop)
                weights = rows[:, self.shells[start:stop]] * self.trapezoid[start:stop]
                yield piece, slice(2 * start, 2 * stop), np.repeat(weights, 2, axis=1)

    def _add(self, sums: Sums, piece: Piece, found: Reals) -> None:
        orders = len(self.by_order)
        sums.squares[:, piece.residue] += found[:orders]
        if piece.window is not None:
            sums.outer[piece.window] += found[orders]


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
