"""The tables of a store as a file for other programs: in long form as Parquet or CSV, by groups as NetCDF."""

from pathlib import Path
from typing import Literal

import dask
import xarray as xr

from sobolev_batch.errors import from_extra, write_file
from sobolev_batch.store.layout import TABLES
from sobolev_batch.store.lock import utc_now
from sobolev_batch.tables.convergence import table
from sobolev_batch.tables.open import AnyStore, as_tree, finished_group, stores_of
from sobolev_batch.tables.rendering import machine_table
from sobolev_batch.transform.lattice import Orders

ExportFormat = Literal["parquet", "netcdf", "csv"]
BY_ENDING: dict[str, ExportFormat] = {".parquet": "parquet", ".nc": "netcdf", ".csv": "csv"}


def export(store: AnyStore, path: Path, style: ExportFormat, order: Orders | None = None) -> None:
    """Write the tables of a store, of one object or of several, to a file.

    Parquet and CSV have the rows of `table`. NetCDF has the groups of the store but fields, spectra and records, below
    groups of their objects where there are several. InputError where a library is not installed, StoreError where the
    file cannot be written.
    """
    data: bytes | memoryview
    if style == "csv":
        data = f"{machine_table(table(store, order), 'csv')}\n".encode()
    elif style == "parquet":
        with from_extra("export", "a Parquet file needs"):
            data = table(store, order).to_parquet(engine="pyarrow", index=False)
    else:
        with from_extra("export", "a NetCDF file needs"):
            import h5netcdf  # noqa: F401
        # It is made in memory, since its library ends the process where a disk is full. Threads need no lock of a
        # cluster: xarray keeps such locks by the place of data in memory, and might take that of one that is gone.
        with dask.config.set(scheduler="threads"):
            data = _groups_of(store).to_netcdf(engine="h5netcdf")
    write_file(path, data, "the file")


def _groups_of(store: AnyStore) -> xr.DataTree:
    groups = {"/": xr.Dataset()}
    for name, place in stores_of(store).items():
        tree = as_tree(place)
        # Without tables it says so.
        finished_group(tree, "meshes", load=False)
        groups[name or "/"] = xr.Dataset(attrs=tree.attrs)
        for group in [one for one in TABLES if one in tree.children]:
            groups[f"{name}/{group}".lstrip("/")] = _as_netcdf(tree[group].to_dataset().load())
    groups["/"].attrs |= {"Conventions": "CF-1.11", "history": f"{utc_now()} sobolev-batch export"}
    return xr.DataTree.from_dict(groups)


def _as_netcdf(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset in which those units are words that UDUNITS, and whoever follows CF, does not know.

    Coordinates with blanks are variables, which they would be in the file, with a warning.
    """
    copy = dataset.reset_coords([name for name in dataset.coords if " " in str(name)]).drop_encoding()
    for variable in copy.variables.values():
        if "unit length" in variable.attrs.get("units", ""):
            variable.attrs["units_in_words"] = variable.attrs.pop("units")
    return copy
