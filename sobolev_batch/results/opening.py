"""Opening a store for reading."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import xarray as xr

from sobolev_batch.batch.location import Location
from sobolev_batch.batch.store import Store
from sobolev_batch.errors import DamageError


def open_store(place: str | Path | Location) -> xr.DataTree:
    """Open the store at a path or URL lazily, as `xarray.open_datatree(place, engine="zarr")` does.

    Groups: fourier (the fields), meshes, norms, distances, convergence, records; see docs/store.md.
    Fields stay where they are until values of them are asked for.

    Raises:
        StoreError: no store of a study is there, it cannot be reached, or it is not as this package writes it.
        DamageError: data of a table are not there. (Those that are damaged raise when they are read.)
    """
    store = Store.open(place)
    lost = store.lost_tables()
    if lost:
        # They would read as NaN, zero or nothing, like data.
        raise DamageError(
            f"{store.path}: the table {lost[0]} is not there, or not all of it; run the study again to make it anew",
            "it is not there",
        )
    # Left to itself, xarray looks for older formats, which nobody has checked, and lists what it knows already.
    keys: Any = store.keys()
    with store.location.access("read"):
        return xr.open_datatree(keys, engine="zarr", consolidated=True, zarr_format=3)
