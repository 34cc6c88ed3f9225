"""Norms and distances from stored fields: batches and tiles of rows, each one task over the store."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Complexes, Reals, slices
from sobolev_batch.geometry.surface import DIRECTIONS, Extent
from sobolev_batch.norms.budget import Sums, Support, add_sums, image_weight, sums_of_shells
from sobolev_batch.norms.estimate import NormEstimate, ReferenceEstimate, Tail, estimate_norms
from sobolev_batch.norms.fields import Quality, TailQuality
from sobolev_batch.norms.gram import Arrangement, differences
from sobolev_batch.norms.images import NearAxes
from sobolev_batch.norms.spectrum import ComparedSpectra, RadialAxis, Spectra
from sobolev_batch.norms.tail.integrals import OctaveSums, OctaveWeights, integral_over, squared_moduli
from sobolev_batch.norms.tail.remainder import Remainder
from sobolev_batch.norms.tail.sampling import TailSampling
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import FIELD, Store
from sobolev_batch.study.lattice_choice import LatticeChoice
from sobolev_batch.transform.lattice import Block, Lattice, SobolevWeights, shell_sums

# Others that are multiplied with the rows of a tile at a time: nearly as fast as all of them at once.
_GROUP = 32
_READ_AT_ONCE = 8
# For fewer rows than this, products do not earn what arranging the samples costs: pairs are taken one by one.
_FEWEST_ROWS = 4
# Two surfaces may not have been compared beyond the octaves. At these orders, their mean energy there is at least this
# fraction of the last measured one, a little below what parallel sheets at any gap leave; or less by what that lacks of
# the sum of both own ones, since close sheets of the little that differs count several times there. It exceeds the sum
# by no more than this factor, which such sheets reach, or this multiple of the last distance from it; or this fraction
# of it, where the energy has just grown by more than a factor from octave to octave. Below the sum, it is by no more
# than that multiple of the last excess.
_AT_ORDERS, _LEAST_LIMITS = (-4.0, -2.5, -1.5, -1.0, -0.5), (0.25, 0.31, 0.4, 0.45, 0.5)
_MOST, _SWING, _RISE, _STEEPEST_GROWTH = (1.87, 1.75, 1.55, 1.35, 1.05), 1.25, 0.9, 2.5
# Rows of a tile whose values in octaves are held at a time take this many bytes.
_HELD_BYTES = 128 << 20
# Bytes of a sample of octaves: frequency, weight, place, values of three fields with squares, and its move to radii.
_SAMPLE_BYTES = 400.0
# What tasks make anew: it is cheaper than sending it.
_MADE_ANEW = {"weights", "octave_weights", "axis", "_from_reference"}
# A sample of a row takes this much more while its spectra are computed.
_SPECTRUM_BYTES = 100.0


@dataclass(frozen=True, eq=False)
class Compared:
    """Norms of rows and their distances to the reference, each (orders, rows), NaN without the reference's field.

    Attributes:
        reference: What the distances are relative to.
        beyond: What lies beyond the last octave in the squared norms, and in the squared distances.
    """

    norms: NormEstimate
    distances: NormEstimate
    reference: ReferenceEstimate
    beyond: tuple[Reals, Reals]


@dataclass(frozen=True, eq=False)
class Evaluator:
    """The fields of a store, with what is known of them, as all tasks share it that compute from them.

    Attributes:
        reference: Row of the reference, or None if it has no field.
        areas: Area of every row's surface (rows,), NaN without a field.
        errors: Norms of the fields' own errors (orders, rows), likewise.
        beyond: Bounds on the distances from the study's reference beyond a lattice (orders, rows), NaN where these are
            extrapolated.
        images: Roots of what images add to the squared distances from the reference (orders, rows), NaN if unknown.
        widths: Widths of all surfaces together (13,), see `Extent`.
        checksums: Checksums of the blocks of each field, by its row, and of its values in octaves.
        sampling: Samples of the octaves; None where the fields are all there is.
        qualities: Quality of each row's values in octaves.
        known_reference: Row of the study's reference, which the qualities know; None if it has no field.
        tile_bytes: Bytes of fields that a task holds at a time: rows of a tile, a group of others, and fields as read.
        is_given: True if the lattice was given, and not chosen for an accuracy.
    """

    store: Store
    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    reference: int | None
    areas: Reals
    errors: Reals
    beyond: Reals
    images: Reals
    widths: Reals
    checksums: Mapping[int, tuple[int, ...]]
    sampling: TailSampling | None = None
    qualities: Mapping[int, TailQuality] = field(default_factory=dict)
    known_reference: int | None = None
    tile_bytes: int = 384 << 20
    is_given: bool = False

    @classmethod
    def for_fields(
        cls,
        store: Store,
        choice: LatticeChoice,
        orders: tuple[float, ...],
        stored: Mapping[int, str],
        checksums: Mapping[int, tuple[int, ...]],
        reference: int,
        compared_with: int | None = None,
    ) -> Self:
        """Return the evaluator of rows with stored qualities; distances are to the reference, or another row."""
        qualities = {row: Quality.from_json(text) for row, text in stored.items()}
        count = store.document(FIELD)["shape"][0]
        known = reference if reference in qualities else None
        extents = [quality.extent for quality in qualities.values()]
        evaluator = cls(
            store=store,
            lattice=choice.lattice,
            blocks=Fields(store).blocks_of(choice.lattice),
            orders=orders,
            reference=known if compared_with is None else compared_with,
            areas=np.full(count, np.nan),
            errors=np.full((len(orders), count), np.nan),
            beyond=np.full((len(orders), count), np.nan),
            images=np.full((len(orders), count), np.nan),
            widths=Extent.union(extents).widths if extents else np.zeros(len(DIRECTIONS)),
            checksums=checksums,
            sampling=choice.tail,
            qualities={row: quality.tail for row, quality in qualities.items() if quality.tail is not None},
            known_reference=known,
            is_given=not choice.basis,
        )
        for row, quality in qualities.items():
            evaluator.areas[row], evaluator.errors[:, row] = quality.area, quality.error_norms(evaluator.weights)
            evaluator.beyond[:, row] = np.sqrt(quality.beyond_at(orders))
        return evaluator

    @property
    def complete(self) -> list[int]:
        """Rows with a field."""
        return np.flatnonzero(~np.isnan(self.areas)).tolist()

    @cached_property
    def weights(self) -> SobolevWeights:
        """Weights of the orders on the lattice, with a step where octaves follow."""
        return SobolevWeights(self.lattice, self.orders, None if self.sampling is None else self.sampling.cutoff)

    @cached_property
    def octave_weights(self) -> tuple[OctaveWeights, ...]:
        """Weights of the samples of each octave."""
        octaves = () if self.sampling is None else self.sampling.octaves
        return tuple(OctaveWeights(octave, self.orders) for octave in octaves)

    @cached_property
    def axis(self) -> RadialAxis:
        """Radii of the spectra of fields."""
        return RadialAxis(self.lattice, self.sampling)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _MADE_ANEW}

    @property
    def task_bytes(self) -> float:
        """Memory that a task takes at most, as measured: the fields that it holds, and temporaries."""
        block_bytes = 16.0 * self.blocks[0].size
        tail_bytes = 0.0
        if self.sampling is not None:
            tail_bytes = _HELD_BYTES + (_SAMPLE_BYTES + 8 * len(self.orders)) * self.sampling.size
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

    def norms(self, rows: Sequence[int]) -> Compared:
        """Return the norms of rows, and their distances to the reference, from their fields."""
        reference = None if self.reference is None else self.spectra([self.reference]).norm
        return self.norms_of(rows, self.spectra(rows), reference)

    def norms_of(self, rows: Sequence[int], spectra: ComparedSpectra, reference: Spectra | None) -> Compared:
        """Return the norms of rows, and their distances to the reference, from the spectra of both.

        That of the reference is (1, radii), or None without its field.
        """
        rows, b = list(rows), self.reference
        norms, tail = self._estimated(spectra.norm, rows)
        zeros, unknown = np.zeros_like(norms.values), np.full_like(norms.values, np.nan)
        beyond = zeros if tail is None else tail.remainder
        if b is None or reference is None:
            nothing = NormEstimate(*[unknown] * 5)
            return Compared(norms, nothing, ReferenceEstimate(nothing, unknown, unknown), (beyond, unknown))
        norm_of_b, of_b = self._estimated(reference, [b])
        distances, of_difference = self._estimated(spectra.distance, rows, b)
        products = spectra.product(reference)
        of_product = Tail.of_product(self.axis.octave_integrals(products, self.orders), tail, of_b, of_difference)
        on_lattice = self._sums(products), self.weights, self.widths
        against = ReferenceEstimate.from_products(*on_lattice, distances, norm_of_b, of_product)
        beyond_difference = zeros if of_difference is None else of_difference.remainder
        return Compared(norms, distances, against, (beyond, beyond_difference))

    def _estimated(
        self, spectra: Spectra, rows: list[int], other: int | None = None
    ) -> tuple[NormEstimate, Tail | None]:
        """Return the norms of rows (orders, rows), or their distances to another one, by their spectra; and tails."""
        areas, errors, unseen = self.areas[rows], self.errors[:, rows], np.full(len(rows), np.nan)
        if other is not None:
            # The distance of a row to itself is zero, and nothing is uncertain about that.
            areas, differ = areas + self.areas[other], np.not_equal(rows, other)
            errors = np.hypot(errors, self.errors[:, [other]]) * differ
            unseen = (self.beyond[:, rows] + self.beyond[:, [other]]) * differ
        tail = None
        if self.sampling is not None:
            of_rows = zip(rows, self.axis.energies(spectra), strict=True)
            beyond = np.array([self._remainder(row, other, energies) for row, energies in of_rows])
            tail = Tail(*self.axis.octave_integrals(spectra, self.orders), *np.moveaxis(beyond, 0, -1))
        images = spectra.images_at(self.orders)
        return self._estimate(self._sums(spectra), tail, areas, errors, unseen, images), tail

    def _sums(self, spectra: Spectra) -> Sums:
        return sums_of_shells(spectra.sums[:, : self.lattice.shell_count], self.weights)

    def only(self, rows: Iterable[int]) -> Self:
        """Return what is needed for some rows alone: of many rows, the rest is much to send."""
        needed = {*rows} if self.reference is None else {*rows, self.reference}
        checksums = {row: self.checksums[row] for row in sorted(needed & self.checksums.keys())}
        qualities = {row: self.qualities[row] for row in sorted(needed & self.qualities.keys())}
        return replace(self, checksums=checksums, qualities=qualities)

    def spectra(self, rows: Sequence[int]) -> ComparedSpectra:
        """Return the spectra of rows, from their fields. Without the reference's field, those of distances are NaN."""
        rows = list(rows)
        own = np.zeros((len(rows), self.lattice.shell_count))
        differences, products = (np.zeros_like(own) if self.reference is not None else own * np.nan for _ in range(2))
        # The rows of norms come first, then those of distances.
        near_axes = NearAxes(self.lattice, 2 * len(rows)) if self.sampling is None else None
        for number, block in enumerate(self.blocks):
            reference = None if self.reference is None else self.read([self.reference], number)
            for batch in slices(len(rows), self._read_at_once):
                values = self.read(rows[batch], number)
                own[batch] += shell_sums(values, None, self.lattice, block)
                if near_axes is not None:
                    near_axes.take(batch, block, values)
                if reference is not None:
                    values -= reference
                    if near_axes is not None:
                        near_axes.take(slice(batch.start + len(rows), batch.stop + len(rows)), block, values)
                    differences[batch] += shell_sums(values, None, self.lattice, block)
                    products[batch] += shell_sums(values, np.broadcast_to(reference, values.shape), self.lattice, block)
        images = np.zeros((2 * len(rows), 0)) if near_axes is None else near_axes.images()
        if self.reference is None:
            images[len(rows) :] = np.nan
        samples = 0 if self.sampling is None else self.sampling.size
        reference_octaves = np.full(samples, np.nan) if self.reference is None else self.read_octaves(self.reference)
        parts = []
        for batch in slices(len(rows), max(1, int(_HELD_BYTES // (_SPECTRUM_BYTES * max(samples, 1))))):
            octaves = np.stack([self.read_octaves(row) for row in rows[batch]]).astype(np.complex128)
            arrays = self.axis.spectra(own[batch], squared_moduli(octaves), images[: len(rows)][batch]).named("norm")
            octaves -= reference_octaves
            of_difference = self.axis.spectra(differences[batch], squared_moduli(octaves), images[len(rows) :][batch])
            arrays |= of_difference.named("distance")
            inner = (octaves * reference_octaves.conj()).real
            arrays |= self.axis.spectra(products[batch], inner, is_square=False).named("product")
            parts.append(ComparedSpectra(arrays))
        return ComparedSpectra.joined(parts)

    def pairs(self, rows: Sequence[int], others: Sequence[int]) -> NormEstimate:
        """Return distances over (orders, rows, others), in batches that fit a task; all others are rows, or none."""
        distances, is_square = np.zeros((5, len(self.orders), len(rows), len(others))), tuple(rows) == tuple(others)
        for batch in slices(len(rows), max(1, self._capacity - self._group - self._read_at_once)):
            first = batch.start if is_square else 0
            found = self.tile(rows[batch], others[first:]).stacked
            distances[..., batch, first:] = found
            if is_square:
                distances[..., first:, batch] = np.swapaxes(found, -1, -2)
        return NormEstimate(*distances)

    def tile(self, rows: Sequence[int], others: Sequence[int]) -> NormEstimate:
        """Return distances over (orders, rows, others); the others begin with all of the rows, or have none of them."""
        shared = len(rows) if tuple(others[: len(rows)]) == tuple(rows) else 0
        if self._capacity < _FEWEST_ROWS:
            sums = Sums.zeros(len(self.orders), len(rows), len(others))
            direct_pairs = np.ones((len(rows), len(others)), dtype=bool)
        else:
            by_block = [self._block_sums(rows, others, number, shared) for number in range(len(self.blocks))]
            products, left, right = (add_sums(sums) for sums in zip(*by_block, strict=True))
            sums, direct_pairs = differences(products, left, right)
        for i, j in np.argwhere(np.triu(direct_pairs) if shared else direct_pairs).tolist():
            pair = rows[i], others[j]
            shells = np.zeros(self.lattice.shell_count) if pair[0] == pair[1] else self.sums_over_shells(pair)
            direct = sums_of_shells(shells, self.weights)
            for array, found in zip(sums, direct, strict=True):
                array[..., i, j] = found
        if shared:
            for array in sums:
                square = np.triu(array[..., :shared])
                array[..., :shared] = square + np.swapaxes(np.triu(square, 1), -1, -2)
        mine, theirs, differ = (..., [*rows], None), (..., None, [*others]), np.not_equal.outer(rows, others)
        errors = np.hypot(self.errors[mine], self.errors[theirs]) * differ
        # By the triangle inequality, over the study's reference.
        unseen = (self.beyond[mine] + self.beyond[theirs]) * differ
        tail = None if self.sampling is None else self._tails_of_pairs(self.sampling, rows, others, shared)
        # Images add no more than what those of both differences from the reference add, and no more than all of the
        # difference would, at the least distance of faces to their images, of which the sum may have lost as much.
        parts = np.array([image_weight(self.lattice.spacing, order - 1, self.widths) for order in self.orders])
        most = np.divide(parts, 1 - parts, where=parts < 1, out=np.full_like(parts, 1e100))[:, None, None]
        images = np.minimum((self.images[mine] + self.images[theirs]) ** 2, most * sums.totals)
        return self._estimate(sums, tail, self.areas[mine] + self.areas[theirs], errors, unseen, images)

    def _estimate(
        self, sums: Sums, tail: Tail | None, areas: Reals, errors: Reals, unseen: Reals, images: Reals
    ) -> NormEstimate:
        """Return norms; areas and norms of the fields' own errors are those of both surfaces of a pair together.

        Bounds on the norms that the lattice leaves unseen, and on what images add to the squared norms, may be known.
        """
        support, beyond, given = Support(areas, self.widths), unseen**2, self.is_given
        return estimate_norms(sums, self.weights, support, errors, tail, is_given=given, beyond=beyond, images=images)

    def _block_sums(self, rows: Sequence[int], others: Sequence[int], number: int, shared: int) -> Sequence[Sums]:
        """Return one block's products of rows and others, and the squares of either.

        The first ``shared`` others are the rows: of these, only the products on and above the diagonal.
        """
        block = self.blocks[number]
        arrangement = Arrangement.for_block(self.weights, block)
        reference = None if self.reference is None else self.read([self.reference], number)

        def read(fields: Sequence[int], buffer: Complexes) -> Complexes:
            for batch in slices(len(fields), self._read_at_once):
                values = self.read(fields[batch], number).astype(np.complex128, copy=False)
                if reference is not None:
                    values -= reference
                np.take(values.reshape(len(values), -1), arrangement.order, axis=1, out=buffer[batch], mode="clip")
            return buffer[: len(fields)]

        held = read(rows, np.empty((len(rows), block.size), dtype=np.complex128))
        left = arrangement.squares(held)
        products, right = (Sums.zeros(len(self.orders), *shape, len(others)) for shape in ((len(rows),), ()))

        def multiply(group: slice, fields: Complexes, above: int) -> None:
            for array, found in zip(products, arrangement.products(held[:above], fields), strict=True):
                array[..., :above, group] = found
            for array, found in zip(right, arrangement.squares(fields), strict=True):
                array[..., group] = found

        for group in slices(shared, self._group):
            multiply(group, held[group], group.stop)
        buffer = np.empty((min(self._group, len(others) - shared), block.size), dtype=np.complex128)
        for group in slices(len(others), self._group, shared):
            multiply(group, read(others[group], buffer), len(rows))
        return products, left, right

    def read(self, rows: Sequence[int], number: int) -> Complexes:
        """Read one block of fields, and check it against their records."""
        expected = [self.checksums[row][number] for row in rows]
        return Fields(self.store).read(rows, self.blocks[number].place_in(self.lattice.half), expected)

    def read_octaves(self, row: int) -> Complexes:
        """Return the values of a row at all samples of octaves (n,), and check them against its record."""
        if self.sampling is None:
            return np.zeros(0, dtype=np.complex128)
        place = (slice(0, self.sampling.size),)
        values: Complexes = Fields(self.store).read([row], place, [self.checksums[row][-1]])[0]
        return values

    def octave_sums(self, values: Complexes) -> list[OctaveSums]:
        """Return the integrals of |values|² over each octave, from those at all samples (n,)."""
        parts = () if self.sampling is None else self.sampling.split(squared_moduli(values))
        return [weights.sums(squares) for weights, squares in zip(self.octave_weights, parts, strict=True)]

    def _tails_of_pairs(self, sampling: TailSampling, rows: Sequence[int], others: Sequence[int], shared: int) -> Tail:
        """Return the tails of squared distances (orders, rows, others); the first ``shared`` others are the rows."""
        parts = np.zeros((len(fields(Tail)), len(self.orders), len(rows), len(others)))
        for batch in slices(len(rows), max(1, _HELD_BYTES // (16 * sampling.size))):
            held = {i: self.read_octaves(rows[i]) for i in range(batch.start, batch.stop)}
            for j in range(min(batch.start, shared), len(others)):
                values = held[j] if j < shared and j in held else self.read_octaves(others[j])
                for i, own in held.items():
                    if i < j or j >= shared:
                        sums = self.octave_sums(own - values)
                        beyond = self._remainder(rows[i], others[j], [octave.energy for octave in sums])
                        parts[..., i, j] = astuple(Tail(*integral_over(sums), *beyond))
        if shared:
            parts[..., :shared] += np.swapaxes(np.triu(parts[..., :shared], 1), -1, -2)
        return Tail(*parts)

    @cached_property
    def _from_reference(self) -> dict[int, tuple[Reals, Reals]]:
        """Part beyond the octaves of the squared distance from the reference (orders,), and its error, by row."""
        known = {row: quality.difference for row, quality in self.qualities.items()}
        return {row: difference.at(self.orders) for row, difference in known.items() if difference is not None}

    def _remainder(self, row: int, other: int | None, measured: Sequence[float]) -> tuple[Reals, Reals]:
        """Return what lies beyond the octaves in a squared norm or distance (orders,), and how far off it may be.

        It is known of norms, and to the reference. Else it is between bounds, which follow from the energies in the
        octaves, which are measured, and those of both surfaces beyond; and, by the triangle inequality, from the known
        distances.
        """
        if other is None:
            return self.qualities[row].own.at(self.orders)
        for first, second in ((row, other), (other, row)):
            if second == self.known_reference and first in self._from_reference:
                return self._from_reference[first]
        parts = [self.qualities[number].own for number in (row, other)]
        energies, cutoff = [max(part.energies) for part in parts], parts[0].cutoff
        before, last = ([0.0, *measured])[-2:]
        # Equal meshes have equal values.
        if not last:
            return np.zeros(len(self.orders)), np.zeros(len(self.orders))
        # Between parallel surfaces the energy grows like |ξ|², rises through the sum to twice it, and swings about it.
        total = sum(energies)
        least, largest = ((math.sqrt(energies[0]) + sign * math.sqrt(energies[1])) ** 2 for sign in (-1, 1))
        swing = max(_SWING * abs(total - last), _RISE * total if last > _STEEPEST_GROWTH * before else 0.0)
        limit, most = (np.interp(self.orders, _AT_ORDERS, values) for values in (_LEAST_LIMITS, _MOST))
        lowest = np.minimum(limit * last, min(2 * last - total, total, max(total - _SWING * (last - total), least)))
        highest = np.minimum(np.maximum(most * total, total + swing), largest)
        unit, off = Remainder.alike(cutoff, 1.0).at(self.orders)
        lower, upper = np.maximum(lowest, 0.0) * (unit - off), highest * (unit + off)
        if self._from_reference.keys() >= {row, other}:
            known = self._from_reference[row], self._from_reference[other]
            low, high = (np.maximum([values + sign * errors for values, errors in known], 0.0) for sign in (-1, 1))
            nearest, farthest = np.sqrt(low), np.sqrt(high)
            upper = np.minimum(upper, farthest.sum(axis=0) ** 2)
            lower = np.clip(lower, np.maximum(nearest - farthest[::-1], 0.0).max(axis=0) ** 2, upper)
        return (lower + upper) / 2, (upper - lower) / 2

    def sums_over_shells(self, rows: Sequence[int]) -> Reals:
        """Return the sums of |a|² over shells, see `shell_sums`, of the field of a row or the difference of two."""
        sums = np.zeros(self.lattice.shell_count)
        for number, block in enumerate(self.blocks):
            values = self.read(rows, number)
            sums += shell_sums(values[0] - values[1] if len(rows) > 1 else values[0], None, self.lattice, block)
        return sums
