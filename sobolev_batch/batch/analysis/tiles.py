"""Norms and distances from stored fields: tiles of rows, each one task over the store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.tails import TailReducer
from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.budget import (
    NormEstimate,
    Sums,
    Support,
    add_sums,
    aliased,
    estimate_norms,
    sums_of_shells,
)
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.metrics.causes import area_and_shape
from sobolev_batch.spectral.metrics.gram import Arrangement, differences
from sobolev_batch.spectral.octaves.tail import Tail
from sobolev_batch.spectral.shells import SobolevWeights, shell_sums

Reals = NDArray[np.float64]
T = TypeVar("T", Sums, Tail)
Complexes = NDArray[np.complex128]

# Others that are multiplied with the rows of a tile at a time: nearly as fast as all of them at once.
_GROUP = 32
_READ_AT_ONCE = 8
# For fewer rows than this, products do not earn what arranging the samples costs: pairs are taken one by one.
_FEWEST_ROWS = 4
# Factor of the errors of surfaces that are not equal.
_APART = np.ones(())
# The others of a tile for each of its rows: they only pass through, and its rows are read but once for them.
_TILE_LENGTH = 4


@dataclass(frozen=True, eq=False)
class Parts(Generic[T]):
    """What norms and distances are made of, on the lattice or beyond it.

    Attributes:
        own: Rows.
        difference: Differences of the rows from the reference.
        product: Scalar products of these differences with the reference, (orders, rows).
        reference: Reference, as a single row.
    """

    own: T
    difference: T
    product: Reals
    reference: T


@dataclass(frozen=True, eq=False)
class Reducer:
    """The input that all tiles of one reduction share.

    Attributes:
        store: Store of the fields.
        lattice: Lattice of the fields.
        blocks: Blocks of the lattice, one chunk each.
        orders: Sobolev orders s.
        reference: Row of the reference, or None if it has no field.
        areas: Area of every row's surface (rows,), NaN without a field.
        errors: Norms of the fields' own errors (orders, rows), likewise.
        widths: Widths of all surfaces together (13,), see `Extent`.
        checksums: Checksums of the blocks of each field, by its row.
        tails: Tails from values in octaves; None where the fields are all there is.
        tile_bytes: Bytes of fields that a task holds at a time, in all: the rows of a tile, a group of the others,
            and fields as they are read.
    """

    store: Store
    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    reference: int | None
    areas: Reals
    errors: Reals
    widths: Reals
    checksums: Mapping[int, tuple[int, ...]]
    tails: TailReducer | None = None
    tile_bytes: int = 384 << 20

    @property
    def weights(self) -> SobolevWeights:
        """Weights of the orders on the lattice, with a step where octaves follow."""
        return SobolevWeights(self.lattice, self.orders, None if self.tails is None else self.tails.sampling.cutoff)

    def tiles(self, rows: Sequence[int], workers: int) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
        """Yield rows and others of tiles that cover every pair once, fit into a task's memory and occupy the workers.

        The others of a tile either begin with its rows or have none of them.
        """
        for batch in self.row_batches(rows, workers):
            remaining = rows[rows.index(batch[0]) :]
            for others in _slices(len(remaining), _TILE_LENGTH * len(batch)):
                yield batch, remaining[others]

    def row_batches(self, rows: Sequence[int], workers: int) -> list[Sequence[int]]:
        """Return the rows in batches that fit into a task's memory beside others and occupy the workers."""
        fitting = max(1, self._capacity - self._group - self._read_at_once)
        per_worker = max(_GROUP, -(-len(rows) // (2 * max(workers, 1))))
        return [rows[batch] for batch in _slices(len(rows), min(fitting, per_worker))]

    @property
    def task_bytes(self) -> float:
        """Memory that a task takes at most, as measured: the fields that it holds, and temporaries."""
        block_bytes = 16.0 * self.blocks[0].size
        tail_bytes = 0.0 if self.tails is None else self.tails.task_bytes
        return max(5 * block_bytes, self.tile_bytes + 4 * block_bytes) + tail_bytes

    @property
    def _capacity(self) -> int:
        return self.tile_bytes // (self.blocks[0].size * 16)

    @property
    def _group(self) -> int:
        return max(1, min(_GROUP, self._capacity // 4))

    @property
    def _read_at_once(self) -> int:
        return max(1, min(_READ_AT_ONCE, self._capacity // 16))

    def norms(self, rows: Sequence[int]) -> tuple[NormEstimate, NormEstimate, Reals]:
        """Return norms of rows, distances to the reference and their decomposition, each over (orders, rows).

        Without the reference's field, all but the norms are NaN.
        """
        rows = list(rows)
        lattice = self._lattice_part(rows)
        tail = None if self.tails is None else self._tail_part(self.tails, rows)
        own = self._estimate(lattice.own, None if tail is None else tail.own, self.areas[rows], self.errors[:, rows])
        if self.reference is None:
            unknown = np.full_like(own.values, np.nan)
            return own, NormEstimate(*[unknown] * 5), np.stack([unknown] * 3)
        # The reference's distance to itself is zero, and nothing is uncertain about that.
        apart = np.array([row != self.reference for row in rows], dtype=np.float64)
        areas, errors = self.areas[rows] + self.areas[self.reference], self.errors[:, rows]
        errors = errors + self.errors[:, [self.reference]]
        difference = None if tail is None else tail.difference
        distances = self._estimate(lattice.difference, difference, areas, errors, apart)
        product, reference = lattice.product, lattice.reference.totals
        if tail is not None:
            # Beyond the octaves ||a||² - ||b||² - ||a - b||² is twice the product <a - b, b>.
            beyond = tail.own.beyond - tail.reference.beyond - tail.difference.beyond * apart
            product = product + tail.product + beyond / 2 * apart
            reference = reference + tail.reference.squares
        return own, distances, area_and_shape(distances.values**2, product, reference[:, 0])

    def _lattice_part(self, rows: Sequence[int]) -> Parts[Sums]:
        """Return the sums over the lattice; zero without the reference."""
        own = np.zeros((len(rows), self.lattice.shell_count))
        differences, products, reference_sums = np.zeros_like(own), np.zeros_like(own), np.zeros_like(own[:1])
        for number, block in enumerate(self.blocks):
            reference = None if self.reference is None else self.read([self.reference], number)
            if reference is not None:
                reference_sums += shell_sums(reference, None, self.lattice, block)
            for batch in _slices(len(rows), self._read_at_once):
                values = self.read(rows[batch], number)
                own[batch] += shell_sums(values, None, self.lattice, block)
                if reference is not None:
                    values -= reference
                    differences[batch] += shell_sums(values, None, self.lattice, block)
                    products[batch] += shell_sums(values, np.broadcast_to(reference, values.shape), self.lattice, block)
        sums = [sums_of_shells(shells, self.weights) for shells in (own, differences, products, reference_sums)]
        return Parts(sums[0], sums[1], sums[2].totals, sums[3])

    def _tail_part(self, tails: TailReducer, rows: Sequence[int]) -> Parts[Tail]:
        """Return the tails beyond the lattice; those of the norms stand for the others without the reference."""
        reference = None if self.reference is None else tails.read(self.reference)
        own, differences, products = [], [], []
        for row in rows:
            values = tails.read(row)
            own.append(tails.of_norm(row, values))
            if reference is not None and self.reference is not None:
                difference = values - reference
                differences.append(tails.of_pair(row, self.reference, difference))
                products.append(tails.weights.integrals((difference * reference.conj()).real.astype(np.float64)))
        norms = Tail.stacked(own)
        if reference is None or self.reference is None:
            return Parts(norms, norms, norms.beyond, norms)
        of_reference = tails.of_norm(self.reference, reference)
        return Parts(norms, Tail.stacked(differences), np.stack(products, axis=-1), Tail.stacked([of_reference]))

    def tile(self, rows: Sequence[int], others: Sequence[int]) -> NormEstimate:
        """Return distances of rows to other rows, over (orders, rows, others).

        Args:
            rows: Rows of one side.
            others: Rows of the other side; they either begin with all of the rows or have none of them.
        """
        shared = len(rows) if tuple(others[: len(rows)]) == tuple(rows) else 0
        if self._capacity < _FEWEST_ROWS:
            sums = Sums.zeros(len(self.orders), len(rows), len(others))
            direct_pairs = np.ones((len(rows), len(others)), dtype=bool)
        else:
            by_block = [self._block_sums(rows, others, number, shared) for number in range(len(self.blocks))]
            products, left, right = (add_sums(sums) for sums in zip(*by_block, strict=True))
            sums, direct_pairs = differences(products, left, right)
        for i, j in np.argwhere(np.triu(direct_pairs) if shared else direct_pairs).tolist():
            direct = self._direct(rows[i], others[j])
            sums.squares[:, :, i, j], sums.outer[:, i, j] = direct.squares, direct.outer
        if shared:
            for square in (sums.squares[..., :shared], sums.outer[..., :shared]):
                square[...] = np.triu(square) + np.swapaxes(np.triu(square, 1), -1, -2)
        unequal = np.array([[row != other for other in others] for row in rows], dtype=np.float64)
        areas = self.areas[list(rows)][:, None] + self.areas[list(others)]
        errors = self.errors[:, list(rows)][:, :, None] + self.errors[:, list(others)][:, None, :]
        tail = None if self.tails is None else self.tails.of_pairs(rows, others, shared)
        return self._estimate(sums, tail, areas, errors, unequal)

    def _estimate(
        self, sums: Sums, tail: Tail | None, areas: Reals, errors: Reals, apart: Reals = _APART
    ) -> NormEstimate:
        """Return norms with their errors, which are zero where surfaces are equal.

        Args:
            sums: Sums over the lattice.
            tail: Tails beyond it; None where the fields are all there is.
            areas: Areas of the surfaces, of both of a pair together.
            errors: Norms of the errors of the fields, likewise.
            apart: 0 for pairs of equal surfaces, else 1.
        """
        if tail is None:
            return estimate_norms(sums, self.weights, Support(areas * apart, self.widths), errors * apart)
        images = aliased(sums, self.weights, self.widths) * apart
        return tail.scaled(apart).estimate(sums.totals, images, errors * apart)

    def _block_sums(
        self, rows: Sequence[int], others: Sequence[int], number: int, shared: int
    ) -> tuple[Sums, Sums, Sums]:
        """Return one block's products of rows and others, and the squares of either.

        The first ``shared`` others are the rows: of these, only the products on and above the diagonal.
        """
        block = self.blocks[number]
        arrangement = Arrangement.for_block(self.weights, block)
        reference = None if self.reference is None else self.read([self.reference], number)

        def read(fields: Sequence[int], buffer: Complexes) -> Complexes:
            for batch in _slices(len(fields), self._read_at_once):
                values = self.read(fields[batch], number).astype(np.complex128, copy=False)
                if reference is not None:
                    values -= reference
                np.take(values.reshape(len(values), -1), arrangement.order, axis=1, out=buffer[batch], mode="clip")
            return buffer[: len(fields)]

        held = read(rows, np.empty((len(rows), block.size), dtype=np.complex128))
        left = arrangement.squares(held)
        products, right = arrangement.zeros(len(rows), len(others)), arrangement.zeros(len(others))

        def multiply(group: slice, fields: Complexes, above: int) -> None:
            sums, squares = arrangement.products(held[:above], fields), arrangement.squares(fields)
            products.squares[:, :, :above, group], products.outer[:, :above, group] = sums.squares, sums.outer
            right.squares[..., group], right.outer[..., group] = squares.squares, squares.outer

        for group in _slices(shared, self._group):
            multiply(group, held[group], group.stop)
        buffer = np.empty((min(self._group, len(others) - shared), block.size), dtype=np.complex128)
        for group in _slices(len(others), self._group, shared):
            multiply(group, read(others[group], buffer), len(rows))
        return products, left, right

    def read(self, rows: Sequence[int], number: int) -> Complexes:
        """Read one block of fields, and check it against their records."""
        expected = [self.checksums[row][number] for row in rows]
        return self.store.read_fields(rows, self.lattice.place(self.blocks[number]), expected)

    def _direct(self, row: int, other: int) -> Sums:
        """Return the sums of one pair, from the difference of its fields."""
        sums = np.zeros(self.lattice.shell_count)
        if row != other:
            for number, block in enumerate(self.blocks):
                a, b = self.read([row, other], number)
                sums += shell_sums(a - b, None, self.lattice, block)
        return sums_of_shells(sums, self.weights)


def _slices(count: int, size: int, start: int = 0) -> Iterator[slice]:
    for first in range(start, count, size):
        yield slice(first, min(first + size, count))
