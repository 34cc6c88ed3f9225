"""Convergence tables: for each family and level, the distance to the reference and the observed rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
import xarray as xr

from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.groups import chosen_orders, finished_group, has_proximity
from sobolev_batch.results.tables.text import Format, machine_table, printed_table, prose
from sobolev_batch.spectral.shells import Orders

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
# Where the study asks for them.
_PROXIMITIES = ("hausdorff", "chamfer", "chamfer_error")
_HEADERS = ("mesh", "triangles", "edge", "distance ± error", "relative", "rate", "area")
_PROXIMITY_HEADERS = ("Hausdorff ≥", "Chamfer ± s.e.")
_NOTE = """\
The true distance lies within its error, the sum of truncation (frequencies beyond
xi_max; they can only add to the distance), aliasing (spacing of the lattice) and
discretisation (quadrature and NUFFT). Lengths are in the study's unit. A distance
marked * is not larger than its error, and gives no rate. The column "area" is the
fraction of the squared distance that a change of total area alone explains."""
_PROXIMITY_NOTE = """\
Hausdorff and Chamfer distances are for orientation, and the same at all orders.
Hausdorff is a lower bound: the largest distance from any vertex or sampled point to
the other mesh. Chamfer is the mean distance of sampled points, both ways, with its
standard error."""
_ACCURACY_NOTE = """\
The study asks for an error of at most {rtol:g} of each distance; a distance
marked ! has a larger one."""


def table(store: AnyStore, order: Orders | None = None) -> pd.DataFrame:
    """Return the convergence table of a store in long form: one row for each mesh and order.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders, or several; default all.

    Returns:
        Columns order, mesh, family, name, level, status, reason, triangles, edge_length (mean), distance (to the
        reference), error and its parts truncation, aliasing and discretisation, relative and relative_error (over the
        norm of the reference), area_part and shape_part (what a change of total area alone explains of the distance,
        and the rest: their squares add up to its square), rate (observed order of convergence in the edge length) and
        rate_error, resolved (the distance exceeds its error), within (the error is as small as the study asks
        for); where the study asks for [proximity] also hausdorff, chamfer and chamfer_error. Lengths are in
        the study's unit. Numbers of a mesh that failed are NaN; so are the parts in old stores that lack them. The
        frame's ``attrs`` have the reference's label and the study's rtol, if it has one.

    Raises:
        InputError: The store has no tables yet, or lacks an order.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> frame = sb.table("storage/icosphere.zarr", order=-10)
    >>> frame.attrs["reference"]
    'reference'
    >>> frame.set_index("mesh")["rate"].round(1).to_dict()
    {'icosphere/0': nan, 'icosphere/1': 2.0, 'icosphere/2': 2.0, 'icosphere/3': 2.0}
    """
    tree = as_tree(store)
    convergence, meshes = finished_group(tree, "convergence"), finished_group(tree, "meshes")
    labels = convergence["mesh"].values
    others = labels != convergence.attrs["reference"]
    columns = {"mesh": labels[others], **{key: meshes[key].values[others] for key in _ABOUT}}
    nearness = {}
    if has_proximity(tree):
        proximity = finished_group(tree, "proximity")
        nearness = {key: proximity[key].values[others] for key in _PROXIMITIES}
    frames = []
    for s in chosen_orders(convergence, order):
        row = convergence.sel(order=s)
        numbers = {key: row[key].values[others] if key in row else math.nan for key in _NUMBERS}
        frames.append(pd.DataFrame({"order": s, **columns, **numbers, **nearness}))
    frame = pd.concat(frames, ignore_index=True)
    frame.attrs = {key: convergence.attrs[key] for key in ("reference", "rtol") if key in convergence.attrs}
    return frame


def format_table(tree: xr.DataTree, style: Format = "text", orders: Sequence[float] | None = None) -> str:
    """Return the convergence table of an open store as text; see `table`."""
    frame = table(tree, orders)
    if style in ("csv", "json"):
        return machine_table(frame, style)
    headers = (*_HEADERS, *_PROXIMITY_HEADERS) if has_proximity(tree) else _HEADERS
    sections = []
    for order, rows in frame.groupby("order", sort=False):
        cells = [_cells(row)[: len(headers)] for row in rows.to_dict(orient="records")]
        caption = prose(f"Sobolev distance of order {order:g} to {frame.attrs['reference']}", style)
        separator = "\n" if style == "latex" else "\n\n"
        sections.append(f"{caption}{separator}{printed_table(cells, headers, style)}")
    sections.append(prose("\n".join(_notes(tree, frame)), style))
    failures = "\n".join(_failures(tree, frame))
    return "\n\n".join([*sections, prose(failures, style)] if failures else sections)


def _notes(tree: xr.DataTree, frame: pd.DataFrame) -> list[str]:
    notes = [_NOTE]
    if has_proximity(tree):
        notes.append(_PROXIMITY_NOTE)
    if "rtol" in frame.attrs:
        notes.append(_ACCURACY_NOTE.format(rtol=frame.attrs["rtol"]))
    return notes


def _failures(tree: xr.DataTree, frame: pd.DataFrame) -> list[str]:
    rows = frame.drop_duplicates("mesh").query("status != 'complete'")
    failures = [f"{row.mesh} is {row.status}: {row.reason}" for row in rows.itertuples(index=False)]
    if has_proximity(tree):
        reasons = finished_group(tree, "proximity")["reason"].to_series()
        failures += [f"{mesh} has no proximity: {reason}" for mesh, reason in reasons.items() if reason]
    return failures


def _cells(row: dict[str, Any]) -> list[str]:
    if row["status"] != "complete":
        return [row["mesh"], *["missing"] * (len(_HEADERS) + len(_PROXIMITY_HEADERS) - 1)]
    return [
        row["mesh"],
        f"{row['triangles']:,}" if row["triangles"] else "",
        _number(row["edge_length"], ".4g"),
        _with_error(row["distance"], row["error"], ".6e", ".0e") + _mark(row),
        _number(row["relative"], ".5e"),
        _with_error(row["rate"], row["rate_error"], ".3f", ".0e"),
        _area_fraction(row),
        _number(row.get("hausdorff", math.nan), ".2e"),
        _with_error(row.get("chamfer", math.nan), row.get("chamfer_error", math.nan), ".4e", ".0e"),
    ]


def _area_fraction(row: dict[str, Any]) -> str:
    if not row["resolved"] or math.isnan(row["area_part"]):
        return ""
    return f"{100 * (row['area_part'] / row['distance']) ** 2:.1f} %"


def _mark(row: dict[str, Any]) -> str:
    if not row["resolved"]:
        return "*"
    return "" if row["within"] else "!"


def _with_error(value: float, error: float, spec: str, error_spec: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:{spec}} ± {'?' if math.isnan(error) else format(error, error_spec)}"


def _number(value: float, spec: str) -> str:
    return "" if math.isnan(value) else format(value, spec)
