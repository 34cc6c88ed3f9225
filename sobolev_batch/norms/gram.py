"""Squared distances between many fields at once, as weighted matrix products.

Fields enter as differences to one center, so that |a|² + |b|² - 2<a, b> loses only the digits by which a pair is closer
to each other than to the center. Pairs that lose too many are reported; their differences must be summed directly.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.norms.budget import Sums, outer_windows
from sobolev_batch.transform.lattice import Block, SobolevWeights

Run = tuple[slice, int, int | None]

# A squared distance this much below the squared distances to the center has lost six of its sixteen digits.
_CANCELLATION = 1e-6
# Columns of one product: this many samples of a few dozen fields, weighted for a few orders, stay in cache.
_COLUMNS = 1 << 12
# One sample in eight represents the outer ranges well enough, or this many samples if that is more.
_SAMPLED_ONE_IN = 8
_FEWEST_SAMPLED = 1 << 10


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Samples of a block of the half lattice, sorted by the sums that they count towards.

    A matrix product then runs over one contiguous run of all fields after the other, with the
    weights of all orders at once, instead of gathering samples for each.

    Attributes:
        order: Position in the block of each sample, int64 (block.size,).
        runs: Neighbouring samples that count towards the same sums, and cover the block: their positions, |k|² mod 4,
            and the outer range that they represent, or None.
        shells: |k|² of each sample, int32 (block.size,).
        trapezoid: Weight of each sample in the sum over the lattice (block.size,).
        by_order: Weights of the shells for each order, and for narrower ones (rows, lattice.shell_count).
        places: Rows of these that `Sums.totals` and `Sums.by_residue` take.
        by_window: Weights of the shells for the outer ranges (2, lattice.shell_count), raised for samples left out.
    """

    order: NDArray[np.intp]
    runs: tuple[Run, ...]
    shells: NDArray[np.int32]
    trapezoid: Reals
    by_order: Reals
    places: tuple[list[int], list[int]]
    by_window: Reals

    @classmethod
    def for_block(cls, weights: SobolevWeights, block: Block) -> Self:
        """Return the arrangement of a block of the weights' lattice."""
        lattice = weights.lattice
        shells = lattice.shells(block).ravel()
        windows = outer_windows(weights)
        numbers = (shells % 4 * 3).astype(np.uint8)
        for i, window in enumerate(windows):
            members = np.flatnonzero(window[shells])
            # Drawn, not strided: strides would follow the lattice's rows. The same for every tile.
            count = min(len(members), max(-(-len(members) // _SAMPLED_ONE_IN), _FEWEST_SAMPLED))
            numbers[np.random.default_rng(i).choice(members, count, replace=False)] += i + 1
            window *= len(members) / max(count, 1)
        order = np.argsort(numbers, kind="stable")
        ends = np.cumsum(np.bincount(numbers, minlength=12)).tolist()
        runs = tuple(
            (slice(start, end), number // 3, number % 3 - 1 if number % 3 else None)
            for number, (start, end) in enumerate(zip([0, *ends], ends, strict=False))
            if end > start
        )
        trapezoid = lattice.trapezoid_weights(block).ravel()[order]
        parts = weights.orders, weights.narrower.orders
        every = list(dict.fromkeys(chain(*parts)))
        by_order = replace(weights, orders=tuple(every)).per_shell
        places = [every.index(s) for s in parts[0]], [every.index(s) for s in parts[1]]
        return cls(order, runs, shells[order], trapezoid, by_order, places, windows)

    def products(self, first: Complexes, second: Complexes) -> Sums:
        """Return the contributions of this block to the inner products Re <a_i, b_j>_s of fields.

        The fields are complex128 (m, block.size) and (n, block.size), arranged, each row contiguous; preferably the
        second ones are fewer. The arrays end in (m, n). Contributions of all blocks of the half lattice add up.
        """
        m, n = len(first), len(second)
        left, right = first.view(np.float64), second.view(np.float64)
        sums = Sums.zeros(len(self.places[0]), m, n)
        # Allocated once: large temporaries cost as much as the arithmetic on them.
        buffer = np.empty((len(self.by_order) + 1) * n * 2 * _COLUMNS)
        for run, columns, weights in self._column_batches():
            weighted = buffer[: weights.size * n].reshape(len(weights), n, -1)
            np.multiply(right[:, columns], weights[:, None], out=weighted)
            products = left[:, columns] @ weighted.reshape(len(weights) * n, -1).T
            self._add(sums, run, np.moveaxis(products.reshape(m, len(weights), n), 1, 0))
        return sums

    def squares(self, fields: Complexes) -> Sums:
        """Return the products of fields (m, block.size) with themselves, in arrays that end in (m,)."""
        values = fields.view(np.float64)
        sums = Sums.zeros(len(self.places[0]), len(fields))
        buffer = np.empty(len(fields) * 2 * _COLUMNS)
        for run, columns, weights in self._column_batches():
            squared = buffer[: len(fields) * weights.shape[1]].reshape(len(fields), -1)
            np.square(values[:, columns], out=squared)
            self._add(sums, run, weights @ squared.T)
        return sums

    def _column_batches(self) -> Iterator[tuple[Run, slice, Reals]]:
        """Yield columns of real and imaginary parts that stay in cache, with weights (rows or one more, columns)."""
        for run in self.runs:
            samples, _, window = run
            rows = self.by_order if window is None else np.vstack([self.by_order, self.by_window[window]])
            for start in range(samples.start, samples.stop, _COLUMNS):
                stop = min(start + _COLUMNS, samples.stop)
                weights = rows[:, self.shells[start:stop]] * self.trapezoid[start:stop]
                yield run, slice(2 * start, 2 * stop), np.repeat(weights, 2, axis=1)

    def _add(self, sums: Sums, run: Run, products: Reals) -> None:
        _, residue, window = run
        of_totals, of_residues = self.places
        sums.totals[...] += products[of_totals]
        sums.by_residue[:, residue] += products[of_residues]
        if window is not None:
            sums.outer[window] += products[-1]


def differences(products: Sums, first: Sums, second: Sums) -> tuple[Sums, NDArray[np.bool_]]:
    """Return squared differences of pairs from their inner products, and a mask of those that cancelled.

    The products are those of the differences to the center, in arrays that end in (m, n). The others are squares of
    these, and end in (m,) and (n,). The mask (m, n) is True for pairs that lost more than some six digits at any order.
    """
    scales = [a[..., :, None] + b[..., None, :] for a, b in zip(first, second, strict=True)]
    squares = Sums(*(scale - 2 * both for scale, both in zip(scales, products, strict=True)))
    cancelled: NDArray[np.bool_] = np.any(squares.totals <= _CANCELLATION * scales[0], axis=0)
    return squares._replace(outer=np.maximum(squares.outer, 0.0)), cancelled
