"""Convergence tables: per family and level, the distance to the reference and the observed rate."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
import xarray as xr
from tabulate import tabulate

from sobolev_batch.errors import InputError

Format = Literal["text", "csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)

_ABOUT = ("family", "name", "level", "status", "reason", "triangles")
_NUMBERS = (
    "edge_length",
    "distance",
    "error",
    "truncation",
    "aliasing",
    "discretisation",
    "relative",
    "relative_error",
    "area_part",
    "shape_part",
    "rate",
    "rate_error",
    "resolved",
    "within",
)
# In the study's unit of length, where the study asks for them.
_PROXIMITIES = ("hausdorff", "chamfer", "chamfer_error")
TABULATE_FORMATS = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}
_HEADERS = ("mesh", "triangles", "edge", "distance ± error", "relative", "rate", "area")
_PROXIMITY_HEADERS = ("Hausdorff ≥", "Chamfer ± s.e.")
_NOTE = """\
The true distance lies within its error: truncation (beyond xi_max; it can only
raise the distance), aliasing (spacing of the lattice) and discretisation
(quadrature and NUFFT) together. Lengths are in the study's unit. A distance
marked * is not larger than its error; no rate is taken from it. The column area
tells which part of the squared distance a pure change of total area explains."""
_PROXIMITY_NOTE = """\
Hausdorff (at least: the largest distance found, from vertices and drawn points
to the other mesh) and Chamfer (mean distances of drawn points, both ways, with their
standard error) are for orientation; they know no order."""
_ACCURACY_NOTE = """\
The study asks for an error of at most {rtol:g} of each distance; where it is
larger, the distance is marked !."""


def convergence_frame(tree: xr.DataTree, orders: Sequence[float] | None = None) -> pd.DataFrame:
    """The convergence table of a store in long form: one line per mesh and order.

    Args:
        tree: an open store.
        orders: which of the store's orders; default all.

    Returns:
        Columns order, mesh, family, name, level, status, reason, triangles, edge_length, distance,
        error, truncation, aliasing, discretisation, relative, relative_error, area_part
        and shape_part (of the distance: what a pure change of total area explains, and the rest; their
        squares add up to its square), rate, rate_error, resolved (whether the distance exceeds its
        error), within (whether the error is as small as the study asks for); where the study asks for
        [proximity] also hausdorff, chamfer and chamfer_error. Lengths are in the study's unit. A mesh that
        failed has NaN, never a number; so do the parts in a store whose tables were made before there were any.

    Raises:
        InputError: no tables in the store yet, or an order that it was not reduced for.
    """
    convergence, meshes = finished_group(tree, "convergence"), finished_group(tree, "meshes")
    labels = convergence["mesh"].values
    others = labels != convergence.attrs["reference"]
    about = {key: meshes[key].values[others] for key in _ABOUT}
    nearness = {}
    if has_proximity(tree):
        found = finished_group(tree, "proximity")
        nearness = {key: found[key].values[others] for key in _PROXIMITIES}
    parts = []
    for order in chosen_orders(convergence, orders):
        here = convergence.sel(order=order)
        numbers = {key: here[key].values[others] if key in here else math.nan for key in _NUMBERS}
        parts.append(pd.DataFrame({"order": order, "mesh": labels[others], **about, **numbers, **nearness}))
    return pd.concat(parts, ignore_index=True)


def format_table(tree: xr.DataTree, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """The convergence table of a store as text for people (text, markdown, latex) or programs (csv, json).

    Raises:
        InputError: as for `convergence_frame`.
    """
    frame = convergence_frame(tree, orders)
    if style == "csv":
        return str(frame.to_csv(index=False, lineterminator="\n")).rstrip("\n")
    if style == "json":
        records = frame.replace({np.nan: None}).to_dict(orient="records")
        return json.dumps(records, indent=2, allow_nan=False)
    reference = tree["convergence"].attrs["reference"]
    headers = (*_HEADERS, *_PROXIMITY_HEADERS) if has_proximity(tree) else _HEADERS
    parts = []
    for order, group in frame.groupby("order", sort=False):
        cells = [_cells(line)[: len(headers)] for line in group.to_dict(orient="records")]
        caption = f"Sobolev distance of order {order:g} to {reference}"
        table = tabulate(
            cells,
            headers=headers,
            tablefmt=TABULATE_FORMATS[style],
            disable_numparse=True,
            colalign=("left", *["right"] * (len(headers) - 1)),
        )
        parts.append(f"% {caption}\n{table}" if style == "latex" else f"{caption}\n\n{table}")
    note = _NOTE
    if has_proximity(tree):
        note += "\n" + _PROXIMITY_NOTE
    if "rtol" in tree["convergence"].attrs:
        note += "\n" + _ACCURACY_NOTE.format(rtol=tree["convergence"].attrs["rtol"])
    parts.append("\n".join(f"% {line}" if style == "latex" else line for line in note.split("\n")))
    failures = frame.drop_duplicates("mesh").query("status != 'complete'")
    notes = [f"{line.mesh} is {line.status}: {line.reason}" for line in failures.itertuples(index=False)]
    if has_proximity(tree):
        reasons = finished_group(tree, "proximity")["reason"].to_series()
        notes += [f"{mesh} has no proximity: {reason}" for mesh, reason in reasons.items() if reason]
    if notes:
        parts.append("\n".join(f"% {note}" if style == "latex" else note for note in notes))
    return "\n\n".join(parts)


def has_proximity(tree: xr.DataTree) -> bool:
    """Whether a store has Hausdorff and Chamfer distances."""
    return "proximity" in tree.children


def finished_group(tree: xr.DataTree, name: str, *, load: bool = True) -> xr.Dataset:
    """A table of an open store, in memory unless it may stay where it is.

    Raises:
        InputError: there are no tables in the store yet.
    """
    if name not in tree.children:
        raise InputError("the store has no tables yet: run the study to its end")
    found = tree[name].to_dataset()
    return found.load() if load else found


def chosen_orders(table: xr.Dataset, orders: Sequence[float] | None) -> list[float]:
    """Those of a table's orders that are asked for; all of them by default.

    Raises:
        InputError: one is not there.
    """
    there: list[float] = table["order"].values.tolist()
    if orders is None:
        return there
    for order in orders:
        if order not in there:
            known = ", ".join(f"{s:g}" for s in there)
            raise InputError(f"the store has no order {order:g}, only {known}; add it to the study and run it again")
    return list(orders)


def _cells(line: dict[str, Any]) -> list[str]:
    if line["status"] != "complete":
        return [line["mesh"], *["missing"] * (len(_HEADERS) + len(_PROXIMITY_HEADERS) - 1)]
    return [
        line["mesh"],
        f"{line['triangles']:,}" if line["triangles"] else "",
        _number(line["edge_length"], ".4g"),
        _with_error(line["distance"], line["error"], ".6e", ".0e") + _mark(line),
        _number(line["relative"], ".5e"),
        _with_error(line["rate"], line["rate_error"], ".3f", ".0e"),
        _area_share(line),
        _number(line.get("hausdorff", math.nan), ".2e"),
        _with_error(line.get("chamfer", math.nan), line.get("chamfer_error", math.nan), ".4e", ".0e"),
    ]


def _area_share(line: dict[str, Any]) -> str:
    """Of a distance that is larger than its error, in per cent."""
    if not line["resolved"] or math.isnan(line["area_part"]):
        return ""
    return f"{100 * (line['area_part'] / line['distance']) ** 2:.1f} %"


def _mark(line: dict[str, Any]) -> str:
    if not line["resolved"]:
        return "*"
    return "" if line["within"] else "!"


def _with_error(value: float, error: float, spec: str, error_spec: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:{spec}} ± {'?' if math.isnan(error) else format(error, error_spec)}"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else format(value, spec)
