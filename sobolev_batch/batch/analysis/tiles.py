"""From stored fields to norms and distances: tiles of rows, each one Dask task over the store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.errors.budget import NormEstimate, Sums, Support, add_sums, estimate_norms, sums_of_shells
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.metrics.decomposition import Proportion
from sobolev_batch.spectral.metrics.gram import Arrangement, differences
from sobolev_batch.spectral.shells import SobolevWeights, shell_sums

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Fields that a task holds at a time, in all: the rows of a tile; a group of the others, for which a
# matrix product is nearly as fast as for all of them; and fields as they are read.
_TILE_BYTES = 384 << 20
_GROUP = 32
_READ_AT_ONCE = 8
# Of fewer rows than this, products do not earn what arranging the samples costs: pairs are taken one by one.
_FEWEST_ROWS = 4
# The others of a tile per row of it: they only pass through, and its rows are read but once for them.
_TILE_LENGTH = 4


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
        checksums: by row, of the blocks of its field.
    """

    store: Store
    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    center: int | None
    areas: Reals
    errors: Reals
    widths: Reals
    checksums: Mapping[int, tuple[int, ...]]

    @cached_property
    def weights(self) -> SobolevWeights:
        """Weights of the lattice's shells."""
        return SobolevWeights(self.lattice, self.orders)

    def tiles(self, rows: Sequence[int], workers: int) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
        """Rows and others of tiles that cover every pair once, fit into a task's memory and occupy the workers.

        The others of a tile either begin with its rows or have none of them.
        """
        for strip in self.strips(rows, workers):
            remaining = rows[rows.index(strip[0]) :]
            for part in _parts(len(remaining), _TILE_LENGTH * len(strip)):
                yield strip, remaining[part]

    def strips(self, rows: Sequence[int], workers: int) -> list[Sequence[int]]:
        """The rows in parts that fit into a task's memory with what meets them and occupy the workers."""
        fitting = max(1, self._capacity - self._group - self._read_at_once)
        shared = max(_GROUP, -(-len(rows) // (2 * max(workers, 1))))
        return [rows[part] for part in _parts(len(rows), min(fitting, shared))]

    @property
    def task_bytes(self) -> float:
        """What one task of the reduction takes at most, measured: the fields it holds, the others as temporaries."""
        block_bytes = 16.0 * self.blocks[0].size
        return max(5 * block_bytes, _TILE_BYTES + 4 * block_bytes)

    @property
    def _capacity(self) -> int:
        return _TILE_BYTES // (self.blocks[0].size * 16)

    @property
    def _group(self) -> int:
        return max(1, min(_GROUP, self._capacity // 4))

    @property
    def _read_at_once(self) -> int:
        return max(1, min(_READ_AT_ONCE, self._capacity // 16))

    def norms(self, rows: Sequence[int]) -> tuple[NormEstimate, NormEstimate, Proportion]:
        """Norms of rows, their distances to the center and the parts of these, each over (orders, rows).

        Without a center, all but the norms is NaN.
        """
        own = np.zeros((len(rows), self.lattice.shell_count))
        to_center, products = np.zeros_like(own), np.zeros_like(own)
        of_center = np.zeros(self.lattice.shell_count)
        for number, block in enumerate(self.blocks):
            center = None if self.center is None else self._read([self.center], number)[0]
            if center is not None:
                of_center += shell_sums(center, None, self.lattice, block)
            for part in _parts(len(rows), self._read_at_once):
                values = self._read(rows[part], number)
                own[part] += shell_sums(values, None, self.lattice, block)
                if center is not None:
                    values -= center
                    to_center[part] += shell_sums(values, None, self.lattice, block)
                    centers = np.broadcast_to(center, values.shape)
                    products[part] += shell_sums(values, centers, self.lattice, block)
        of_rows = self.areas[list(rows)], self.errors[:, list(rows)]
        norms = self._assess(sums_of_shells(own, self.weights), *of_rows)
        if self.center is None:
            unknown = np.full_like(norms.values, np.nan)
            return norms, NormEstimate(*[unknown] * 4), Proportion(*[unknown] * 3)
        # The reference's distance to itself is zero, and nothing is uncertain about that.
        apart = np.array([row != self.center for row in rows], dtype=np.float64)
        areas = (of_rows[0] + self.areas[self.center]) * apart
        errors = (of_rows[1] + self.errors[:, [self.center]]) * apart
        distances = self._assess(sums_of_shells(to_center, self.weights), areas, errors)
        return norms, distances, Proportion.of_shells(to_center, products, of_center, self.weights)

    def tile(self, rows: Sequence[int], others: Sequence[int]) -> NormEstimate:
        """Distances of rows to other rows, over (orders, rows, others).

        Args:
            rows: of one side.
            others: of the other side; they either begin with all of the rows or have none of them.
        """
        shared = len(rows) if tuple(others[: len(rows)]) == tuple(rows) else 0
        if self._capacity < _FEWEST_ROWS:
            sums = Sums.zeros(len(self.orders), len(rows), len(others))
            direct_pairs = np.ones((len(rows), len(others)), dtype=bool)
        else:
            found = [self._block_sums(rows, others, number, shared) for number in range(len(self.blocks))]
            products, left, right = (add_sums(parts) for parts in zip(*found, strict=True))
            sums, direct_pairs = differences(products, left, right)
        for i, j in np.argwhere(np.triu(direct_pairs) if shared else direct_pairs).tolist():
            direct = self._direct(rows[i], others[j])
            sums.squares[:, :, i, j], sums.outer[:, i, j] = direct.squares, direct.outer
        if shared:
            for square in (sums.squares[..., :shared], sums.outer[..., :shared]):
                square[...] = np.triu(square) + np.swapaxes(np.triu(square, 1), -1, -2)
        unequal = np.array([[row != other for other in others] for row in rows], dtype=np.float64)
        areas = (self.areas[list(rows)][:, None] + self.areas[list(others)]) * unequal
        errors = (self.errors[:, list(rows)][:, :, None] + self.errors[:, list(others)][:, None, :]) * unequal
        return self._assess(sums, areas, errors)

    def _assess(self, sums: Sums, areas: Reals, errors: Reals) -> NormEstimate:
        return estimate_norms(sums, self.weights, Support(areas, self.widths), errors)

    def _block_sums(
        self, rows: Sequence[int], others: Sequence[int], number: int, shared: int
    ) -> tuple[Sums, Sums, Sums]:
        """One block's products of rows and others, and the squares of either.

        Of the first ``shared`` others, which are the rows, only the products on and above the diagonal.
        """
        block = self.blocks[number]
        arrangement = Arrangement.of(self.weights, block)
        center = None if self.center is None else self._read([self.center], number)

        def read(wanted: Sequence[int], room: Complexes) -> Complexes:
            for part in _parts(len(wanted), self._read_at_once):
                values = self._read(wanted[part], number).astype(np.complex128, copy=False)
                if center is not None:
                    values -= center
                np.take(values.reshape(len(values), -1), arrangement.order, axis=1, out=room[part], mode="clip")
            return room[: len(wanted)]

        held = read(rows, np.empty((len(rows), block.size), dtype=np.complex128))
        left = arrangement.squares(held)
        products, right = arrangement.zeros(len(rows), len(others)), arrangement.zeros(len(others))

        def meet(part: slice, group: Complexes, above: int) -> None:
            found, squares = arrangement.products(held[:above], group), arrangement.squares(group)
            products.squares[:, :, :above, part], products.outer[:, :above, part] = found.squares, found.outer
            right.squares[..., part], right.outer[..., part] = squares.squares, squares.outer

        for part in _parts(shared, self._group):
            meet(part, held[part], part.stop)
        room = np.empty((min(self._group, len(others) - shared), block.size), dtype=np.complex128)
        for part in _parts(len(others), self._group, shared):
            meet(part, read(others[part], room), len(rows))
        return products, left, right

    def _read(self, rows: Sequence[int], number: int) -> Complexes:
        """One block of fields, as their records say that they are."""
        expected = [self.checksums[row][number] for row in rows]
        return self.store.read_fields(rows, self.lattice.place(self.blocks[number]), expected)

    def _direct(self, row: int, other: int) -> Sums:
        """The sums of one pair, from the difference of its fields."""
        sums = np.zeros(self.lattice.shell_count)
        if row != other:
            for number, block in enumerate(self.blocks):
                a, b = self._read([row, other], number)
                sums += shell_sums(a - b, None, self.lattice, block)
        return sums_of_shells(sums, self.weights)


def _parts(count: int, size: int, start: int = 0) -> Iterator[slice]:
    for first in range(start, count, size):
        yield slice(first, min(first + size, count))
