"""Tables of a page: cells with their full numbers, rows, and columns with the names that they have in CSV."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

from sobolev_batch.results.tables.formatting import minus

Kind = Literal["number", "text", "label"]


@dataclass(frozen=True)
class Heading:
    """Head of a column.

    Attributes:
        text: Text as it is shown.
        name: Name of the column in CSV.
        kind: "label" for the first column, else what the cells hold.
        second: Name in CSV of a second number in its cells, such as the error; empty where they have none.
    """

    text: str
    name: str
    kind: Kind = "number"
    second: str = ""


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: Text as it is shown.
        key: Number or text that the column is sorted by, and that CSV has; None comes last.
        mark: Short remark about the number.
        second: Second number that CSV has, such as the error; None where there is none.
    """

    text: str
    key: float | str | None = None
    mark: str = ""
    second: float | None = None

    @classmethod
    def of_count(cls, value: int) -> Cell:
        """Return the cell of a whole number."""
        return cls(f"{value:,}", value)

    @classmethod
    def of_text(cls, text: str) -> Cell:
        """Return the cell of a text, which may be empty."""
        return cls(text, text or None)

    @classmethod
    def of_number(cls, value: float, text: str | None = None, mark: str = "", second: float = math.nan) -> Cell:
        """Return the cell of a number, empty for NaN."""
        if not math.isfinite(value):
            return cls("")
        return cls(f"{value:.4g}" if text is None else text, value, mark, second if math.isfinite(second) else None)


@dataclass(frozen=True)
class TableRow:
    """A row of a table.

    Attributes:
        label: Label of the mesh, or another name of the row.
        cells: Other columns; a single cell with a remark instead of all numbers.
        family: Number of the family of the mesh, for its colour; None for none.
        reasons: Section of the page that says why there are no numbers.
    """

    label: str
    cells: tuple[Cell, ...]
    family: int | None = None
    reasons: str = ""


@dataclass(frozen=True)
class Body:
    """Rows of a table, of one order where there are several.

    Attributes:
        rows: Rows.
        order: Order that they belong to; None for all of them.
    """

    rows: tuple[TableRow, ...]
    order: float | None = None

    @property
    def title(self) -> str:
        """Order as it is shown."""
        return "" if self.order is None else minus(f"{self.order:g}")


@dataclass(frozen=True)
class PageTable:
    """A table of a page.

    Attributes:
        name: Name, for its address on the page and for the file of its CSV.
        headings: Heads of the columns, that of the labels first.
        bodies: Rows, by order.
        is_sortable: True where clicks on the heads sort it.
        omitted: Number of rows that a page has no room for.
    """

    name: str
    headings: tuple[Heading, ...]
    bodies: tuple[Body, ...]
    is_sortable: bool = True
    omitted: int = 0

    @classmethod
    def of_reasons(cls, name: str, label: str, reasons: Mapping[str, str]) -> Self | None:
        """Return the table of reasons by mesh or object; None where there are none."""
        if not reasons:
            return None
        rows = tuple(TableRow(one, (Cell.of_text(reason),)) for one, reason in reasons.items())
        return cls(name, (Heading(label, label, "label"), Heading("reason", "reason", "text")), (Body(rows),), False)
