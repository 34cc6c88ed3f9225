"""Arrays of a store besides fields and records: tables, and those that tasks of the reduction fill, chunk by chunk.

Tables are small. Each group of them is written, listed and hidden as a whole. Spectra, and distances of all pairs, have
an array of keys, with a chunk for each chunk of the others along the meshes. Keys tell which fields the numbers were
computed from, so that they are computed again only where a field has changed. They are stored with checksums of the
numbers: a chunk that took the place of another is found.

Keys of new arrays are made in memory and then written as a whole: zarr and xarray look at a store again and again while
they create arrays, and on object storage each look is a request.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import DamageError
from sobolev_batch.store.checked import CHANGED, checksum_of
from sobolev_batch.store.records import Record
from sobolev_batch.store.store import (
    FIELD,
    OCTAVES,
    OCTAVES_GROUP,
    PAGE,
    QUALITY,
    RECORD,
    RECORDS,
    ROOT,
    SPECTRA_GROUP,
    Store,
)

# All other groups are tables.
_GROUPS_OF_TASKS = ("fourier", OCTAVES_GROUP, SPECTRA_GROUP, RECORDS)
# By the kind of a dtype: of strings, complex and real numbers.
_FILL_VALUES: dict[str, Any] = {"U": "", "c": complex(np.nan, np.nan), "f": np.nan}
# Of an array of a table in memory: distances of all pairs of many meshes are cut along the first axis.
_LARGEST_CHUNK_BYTES = 64 << 20


def array_keys(
    name: str,
    dtype: Any,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dimensions: tuple[str, ...],
    **attributes: Any,
) -> dict[str, bytes]:
    """Return the keys of an array without chunks, with checksums. It reads as NaN, or as empty strings."""
    keys: dict[str, Buffer] = {}
    zarr.create_group(MemoryStore(keys), zarr_format=3).create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=chunks,
        compressors=(Crc32cCodec(),),
        fill_value=_FILL_VALUES[np.dtype(dtype).kind],
        dimension_names=dimensions,
        attributes=attributes,
    )
    return _bytes_of(keys)


def dataset_keys(group: str, dataset: xr.Dataset) -> dict[str, bytes]:
    """Return the keys of a group with the arrays of a dataset, with checksums, one chunk each unless they are large."""
    keys: dict[str, Buffer] = {}
    encoding = {
        str(name): {
            "compressors": (Crc32cCodec(),),
            "chunks": variable.encoding.get("chunks", (_steps(variable), *variable.shape[1:])),
        }
        for name, variable in dataset.variables.items()
        if variable.ndim
    }
    # A missing chunk is a lost one, and never a table of zeros.
    with zarr.config.set({"array.write_empty_chunks": True}):
        dataset.to_zarr(MemoryStore(keys), group=group, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
    # xarray writes several at a time, in any order.
    places = {str(name): place for place, name in enumerate(dataset.variables)}
    written = _bytes_of(keys)
    return {key: written[key] for key in sorted(written, key=lambda key: places.get(key.split("/")[1], -1))}


def _steps(variable: xr.Variable) -> int:
    """Return the length of a chunk along the first axis."""
    return max(1, min(variable.shape[0], _LARGEST_CHUNK_BYTES * variable.shape[0] // max(1, variable.nbytes)))


def _bytes_of(keys: dict[str, Buffer]) -> dict[str, bytes]:
    # The root is made by `Store.consolidate`.
    return {key: value.to_bytes() for key, value in keys.items() if key != ROOT}


def hide_tables(store: Store) -> list[str]:
    """Hide the tables, which do not fit together while they are written, and return the names of their nodes."""
    names = table_names(store)
    if names:
        store.documents = {name: document for name, document in store.documents.items() if name not in names}
        store.consolidate()
    return names


def write_table(store: Store, group: str, dataset: xr.Dataset) -> None:
    """Write a group. Readers find it after `Store.consolidate`."""
    large = [name for name, values in dataset.items() if values.nbytes > _LARGEST_CHUNK_BYTES]
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
    keyed = store.keyed_arrays()
    written_with_tables = [QUALITY, *keyed]
    others = {FIELD, OCTAVES, RECORD, PAGE, *written_with_tables}
    names = [name for name in filter(store.is_array, store.documents) if name not in others]
    expected = [*names, *written_with_tables] if table_names(store) else names
    groups = {name: name.split("/")[0] for name in expected}
    # Groups of tasks have the fields besides, which are many.
    prefixes = {name if group in _GROUPS_OF_TASKS else group for name, group in groups.items()}
    sizes = {key: size for prefix in prefixes for key, size in store.location.sizes(prefix).items()}
    incomplete = (name for name in expected if store.is_array(name) and store.incomplete_chunks(name, sizes))
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


# Raise it where other numbers are computed from the same fields: all chunks are then stale.
_VERSION = "2"
# Place of a chunk of keys, counted in chunks.
Index = tuple[int, ...]


def key_of(parts: Iterable[str]) -> str:
    """Return the key for what a chunk's numbers depend on."""
    return hashlib.sha256(" ".join([_VERSION, *parts]).encode()).hexdigest()[:32]


def arrays_of(store: Store, keys: str) -> list[str]:
    """Return the names of the arrays that an array of keys is for, sorted."""
    group = keys.split("/")[0]
    return sorted(name for name in store.keyed_arrays() if name.startswith(f"{group}/") and name != keys)


def missing_chunks(store: Store, keys: str) -> set[Index]:
    """Return the places that are not there as a whole. No chunk is read."""
    sizes, axes = store.location.sizes(keys.split("/")[0]), len(store.document(keys)["shape"])
    names = [keys, *arrays_of(store, keys)]
    return {index[:axes] for name in names for index in store.incomplete_chunks(name, sizes)}


def damaged_chunks(store: Store) -> Iterator[tuple[str, Index, str]]:
    """Yield the array of keys, place and damage of each chunk that is not what was written."""
    for keys in store.keyed_arrays():
        if keys.endswith("/key"):
            for index in store.chunk_keys(keys).values():
                try:
                    read_chunk(store, keys, index)
                except DamageError as error:
                    yield keys, index, error.what


def read_chunk(store: Store, keys: str, index: Index) -> tuple[list[str], dict[str, Reals]]:
    """Return a chunk of keys, flattened, and of their arrays by name; DamageError where they do not match."""
    sealed = np.asarray(store.read(keys, _region(store, keys, index)))
    arrays = {name: np.asarray(store.read(name, _region(store, name, index))) for name in arrays_of(store, keys)}
    # A single key is for the whole of a chunk, others are for its rows.
    is_for_rows = sealed.ndim == 1
    for number, text in enumerate(sealed.ravel().tolist()):
        if text and text != seal(
            key_in(text), [values[number] if is_for_rows else values for values in arrays.values()]
        ):
            raise DamageError(f"{store.path}: chunk {index} of {keys.split('/')[0]} is damaged ({CHANGED})", CHANGED)
    return [key_in(text) for text in sealed.ravel().tolist()], arrays


def seal(key: str, arrays: Iterable[Reals]) -> str:
    """Return a key with the checksums of the values that it is for, in the order of `arrays_of`."""
    return " ".join([key, *(str(checksum_of(np.ascontiguousarray(values))) for values in arrays)])


def key_in(text: str) -> str:
    """Return the key of a `seal`, or none of an empty text."""
    return text.partition(" ")[0]


def withdraw_chunk(store: Store, keys: str, index: Index) -> None:
    """Erase the keys of a damaged chunk: the next run computes it again."""
    region = _region(store, keys, index)
    shape = [axis.stop - axis.start for axis in region]
    store.write(keys, region, np.full(shape, "", dtype=object))


def _region(store: Store, name: str, index: Index) -> tuple[slice, ...]:
    """Return the place of an array's chunk along the axes of its keys."""
    document = store.document(name)
    steps = document["chunk_grid"]["configuration"]["chunk_shape"]
    return tuple(
        slice(step * number, min(step * (number + 1), length))
        for number, step, length in zip(index, steps, document["shape"], strict=False)
    )
