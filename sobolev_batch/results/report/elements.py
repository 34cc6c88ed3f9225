"""What pages are made of: tables with all digits of their numbers, facts, and limits on their size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import tomli_w

from sobolev_batch.results.figures.pair_plots import MOST_MESHES
from sobolev_batch.results.figures.selection import MOST_MESHES as MOST_SPECTRA
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.text import Column, minus

_LONGEST_VALUE = 300

# A row of a table: a record of a frame. It may also have its "order"; a "mark", a short remark about its marked number;
# the number of its "color"; and the text "absent" in place of all numbers, with the section "reasons" that explains it.
Row = Mapping[Any, Any]


@dataclass(frozen=True)
class PageTable:
    """A table of a page.

    Attributes:
        name: Name, for its address on the page and for the file of its CSV.
        columns: Columns, that of the labels first.
        rows: Rows; those of an order follow each other.
        orders: Orders of the rows; None where they belong to all.
        is_sortable: True where clicks on the heads sort it.
        omitted: Number of rows that a page has no room for.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    orders: Sequence[float] | None = None
    is_sortable: bool = True
    omitted: int = 0

    @property
    def bodies(self) -> list[tuple[float | None, str, list[Row]]]:
        """Each order, its text and its rows."""
        if self.orders is None:
            return [(None, "", list(self.rows))]
        return [
            (order, minus(f"{order:g}"), [row for row in self.rows if row["order"] == order]) for order in self.orders
        ]


def reasons_table(name: str, label: str, reasons: Mapping[str, str]) -> PageTable | None:
    """Return the table of reasons by mesh or object; None where there are none."""
    columns = Column(label, label, kind="label"), Column("reason", "reason", kind="text")
    rows = [{label: key, "reason": reason} for key, reason in reasons.items()]
    return PageTable(name, columns, rows, is_sortable=False) if rows else None


@dataclass(frozen=True)
class ReportLimits:
    """Limits on the size of a report, which browsers set.

    Attributes:
        convergence_rows: Rows of all convergence tables together; browsers become slow beyond.
        mesh_rows: Rows of the table of meshes.
        pairs: Meshes in the matrix and on the map.
        spectra: Meshes in the spectra.
        matrix_numbers: Numbers of all matrices together: 10 bytes each, on a page of up to 15 MB.
        points: Points of all convergence charts together.
        reasons: Meshes of a collection that are missing, with their reasons.
    """

    convergence_rows: int = 10_000
    mesh_rows: int = 5_000
    pairs: int = MOST_MESHES
    spectra: int = MOST_SPECTRA
    matrix_numbers: int = 400_000
    points: int = 50_000
    reasons: int = 2_000


def utc_text(time: str) -> str:
    """Return a time of a record, in UTC, for people."""
    return time.replace("T", " ").removesuffix("Z")


def study_text(table: Mapping[str, Any]) -> str:
    """Return the study file of a study, without its comments and layout."""
    return tomli_w.dumps(_without_nulls(table))


def _without_nulls(value: Any) -> Any:
    """TOML has no null; keys without a value are left out."""
    if isinstance(value, Mapping):
        return {key: _without_nulls(entry) for key, entry in value.items() if entry is not None}
    return [_without_nulls(entry) for entry in value] if isinstance(value, list) else value


def large_count(count: int) -> str:
    """Return a count in words where it is large."""
    for size, unit in ((1e9, "billion"), (1e6, "million")):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:,}"


def source_text(entry: Mapping[str, Any]) -> str:
    """Return a source and its parameters on one line."""
    parameters = [f"{key} {_value_text(value)}" for key, value in entry.items() if key not in ("name", "source")]
    text = ", ".join([str(entry.get("source", "")), *parameters])
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"({source_text(value)})"
    if isinstance(value, list):
        return ", ".join(map(_value_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def run_facts(status: Status) -> Iterator[tuple[str, str]]:
    """Yield facts about the latest run, by keyword."""
    yield "store", status.store
    yield "surfaces", f"{status.complete} of {status.total} complete, {len(status.failed)} failed"
    if status.run is not None:
        yield "state", status.run.state
        yield "driver", status.run.driver
        yield "begun", utc_text(status.run.started)
        yield "ended" if status.run.state in ("done", "failed") else "last sign of life", utc_text(status.run.seen)
        if status.run.error:
            yield "error", status.run.error
