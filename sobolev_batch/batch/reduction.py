"""From stored fields to norms and distances: tiles of rows, each one Dask task over the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store import Store
from sobolev_batch.spectral.gram import gram_blocks, squared_distances
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.norms import shell_sums, shell_weights

Reals = NDArray[np.float64]
Place = tuple[slice, slice, slice]

# Fields that a task holds at a time, in all.
_TILE_BYTES = 256 << 20


@dataclass(frozen=True)
class Reducer:
    """What every tile of one reduction shares.

    Attributes:
        store: where the fields are.
        lattice, blocks: how a field is cut into chunks.
        orders: s, each.
        center: the row of the reference, or None if it has no field.
    """

    store: Store
    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    center: int | None

    def rows_per_tile(self) -> int:
        """How many rows make a tile side so that two sides fit into a task's memory."""
        return max(1, _TILE_BYTES // (2 * self.blocks[0].size * 16))

    def norms(self, rows: Sequence[int]) -> tuple[Reals, Reals]:
        """Norms of rows and their distances to the center, each (orders, rows); NaN without a center."""
        own = np.zeros((len(rows), self.lattice.shell_count))
        to_center = np.full_like(own, np.nan if self.center is None else 0.0)
        for block in self.blocks:
            place = self.lattice.place(block)
            center = None if self.center is None else self.store.read_fields([self.center], place)[0]
            for i, row in enumerate(rows):
                values = self.store.read_fields([row], place)[0]
                own[i] += shell_sums(values, None, self.lattice, block)
                if center is not None:
                    to_center[i] += shell_sums(values - center, None, self.lattice, block)
        weights = shell_weights(self.lattice, self.orders)
        return np.sqrt(weights @ own.T), np.sqrt(weights @ to_center.T)

    def tile(self, rows: Sequence[int], others: Sequence[int]) -> Reals:
        """Distances of rows to other rows, (orders, rows, others)."""
        same = tuple(rows) == tuple(others)
        products = np.zeros((len(self.orders), len(rows), len(others)))
        squares = np.zeros((2, len(self.orders), max(len(rows), len(others))))
        for block in self.blocks:
            place = self.lattice.place(block)
            center = 0.0 if self.center is None else self.store.read_fields([self.center], place)
            first = self._differences(rows, place, center)
            second = first if same else self._differences(others, place, center)
            products += gram_blocks(first, second, self.lattice, block, self.orders)
            weights = shell_weights(self.lattice, self.orders)
            for side, fields in enumerate((first, second)):
                for i, field in enumerate(fields):
                    sums = shell_sums(field.reshape(block.shape), None, self.lattice, block)
                    squares[side, :, i] += weights @ sums
        if same:
            # Each half of a weighted product rounds in its own way; a distance matrix is symmetric.
            products = (products + np.swapaxes(products, 1, 2)) / 2
        found, cancelled = squared_distances(products, squares[0][:, : len(rows)], squares[1][:, : len(others)])
        for i, j in np.argwhere(cancelled).tolist():
            found[:, i, j] = self._direct(rows[i], others[j])
        return np.sqrt(found)

    def _differences(
        self, rows: Sequence[int], place: Place, center: NDArray[np.complex128] | float
    ) -> NDArray[np.complex128]:
        values = self.store.read_fields(rows, place).astype(np.complex128, copy=False)
        values -= center
        return values.reshape(len(rows), -1)

    def _direct(self, row: int, other: int) -> Reals:
        """Squared distances of one pair, from the difference of its fields."""
        if row == other:
            return np.zeros(len(self.orders))
        sums = np.zeros(self.lattice.shell_count)
        for block in self.blocks:
            a, b = self.store.read_fields([row, other], self.lattice.place(block))
            sums += shell_sums(a - b, None, self.lattice, block)
        return shell_weights(self.lattice, self.orders) @ sums
