"""Opening a store for reading."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import xarray as xr

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import DIGEST, Store
from sobolev_batch.batch.store.tables import lost_tables
from sobolev_batch.errors import DamageError, InputError, StoreError, one_line

# A store as functions for its readers take it.
AnyStore = str | Path | Location | xr.DataTree

# Entries of the encoding of a tree: where it was opened, and the digest of its tables then.
_SOURCE, _STATE = "source", "state"
# What zarr and xarray raise for metadata that nobody has written.
_MEANINGLESS = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError)


def open_store(store: str | Path | Location) -> xr.DataTree:
    """Open a store lazily, as ``xarray.open_datatree(store, engine="zarr")`` does.

    Groups: fourier (the fields), meshes, norms, distances, convergence, records; where the study requests it also
    proximity. docs/store.md lists their variables with dimensions and units. Fields stay on disk until you ask for
    values of them; they have the accessor `field.sobolev`.

    Args:
        store: Path or URL of the store.

    Raises:
        StoreError: The location has no store of a study, cannot be reached, or holds something else.
        DamageError: Data of a table are missing. (Damaged data raise when they are read.)

    >>> import sobolev_batch as sb
    >>> tree = sb.open_store("storage/icosphere.zarr")
    >>> tree["convergence"]["distance"].dims
    ('mesh', 'order')
    >>> tree["convergence"].attrs["reference"]
    'reference'
    """
    # Else values that are read once the process has gone to another folder would be missing ones.
    location = Location.parse(store).absolute()
    opened = Store.open(location)
    lost = lost_tables(opened)
    if lost:
        # Without this check they would read as NaN, zero or nothing, like data.
        raise DamageError(
            f"{opened.path}: the table {lost[0]} is missing or incomplete; run the study again to replace it",
            "it is missing",
        )
    # Left to itself, xarray looks for older formats, which nobody has checked, and lists keys again.
    keys: Any = opened.checked_keys()
    with opened.location.access("read"):
        try:
            tree = xr.open_datatree(keys, engine="zarr", consolidated=True, zarr_format=3)
        except _MEANINGLESS as error:
            problem = f"its metadata make no sense: {one_line(error)}"
            raise DamageError(
                f"{opened.path}: the store is damaged ({problem}); run the study again", problem
            ) from error
    tree.encoding = {**tree.encoding, _SOURCE: str(location), _STATE: tree.attrs.pop(DIGEST, None)}
    return tree


def as_tree(store: AnyStore) -> xr.DataTree:
    """Return a store as a DataTree, which it may be already."""
    return store if isinstance(store, xr.DataTree) else open_store(store)


def source_of(tree: xr.DataTree) -> str | None:
    """Return the path or URL at which a tree was opened by `open_store`; None for other trees."""
    source = tree.encoding.get(_SOURCE)
    return None if source is None else str(source)


def require_unchanged(tree: xr.DataTree) -> None:
    """Check that no run has changed a store since it was opened: then all that was read is one state of it.

    Raises:
        StoreError: Its tables are not those that it had, or it is gone.
    """
    source = source_of(tree)
    if source is not None and Store.open(source).attributes().get(DIGEST) != tree.encoding.get(_STATE):
        raise StoreError(
            f"{source}: a run has changed the store while it was read; once that run has ended, open the store again, "
            "or give the same command again"
        )


def location_of(store: AnyStore) -> str | Path | Location:
    """Return the path or URL of a store, which may be open.

    Raises:
        InputError: A DataTree that does not say where it was opened.
    """
    if not isinstance(store, xr.DataTree):
        return store
    source = source_of(store)
    if source is None:
        raise InputError(
            "the DataTree does not say where it was opened; open it with sobolev_batch.open_store, "
            "or give the path or URL of the store"
        )
    return source


@contextmanager
def fields_read(store: AnyStore) -> Iterator[None]:
    """Explain a checksum error that reading a field of an open store raises.

    Raises:
        DamageError: The bytes of a field are not those that were stored.
    """
    try:
        yield
    except ValueError as error:
        # zarr's codec has no exception of its own.
        if "checksum" not in str(error):
            raise
        place = (
            (store.encoding.get(_SOURCE) or "the store") if isinstance(store, xr.DataTree) else Location.parse(store)
        )
        raise DamageError(
            f"{place}: a field is damaged: its bytes are not those that were stored; "
            "sobolev-batch verify names it, and run computes it again",
            "its bytes are not those that were stored",
        ) from error
