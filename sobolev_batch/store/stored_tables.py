"""Tables of a store: each group of them is small, and is written, listed and hidden as a whole."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.errors import DamageError
from sobolev_batch.store.layout import (
    OCTAVES_GROUP,
    QUALITY,
    RECORDS,
    SPECTRA_GROUP,
    Store,
    dataset_keys,
    is_large,
)
from sobolev_batch.store.records import Record

# All other groups are tables.
_GROUPS_OF_TASKS = ("fourier", OCTAVES_GROUP, SPECTRA_GROUP, RECORDS)


def hide_tables(store: Store) -> list[str]:
    """Hide the tables, which do not fit together while they are written, and return the names of their nodes."""
    names = table_names(store)
    if names:
        store.hide(names)
    return names


def write_table(store: Store, group: str, dataset: xr.Dataset) -> None:
    """Write a group. Readers find it after `Store.consolidate`."""
    large = [name for name, values in dataset.items() if is_large(values)]
    store.publish(dataset_keys(group, dataset.drop_vars(large)))
    # One after the other, since keys are copies.
    for name in large:
        store.publish(dataset_keys(group, dataset[[name]].drop_vars(list(dataset.coords), errors="ignore")))


def table_attributes(store: Store, group: str) -> dict[str, Any] | None:
    """Return the attributes of a group, or None if it is not listed."""
    listed = store.exists() and group in store.documents
    return store.documents[group].get("attributes", {}) if listed else None


def table_names(store: Store) -> list[str]:
    """Return the names of the groups and arrays of tables that are listed."""
    return [name for name in store.documents if name and name.split("/")[0] not in _GROUPS_OF_TASKS]


def damaged_tables(store: Store) -> dict[str, str]:
    """Return the damage of each small array, of tables and coordinates, that cannot be read."""
    keyed, names = store.keyed_arrays(), store.whole_arrays()
    expected = [*names, QUALITY, *keyed] if table_names(store) else names
    groups = {name: name.split("/")[0] for name in expected}
    # Groups of tasks have the fields besides, which are many.
    prefixes = {name if group in _GROUPS_OF_TASKS else group for name, group in groups.items()}
    sizes = {key: size for prefix in prefixes for key, size in store.location.sizes(prefix).items()}
    incomplete = (name for name in expected if store.incomplete_chunks(name, sizes))
    damage = dict.fromkeys(incomplete, "it is not there, or not all of it")
    for name in expected:
        if name not in damage and name not in keyed:
            try:
                store.read(name)
            except DamageError as error:
                damage[name] = error.what
    return damage


def rows_unlike_tables(
    store: Store, records: Sequence[Record | None], among: Collection[int] | None = None
) -> dict[int, str]:
    """Return how records differ from those that the tables were made from, by their rows; of some rows, or of all."""
    if table_attributes(store, "convergence") is None:
        return {}
    columns = (np.asarray(store.read(f"meshes/{name}")).tolist() for name in ("row", "status", "key"))
    tabulated = {row: entry for row, *entry in zip(*columns, strict=True) if among is None or row in among}
    unlike = {}
    for row, entry in tabulated.items():
        record = records[row] if row < len(records) else None
        if record is None and entry[0] != "missing":
            unlike[row] = "its completion record is missing"
        elif record is not None and [record.status, record.key] != entry:
            unlike[row] = "its completion record is not the one that the tables were made from"
    return unlike
