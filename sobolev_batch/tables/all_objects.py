"""The tables of all objects of a study after each other, as the root of its store has them.

Thousands of objects are queried there without opening thousands of groups. Labels begin with the name of the object.
"""

import logging
import pickle
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain, islice
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.norms.columns import describe
from sobolev_batch.store.encoding import with_coordinates
from sobolev_batch.store.layout import NUMERICS, RECORD, TABLES_OF_ALL, Store, hide_tables, write_table

_log = logging.getLogger(__name__)

# A table for each of these groups that an object has.
Tables = Mapping[str, xr.Dataset]
# Kinds of numpy's types of texts.
_TEXTS = "OTU"
# Tables of objects that are in memory at a time, as datasets: as bytes they take a twentieth.
_MOST_AT_ONCE = 1000


def tables_in(store: Store) -> dict[str, xr.Dataset]:
    """Return the tables of a store, of an object or of all, in memory; none before they were made."""
    keys: Any = store.checked_keys(RECORD, has_tables=True)
    names = [name for name in TABLES_OF_ALL if name in store.documents and "convergence" in store.documents]
    opened = (xr.open_dataset(keys, group=name, engine="zarr", consolidated=True, zarr_format=3) for name in names)
    return {name: with_coordinates(table.load()) for name, table in zip(names, opened, strict=True)}


def packed_tables(name: str, tables: Tables, unit_length: float) -> bytes:
    """Return the tables of an object as rows of all, with its name and its reference, and its unit as a coordinate.

    That is the study's unit in terms of the unit of length of the files: another for each object. The bytes are for
    `write_all`; the driver of a run holds thousands.
    """
    reference = f"{name}/{tables['convergence'].attrs['reference']}"
    found = {}
    for group, table in tables.items():
        count = table.sizes["mesh"]
        columns = {
            "mesh": np.array([f"{name}/{label}" for label in table["mesh"].values], dtype=object),
            "object": np.full(count, name, dtype=object),
            "reference": np.full(count, reference, dtype=object),
            "unit_length": np.full(count, unit_length),
        }
        attributes = {key: value for key, value in table.attrs.items() if key not in ("reference", "digest")}
        found[group] = table.assign_coords({key: ("mesh", values) for key, values in columns.items()})
        found[group].attrs = attributes
    return zlib.compress(pickle.dumps(found))


def write_all(root: Store, names: Sequence[str], changed: Iterable[bytes], kept: Collection[str]) -> None:
    """Write the tables of all objects in the order of their names: those that changed, and those kept of before.

    Only bytes that `packed_tables` has returned in a run may be given. Tables of before go if they lack an order.
    """
    parts, waiting = list[Tables](), iter(changed)
    while batch := [pickle.loads(zlib.decompress(one)) for one in islice(waiting, _MOST_AT_ONCE)]:  # noqa: S301
        parts.append(_joined(batch))
    old = tables_in(root) if kept else {}
    before = {group: table.sel(mesh=table["object"].isin(list(kept))) for group, table in old.items()}
    if before and parts:
        orders = parts[0]["convergence"]["order"].values
        if np.isin(orders, before["convergence"]["order"]).all():
            before["convergence"] = before["convergence"].sel(order=orders)
        else:
            before = {}
            _log.warning("%s: objects that this run left out lack an order, and rows in the tables of all", root.path)
    parts.append(before)
    rank = {name: place for place, name in enumerate(names)}
    tables = {}
    for group, table in _joined(parts).items():
        order = np.argsort([rank[name] for name in table["object"].values.tolist()], kind="stable")
        tables[group] = table.isel(mesh=order)
    # A run that was killed may have left some that are not listed.
    replaced = {*hide_tables(root), *TABLES_OF_ALL}
    for group, table in tables.items():
        write_table(root, group, table)
    for name in replaced - root.documents.keys():
        root.location.remove(name)
    root.consolidate()


def _joined(parts: Sequence[Tables]) -> dict[str, xr.Dataset]:
    of_groups = {
        group: [part[group] for part in parts if group in part and part[group].sizes["mesh"]] for group in TABLES_OF_ALL
    }
    return {group: concatenated(tables) for group, tables in of_groups.items() if tables}


def concatenated(tables: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return tables after each other, with NaN or empty texts where only others have a column.

    Attributes that differ are left out, but for the lists of metadata and of versions of the numerics, which have what
    is in any of them. Dask arrays stay lazy. xarray's own function takes milliseconds for each column of each table.
    """
    known = {name: variable for table in reversed(tables) for name, variable in table.variables.items()}
    columns: dict[Any, xr.Variable] = {}
    for name, model in known.items():
        columns[name] = model.drop_encoding()
        if "mesh" in model.dims:
            found = [
                table.variables[name] if name in table.variables else _missing(model, table.sizes["mesh"])
                for table in tables
            ]
            # Metadata that are numbers of one object may be texts of another.
            if any(one.dtype.kind in _TEXTS for one in found):
                found = [one if one.dtype.kind in _TEXTS else _as_texts(one) for one in found]
            columns[name] = xr.Variable(model.dims, np.concatenate([one.data for one in found]), model.attrs)
    coordinates = {name for table in tables for name in table.coords}
    attributes = {}
    for name, value in tables[0].attrs.items():
        values = [table.attrs.get(name, value) for table in tables]
        if name in ("metadata", NUMERICS):
            attributes[name] = list(dict.fromkeys(chain(*values)))
        elif all(one == value for one in values):
            attributes[name] = value
    return describe(xr.Dataset(columns, attrs=attributes).set_coords(list(coordinates)))


def _as_texts(numbers: xr.Variable) -> xr.Variable:
    texts = ["" if np.isnan(number) else str(number).removesuffix(".0") for number in numbers.values.tolist()]
    return xr.Variable("mesh", np.array(texts, dtype=object))


def _missing(model: xr.Variable, count: int) -> xr.Variable:
    kind, shape = model.dtype.kind, (count, *model.shape[1:])
    absent = np.datetime64("NaT", "s") if kind == "M" else "" if kind in _TEXTS else np.nan
    return xr.Variable(model.dims, np.full(shape, absent, model.dtype if kind in _TEXTS else None), model.attrs)
