"""Distances over time, for families of meshes that move."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.geometry.surface import is_finite_number
from sobolev_batch.norms.columns import NUMBER, VARIABLES, described
from sobolev_batch.tables import Format
from sobolev_batch.tables.open import AnyStore, as_tree, finished_group, reference_of
from sobolev_batch.tables.other_orders import table_at
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import with_error, wrapped
from sobolev_batch.transform.lattice import Orders

# A mesh whose distance has grown by this factor since its first time is worth a new one.
REMESHING_FACTOR = 2.0
_NUMBERS = ("distance", "error", "relative", "relative_error")
_NOTE = """\
If a new mesh of as many triangles would be as near as the first one, it pays once the
distance has certainly grown to {factor:g} times that of the first time."""


def evolution(store: AnyStore, order: Orders | None = None, *, factor: float = REMESHING_FACTOR) -> xr.Dataset:
    """Return the distances of moving meshes from the study's reference over time, and when a new mesh pays.

    Args:
        store: Path, URL or opened DataTree of a store whose meshes have times.
        order: One order s < -1/2, or several; default all of the store.
        factor: Growth of the distance at which a new mesh pays, larger than 1.

    Returns:
        Dataset over `family`, `time` and `order`, float64: `distance` and its `error`, in the square root of a unit
        length, `relative` and `relative_error` (over the norm of the reference), and `growth`, the distance over
        that of the family's first time with a distance, NaN if that is not larger than its error. Over `family` and
        `order` it has `remesh_time`, the first time at which the distance has certainly grown by the factor; later it
        may fall again. NaN where a family has no mesh of a time, where no time is late enough, and without a growth.

    Raises:
        InputError: The store has no tables yet or no mesh with a time, or the factor is not larger than 1.
        OrderError: An order is not below -1/2.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> ball = {"source": "icosphere", "levels": [2]}
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "wound-up"},
    ...     "lattice": {"xi_max": 2.0, "M": 20},
    ...     "norm": {"orders": [-4.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "carried", "source": "flow", "times": [0, 1, 2], "mesh": ball}],
    ... })
    >>> _ = sb.run(study, "memory://wound-up.zarr")
    >>> found = sb.evolution("memory://wound-up.zarr", -4.0)
    >>> bool((found["growth"].sel(family="carried").diff("time") > 0).all())
    True
    """
    if not is_finite_number(factor) or factor <= 1:
        raise InputError(f"the factor must be larger than 1, found {factor!r}")
    found = _over_time(as_tree(store), order)
    for name in (*_NUMBERS, "time", "order"):
        found[name].attrs = VARIABLES[name]
    found["family"].attrs = described("family of meshes")
    first = found.isel(time=found["distance"].notnull().argmax("time")).drop_vars("time")
    # Nothing is known of the growth of a distance that may be zero.
    growth = found["distance"] / first["distance"].where(first["distance"] > first["error"])
    late = found["distance"] - found["error"] > factor * (first["distance"] + first["error"])
    remesh_time = found["time"].where(late & growth.notnull()).min("time")
    return found.assign(
        growth=growth.assign_attrs(described("distance over that of the first time", NUMBER)),
        remesh_time=remesh_time.transpose("family", "order").assign_attrs(
            described("first time at which a new mesh pays", factor=f"{factor:g}")
        ),
    )


def format_evolution(
    store: AnyStore, style: Format = "text", orders: Sequence[float] | None = None, *, factor: float = REMESHING_FACTOR
) -> str:
    """Return the distances of moving meshes as text; see `evolution`."""
    tree = as_tree(store)
    found = evolution(tree, orders, factor=factor)
    columns = [*_NUMBERS, "growth"]
    frame: pd.DataFrame = found[columns].to_dataframe().dropna(how="all").reset_index()
    names = found["family"].values.tolist()
    table = (Column("time", "time", "{:.12g}".format), *(Column(f"family {name}", name) for name in names))
    sections = []
    for order in found["order"].values.tolist():
        families = {name: found.sel(order=order, family=name) for name in names}
        cells = [
            {"time": time, **{f"family {name}": _cell(rows.sel(time=time)) for name, rows in families.items()}}
            for time in found["time"].values.tolist()
        ]
        caption = f"Sobolev distance of order {order:g} to {reference_of(tree)} over time, in % of its norm"
        moments = [f"{name}: {_moment(rows, factor)}" for name, rows in families.items()]
        sections.append(Section(caption, [(table, cells)], moments))
    return rendered(style, frame[["order", "family", "time", *columns]], sections, wrapped(_NOTE.format(factor=factor)))


def has_times(tree: xr.DataTree) -> bool:
    """Return True if any mesh of the store has a time."""
    return "time" in finished_group(tree, "meshes", load=False).coords


def _over_time(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the numbers of the meshes with times, but for the reference, over family, time and order."""
    table = table_at(tree, "convergence", order).drop_sel(mesh=reference_of(tree)).reset_coords()
    if not has_times(tree) or not (moving := table.dropna("mesh", subset=["time"])).sizes["mesh"]:
        raise InputError("no mesh of the store has a time: the sources flow and files can give them times")
    families, times = moving["family"].values, moving["time"].values
    places = pd.MultiIndex.from_arrays([families, times], names=["family", "time"])
    along = xr.Coordinates.from_pandas_multiindex(places, "mesh")
    found = moving[[*_NUMBERS]].drop_vars("mesh").assign_coords(along).isel(mesh=~places.duplicated(keep="last"))
    return found.unstack("mesh").reindex(family=pd.unique(families)).transpose("family", "time", "order")


def _cell(found: xr.Dataset) -> str:
    text = with_error(100 * found["relative"].item(), 100 * found["relative_error"].item())
    growth = found["growth"].item()
    return f"{text}  {growth:5.2f} ×" if np.isfinite(growth) else text


def _moment(found: xr.Dataset, factor: float) -> str:
    if not found["distance"].notnull().any():
        return "no distance is known"
    if not found["growth"].notnull().any():
        return "its first distance is not larger than its error, so nothing is known of its growth"
    moment = found["remesh_time"].item()
    if np.isfinite(moment):
        return f"a new mesh first pays at time {moment:.12g}"
    return f"the distance has at no time certainly grown to {factor:g} times the first"
