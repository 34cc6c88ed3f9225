"""Fields in a store: their chunks, of blocks of the lattice and of octaves, written and read against checksums."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zarr.buffer.cpu import NDBuffer

from sobolev_batch.arrays import slices
from sobolev_batch.errors import DamageError
from sobolev_batch.store.checked import CHANGED, checksum_of
from sobolev_batch.store.layout import FIELD, OCTAVES, Store
from sobolev_batch.store.metadata import chunk_shape
from sobolev_batch.store.records import Record
from sobolev_batch.transform.lattice import AXES, Block, Lattice

# A place of values of a field is given by slices of a block of the lattice, or by the slice of all samples of octaves.
Place = tuple[slice, ...]


@dataclass(frozen=True)
class Fields:
    """The fields of a store."""

    store: Store

    def places(self) -> tuple[Place, ...]:
        """Return the places of a field's values: its blocks, in the order of a plan's blocks, and then its octaves."""
        array = self.store.array(FIELD)
        axes = map(slices, array.shape[1:], array.chunks[1:])
        octaves = [(slice(0, self.store.document(OCTAVES)["shape"][1]),)] if OCTAVES in self.store.documents else []
        return (*product(*axes), *octaves)

    def blocks_of(self, lattice: Lattice) -> tuple[Block, ...]:
        """Return the blocks of a field on its lattice, in the order of `places`."""
        x, y, z = lattice.half.start
        return tuple(
            Block((x + i.start, y + j.start, z + k.start), (i.stop - i.start, j.stop - j.start, k.stop - k.start))
            for i, j, k in (place for place in self.places() if len(place) == len(AXES))
        )

    def write(self, row: int, place: Place, values: NDArray[Any]) -> int:
        """Write a row's values at a place, made of whole chunks, and return their checksum for `read`."""
        name = FIELD if len(place) == len(AXES) else OCTAVES
        document = self.store.document(name)
        values = np.ascontiguousarray(values, dtype=document["data_type"])
        index = [row, *(axis.start // step for axis, step in zip(place, chunk_shape(document)[1:], strict=True))]
        self.store.write(name, index, values[None])
        return checksum_of(values)

    def read(self, rows: Sequence[int], place: Place, checksums: Sequence[int] | None = None) -> NDArray[Any]:
        """Return the values of several rows at a place, complex (len(rows), ...).

        They are compared with the checksums that the tasks returned; without these, missing values read as NaN. A
        DamageError names the row whose values are damaged, lost, or others.
        """
        store, array = self.store, self.store.array(FIELD if len(place) == len(AXES) else OCTAVES)
        values = np.empty((len(rows), *(axis.stop - axis.start for axis in place)), dtype=array.dtype)

        def read(i: int) -> None:
            # On object storage, all but a wrong checksum is a failure of the access.
            damage = ValueError if store.location.scheme else (OSError, ValueError)
            with store.location.access("read"):
                try:
                    # It is read in place: copying a field costs as much as reading it.
                    array.get_basic_selection((rows[i], *place), out=NDBuffer.from_numpy_array(values[i]))
                except damage as error:
                    raise _damage(store, rows[i], str(error)) from error
            if checksums is not None and checksum_of(values[i]) != checksums[i]:
                others = f"{CHANGED} for its record"
                raise _damage(store, rows[i], "it is not there" if np.isnan(values[i]).all() else others)

        # Most of the time of a request is spent waiting.
        with ThreadPoolExecutor(max(1, len(rows)) if store.location.scheme else 1) as pool:
            list(pool.map(read, range(len(rows))))
        return values

    def damage(self, row: int, record: Record) -> str:
        """Read the field of a row, and return how it differs from its record; empty if it does not."""
        if len(record.checksums) != len(places := self.places()):
            return f"its record knows of {len(record.checksums)} blocks, and the store has {len(places)}"
        try:
            for place, checksum in zip(places, record.checksums, strict=True):
                self.read([row], place, [checksum])
        except DamageError as error:
            return error.what
        return ""

    def complete_rows(self) -> set[int]:
        """Return the rows whose blocks all exist in their full length. No block is read."""
        rows = set(range(self.store.document(FIELD)["shape"][0]))
        for name in self.store.documents.keys() & {FIELD, OCTAVES}:
            rows -= {place[0] for place in self.store.incomplete_chunks(name, self.store.location.sizes(f"{name}/c"))}
        return rows


def _damage(store: Store, row: int, problem: str) -> DamageError:
    return store.damage(f"the field of {store.names_of_rows(row + 1)[row]}", problem, row)
