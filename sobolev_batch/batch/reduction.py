"""From stored fields to norms and distances: tiles of rows, each one Dask task over the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store import Store
from sobolev_batch.spectral.budget import Assessed, Sums, add_sums, assess, sums_of_shells
from sobolev_batch.spectral.gram import differences, gram_blocks
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.shells import shell_sums

Reals = NDArray[np.float64]
Place = tuple[slice, slice, slice]

# Fields that a task holds at a time, in all.
_TILE_BYTES = 256 << 20


@dataclass(frozen=True, eq=False)
class Reducer:
    """What every tile of one reduction shares.

    Attributes:
        store: where the fields are.
        lattice: of the fields.
        blocks: how a field is cut into chunks.
        orders: s, each.
        center: the row of the reference, or None if it has no field.
        areas: (rows,) of every row's surface, NaN without a field.
        errors: (orders, rows) norms of the fields' own errors, likewise.
        widths: (13,) extents of all surfaces together, see `support_widths`.
    """

    store: Store
    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    center: int | None
    areas: Reals
    errors: Reals
    widths: Reals

    def rows_per_tile(self) -> int:
        """How many rows make a tile side so that two sides fit into a task's memory."""
        return max(1, _TILE_BYTES // (2 * self.blocks[0].size * 16))

    def norms(self, rows: Sequence[int]) -> tuple[Assessed, Assessed]:
        """Norms of rows and their distances to the center, each over (orders, rows); NaN without a center."""
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
        of_rows = self.areas[list(rows)], self.errors[:, list(rows)]
        norms = self._assess(sums_of_shells(own, self.lattice, self.orders), *of_rows)
        if self.center is None:
            return norms, Assessed(*(np.full_like(norms.values, np.nan) for _ in range(4)))
        # The reference's distance to itself is zero, and nothing is uncertain about that.
        apart = np.array([row != self.center for row in rows], dtype=np.float64)
        areas = (of_rows[0] + self.areas[self.center]) * apart
        errors = (of_rows[1] + self.errors[:, [self.center]]) * apart
        return norms, self._assess(sums_of_shells(to_center, self.lattice, self.orders), areas, errors)

    def tile(self, rows: Sequence[int], others: Sequence[int]) -> Assessed:
        """Distances of rows to other rows, over (orders, rows, others)."""
        same = tuple(rows) == tuple(others)
        products, left, right = [], [], []
        for block in self.blocks:
            place = self.lattice.place(block)
            center = 0.0 if self.center is None else self.store.read_fields([self.center], place)
            first = self._differences(rows, place, center)
            second = first if same else self._differences(others, place, center)
            products.append(gram_blocks(first, second, self.lattice, block, self.orders))
            left.append(self._squares(first, block))
            right.append(left[-1] if same else self._squares(second, block))
        total = add_sums(products)
        if same:
            # Each half of a weighted product rounds in its own way; a distance matrix is symmetric.
            total = Sums(*((part + np.swapaxes(part, -1, -2)) / 2 for part in (total.squares, total.outer)))
        found, cancelled = differences(total, add_sums(left), add_sums(right))
        for i, j in np.argwhere(cancelled).tolist():
            direct = self._direct(rows[i], others[j])
            found.squares[:, :, i, j], found.outer[:, i, j] = direct.squares, direct.outer
        unequal = np.array([[row != other for other in others] for row in rows], dtype=np.float64)
        areas = (self.areas[list(rows)][:, None] + self.areas[list(others)]) * unequal
        errors = (self.errors[:, list(rows)][:, :, None] + self.errors[:, list(others)][:, None, :]) * unequal
        return self._assess(found, areas, errors)

    def _assess(self, sums: Sums, areas: Reals, errors: Reals) -> Assessed:
        return assess(sums, self.lattice, self.orders, areas=areas, widths=self.widths, discretisation=errors)

    def _squares(self, fields: NDArray[np.complex128], block: Block) -> Sums:
        sums = [shell_sums(field.reshape(block.shape), None, self.lattice, block) for field in fields]
        return sums_of_shells(np.stack(sums), self.lattice, self.orders)

    def _differences(
        self, rows: Sequence[int], place: Place, center: NDArray[np.complex128] | float
    ) -> NDArray[np.complex128]:
        values = self.store.read_fields(rows, place).astype(np.complex128, copy=False)
        values -= center
        return values.reshape(len(rows), -1)

    def _direct(self, row: int, other: int) -> Sums:
        """The sums of one pair, from the difference of its fields."""
        sums = np.zeros(self.lattice.shell_count)
        if row != other:
            for block in self.blocks:
                a, b = self.store.read_fields([row, other], self.lattice.place(block))
                sums += shell_sums(a - b, None, self.lattice, block)
        return sums_of_shells(sums, self.lattice, self.orders)
