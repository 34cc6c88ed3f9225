"""Convergence tables: for each family and level, the distance to the reference and the observed rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import pandas as pd
import xarray as xr

from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.formatting import Digits
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
    "statistical",
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
_NOTE = """\
The true distance lies within its error, the sum of truncation (frequencies beyond
the highest one), aliasing (spacing of the lattice), discretisation (quadrature and
NUFFT) and chance (random frequencies, if the study samples octaves). Lengths are in
the study's unit. A distance marked * is not larger than its error, and gives no rate.
The column "area" is the fraction of the squared distance that a change of total area
alone explains."""
_PROXIMITY_NOTE = """\
Hausdorff and Chamfer distances are for orientation, and the same at all orders.
Hausdorff is a lower bound: the largest distance from any vertex or sampled point to
the other mesh. Chamfer is the mean distance of sampled points, both ways, with its
standard error."""
_ACCURACY_NOTE = """\
The study asks for an error of at most {rtol:g} of each distance; a distance
marked ! has a larger one."""


class Mark(NamedTuple):
    """A remark about a distance, in a text table and on the page of a report."""

    text: str = ""
    page: str = ""


@dataclass(frozen=True)
class Column:
    """A column of the text table and of the page of a report, beside the meshes; see `shown_rows` for its rows.

    Attributes:
        name: Number of a row that the column shows. Its cell is empty where that is NaN.
        header: Header in text tables; without one they leave the column out.
        heading: Heading on the page.
        text: Template of cells in text tables.
        page: Template of cells on the page.
        is_marked: True where the mark of the distance follows the number.
        group: Group of the store that has the number; the column is shown if the store has the group.
    """

    name: str
    header: str
    heading: str
    text: str
    page: str
    is_marked: bool = False
    group: str = "convergence"

    def text_cell(self, row: dict[str, Any]) -> str:
        """Return the cell of a text table."""
        if row["status"] != "complete":
            return "missing"
        # The number itself is not NaN here, but its error may be.
        text = "" if math.isnan(row[self.name]) else self.text.format_map(row).replace("nan", "?")
        return text + row["mark"].text if self.is_marked else text


_DISTANCE = "{distance:.6e} ± {error:.0e}"
_CHAMFER = "{chamfer:.4e} ± {chamfer_error:.0e}"
_COLUMNS = (
    Column("triangles", "triangles", "triangles", "{triangles:,}", "{triangles:,}"),
    Column("edge_length", "edge", "mean edge", "{edge_length:.4g}", "{edge_length:.4g}"),
    Column("distance", "distance ± error", "distance", _DISTANCE, "{digits[distance].value}", is_marked=True),
    Column("error", "", "± error", "", "{digits[distance].error}"),
    Column("relative", "relative", "relative distance", "{relative:.5e}", "{digits[relative].together}"),
    Column("rate", "rate", "rate", "{rate:.3f} ± {rate_error:.0e}", "{digits[rate].together}"),
    Column("area_fraction", "area", "area", "{area_percent:.1f} %", "{area_percent:.1f} %"),
    Column("hausdorff", "Hausdorff ≥", "Hausdorff ≥", "{hausdorff:.2e}", "{hausdorff:.3g}", group="proximity"),
    Column("chamfer", "Chamfer ± s.e.", "Chamfer", _CHAMFER, "{digits[chamfer].together}", group="proximity"),
)
_ERRORS = {"distance": "error", "relative": "relative_error", "rate": "rate_error", "chamfer": "chamfer_error"}


def table(store: AnyStore, order: Orders | None = None) -> pd.DataFrame:
    """Return the convergence table of a store in long form: one row for each mesh and order.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders, or several; default all.

    Returns:
        Columns order, mesh, family, name, level, status, reason, triangles, edge_length (mean), distance (to the
        reference), error and its parts truncation, aliasing, discretisation and statistical, relative and
        relative_error (over the norm of the reference), area_part and shape_part (what a change of total area alone
        explains of the distance, and the rest: their squares add up to its square), rate (observed order of convergence
        in the edge length) and rate_error, resolved (the distance exceeds its error), within (the error is as small as
        the study asks for); where the study asks for [proximity] also hausdorff, chamfer and chamfer_error. Lengths are
        in the study's unit. Numbers of a mesh that failed are NaN; so are the parts in old stores that lack them. The
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
    columns = [column for column in shown_columns(tree) if column.header]
    headers = ["mesh", *(column.header for column in columns)]
    sections = []
    for order, rows in frame.groupby("order", sort=False):
        cells = [[row["mesh"], *(column.text_cell(row) for column in columns)] for row in shown_rows(rows)]
        caption = prose(f"Sobolev distance of order {order:g} to {frame.attrs['reference']}", style)
        separator = "\n" if style == "latex" else "\n\n"
        sections.append(f"{caption}{separator}{printed_table(cells, headers, style)}")
    sections.append(prose("\n".join(_notes(tree, frame)), style))
    failures = "\n".join(_failures(tree, frame))
    return "\n\n".join([*sections, prose(failures, style)] if failures else sections)


def shown_columns(tree: xr.DataTree) -> list[Column]:
    """Return the columns of which an open store has the numbers."""
    return [column for column in _COLUMNS if column.group in tree.children]


def shown_rows(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows of `table` with their marks, fractions of area and `Digits`, and NaN for no triangles."""
    rows: list[dict[str, Any]] = frame.to_dict(orient="records")
    for row in rows:
        fraction = _area_fraction(row)
        row.update(triangles=row["triangles"] or math.nan, area_fraction=fraction, area_percent=100 * fraction)
        row["mark"] = _mark(row)
        row["digits"] = {name: Digits.of(row[name], row[error]) for name, error in _ERRORS.items() if name in row}
    return rows


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


def _area_fraction(row: dict[str, Any]) -> float:
    """Return the fraction of the squared distance that a change of area explains, NaN if that is not resolved."""
    has_fraction = row["resolved"] and row["distance"]
    return (row["area_part"] / row["distance"]) ** 2 if has_fraction else math.nan


def _mark(row: dict[str, Any]) -> Mark:
    if not row["resolved"]:
        return Mark("*", "below its error")
    return Mark() if row["within"] else Mark("!", "above rtol")
