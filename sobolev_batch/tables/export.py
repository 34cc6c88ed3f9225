"""The tables of a store as a file for other programs: in long form as Parquet or CSV, by groups as NetCDF."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import xarray as xr

from sobolev_batch.errors import from_extra, written
from sobolev_batch.store.lock import utc_now
from sobolev_batch.tables.convergence import table
from sobolev_batch.tables.open import AnyStore, as_tree, finished_group, stores_of
from sobolev_batch.tables.rendering import json_text, machine_table
from sobolev_batch.transform.lattice import Orders

ExportFormat = Literal["parquet", "netcdf", "csv"]
_GROUPS = ("meshes", "norms", "distances", "convergence", "proximity")


def export(store: AnyStore, path: Path, style: ExportFormat, order: Orders | None = None) -> None:
    """Write the tables of a store, of one object or of several, to a file.

    Parquet and CSV have the rows of `table`. NetCDF has the groups of the store but fields, spectra and records, below
    groups of their objects where there are several; attributes that are tables or lists are JSON. InputError where a
    library is not installed, StoreError where the file cannot be written.
    """
    with written(path, "the file"):
        if style == "csv":
            path.write_text(machine_table(table(store, order), "csv") + "\n", encoding="utf-8")
        elif style == "parquet":
            with from_extra("export", "a Parquet file needs"):
                table(store, order).to_parquet(path, engine="pyarrow", index=False)
        else:
            with from_extra("export", "a NetCDF file needs"):
                import h5netcdf  # noqa: F401
            _groups_of(store).to_netcdf(path, engine="h5netcdf")


def _groups_of(store: AnyStore) -> xr.DataTree:
    groups = {}
    for name, place in stores_of(store).items():
        tree = as_tree(place)
        # Without tables it says so.
        finished_group(tree, "meshes", load=False)
        root = xr.Dataset(attrs=tree.attrs)
        for group, one in (("", root), *((g, tree[g].to_dataset().load()) for g in _GROUPS if g in tree.children)):
            groups["/".join(filter(None, ("", name, group))) or "/"] = _plain(one)
    groups.setdefault("/", xr.Dataset())
    groups["/"].attrs |= {"Conventions": "CF-1.11", "history": f"{utc_now()} sobolev-batch export"}
    return xr.DataTree.from_dict(groups)


def _plain(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose strings and attributes NetCDF can hold."""
    copy = dataset.copy()
    for name, variable in dataset.variables.items():
        if variable.dtype.kind in "TU":
            copy[name] = variable.astype(object)
        copy[name].attrs = _texts(variable.attrs)
        if "unit length" in copy[name].attrs.get("units", ""):
            # UDUNITS, and whoever follows CF, know no unit that is the study's own.
            copy[name].attrs["units_in_words"] = copy[name].attrs.pop("units")
        copy[name].encoding = {}
    copy.attrs = _texts(dataset.attrs)
    return copy


def _texts(attributes: dict[str, object]) -> dict[str, object]:
    plain = {name: value for name, value in attributes.items() if type(value) in (str, int, float)}
    return {name: plain.get(name, json_text(value)) for name, value in attributes.items()}
