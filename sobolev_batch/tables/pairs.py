"""Distances of all pairs in the store: square tiles, each computed by one task and written as chunks of its own.

Neither the driver nor a task holds the whole matrix. A tile has a key, which tells the fields that it was computed
from: an interrupted run goes on with the tiles that are missing, and new meshes, which come last, cost new tiles.
"""

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import xarray as xr

from sobolev_batch.errors import DamageError
from sobolev_batch.norms.columns import VARIABLES, describe
from sobolev_batch.norms.estimate import PARTS, NormEstimate
from sobolev_batch.store.encoding import array_keys, dataset_keys
from sobolev_batch.store.layout import DISTANCES, PAIRS_KEYS, Store
from sobolev_batch.store.metadata import chunk_shape
from sobolev_batch.store.sealed_chunks import key_in, key_of, missing_chunks, seal
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.tables.stored_spectra import read_spectra

# Raise it whenever the same fields lead to other distances: tiles of older versions are then made again.
_TILES_VERSION = 6
# Meshes along a side of a tile: with fewer, small studies keep their workers busy; with more, there are fewer keys.
_FEWEST, _MOST, _TILES_OF_A_ROW = 32, 512, 8
# Arrays of the distances and their errors, as `NormEstimate.named` names them.
_COLUMNS = ("distance", "error", "error_part")
# What a pair takes on disk, for each order.
PAIR_BYTES = 8 * (2 + len(PARTS))


def _side(meshes: int) -> int:
    """Return the number of meshes along a side of a tile: a power of two, which seldom changes as meshes are added."""
    return int(np.clip(2 ** np.ceil(np.log2(max(meshes, 1) / _TILES_OF_A_ROW)), _FEWEST, _MOST))


def tile_count(meshes: int) -> int:
    """Return the number of tiles that are computed for some meshes."""
    return math.comb(math.ceil(meshes / _side(meshes)) + 1, 2)


@dataclass(frozen=True, eq=False)
class Pairs:
    """The distances of all pairs of a study's meshes in a store.

    Attributes:
        rows: Row of each mesh in the order of the matrix, that in which the meshes were added.
        keys: What each row with a field was computed from, by the row; see `Record`.
    """

    store: Store
    rows: Sequence[int]
    keys: Mapping[int, str]
    orders: tuple[float, ...]
    reference: int

    @classmethod
    def tabulated(cls, store: Store) -> Self:
        """Return the distances of all pairs by the tables of a store, which it may lack."""
        rows, status, keys = (np.asarray(store.read(f"meshes/{name}")).tolist() for name in ("row", "status", "key"))
        complete = {row: key for row, key, state in zip(rows, keys, status, strict=True) if state == "complete"}
        orders = tuple(store.attributes()["study"]["orders"])
        return cls(store, tuple(sorted(rows)), complete, orders, store.reference)

    def lay_out(self, coordinates: xr.Dataset) -> None:
        """Lay out the arrays, with coordinates of tables, for `Store.consolidate`; tiles that exist stay."""
        labels = self.store.labels()
        meshes = coordinates.sel(mesh=[labels[row] for row in self.rows])
        count, side = len(self.rows), self.side
        shape, chunks = (count, count, len(self.orders)), (side, side, len(self.orders))
        others = ("other", meshes["mesh"].values, dict(VARIABLES["other"]))
        keys = dataset_keys(DISTANCES, describe(meshes.assign_coords(other=others, part=np.array(PARTS, dtype=object))))
        # xarray makes coordinates of what `coordinates` names.
        names = " ".join(["key", *sorted(map(str, meshes.coords.keys() - meshes.sizes.keys()))])
        for name in _COLUMNS:
            path, dimensions = f"{DISTANCES}/{name}", ("mesh", "other", "order")
            attributes = {**VARIABLES[name], "coordinates": names}
            # A chunk for each part, as small as those of the distances.
            length, step, axis = ((len(PARTS),), (1,), ("part",)) if name == "error_part" else ((), (), ())
            keys |= array_keys(path, "float64", shape + length, chunks + step, dimensions + axis, **attributes)
        tiles = math.ceil(count / side)
        keys |= array_keys(PAIRS_KEYS, str, (tiles, tiles), (1, 1), ("tile", "other_tile"))
        before = self.store.stored_document(f"{DISTANCES}/{_COLUMNS[0]}")
        if before is not None and chunk_shape(before) != list(chunks):
            self.store.location.remove(DISTANCES)
        self.store.publish(keys)

    @property
    def side(self) -> int:
        """Number of meshes along a side of a tile."""
        return _side(len(self.rows))

    def tile_rows(self, number: int) -> Sequence[int]:
        """Return the rows along one side of a tile."""
        return self.rows[number * self.side : (number + 1) * self.side]

    def key_of_tile(self, tile: tuple[int, int]) -> str:
        """Return the key of what a tile depends on."""
        sides = [[self.keys.get(row, "") for row in self.tile_rows(number)] for number in tile]
        # A tile depends on the reference too: its products are of differences from it.
        ends = self.keys.get(self.reference, ""), *map(repr, self.orders), str(_TILES_VERSION)
        return key_of([*sides[0], "|", *sides[1], "|", *ends])

    def stale(self) -> list[tuple[int, int]]:
        """Return the tiles (i, j), i <= j, that are to be computed. No distance is read."""
        count, missing = math.ceil(len(self.rows) / self.side), missing_chunks(self.store, PAIRS_KEYS)
        try:
            texts = np.asarray(self.store.read(PAIRS_KEYS)).tolist()
        except DamageError:
            texts = [[""] * count] * count
        stored = {(i, j): key_in(text) for i, line in enumerate(texts) for j, text in enumerate(line)}
        return [
            (i, j)
            for i in range(count)
            for j in range(i, count)
            if {(i, j), (j, i)} & missing or not stored[i, j] == stored[j, i] == self.key_of_tile((i, j))
        ]

    def only(self, tile: tuple[int, int]) -> Self:
        """Return what is needed for a tile alone: of many meshes, the rest is much to send."""
        needed = {self.reference, *self.tile_rows(tile[0]), *self.tile_rows(tile[1])}
        return replace(self, keys={row: self.keys[row] for row in sorted(needed & self.keys.keys())})


def fill_tile(evaluator: Evaluator, pairs: Pairs, tile: tuple[int, int]) -> None:
    """Compute a tile of distances, and write it with its mirror image; DamageError where a field was changed."""
    sides = [pairs.tile_rows(number) for number in tile]
    estimate = known_distances(evaluator, sides[0], sides[1], pairs.keys.keys())
    arrays = {name: np.moveaxis(values, 0, 2) for name, values in sorted(estimate.named("distance").items())}
    mirrored = {name: np.swapaxes(values, 0, 1) for name, values in arrays.items()}
    both = {tile: arrays, tile[::-1]: mirrored} if tile[0] != tile[1] else {tile: arrays}
    # Should this be interrupted, no old key may stand for new values.
    for place in both:
        pairs.store.write(PAIRS_KEYS, place, [[""]])
    for place, values_by_name in both.items():
        for name, values in values_by_name.items():
            pairs.store.write(f"{DISTANCES}/{name}", place, values)
    for place, values_by_name in both.items():
        pairs.store.write(PAIRS_KEYS, place, [[seal(pairs.key_of_tile(tile), values_by_name.values())]])


def known_distances(
    evaluator: Evaluator, rows: Sequence[int], others: Sequence[int], complete: Set[int]
) -> NormEstimate:
    """Return distances over (orders, rows, others): those of `pair_distances` where both are complete, else NaN."""
    known = [[row for row in side if row in complete] for side in (rows, others)]
    first, second = np.ix_(*([place for place, row in enumerate(side) if row in complete] for side in (rows, others)))
    values = np.full((1 + len(PARTS), len(evaluator.orders), len(rows), len(others)), np.nan)
    if all(known):
        values[..., first, second] = pair_distances(evaluator, *known).stacked
    return NormEstimate(*values)


def pair_distances(evaluator: Evaluator, rows: Sequence[int], others: Sequence[int]) -> NormEstimate:
    """Return distances over (orders, rows, others), see `Evaluator.pairs`; those to the reference come from spectra."""
    reference, sides = evaluator.reference, {*rows, *others}
    if reference is None or not (evaluator.sampling is None or reference in sides):
        return evaluator.pairs(rows, others)
    read = sorted(sides | {reference})
    spectra, places = read_spectra(evaluator.store, read), {row: k for k, row in enumerate(read)}
    images = evaluator.images.copy()
    if evaluator.sampling is None:
        images[:, read] = np.sqrt(spectra.distance.images_at(evaluator.orders))
    distances = replace(evaluator, images=images).pairs(rows, others).stacked
    of_reference = spectra[[places[reference]]].norm
    for side, opposite, axis in ((rows, others, 2), (others, rows, 3)):
        if reference in side:
            found = evaluator.norms_of(opposite, spectra[[places[row] for row in opposite]], of_reference).distances
            distances.swapaxes(2, axis)[:, :, side.index(reference)] = found.stacked
    return NormEstimate(*distances)
