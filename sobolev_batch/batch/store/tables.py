"""Tables: the small arrays of a store, each group of which is written, listed and withdrawn as a whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

from sobolev_batch.batch.store.store import CHECKSUM_BYTES, LABELS, QUALITY, RECORDS, ROOT, WITNESS_GROUP, Store
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.lattice import AXES

# All other groups are tables.
_GROUPS_OF_TASKS = ("fourier", RECORDS, WITNESS_GROUP)


@dataclass(frozen=True)
class Tables:
    """The tables of a store."""

    store: Store

    def withdraw(self) -> tuple[str, ...]:
        """Have no reader find the tables until they are listed again: while they are written they do not fit together.

        Nor witness functions, which belong to the fields that are replaced.

        Returns:
            The names of all tables that there were.
        """
        names = tuple(self._names())
        hidden = [*names, *(name for name in self.store.documents if name.split("/")[0] == WITNESS_GROUP)]
        for name in hidden:
            del self.store.documents[name]
        if hidden:
            self.store.consolidate()
        return names

    def write(self, group: str, dataset: xr.Dataset, *, instead_of: Sequence[str] = ()) -> None:
        """Replace a group, each array in one chunk; `Store.consolidate` makes it known to readers.

        Args:
            group: its name.
            dataset: what it is to hold.
            instead_of: tables that were withdrawn; those of the group that it has no longer are removed.
        """
        made: dict[str, Buffer] = {}
        # A chunk that is not there is a lost one, and never a table of zeros.
        with zarr.config.set({"array.write_empty_chunks": True}):
            dataset.to_zarr(
                MemoryStore(made),
                group=group,
                mode="w",
                zarr_format=3,
                consolidated=False,
                encoding=table_encoding(dataset),
            )
        made.pop(ROOT, None)
        for name in instead_of:
            if name.startswith(f"{group}/") and f"{name}/{ROOT}" not in made:
                self.store.location.remove(name)
        self.store.publish(made, last=f"{group}/{ROOT}")

    def attributes(self, group: str) -> dict[str, Any] | None:
        """The attributes of a group, or None where it was not written yet."""
        there = self.store.is_there() and group in self.store.documents
        return self.store.documents[group].get("attributes", {}) if there else None

    def lost(self) -> tuple[str, ...]:
        """The arrays of tables that are not all there; nothing is read of them."""
        lost = self._lost(self._names(), self._groups())
        # Errors of norms hang on the first, and it is written with them; witness functions on the others.
        besides = [*([QUALITY] if self._names() else ()), *self._axes_of_witness()]
        return (*lost, *self._lost(besides, besides))

    def damaged(self) -> dict[str, str]:
        """What is wrong with each small array, of tables and coordinates, that cannot be read."""
        coordinates = [LABELS, *(f"fourier/{name}" for name in AXES), *self._axes_of_witness()]
        lost = {*self.lost(), *self._lost(coordinates, coordinates)}
        damaged = dict.fromkeys(sorted(lost), "it is not there, or not all of it")
        for name in [*coordinates, QUALITY, *self._names()]:
            if name not in damaged and self.store.document(name).get("node_type") == "array":
                try:
                    self.store.read(name, ...)
                except DamageError as error:
                    damaged[name] = error.what
        return damaged

    def _axes_of_witness(self) -> list[str]:
        names = (f"{WITNESS_GROUP}/{name}" for name in ("mesh", "order"))
        return [name for name in names if name in self.store.documents]

    def _groups(self) -> list[str]:
        return sorted({name.split("/")[0] for name in self.store.documents if name} - set(_GROUPS_OF_TASKS))

    def _names(self) -> list[str]:
        groups = self._groups()
        return [name for name in self.store.documents if name.split("/")[0] in groups]

    def _lost(self, names: Sequence[str], prefixes: Sequence[str]) -> tuple[str, ...]:
        """Which of some arrays are not there as long as they should be, by the sizes of keys."""
        sizes = {key: size for prefix in prefixes for key, size in self.store.location.sizes(prefix).items()}
        lost = []
        for name in names:
            if self.store.document(name).get("node_type") != "array":
                continue
            array = self.store.array(name)
            # Texts have no size that could be foretold.
            fixed = array.dtype.kind in "biufc"
            expected = math.prod(array.chunks) * array.dtype.itemsize + CHECKSUM_BYTES * bool(array.ndim)
            counts = (-(-n // m) for n, m in zip(array.shape, array.chunks, strict=True))
            for number in np.ndindex(*counts):
                found = sizes.get(f"{name}/{array.metadata.encode_chunk_key(number)}", 0)
                if found != expected if fixed else not found:
                    lost.append(name)
                    break
        return tuple(lost)


def table_encoding(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """One chunk per array, with a checksum."""
    return {
        str(name): {"compressors": (Crc32cCodec(),), "chunks": variable.shape}
        for name, variable in dataset.variables.items()
        if variable.ndim
    }
