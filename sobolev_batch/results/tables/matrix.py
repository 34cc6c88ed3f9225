"""The distances of every mesh to every other and to the reference, order by order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from tabulate import tabulate

from sobolev_batch.errors import InputError
from sobolev_batch.results.tables.convergence import TABULATE_FORMATS, Format, chosen_orders, finished_group
from sobolev_batch.results.tables.formatting import concise

Reals = NDArray[np.float64]

_COLUMNS = ("distance", "error", "truncation", "aliasing", "discretisation")
# As text; beyond, nobody finds anything.
_MOST_MESHES = 20
_WIDTH = 100
_LONGEST_LABEL = 30
_NOTE = """\
Digits in brackets are the error in units of the last digit: 1.234(5)e-02 is
0.01234 ± 0.00005, and the true distance lies within that. Columns have the
numbers of rows; the matrix is symmetric. Lengths are in the study's unit."""


@dataclass(frozen=True)
class Matrix:
    """The distances of one order between the meshes that have any.

    Attributes:
        order: s.
        labels: of the meshes, in the study's order.
        values: (meshes, meshes), symmetric.
        errors: likewise.
    """

    order: float
    labels: tuple[str, ...]
    values: Reals
    errors: Reals

    @classmethod
    def of(cls, tree: xr.DataTree, order: float, most: int | None = None) -> Matrix | None:
        """The matrix of an open store without its failed meshes; None where the study asked for no such distances.

        Args:
            tree: an open store.
            order: one of its orders.
            most: so many meshes, the first ones and the reference; default all.
        """
        distances = _distances(tree)
        (order,) = chosen_orders(distances, [order])
        if distances.sizes["other"] != distances.sizes["mesh"]:
            return None
        reference = tree["convergence"].attrs["reference"]
        labels = distances["mesh"].values.tolist()
        complete = finished_group(tree, "meshes")["status"].values == "complete"
        kept = [i for i, label in enumerate(labels) if complete[i] and label != reference]
        place = labels.index(reference)
        kept = [*kept[: None if most is None else max(0, most - 1)], *([place] if complete[place] else [])]
        here = distances.sel(order=order).isel(mesh=kept, other=kept).load()
        return cls(order, tuple(labels[i] for i in kept), here["distance"].values, here["error"].values)


def matrix_frame(tree: xr.DataTree, order: float) -> pd.DataFrame:
    """The distances of one order in long form: one line per mesh and other mesh, itself included.

    ``frame.pivot(index="mesh", columns="other", values="distance")`` is the matrix.

    Args:
        tree: an open store.
        order: one of the store's orders.

    Returns:
        Columns order, mesh, other, distance, error, truncation, aliasing, discretisation, in the study's
        unit of length. Distances of a mesh that failed are NaN. The others are the reference alone where the
        study asks for no more.

    Raises:
        InputError: no tables in the store yet, or an order that it was not reduced for.
    """
    distances = _distances(tree)
    here = distances[list(_COLUMNS)].sel(order=chosen_orders(distances, [order])[0]).load()
    frame = here.to_dataframe(dim_order=["mesh", "other"]).reset_index()
    return frame[["order", "mesh", "other", *_COLUMNS]]


def format_matrix(tree: xr.DataTree, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """The distance matrices of a store as text for people (text, markdown, latex) or programs (csv, json).

    Raises:
        InputError: as for `matrix_frame`; more meshes than people can read, for people.
    """
    distances = _distances(tree)
    chosen = chosen_orders(distances, orders)
    if style in ("csv", "json"):
        frame = pd.concat([matrix_frame(tree, order) for order in chosen])
        if style == "csv":
            return str(frame.to_csv(index=False, lineterminator="\n")).rstrip("\n")
        records = frame.astype(object).where(frame.notna(), None).to_dict(orient="records")
        return json.dumps(records, indent=2, allow_nan=False)
    count = distances.sizes["mesh"]
    if count > _MOST_MESHES:
        raise InputError(
            f"a matrix of {count} meshes is too large to be read as {style}, which goes up to {_MOST_MESHES}: "
            "take --format csv or json"
        )
    parts = []
    for order in chosen:
        here = distances.sel(order=order).load()
        caption = f"Sobolev distances of order {order:g}"
        tables = [_table(here, columns, style) for columns in _groups(here, style)]
        parts.append("\n\n".join([f"% {caption}" if style == "latex" else caption, *tables]))
    parts.append("\n".join(f"% {line}" if style == "latex" else line for line in _NOTE.split("\n")))
    return "\n\n".join(parts)


def _distances(tree: xr.DataTree) -> xr.Dataset:
    return finished_group(tree, "distances", load=False)


def _groups(here: xr.Dataset, style: Format) -> list[list[int]]:
    """Columns that stand beside each other: as many as a line of text has room for."""
    columns = [j for j in range(here.sizes["other"]) if any(row[1] for row in _rows(here, [j]))]
    if style != "text":
        return [columns]
    taken = max(len(row[0]) for row in _rows(here, [])) + 2
    widths = [max(len(row[1]) for row in _rows(here, [column])) + 2 for column in columns]
    each = max(1, (_WIDTH - taken) // max(widths))
    return [columns[start : start + each] for start in range(0, len(columns), each)]


def _rows(here: xr.Dataset, columns: Sequence[int]) -> list[list[str]]:
    labels, others = (here[name].values.tolist() for name in ("mesh", "other"))
    values, errors = here["distance"].values, here["error"].values
    square = labels == others
    rows = []
    for i, label in enumerate(labels):
        short = label if len(label) <= _LONGEST_LABEL else label[: _LONGEST_LABEL - 1] + "…"
        cells = [
            "" if square and i <= j else concise(float(values[i, j]), float(errors[i, j])) or "missing" for j in columns
        ]
        rows.append([f"{i + 1} {short}", *cells])
    return rows


def _table(here: xr.Dataset, columns: Sequence[int], style: Format) -> str:
    """One table; of a symmetric matrix the part below the diagonal."""
    labels, others = (here[name].values.tolist() for name in ("mesh", "other"))
    # The mesh of the first column has no cells below the diagonal, and a name all the same.
    named = columns[:1] if labels == others else []
    rows = [row for i, row in enumerate(_rows(here, columns)) if any(row[1:]) or i in named]
    return str(
        tabulate(
            rows,
            headers=["", *(str(labels.index(others[j]) + 1) for j in columns)],
            tablefmt=TABULATE_FORMATS[style],
            disable_numparse=True,
            colalign=("left", *["right"] * len(columns)),
        )
    )
