"""The verdict of a study: the nearest mesh at each size, the smallest ones near enough, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import pandas as pd

from sobolev_batch.results.figures.selection import spread
from sobolev_batch.results.report.cells import Body, Cell, Heading, PageTable, TableRow
from sobolev_batch.results.tables.convergence import nearest
from sobolev_batch.results.tables.formatting import Digits, minus
from sobolev_batch.results.tables.smallest import smallest_of

_BOUNDS = (0.05, 0.01)
# Meshes whose numbers of triangles differ by no more than this factor are of one size.
_SAME_SIZE = 1.2
# More rows are no verdict any more.
_MOST_SIZES = 8
_MOST_FAMILIES = 6
_MOST_NAMED = 3

_HEADINGS = (
    Heading("verdict", "verdict", "label"),
    Heading("mesh", "mesh", "text"),
    Heading("relative", "relative", second="relative_error"),
    Heading("triangles", "triangles"),
    Heading("remark", "remark", "text"),
)


@dataclass(frozen=True)
class StudyVerdict:
    """The verdict on a study, at each order.

    Attributes:
        sentences: A sentence for each order.
        table: Nearest meshes, smallest meshes below bounds, and meshes that are missing or imprecise.
        omitted: Note on the sizes and families that the table leaves out; empty where it has all.
    """

    sentences: tuple[str, ...]
    table: PageTable
    omitted: str

    @classmethod
    def of(cls, frame: pd.DataFrame, failed: Mapping[str, str]) -> Self:
        """Return the verdict on the rows of `table`.

        Args:
            frame: Rows of all orders.
            failed: Reason for each mesh that is missing.
        """
        groups = [(float(order), rows) for order, rows in frame.groupby("order", sort=False)]
        sizes = _sizes(groups[0][1])
        shown_sizes = spread(sizes, _MOST_SIZES)
        sized = frame[frame["triangles"] > 0]["family"].unique().tolist()
        bodies = []
        for order, rows in groups:
            at_sizes = [rows[rows["mesh"].isin(labels)] for labels in shown_sizes]
            found = (*_nearest_rows(rows, at_sizes), *_smallest_rows(rows, sized[:_MOST_FAMILIES]))
            bodies.append(Body((*found, *_short_rows(rows), *_missing_rows(failed)), order))
        omitted = [
            f"{shown} of {total} {things}"
            for shown, total, things in (
                (len(shown_sizes), len(sizes), "sizes"),
                (min(len(sized), _MOST_FAMILIES), len(sized), "families"),
            )
            if shown < total
        ]
        return cls(
            tuple(_sentence(order, rows, frame.attrs["reference"]) for order, rows in groups),
            PageTable("verdict", _HEADINGS, tuple(bodies), is_sortable=False),
            " and ".join(omitted),
        )


def _sentence(order: float, rows: pd.DataFrame, reference: str) -> str:
    """Return a sentence on one order."""
    name, at_order = "the reference" if reference == "reference" else reference, minus(f"at order {order:g}")
    found, count = nearest(rows), int(rows["distance"].notna().sum())
    if count == 0:
        return f"No mesh could be compared with {name}."
    if found is None:
        return f"No distance to {name} is above its error {at_order}: the meshes may be equal to it."
    best, rivals = found.mesh, found.rivals
    # On one line, in a sentence.
    amount = Digits.percent(best["relative"], best["relative_error"]).together.replace(" ", "\N{NO-BREAK SPACE}")
    doubt = f", and the errors leave open whether {rivals[0]} is nearer" if rivals else ""
    if count == 1:
        return f"{best['mesh']} differs from {name} by {amount} {at_order}."
    return f"Of {count:,} meshes, {best['mesh']} is nearest to {name} {at_order}: it differs by {amount}{doubt}."


def _sizes(rows: pd.DataFrame) -> list[list[str]]:
    """Return the labels of meshes of about as many triangles, where these are of several families."""
    known = rows[rows["triangles"] > 0].sort_values("triangles", kind="stable")
    sizes: list[pd.DataFrame] = []
    while len(known):
        is_same = known["triangles"] <= _SAME_SIZE * known["triangles"].iloc[0]
        sizes.append(known[is_same])
        known = known[~is_same]
    return [size["mesh"].tolist() for size in sizes if size["family"].nunique() > 1]


def _nearest_rows(rows: pd.DataFrame, at_sizes: Sequence[pd.DataFrame]) -> Iterator[TableRow]:
    """Yield the nearest mesh of all, and those of each size."""
    yield _nearest_row("nearest of all", rows)
    for members in at_sizes:
        low, high = int(members["triangles"].min()), int(members["triangles"].max())
        counts = f"{low:,}" if low == high else f"{low:,} to {high:,}"
        yield _nearest_row(f"{counts} triangles", members)


def _nearest_row(label: str, members: pd.DataFrame) -> TableRow:
    found = nearest(members)
    if found is None:
        is_known = members["distance"].notna().any()
        return TableRow(label, (Cell("no distance is above its error" if is_known else "no distance is known"),))
    best, rivals = found.mesh, found.rivals
    return _row(label, best, f"errors leave open {_names(rivals)}" if rivals else _lead(best, members))


def _lead(best: pd.Series, members: pd.DataFrame) -> str:
    """Return by how much the nearest mesh is nearer than the next one of another family."""
    others = members[(members["family"] != best["family"]) & members["distance"].notna()]
    if not len(others):
        return ""
    second = others.loc[others["distance"].idxmin()]
    ratio = second["distance"] / best["distance"]
    return f"{ratio:.3g} times nearer than {second['mesh']}" if ratio < 100 else f"far nearer than {second['mesh']}"


def _smallest_rows(rows: pd.DataFrame, families: Sequence[str]) -> Iterator[TableRow]:
    """Yield the smallest mesh of each family below each bound."""
    for bound in _BOUNDS:
        frame = smallest_of(rows, bound)
        for row in frame[frame["family"].isin(families)].to_dict(orient="records"):
            label = f"below {100 * bound:g} %: {row['family']}"
            open_ones = f"errors leave open {_names(row['undecided'])}" if row["undecided"] else ""
            if row["mesh"]:
                yield _row(label, row, open_ones)
            else:
                amount = Digits.percent(row["nearest_relative"], row["nearest_relative_error"]).together
                closest = f"{row['nearest']} has {amount}" if row["nearest"] else ""
                yield TableRow(label, (Cell("; ".join(filter(None, ("none", closest, open_ones)))),))


def _short_rows(rows: pd.DataFrame) -> Iterator[TableRow]:
    """Yield the meshes whose distances have larger errors than the study asks for."""
    short = rows[rows["resolved"].astype(bool) & ~rows["within"].astype(bool) & rows["distance"].notna()]
    if len(short):
        yield TableRow("above rtol", (Cell(_names(short["mesh"].tolist())),))


def _missing_rows(failed: Mapping[str, str]) -> Iterator[TableRow]:
    if failed:
        yield TableRow("missing", (Cell(_names(list(failed))),), reasons="failed")


def _row(label: str, mesh: Mapping[str, Any] | pd.Series, remark: str) -> TableRow:
    relative, error = float(mesh["relative"]), float(mesh["relative_error"])
    cells = (
        Cell.of_text(mesh["mesh"]),
        Cell.of_number(relative, Digits.percent(relative, error).together, second=error),
        Cell.of_count(int(mesh["triangles"])) if mesh["triangles"] > 0 else Cell(""),
        Cell.of_text(remark),
    )
    return TableRow(label, cells)


def _names(labels: Sequence[str]) -> str:
    """Return a few labels, and how many more there are."""
    more = len(labels) - _MOST_NAMED
    return ", ".join(labels[:_MOST_NAMED]) + (f" and {more:,} more" if more > 0 else "")
