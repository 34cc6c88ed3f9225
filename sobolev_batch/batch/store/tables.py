"""Tables: the small arrays of a store. Each group of them is written, listed and invalidated as a whole."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.batch.store.hierarchy import (
    LABELS,
    OCTAVES,
    OCTAVES_GROUP,
    QUALITY,
    RECORDS,
    ROOT,
    Hierarchy,
    StoredChunks,
)
from sobolev_batch.batch.store.layout import Layout
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.lattice import AXES

# All other groups are tables.
_GROUPS_OF_TASKS = ("fourier", OCTAVES_GROUP, RECORDS)


@dataclass(frozen=True)
class Tables:
    """Tables of a store."""

    store: Hierarchy

    def invalidate(self) -> tuple[str, ...]:
        """Hide the tables from readers until they are written and listed again, and return their names.

        While they are written they do not fit together.
        """
        names = tuple(self._names())
        if names:
            self.store.hide(names)
            # Errors of norms need them, and they are written before tables are listed again.
            self.store.forget_digests(QUALITY)
            self.store.consolidate()
        return names

    def write(self, group: str, dataset: xr.Dataset, *, instead_of: Sequence[str] = ()) -> None:
        """Replace a group, each array in one chunk. Readers find it after `Store.consolidate`.

        Args:
            group: Name of the group.
            dataset: New content of the group.
            instead_of: Names of tables that were invalidated. Those that the group no longer has are removed.
        """
        layout = Layout()
        layout.add_dataset(group, dataset)
        keys = layout.keys(group)
        for name in instead_of:
            if name.startswith(f"{group}/") and f"{name}/{ROOT}" not in keys:
                self.store.location.remove(name)
        self.store.publish(keys, last=f"{group}/{ROOT}")

    def attributes(self, group: str) -> dict[str, Any] | None:
        """Return the attributes of a group, or None if it is not listed."""
        listed = self.store.exists() and group in self.store.documents
        return self.store.documents[group].get("attributes", {}) if listed else None

    def lost(self) -> tuple[str, ...]:
        """Return the arrays of tables with missing chunks. No chunk is read."""
        names = self._names()
        # Errors of norms need the qualities, which are written with them.
        others = [QUALITY] if names else []
        return tuple(self._incomplete(names, self._groups()) + self._incomplete(others, others))

    def without_records(self, records: Sequence[object | None]) -> tuple[int, ...]:
        """Return the rows that tables list as complete, and that have no record.

        Args:
            records: Record of each row, or None.
        """
        if self.attributes("convergence") is None:
            return ()
        rows, statuses = (np.asarray(self.store.read(f"meshes/{name}", ...)).tolist() for name in ("row", "status"))
        return tuple(
            row
            for row, status in zip(rows, statuses, strict=True)
            if status == "complete" and (row >= len(records) or records[row] is None)
        )

    def damaged(self) -> dict[str, str]:
        """Return the damage of each small array, of tables and coordinates, that cannot be read."""
        of_octaves = [name for name in self.store.documents if name.startswith(f"{OCTAVES_GROUP}/") and name != OCTAVES]
        coordinates = [LABELS, *(f"fourier/{name}" for name in AXES), *of_octaves]
        lost = {*self.lost(), *self._incomplete(coordinates, coordinates)}
        damage = dict.fromkeys(sorted(lost), "it is not there, or not all of it")
        for name in [*coordinates, QUALITY, *self._names()]:
            if name not in damage and self._is_array(name):
                try:
                    self.store.read(name, ...)
                except DamageError as error:
                    damage[name] = error.what
        return damage

    def _groups(self) -> list[str]:
        return sorted({name.split("/")[0] for name in self.store.documents if name} - set(_GROUPS_OF_TASKS))

    def _names(self) -> list[str]:
        groups = self._groups()
        return [name for name in self.store.documents if name.split("/")[0] in groups]

    def _is_array(self, name: str) -> bool:
        return self.store.document(name).get("node_type") == "array"

    def _incomplete(self, names: Iterable[str], prefixes: Iterable[str]) -> list[str]:
        """Return the arrays that have missing or short chunks, given prefixes of their keys."""
        sizes = {key: size for prefix in prefixes for key, size in self.store.location.sizes(prefix).items()}
        incomplete = []
        for name in filter(self._is_array, names):
            chunks = StoredChunks(self.store, name, sizes)
            if not chunks.are_complete(np.ndindex(*chunks.counts)):
                incomplete.append(name)
        return incomplete
