"""Arrays and datasets as the keys of a zarr store: metadata documents, and chunks with checksums.

They are those of zarr and xarray, which take a millisecond for each array, and thousands of objects have a hundred.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import google_crc32c
import numpy as np
import xarray as xr
from numcodecs.vlen import VLenUTF8
from numpy.typing import NDArray

ROOT = "zarr.json"
# Arrays of tables above this size in memory, such as distances of all pairs of many meshes, have several chunks.
LARGEST_CHUNK_BYTES = 64 << 20
# What missing chunks would read as, by the kind of a dtype. Arrays that tasks fill have NaN also for complex numbers.
_FILL_VALUES: dict[str, Any] = {"O": "", "U": "", "b": False, "i": 0, "f": "NaN", "c": [0.0, 0.0]}
_MISSING = {**_FILL_VALUES, "c": ["NaN", "NaN"]}
# What fills chunks that reach beyond their array.
_PADDING: dict[str, Any] = {"O": "", "f": np.nan, "c": complex(np.nan, np.nan)}
# NaN as xarray writes it in attributes: its bytes in base64.
_NAN = "AAAAAAAA+H8="

# The codec of texts.
TEXTS = VLenUTF8()


def array_keys(
    name: str, dtype: Any, shape: Sequence[int], chunks: Sequence[int], dimensions: Sequence[str], **attributes: Any
) -> dict[str, bytes]:
    """Return the keys of an array without chunks, and of its group. It reads as NaN, or as empty strings."""
    document = _array_document(np.dtype(dtype), shape, chunks, dimensions, _MISSING, attributes)
    return {f"{name}/{ROOT}": document, f"{name.partition('/')[0]}/{ROOT}": _json(group_document({}))}


def dataset_keys(group: str, dataset: xr.Dataset) -> dict[str, bytes]:
    """Return the keys of a group with the arrays of a dataset, one chunk each unless they are large.

    They are those that xarray writes, but for coordinates with blanks in their names, see `with_coordinates`, and for
    booleans, which its versions before 2026.9 store as integers of the same bytes.
    """
    # The attribute that lists coordinates has blanks between them.
    dataset = dataset.reset_coords([name for name in dataset.coords if " " in str(name)])
    variables, attributes = xr.conventions.encode_dataset_coordinates(dataset)
    keys = {f"{group}/{ROOT}": _json(group_document(attributes))}
    for name, variable in variables.items():
        step = max(1, min(variable.shape[0], LARGEST_CHUNK_BYTES * variable.shape[0] // max(1, variable.nbytes)))
        chunks = variable.encoding.get("chunks", (step, *variable.shape[1:]))
        encoded = variable if variable.dtype == bool else xr.conventions.encode_cf_variable(variable)
        # What xarray has read from a store has another type of texts.
        values = encoded.values.astype(object) if encoded.dtype.kind in "TU" else encoded.values
        attributes = {key: _NAN if key == "_FillValue" else value for key, value in encoded.attrs.items()}
        document = _array_document(values.dtype, values.shape, chunks, encoded.dims, _FILL_VALUES, attributes)
        keys[f"{group}/{name}/{ROOT}"] = document
        keys |= {chunk_key(f"{group}/{name}", index): chunk for index, chunk in chunks_of(values, chunks)}
    return keys


def documents_in(keys: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Return the metadata documents among keys, by their nodes."""
    ending = f"/{ROOT}"
    return {key.removesuffix(ending): json.loads(content) for key, content in keys.items() if key.endswith(ending)}


def with_coordinates(dataset: xr.Dataset) -> xr.Dataset:
    """Return a table of a store in which those are coordinates again that xarray cannot list, for their blanks."""
    return dataset.set_coords([name for name in dataset.data_vars if " " in str(name)])


def chunk_key(name: str, index: Iterable[int]) -> str:
    """Return the key of a chunk of an array."""
    return "/".join([name, "c", *map(str, index)])


def chunks_of(values: NDArray[Any], steps: Sequence[int]) -> Iterator[tuple[tuple[int, ...], bytes]]:
    """Yield the indices of chunks of texts or numbers, and their bytes as the codecs of an array encode them."""
    for index in np.ndindex(*(-(-length // step) for length, step in zip(values.shape, steps, strict=True))):
        chunk = values[tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, steps, strict=True))]
        if chunk.shape != tuple(steps):
            whole = np.full(steps, _PADDING.get(values.dtype.kind, 0), dtype=values.dtype)
            whole[tuple(map(slice, chunk.shape))] = chunk
            chunk = whole
        if chunk.dtype == object:
            data = bytes(TEXTS.encode(np.ascontiguousarray(chunk).ravel()))
        else:
            data = chunk.astype(chunk.dtype.newbyteorder("<"), copy=False).tobytes()
        yield index, data + int(google_crc32c.value(data)).to_bytes(4, "little")


def _array_document(
    dtype: np.dtype[Any],
    shape: Sequence[int],
    chunks: Sequence[int],
    dimensions: Sequence[Any],
    fill_values: dict[str, Any],
    attributes: dict[Any, Any],
) -> bytes:
    is_text = dtype.kind in "OU"
    codec: dict[str, Any] = {"name": "vlen-utf8", "configuration": {}} if is_text else {"name": "bytes"}
    if not is_text and dtype.itemsize > 1:
        codec["configuration"] = {"endian": "little"}
    document = {
        "shape": shape,
        "data_type": "string" if is_text else dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill_values[dtype.kind],
        "codecs": [codec, {"name": "crc32c"}],
        "attributes": attributes,
        "dimension_names": dimensions,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }
    return _json(document)


def group_document(attributes: dict[Any, Any]) -> dict[str, Any]:
    """Return the metadata document of a group."""
    return {"attributes": attributes, "zarr_format": 3, "node_type": "group"}


def _json(document: dict[str, Any]) -> bytes:
    # Attributes may hold arrays and numbers of NumPy.
    return json.dumps(document, indent=2, default=lambda value: value.tolist()).encode()
