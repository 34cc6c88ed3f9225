"""Distances of every mesh to every other and to the reference, order by order."""

from collections.abc import Sequence
from typing import Literal

import pandas as pd
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.norms.columns import parts_as_variables
from sobolev_batch.norms.estimate import PARTS, quotients
from sobolev_batch.parameters import check_choice
from sobolev_batch.tables import Format
from sobolev_batch.tables.open import AnyStore, as_tree, reference_of
from sobolev_batch.tables.other_orders import distances_at, order_note, table_at
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import middle_cut, with_error
from sobolev_batch.transform.lattice import single_order

_COLUMNS = ("distance", "error", *PARTS)
# A longer printed matrix cannot be read.
_MOST_MESHES = 20
_LONGEST_LABEL = 30
_NOTE = "Errors are meant as bounds. The columns have the numbers of the rows; the matrix is symmetric."


def matrix(
    store: AnyStore,
    order: float,
    values: Literal["distance", "error", "truncation", "aliasing", "discretisation", "statistical"] = "distance",
) -> pd.DataFrame:
    """Return the distances of every mesh to every other as a matrix.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: Order s < -1/2. One that the store lacks is computed from the stored fields of all meshes.
        values: Content of the matrix: the distances, their errors, or a part of the errors.

    Returns:
        A symmetric frame of float64 in the study's unit of length, with the labels of meshes as index "mesh" and
        columns "other". The columns are the reference alone where the study requests no more. NaN where a
        mesh failed. The frame's ``attrs`` have the order and the reference's label.

    Raises:
        InputError: The store has no tables yet.
        OrderError: The order is not below -1/2.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> distances = sb.matrix("storage/icosphere.zarr", order=-10)
    >>> distances.shape, distances.attrs["reference"]
    ((5, 5), 'reference')
    >>> bool((distances == distances.T).all(axis=None))
    True
    >>> distances["icosphere/0"].idxmax()
    'reference'
    """
    tree = as_tree(store)
    order = single_order(order)
    distances = distances_at(tree, order)
    check_choice("values", values, _COLUMNS)
    frame: pd.DataFrame = parts_as_variables(distances)[values].sel(order=order).transpose("mesh", "other").to_pandas()
    frame.attrs = {"order": order, "reference": reference_of(tree), "values": values}
    return frame


def matrix_frame(distances: xr.Dataset) -> pd.DataFrame:
    """Return distances in long form, with their errors: one row for each order and pair of meshes."""
    names = ["order", "mesh", "other"]
    return parts_as_variables(distances).to_dataframe(dim_order=names).reset_index()[[*names, *_COLUMNS]]


def format_matrix(store: AnyStore, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """Return the distance matrices of a store as text; InputError where they are too large for people."""
    tree = as_tree(store)
    distances = distances_at(tree, orders)
    count = distances.sizes["mesh"]
    if count > _MOST_MESHES and style not in ("csv", "json"):
        raise InputError(f"a matrix of {count} meshes is too large to be read as {style}; take --format csv or json")
    distances.load()
    sections = (_section(tree, distances.sel(order=order)) for order in distances["order"].values)
    notes = [_NOTE]
    if "computed" in distances.attrs:
        notes += order_note(tree, distances.attrs["computed"])
    return rendered(style, matrix_frame(distances), sections, notes)


def _section(tree: xr.DataTree, distances: xr.Dataset) -> Section:
    """Return the matrix of one order, in per cent of the norm of the reference if that is known.

    A symmetric one has only the cells below its diagonal.
    """
    values, errors, order = distances["distance"].values, distances["error"].values, distances["order"].item()
    unit, reference = "in the square root of a unit length", reference_of(tree)
    if "norms" in tree.children:
        norm = table_at(tree, "norms", order).sel(mesh=reference).squeeze("order")
        if norm["norm"].notnull():
            relative = quotients((values, errors), (norm["norm"].values, norm["error"].values))
            values, errors, unit = 100 * relative[0], 100 * relative[1], f"in % of the norm of {reference}"
    labels, others = (distances[name].values.tolist() for name in ("mesh", "other"))
    is_symmetric = labels == others
    rows = [
        {"label": f"{i + 1} {middle_cut(label, _LONGEST_LABEL)}"}
        | {
            str(j): with_error(float(values[i, j]), float(errors[i, j])) or "missing"
            for j in range(i if is_symmetric else len(others))
        }
        for i, label in enumerate(labels)
    ]
    kept = {str(j): labels.index(other) + 1 for j, other in enumerate(others) if any(str(j) in row for row in rows)}
    columns = [Column("label", ""), *(Column(j, str(number)) for j, number in kept.items())]
    return Section(f"Sobolev distances of order {order:g}, {unit}", [(columns, rows)])
