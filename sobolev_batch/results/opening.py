"""Opening a store for reading."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from sobolev_batch.batch.store import Store


def open_store(path: str | Path) -> xr.DataTree:
    """Open a store lazily, as `xarray.open_datatree(path, engine="zarr")` does.

    Groups: fourier (the fields), meshes, norms, distances, convergence, records; see docs/store.md.
    Fields stay on disk until values of them are asked for.

    Raises:
        StoreError: no store of a study is at this path.
    """
    return xr.open_datatree(Store.open(path).path, engine="zarr")
