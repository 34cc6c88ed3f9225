"""Arrays and datasets as the keys of a zarr store: metadata documents, and chunks with checksums.

zarr and xarray make the documents. They take a millisecond and more for each array, and thousands of objects have the
same arrays of other values: so the documents of a form are made once, and chunks are encoded here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from threading import Lock
from types import MappingProxyType
from typing import Any

import google_crc32c
import numpy as np
import xarray as xr
import zarr
from numcodecs.vlen import VLenUTF8
from numpy.typing import NDArray
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

ROOT = "zarr.json"
# Arrays of tables above this size in memory, such as distances of all pairs of many meshes, have several chunks.
LARGEST_CHUNK_BYTES = 64 << 20
# Missing values depend on the kind of a dtype: that of strings, of complex and of real numbers.
_FILL_VALUES: dict[str, Any] = {"U": "", "c": complex(np.nan, np.nan), "f": np.nan}
# Documents of forms that are kept in memory, each some ten kilobytes.
_MOST_FORMS = 256


_strings = VLenUTF8()
_of_one_thread = Lock()
# Documents of groups and their arrays by their forms, see `_form_of`.
_documents: dict[tuple[Any, ...], dict[str, bytes]] = {}


@lru_cache(_MOST_FORMS)
def array_keys(
    name: str,
    dtype: Any,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dimensions: tuple[str, ...],
    **attributes: Any,
) -> Mapping[str, bytes]:
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
    return MappingProxyType(_bytes_of(keys))


def dataset_keys(group: str, dataset: xr.Dataset) -> dict[str, bytes]:
    """Return the keys of a group with the arrays of a dataset, with checksums, one chunk each unless they are large.

    They are those that xarray writes, but for coordinates with blanks in their names, see `with_coordinates`.
    """
    # The attribute that lists coordinates has blanks between them.
    dataset = dataset.reset_coords([name for name in dataset.coords if " " in str(name)])
    encoded = {str(name): xr.conventions.encode_cf_variable(one) for name, one in dataset.variables.items()}
    if not all(map(_is_one_chunk, dataset.variables.values())):
        return _written(group, dataset)
    form = group, _form_of(dataset, encoded)
    if form not in _documents:
        keys = _written(group, dataset)
        if len(_documents) >= _MOST_FORMS:
            _documents.clear()
        _documents[form] = {key: content for key, content in keys.items() if key.endswith(f"/{ROOT}")}
        return keys
    documents = _documents[form]
    of_group = json.loads(documents[f"{group}/{ROOT}"])
    # xarray names those coordinates there that no other variable has.
    lonely = {key: names for key, names in of_group["attributes"].items() if key == "coordinates"}
    of_group["attributes"] = {**dataset.attrs, **lonely}
    keys = {f"{group}/{ROOT}": json.dumps(of_group, indent=2).encode()}
    for name, one in encoded.items():
        keys[f"{group}/{name}/{ROOT}"] = documents[f"{group}/{name}/{ROOT}"]
        keys["/".join([group, name, "c", *["0"] * one.ndim])] = chunk_of(one.values)
    return keys


def with_coordinates(dataset: xr.Dataset) -> xr.Dataset:
    """Return a table of a store in which those are coordinates again that xarray cannot list, for their blanks."""
    return dataset.set_coords([name for name in dataset.data_vars if " " in str(name)])


def _form_of(dataset: xr.Dataset, encoded: Mapping[str, xr.Variable]) -> tuple[Any, ...]:
    """Return all that the documents of a dataset's arrays depend on: everything but values."""
    shown = [
        (name, one.dims, str(one.dtype), one.shape, json.dumps(one.attrs, default=str)) for name, one in encoded.items()
    ]
    return tuple(map(str, dataset.coords)), tuple(shown)


def _is_one_chunk(variable: xr.Variable) -> bool:
    chunks = variable.encoding.get("chunks", (_steps(variable), *variable.shape[1:]) if variable.ndim else ())
    return bool(variable.ndim and variable.size) and tuple(chunks) == variable.shape


def chunk_of(values: NDArray[Any]) -> bytes:
    """Return the bytes of a chunk of texts or numbers, as the codecs of its array encode it, with their checksum."""
    values = np.ascontiguousarray(values)
    is_text = values.dtype.kind in "OTU"
    data = (
        bytes(_strings.encode(values.astype(object).ravel()))
        if is_text
        else values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
    )
    return data + int(google_crc32c.value(data)).to_bytes(4, "little")


def _written(group: str, dataset: xr.Dataset) -> dict[str, bytes]:
    """Return the keys that xarray writes."""
    keys: dict[str, Buffer] = {}
    encoding = {
        str(name): {
            **{key: variable.encoding[key] for key in ("units", "dtype") if key in variable.encoding},
            "compressors": (Crc32cCodec(),),
            "chunks": variable.encoding.get("chunks", (_steps(variable), *variable.shape[1:])),
        }
        for name, variable in dataset.variables.items()
        if variable.ndim
    }
    # A missing chunk is a lost one, and never a table of zeros. The setting is that of all threads.
    with _of_one_thread, zarr.config.set({"array.write_empty_chunks": True}):
        dataset.to_zarr(MemoryStore(keys), group=group, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
    # xarray writes several at a time, in any order.
    places = {str(name): place for place, name in enumerate(dataset.variables)}
    written = _bytes_of(keys)
    for name in (name for name, variable in dataset.variables.items() if variable.dtype == bool):
        # Versions of xarray before 2026.9 store them as integers, of the same bytes, with an attribute.
        document = json.loads(written[f"{group}/{name}/{ROOT}"])
        document["attributes"].pop("dtype", None)
        document |= {"data_type": "bool", "fill_value": False}
        written[f"{group}/{name}/{ROOT}"] = json.dumps(document, indent=2).encode()
    return {key: written[key] for key in sorted(written, key=lambda key: places.get(key.split("/")[1], -1))}


def _steps(variable: xr.Variable) -> int:
    """Return the length of a chunk along the first axis."""
    return max(1, min(variable.shape[0], LARGEST_CHUNK_BYTES * variable.shape[0] // max(1, variable.nbytes)))


def _bytes_of(keys: dict[str, Buffer]) -> dict[str, bytes]:
    # The root is made by `Store.consolidate`.
    return {key: value.to_bytes() for key, value in keys.items() if key != ROOT}
