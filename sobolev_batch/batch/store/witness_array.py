"""Witness functions in a store: a value at each vertex of each mesh, for each order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.storage.checked import checksum_of
from sobolev_batch.batch.store.hierarchy import ROOT, WITNESS, WITNESS_GROUP, StoredChunks
from sobolev_batch.batch.store.layout import Layout
from sobolev_batch.batch.store.store import Store
from sobolev_batch.errors import DamageError

# Vertices of a chunk: coarse meshes waste little space, and fine ones have few chunks.
_CHUNK = 8192
_DIMENSIONS = 3
_AXES = tuple(f"{WITNESS_GROUP}/{name}" for name in ("mesh", "order"))

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Witnesses:
    """Witness functions of a store, `witness` (mesh, order, vertex); NaN beyond the vertices of a mesh."""

    store: Store

    def exist(self) -> bool:
        """Return whether their arrays exist, listed or not."""
        return all(self.store.has(name) for name in (WITNESS, WITNESS_GROUP, *_AXES))

    def are_listed(self) -> bool:
        """Return whether readers find them."""
        return WITNESS in self.store.documents

    def create(self, labels: Sequence[str], orders: Sequence[float], reference: str, vertices: int) -> None:
        """Create the arrays, or extend them. Values for the same orders, reference and meshes stay.

        Args:
            labels: Labels of all surfaces of the store.
            orders: Orders s.
            reference: Label of the reference.
            vertices: Number of vertices of the largest mesh.
        """
        shape = len(labels), len(orders), vertices
        axes = {"mesh": np.array(labels, dtype=object), "order": np.array(orders, dtype=np.float64)}
        layout = Layout()
        if self.exist() and self._fits(axes, reference):
            current = self.store.array(WITNESS).shape
            if current != (extended := (*shape[:2], max(vertices, current[2]))):
                self.store.resize(WITNESS, extended)
        else:
            self.store.remove(WITNESS_GROUP)
            layout.add_array(
                WITNESS,
                np.float64,
                shape,
                (1, len(orders), _CHUNK),
                ("mesh", "order", "vertex"),
                description="positive where the mesh has area that the reference lacks; NaN beyond its vertices, "
                "and at those that no triangle uses",
                units="1 / unit length",
            )
        layout.add_dataset(WITNESS_GROUP, xr.Dataset(coords=axes, attrs={"reference": reference}))
        self.store.publish(layout.keys(WITNESS_GROUP), last=f"{WITNESS_GROUP}/{ROOT}")

    def list_for_readers(self) -> None:
        """Let readers find them after `Store.consolidate`."""
        for name in (WITNESS_GROUP, WITNESS, *_AXES):
            self.store.document(name)

    def write(self, row: int, values: Reals) -> int:
        """Write the functions of a row, (orders, vertices), and return their checksum for `read`.

        `remove_unused` removes chunks beyond them.
        """
        count = values.shape[1]
        width = min(_CHUNK * math.ceil(count / _CHUNK), self.store.array(WITNESS).shape[2])
        # Whole chunks, or zarr would read the rest of them.
        padded = np.full((values.shape[0], width), np.nan)
        padded[:, :count] = values
        self.store.write(WITNESS, (row, slice(None), slice(0, width)), padded)
        return checksum_of(np.ascontiguousarray(values))

    def read(self, row: int, count: int, checksum: int) -> Reals:
        """Return the functions of a row at its vertices.

        Raises:
            DamageError: They are not what was written.
        """
        if count > self.store.array(WITNESS).shape[2]:
            raise DamageError(f"{self.store.path}: {WITNESS} is too small", "they are not there")
        values = np.ascontiguousarray(self.store.read(WITNESS, (row, slice(None), slice(0, count))))
        if checksum_of(values) != checksum:
            problem = "it is not what was written, or not all of it is there"
            raise DamageError(f"{self.store.path}: {WITNESS} is damaged ({problem})", problem)
        return values

    def damaged(self, counts: Mapping[int, int], checksums: Mapping[int, int]) -> dict[int, str]:
        """Return the damage of the functions of rows that have some.

        Args:
            counts: Number of vertices of each row.
            checksums: Checksum of the functions of each of these rows.
        """
        damaged = {}
        for row, checksum in checksums.items():
            try:
                self.read(row, counts[row], checksum)
            except DamageError as error:
                damaged[row] = error.what
        return damaged

    def remove_unused(self, counts: Mapping[int, int]) -> None:
        """Remove the chunks of rows without functions, and those beyond the vertices of others.

        Args:
            counts: Number of vertices of each row that has functions.
        """
        prefix = f"{WITNESS}/c/"
        for key in self.store.location.sizes(prefix.rstrip("/")):
            index = key.removeprefix(prefix).split("/")
            if len(index) == _DIMENSIONS and all(number.isdigit() for number in index):
                row, _, chunk = map(int, index)
                if chunk >= math.ceil(counts.get(row, 0) / _CHUNK):
                    self.store.location.discard(key)

    def complete_rows(self, counts: Mapping[int, int]) -> set[int]:
        """Return the rows of which every chunk exists in its full length. No chunk is read.

        Args:
            counts: Number of vertices of each row.
        """
        chunks = StoredChunks(self.store, WITNESS)
        return {
            row
            for row, count in counts.items()
            if chunks.are_complete((row, 0, number) for number in range(math.ceil(count / _CHUNK)))
        }

    def _fits(self, axes: dict[str, NDArray[Any]], reference: str) -> bool:
        """Return whether the stored functions have these orders and this reference; records say whose they are."""
        if self.store.document(WITNESS_GROUP).get("attributes", {}).get("reference") != reference:
            return False
        try:
            orders = np.asarray(self.store.read(_AXES[1], ...))
        except DamageError:
            return False
        return np.array_equal(orders, axes["order"])
