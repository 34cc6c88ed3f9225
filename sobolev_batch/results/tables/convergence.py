"""Convergence tables: for each family and level, the distance to the reference and the observed rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import pandas as pd
import xarray as xr

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.errors import InputError
from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.defaults import Format
from sobolev_batch.results.tables.doubts import doubts_of
from sobolev_batch.results.tables.formatting import Digits
from sobolev_batch.results.tables.groups import finished_group, has_proximity, metadata_of
from sobolev_batch.results.tables.orders import convergence_at, order_note
from sobolev_batch.results.tables.sizes import with_rates
from sobolev_batch.results.tables.text import machine_table, printed_table, prose
from sobolev_batch.spectral.shells import Orders

_ABOUT = ("family", "name", "level", "rank", "ordered_by", "status", "reason", "triangles", "vertices", "seconds")
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
Relative distances are fractions of the reference's norm. Errors are meant as bounds,
the sums of truncation (frequencies beyond the highest one), aliasing (spacing of the
lattice), discretisation (quadrature and NUFFT) and chance (random frequencies, if the
study samples octaves). Lengths are in the study's unit. A distance marked * is not
larger than its error, and gives no rate. The column "area" is the share of the squared
distance that a change of total area alone explains."""
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


@dataclass(frozen=True, eq=False)
class Nearest:
    """The mesh that is nearest to the reference.

    Attributes:
        mesh: Its row of `table`.
        rivals: Labels of meshes of which errors leave open whether they are nearer, the nearest first.
    """

    mesh: pd.Series
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class Column:
    """A column of the text table and of the page of a report, beside the meshes; see `shown_rows` for its rows.

    Attributes:
        name: Number of a row that the column shows. Its cell is empty where that is NaN.
        header: Header of the column.
        template: Template of its cells.
        is_marked: True where the mark of the distance follows the number.
        group: Group of the store that has the number; the column is shown if the store has the group.
    """

    name: str
    header: str
    template: str
    is_marked: bool = False
    group: str = "convergence"

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the cell of a mesh that is complete, without its mark."""
        return "" if math.isnan(row[self.name]) else self.template.format_map(row)

    def text_cell(self, row: Mapping[str, Any]) -> str:
        """Return the cell of a text table."""
        if row["status"] != "complete":
            return "missing"
        return self.cell(row) + row["mark"].text if self.is_marked else self.cell(row)


_COLUMNS = (
    Column("triangles", "triangles", "{triangles:,}"),
    Column("edge_length", "edge", "{edge_length:.4g}"),
    Column("relative", "relative", "{digits[relative].together}", is_marked=True),
    Column("distance", "distance", "{digits[distance].together}"),
    Column("rate", "rate", "{digits[rate].together}"),
    Column("area_fraction", "area", "{area_percent:.0f} %"),
    Column("hausdorff", "Hausdorff ≥", "{hausdorff:.3g}", group="proximity"),
    Column("chamfer", "Chamfer ± s.e.", "{digits[chamfer].together}", group="proximity"),
)
# Errors that cells show beside their numbers, by the names of both.
ERRORS = {"distance": "error", "relative": "relative_error", "rate": "rate_error", "chamfer": "chamfer_error"}


def table(store: AnyStore, order: Orders | None = None, *, x: str = "edge_length") -> pd.DataFrame:
    """Return the convergence table of a store in long form: one row for each mesh and order.

    Args:
        store: Path, URL or opened DataTree of the store. Of the store of a collection, the rows of all objects that
            have tables follow each other, and the first column, object, names theirs.
        order: One order s < -1/2, or several; default all of the store. Others than those are computed from the stored
            fields, which takes about as long as reading them.
        x: Size of a mesh, a column of the table, in which rates are observed: "edge_length", "triangles", "vertices"
            or "seconds" (spent on its Fourier field), or one of the metadata that the study gives its meshes.

    Returns:
        One row for each mesh and order. Lengths are in the study's unit. The columns:

        - order, mesh, family, name, level; rank, the place in the family from coarse to fine, and ordered_by, what
          decides on it (level, triangles, names or time);
        - status, reason, triangles, vertices, seconds (of computing), edge_length (mean), and the metadata that the
          study gives its meshes;
        - distance (to the reference), error and its parts truncation, aliasing, discretisation and statistical;
          relative and relative_error (over the norm of the reference);
        - area_part and shape_part: what a change of total area alone explains of the distance, and the rest. Their
          squares add up to its square;
        - rate, the observed order of convergence, and rate_error: distance ~ edge_length^rate, or distance ~ x^-rate
          for another x, since the others grow;
        - resolved (the distance exceeds its error) and within (the error is as small as the study asks for);
        - where the study asks for [proximity]: hausdorff, chamfer and chamfer_error.

        Numbers of a mesh that failed are NaN. The frame's ``attrs`` have the
        reference's label, and where there are any, the study's rtol, as ``metadata`` the names of the metadata, and as
        ``computed`` the orders that were computed from the fields.

    Raises:
        InputError: The store has no tables yet, or its meshes have no such size.
        OrderError: An order is not below -1/2.
        DamageError: An order is to be computed, and a field is not what was stored.
        StoreError: The location has no store of a study.

    >>> import sobolev_batch as sb
    >>> frame = sb.table("storage/icosphere.zarr", order=-10)
    >>> frame.attrs["reference"]
    'reference'
    >>> frame.set_index("mesh")["rate"].round(1).to_dict()
    {'icosphere/0': nan, 'icosphere/1': 2.0, 'icosphere/2': 2.0, 'icosphere/3': 2.0}
    """
    collection = None if isinstance(store, xr.DataTree) else CollectionStore.found(Location.parse(store))
    if collection is not None:
        return _joined(tables_of(collection.begun, order, x=x))
    tree = as_tree(store)
    convergence, meshes = convergence_at(tree, order), finished_group(tree, "meshes")
    labels = convergence["mesh"].values
    others = labels != convergence.attrs["reference"]
    about = [key for key in (*_ABOUT, *metadata_of(tree)) if key in meshes]
    columns = {"mesh": labels[others], **{key: meshes[key].values[others] for key in about}}
    nearness = {}
    if has_proximity(tree):
        proximity = finished_group(tree, "proximity").sel(mesh=labels[others])
        nearness = {key: proximity[key].values for key in _PROXIMITIES}
    frames = []
    for s in dict.fromkeys(convergence["order"].values.tolist()):
        row = convergence.sel(order=s)
        numbers = {key: row[key].values[others] for key in _NUMBERS}
        frames.append(pd.DataFrame({"order": s, **columns, **numbers, **nearness}))
    frame = pd.concat(frames, ignore_index=True)
    kept = ("reference", "rtol", "computed")
    frame.attrs = {key: convergence.attrs[key] for key in kept if key in convergence.attrs}
    if known := metadata_of(tree):
        frame.attrs["metadata"] = known
    return frame if x == "edge_length" else with_rates(frame, x)


def _joined(frames: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of several objects after each other, named in the first column."""
    return pd.concat(frames, names=["object", "row"]).reset_index(level="object").reset_index(drop=True)


def tables_of(
    stores: Mapping[str, AnyStore], order: Orders | None = None, *, x: str = "edge_length"
) -> dict[str, pd.DataFrame]:
    """Return the rows of `table` of each object that has any, by its name.

    Raises:
        InputError: No object has tables, or one that has lacks a size.
        OrderError: An order is not below -1/2.
        StoreError: A location has no store, or it is damaged.
    """
    trees = {name: as_tree(place) for name, place in stores.items()}
    finished = {name: tree for name, tree in trees.items() if "convergence" in tree.children}
    if not finished:
        raise InputError("no object has tables yet: run the study to its end")
    return {name: table(tree, order, x=x) for name, tree in finished.items()}


def format_table(
    tree: xr.DataTree, style: Format = "text", orders: Sequence[float] | None = None, *, x: str = "edge_length"
) -> str:
    """Return the convergence table of an open store as text; see `table`."""
    frame = table(tree, orders, x=x)
    if style in ("csv", "json"):
        return machine_table(frame, style)
    return "\n\n".join(
        [*_tables(tree, frame, style), prose(_notes(tree, frame, x), style), *_remarks(tree, frame, style)]
    )


def format_tables(
    stores: Mapping[str, AnyStore], style: Format = "text", orders: Sequence[float] | None = None, *, x: str
) -> str:
    """Return the convergence tables of several objects as text, one after the other; see `table`."""
    trees = {name: as_tree(place) for name, place in stores.items()}
    frames = tables_of(trees, orders, x=x)
    if style in ("csv", "json"):
        return machine_table(_joined(frames), style)
    sections: list[str] = []
    for name, frame in frames.items():
        tree = trees[name]
        sections += [prose([f"Object {name}"], style), *_tables(tree, frame, style), *_remarks(tree, frame, style)]
    return "\n\n".join([*sections, prose(_notes(tree, frame, x), style)])


def _tables(tree: xr.DataTree, frame: pd.DataFrame, style: Format) -> list[str]:
    """Return the table of each order with its caption, and that of other distances where there are any."""
    sections = []
    for order, rows in frame.groupby("order", sort=False):
        caption = f"Sobolev distance of order {order:g} to {frame.attrs['reference']}"
        sections.append(_section(caption, rows, "convergence", style, _nearest(rows)))
    if has_proximity(tree):
        once = frame[frame["order"] == frame["order"].iloc[0]]
        sections.append(_section("Other distances, the same at all orders", once, "proximity", style))
    return sections


def _remarks(tree: xr.DataTree, frame: pd.DataFrame, style: Format) -> list[str]:
    """Return what failed and what is doubtful, as one paragraph, or nothing."""
    remarks = [*_failures(tree, frame), *(f"{mesh}: {doubt}" for mesh, doubt in doubts_of(tree).items())]
    return [prose(remarks, style)] if remarks else []


def _section(caption: str, frame: pd.DataFrame, group: str, style: Format, sentence: str = "") -> str:
    """Return a caption, the table of one order with the columns of a group, and a sentence."""
    columns = [column for column in _COLUMNS if column.group == group]
    headers = ["mesh", *(column.header for column in columns)]
    cells = [[row["mesh"], *(column.text_cell(row) for column in columns)] for row in shown_rows(frame)]
    parts = [
        prose([caption], style),
        printed_table(cells, headers, style),
        prose([sentence] if sentence else [], style),
    ]
    return ("\n" if style == "latex" else "\n\n").join(filter(None, parts))


def nearest(frame: pd.DataFrame) -> Nearest | None:
    """Return the nearest mesh among rows of `table` of one order; None where no distance is above its error."""
    rows = frame[frame["distance"].notna()].sort_values("distance", kind="stable")
    resolved = rows[rows["resolved"].astype(bool)]
    if not len(resolved):
        return None
    best = resolved.iloc[0]
    others = rows[rows["mesh"] != best["mesh"]]
    rivals = others[others["distance"] - others["error"] < best["distance"] + best["error"]]
    return Nearest(best, tuple(rivals["mesh"]))


def _nearest(frame: pd.DataFrame) -> str:
    """Return a sentence about the mesh that is nearest to the reference at one order."""
    found = nearest(frame)
    if found is None:
        return ""
    best, rivals = found.mesh, found.rivals
    amount = Digits.percent(best["relative"], best["relative_error"]).together
    doubt = f"; its errors leave open whether {rivals[0]} is nearer" if rivals else ""
    return f"Nearest: {best['mesh']}, which differs by {amount}{doubt}."


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
        row["digits"] = {name: Digits.of(row[name], row[error]) for name, error in ERRORS.items() if name in row}
        row["digits"]["relative"] = Digits.percent(row["relative"], row["relative_error"])
    return rows


def _notes(tree: xr.DataTree, frame: pd.DataFrame, x: str) -> list[str]:
    notes = [*_NOTE.splitlines(), *([] if x == "edge_length" else [f"Rates are those of distance ~ ({x})^-rate."])]
    if has_proximity(tree):
        notes += _PROXIMITY_NOTE.splitlines()
    if "rtol" in frame.attrs:
        notes += _ACCURACY_NOTE.format(rtol=frame.attrs["rtol"]).splitlines()
    if "computed" in frame.attrs:
        notes += order_note(tree, frame.attrs["computed"])
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
