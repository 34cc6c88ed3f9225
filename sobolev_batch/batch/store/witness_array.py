"""Witness functions in a store: for each mesh a value at each of its vertices, for each order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

from sobolev_batch.batch.store.store import CHECKSUM_BYTES, ROOT, WITNESS, WITNESS_GROUP, Store, checksum_of
from sobolev_batch.batch.store.tables import table_encoding
from sobolev_batch.errors import DamageError

# Vertices of a chunk: coarse meshes waste little room, and fine ones make few chunks.
_CHUNK = 8192
_DIMENSIONS = 3
_AXES = tuple(f"{WITNESS_GROUP}/{name}" for name in ("mesh", "order"))

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Witnesses:
    """The witness functions in a store, `witness` (mesh, order, vertex); NaN beyond the vertices of a mesh."""

    store: Store

    def are_there(self) -> bool:
        """Whether there is room for them, listed or not."""
        return all(self.store.has(name) for name in (WITNESS, WITNESS_GROUP, *_AXES))

    def are_listed(self) -> bool:
        """Whether readers find them."""
        return WITNESS in self.store.documents

    def lay_out(self, labels: Sequence[str], orders: Sequence[float], reference: str, vertices: int) -> None:
        """Make room; what is there stays if it is of the same orders and meshes.

        Args:
            labels: of all surfaces of the store.
            orders: s, each.
            reference: its label.
            vertices: of the largest mesh.
        """
        shape = len(labels), len(orders), vertices
        axes = {"mesh": np.array(labels, dtype=object), "order": np.array(orders, dtype=np.float64)}
        if self.are_there() and self._fits(axes, reference):
            there = self.store.array(WITNESS).shape
            if there != (grown := (*shape[:2], max(vertices, there[2]))):
                self.store.resize(WITNESS, grown)
        else:
            self.store.remove(WITNESS_GROUP)
            made: dict[str, Buffer] = {}
            zarr.create_group(MemoryStore(made), zarr_format=3).create_array(
                WITNESS,
                shape=shape,
                dtype=np.float64,
                chunks=(1, len(orders), _CHUNK),
                compressors=(Crc32cCodec(),),
                fill_value=np.nan,
                dimension_names=("mesh", "order", "vertex"),
                attributes={
                    "description": "positive where the mesh has area that the reference lacks; NaN beyond "
                    "its vertices, and at those that no triangle uses",
                    "units": "1 / unit length",
                },
            )
            made.pop(ROOT)
            self.store.publish(made, last="")
        dataset = xr.Dataset(coords=axes, attrs={"reference": reference})
        made = {}
        dataset.to_zarr(
            MemoryStore(made),
            group=WITNESS_GROUP,
            zarr_format=3,
            consolidated=False,
            encoding=table_encoding(dataset),
        )
        made.pop(ROOT)
        self.store.publish(made, last=f"{WITNESS_GROUP}/{ROOT}")

    def list_them(self) -> None:
        """Have readers find them, once the root is written."""
        for name in (WITNESS_GROUP, WITNESS, *_AXES):
            self.store.document(name)

    def write(self, row: int, values: Reals) -> int:
        """Write the functions of a row, (orders, vertices); chunks beyond them are left to `sweep`.

        Returns:
            The checksum by which `read` knows them again.
        """
        array = self.store.array(WITNESS)
        count = values.shape[1]
        width = min(_CHUNK * math.ceil(count / _CHUNK), array.shape[2])
        # Whole chunks: a part of one would have the rest of it read.
        padded = np.full((values.shape[0], width), np.nan)
        padded[:, :count] = values
        with self.store.location.access("written"):
            array[row, :, :width] = padded
        return checksum_of(np.ascontiguousarray(values))

    def read(self, row: int, count: int, checksum: int) -> Reals:
        """The functions of a row at its vertices.

        Raises:
            DamageError: they are not what was written.
        """
        array = self.store.array(WITNESS)
        if count > array.shape[2]:
            raise DamageError(f"{self.store.path}: {WITNESS} is too small", "they are not there")
        values = np.ascontiguousarray(self.store.read(WITNESS, (row, slice(None), slice(0, count))))
        if checksum_of(values) != checksum:
            what = "it is not what was written, or not all of it is there"
            raise DamageError(f"{self.store.path}: {WITNESS} is damaged ({what})", what)
        return values

    def sweep(self, counts: Mapping[int, int]) -> None:
        """Remove the chunks of rows that have no functions, and those beyond the vertices of others.

        Args:
            counts: vertices of each row that has functions.
        """
        prefix = f"{WITNESS}/c/"
        for key in self.store.location.sizes(prefix.rstrip("/")):
            place = key.removeprefix(prefix).split("/")
            if len(place) == _DIMENSIONS and all(part.isdigit() for part in place):
                row, _, number = map(int, place)
                if number >= math.ceil(counts.get(row, 0) / _CHUNK):
                    self.store.location.discard(key)

    def whole_rows(self, counts: Mapping[int, int]) -> set[int]:
        """The rows of which every chunk is there, as long as it should be; nothing is read of them.

        Args:
            counts: vertices of each row.
        """
        array = self.store.array(WITNESS)
        whole = math.prod(array.chunks) * array.dtype.itemsize + CHECKSUM_BYTES
        sizes = self.store.location.sizes(f"{WITNESS}/c")
        return {
            row
            for row, count in counts.items()
            if all(
                sizes.get(f"{WITNESS}/{array.metadata.encode_chunk_key((row, 0, number))}") == whole
                for number in range(math.ceil(count / _CHUNK))
            )
        }

    def remove(self) -> None:
        """Take all of them away."""
        self.store.remove(WITNESS_GROUP)

    def _fits(self, axes: dict[str, NDArray[Any]], reference: str) -> bool:
        """Whether what is there is of these orders and of the first of these meshes."""
        if self.store.document(WITNESS_GROUP).get("attributes", {}).get("reference") != reference:
            return False
        try:
            labels, orders = self.store.texts(_AXES[0]), np.asarray(self.store.read(_AXES[1], ...))
        except DamageError:
            return False
        return labels == tuple(axes["mesh"][: len(labels)]) and np.array_equal(orders, axes["order"])
