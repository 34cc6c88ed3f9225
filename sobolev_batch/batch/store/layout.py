"""Layout of new arrays: their keys are made in memory and then written as a whole.

zarr and xarray look at a store again and again while they create arrays. On object storage each look is a request.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore

# By the kind of a dtype: of strings, complex and real numbers.
_FILL_VALUES: dict[str, Any] = {"U": "", "c": complex(np.nan, np.nan), "f": np.nan}


class Layout:
    """New nodes of a hierarchy. Every array has checksums."""

    def __init__(self) -> None:
        self._keys: dict[str, Buffer] = {}
        self._root = zarr.create_group(MemoryStore(self._keys), zarr_format=3)

    def add_array(
        self,
        name: str,
        dtype: Any,
        shape: tuple[int, ...],
        chunks: tuple[int, ...],
        dimensions: tuple[str, ...],
        **attributes: Any,
    ) -> None:
        """Add an array without chunks. It reads as NaN, or as empty strings."""
        self._root.create_array(
            name,
            shape=shape,
            dtype=dtype,
            chunks=chunks,
            compressors=(Crc32cCodec(),),
            fill_value=_FILL_VALUES[np.dtype(dtype).kind],
            dimension_names=dimensions,
            attributes=attributes,
        )

    def add_dataset(self, group: str, dataset: xr.Dataset) -> None:
        """Add the arrays of a dataset with their values, one chunk each."""
        encoding = {
            str(name): {"compressors": (Crc32cCodec(),), "chunks": variable.shape}
            for name, variable in dataset.variables.items()
            if variable.ndim
        }
        # A missing chunk is a lost one, and never a table of zeros.
        with zarr.config.set({"array.write_empty_chunks": True}):
            dataset.to_zarr(
                MemoryStore(self._keys), group=group, mode="a", zarr_format=3, consolidated=False, encoding=encoding
            )

    def keys(self, prefix: str) -> dict[str, bytes]:
        """Return the contents of the keys below a group or an array."""
        return {key: value.to_bytes() for key, value in self._keys.items() if key.startswith(f"{prefix}/")}
