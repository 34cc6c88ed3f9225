"""Results in every format: rows for programs (csv, json), sections of tables and sentences for people."""

import json
import math
import os
import re
import textwrap
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from typing import Any, Literal, TypeAlias

import pandas as pd
from tabulate import tabulate

from sobolev_batch.tables import Format
from sobolev_batch.tables.text import POWER, SHORTEST_TEXT, line_length, middle_cut
from sobolev_batch.visible import visible

# Rows of a table: a frame, or its records; and its cells.
Rows: TypeAlias = pd.DataFrame | Sequence[Mapping[Any, Any]]
Cells: TypeAlias = Sequence[Sequence[str]]

_PLAIN = {ord(raised): plain for plain, raised in zip("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹", strict=True)}
# What follows a number in a text, by the mark of its row.
_MARKS = {"": "", "below its error": "*", "above rtol": "!"}
_TABULATE_FORMATS = {"markdown": "github", "latex": "latex_booktabs"}
# Spaces between columns, and beside headers where there is room.
_GAP, _PADDING = 2, 2
# Spreadsheets take texts that begin so for formulas, and run them; those of East Asia also take the wide ones.
_FORMULA_SIGNS = tuple("=+-@＝＋－＠")
# What divides cells of Markdown, or begins code, links, HTML, entities, formulas, headings or, not in words, emphasis.
_MARKDOWN_MARKS = re.compile(r"[\\|`\[\]<>&~$#*]|(?<![^\W_])_|_(?![^\W_])")
# After the end of a row, LaTeX takes these for options of that end.
_LATEX_OPTIONS = re.compile(r"^( *)(?=[\[*])", re.MULTILINE)


@dataclass(frozen=True)
class Column:
    """A column of a table: of a text, and of a page.

    Attributes:
        name: Column of the frame that has its values, and its name in the CSV of a page.
        format: Function that returns the text of a value, and of the error where there is one.
        error: Column of the frame with the errors, or with other second numbers; empty where there are none.
        kind: "label" for the first column of a page, else what the cells hold.
        is_marked: True where the mark of a row follows the number.
    """

    name: str
    header: str
    format: Callable[..., str] = str
    error: str = ""
    kind: Literal["number", "text", "label"] = "number"
    is_marked: bool = False

    def text(self, row: Mapping[Any, Any]) -> str:
        """Return the cell of a row of the frame; it is empty where the value, or the column, is missing."""
        value = row.get(self.name)
        if value is None or value is pd.NA or (isinstance(value, float) and math.isnan(value)):
            return ""
        return self.format(value, row[self.error]) if self.error else self.format(value)


@dataclass(frozen=True)
class Section:
    """A part of a result for people: a caption, tables of columns and rows, and sentences below each other."""

    caption: str = ""
    tables: Sequence[tuple[Sequence[Column], Rows]] = ()
    sentences: Sequence[str] = ()

    def text(self, style: Format) -> str:
        """Return the part as text, Markdown or LaTeX; tables without rows are left out."""
        tables = [column_table(columns, rows, style) for columns, rows in self.tables if len(rows)]
        parts = prose([self.caption] if self.caption else [], style), *tables, prose(self.sentences, style)
        return ("\n" if style == "latex" else "\n\n").join(filter(None, parts))


def rendered(style: Format, frame: pd.DataFrame, sections: Iterable[Section], notes: Sequence[str]) -> str:
    """Return a result in a format: its rows for programs, or its sections and notes for people."""
    if style in ("csv", "json"):
        return machine_table(frame, style)
    return "\n\n".join(filter(None, (one.text(style) for one in (*sections, Section(sentences=notes)))))


def column_table(columns: Sequence[Column], rows: Rows, style: Format) -> str:
    """Return rows of a frame as a table for people, with marks, and where numbers are absent; see `printed_table`."""
    records = rows.to_dict(orient="records") if isinstance(rows, pd.DataFrame) else rows
    columns = filled(columns, records)
    cells = [
        [
            "missing"
            if row.get("absent") and column.kind != "label"
            else column.text(row) + (_MARKS[row.get("mark", "")] if column.is_marked else "")
            for column in columns
        ]
        for row in records
    ]
    texts = [place for place, column in enumerate(columns) if column.kind == "text"]
    return printed_table(cells, [column.header for column in columns], style, texts)


def filled(columns: Sequence[Column], records: Sequence[Mapping[Any, Any]]) -> list[Column]:
    """Return the columns that some row has, of texts those that some row has a text for; of no rows all columns."""
    found = [one for one in columns if any(one.text(row) if one.kind == "text" else one.name in row for row in records)]
    return found or [*columns]


def machine_table(frame: pd.DataFrame, style: Format) -> str:
    """Return a table as CSV or JSON, which spells control characters itself; missing numbers are blank or null."""
    if style == "csv":
        texts = frame.rename(columns=_csv_cell).apply(
            lambda cells: cells if pd.api.types.is_numeric_dtype(cells) else cells.map(_csv_cell)
        )
        return str(texts.to_csv(index=False, lineterminator="\n")).rstrip("\n")
    return json_text(frame.astype(object).where(frame.notna(), None).to_dict(orient="records"))


def json_text(value: Any) -> str:
    """Return dataclasses, paths, tables and lists as ASCII JSON; null are numbers that are unknown or unbounded."""
    text = json.dumps(value, default=lambda one: os.fspath(one) if isinstance(one, os.PathLike) else asdict(one))
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2)


def printed_table(rows: Cells, headers: Sequence[str], style: Format, texts: Sequence[int] = ()) -> str:
    """Return cells as a table whose columns are aligned to the right, but for the first and for those of texts.

    In a text, spaces beside headers, texts and labels of the first column give way where lines would be too long: texts
    are wrapped, and labels lose their middle. Columns that still have no room follow in a table of their own, beside
    the first column, or the first two where only these tell rows apart, and without rows that have no cells there.
    Tabulate escapes LaTeX's special characters.
    """
    rows = [[_escaped(cell, style) for cell in row] for row in rows]
    headers = [_escaped(text, style) for text in headers]
    if style != "text":
        sides = ["right" if column and column not in texts else "left" for column in range(len(headers))]
        settings = {"tablefmt": _TABULATE_FORMATS[style], "disable_numparse": True, "colalign": sides}
        table = str(tabulate(rows, headers=headers, **settings))
        return _LATEX_OPTIONS.sub(r"\1{}", latex_powers(table)) if style == "latex" else table
    padding = 0 if _lacking(_widths(rows, headers, _PADDING)) > 0 else _PADDING
    short = _with_short_texts(rows, headers, texts)
    widths = _widths(short, headers, padding)
    labels = 1 + (len({row[0] for row in rows}) < len({(*row[:2],) for row in rows}) == len(rows))
    groups = [[*range(labels)]]
    for column in range(labels, len(headers)):
        if len(groups[-1]) > labels and _lacking([widths[other] for other in (*groups[-1], column)]) > 0:
            groups.append([*range(labels)])
        groups[-1].append(column)
    if len(groups) == 1:
        return "\n".join(_lines(short, headers, {0, *texts}, widths))
    # Each group is a table of its own, in which longer labels and texts may have room.
    tables = []
    for group in groups:
        kept = [row for row in rows if group is groups[0] or any(row[i] for i in group[labels:])]
        if cells := [[row[i] for i in group] for row in kept]:
            own = [group.index(i) for i in texts if i in group]
            tables.append(printed_table(cells, [headers[i] for i in group], style, own))
    return "\n\n".join(tables)


def _lines(rows: Cells, headers: Sequence[str], lefts: Container[int], widths: Sequence[int]) -> Iterator[str]:
    lines = (line for row in rows for line in zip_longest(*(cell.split("\n") for cell in row), fillvalue=""))
    aligned = [str.ljust if column in lefts else str.rjust for column in range(len(headers))]
    for line in (headers, ["-" * width for width in widths], *lines):
        cells = (align(cell, width) for align, cell, width in zip(aligned, line, widths, strict=True))
        yield (" " * _GAP).join(cells).rstrip()


def _widths(rows: Cells, headers: Sequence[str], padding: int = 0) -> list[int]:
    return [
        max(len(header) + padding, *(len(line) for cell in column for line in cell.split("\n")))
        for header, *column in zip(headers, *rows, strict=True)
    ]


def _lacking(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * (len(widths) - 1) - line_length()


def _with_short_texts(rows: Cells, headers: Sequence[str], texts: Sequence[int]) -> Cells:
    """Return rows whose labels and texts are shortened so that lines fit, unless two labels would then be the same."""
    for column in texts:
        if (lacking := _lacking(_widths(rows, headers))) > 0:
            width = max(_widths(rows, headers)[column] - lacking, SHORTEST_TEXT)
            cells = ["\n".join(textwrap.wrap(row[column], width, break_long_words=False)) for row in rows]
            rows = [[*row[:column], cell, *row[column + 1 :]] for row, cell in zip(rows, cells, strict=True)]
    if (lacking := _lacking(_widths(rows, headers))) > 0:
        longest = max(_widths(rows, headers)[0] - lacking, SHORTEST_TEXT)
        shorter = [[middle_cut(label, longest), *others] for label, *others in rows]
        if len({row[0] for row in shorter}) == len({row[0] for row in rows}):
            return shorter
    return rows


def prose(lines: Iterable[str], style: Format) -> str:
    """Return lines printed beside tables; LaTeX takes them as comments."""
    return "\n".join(f"{'% ' * (style == 'latex')}{_escaped(line, style)}" for line in lines)


def latex_powers(text: str) -> str:
    r"""Return a text whose powers of ten are formulas of LaTeX, which has no raised digits.

    >>> latex_powers("1.2 × 10⁻⁵ %")
    '1.2 $\\times 10^{-5}$ %'
    """
    return re.sub(rf"{POWER.strip()}([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", lambda one: rf"$\times 10^{{{one[1].translate(_PLAIN)}}}$", text)


def _escaped(text: str, style: Format) -> str:
    """Return a text whose characters have no meaning of their own to terminals and Markdown."""
    return _MARKDOWN_MARKS.sub(r"\\\g<0>", visible(text)) if style == "markdown" else visible(text)


def _csv_cell(value: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula; an apostrophe makes it a text."""
    if not isinstance(value, str):
        return value
    return f"'{visible(value)}" if value.startswith(_FORMULA_SIGNS) else visible(value)
