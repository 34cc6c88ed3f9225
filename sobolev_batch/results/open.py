"""Opening a store for reading."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import xarray as xr

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.errors import DamageError


@contextmanager
def fields_read(place: str | Path | Location) -> Iterator[None]:
    """Where fields of an open store are read: says what to do about a damaged one.

    Raises:
        DamageError: the bytes of a field are not those that were stored.
    """
    try:
        yield
    except ValueError as error:
        # Of zarr's codec, which has no exception of its own.
        if "checksum" not in str(error):
            raise
        raise DamageError(
            f"{Location.of(place)}: a field is damaged: its bytes are not those that were stored; "
            "sobolev-batch verify tells which, and run computes it again",
            "its bytes are not those that were stored",
        ) from error


def open_store(place: str | Path | Location) -> xr.DataTree:
    """Open the store at a path or URL lazily, as `xarray.open_datatree(place, engine="zarr")` does.

    Groups: fourier (the fields), meshes, norms, distances, convergence, records; see docs/store.md.
    Fields stay where they are until values of them are asked for.

    Raises:
        StoreError: no store of a study is there, it cannot be reached, or it is not as this package writes it.
        DamageError: data of a table are not there. (Those that are damaged raise when they are read.)
    """
    store = Store.open(place)
    lost = Tables(store).lost()
    if lost:
        # They would read as NaN, zero or nothing, like data.
        raise DamageError(
            f"{store.path}: the table {lost[0]} is not there, or not all of it; run the study again to make it anew",
            "it is not there",
        )
    # Left to itself, xarray looks for older formats, which nobody has checked, and lists what it knows already.
    keys: Any = store.zarr_store()
    with store.location.access("read"):
        return xr.open_datatree(keys, engine="zarr", consolidated=True, zarr_format=3)
