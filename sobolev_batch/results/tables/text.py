"""Tables as text: for people (text, markdown, latex) or for programs (csv, json)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pandas as pd
from tabulate import tabulate

from sobolev_batch.results.tables.formatting import Format, latex_powers, middle_cut
from sobolev_batch.visible import visible

_TABULATE_FORMATS = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}

# Longest line of text tables, and the least that remains of a label.
LINE_LENGTH = 100
_SHORTEST_LABEL = 20
# Spaces between columns, and beside headers, by tabulate.
_GAP, _PADDING = 2, 2
# Spreadsheets take texts that begin so for formulas, and run them; those of East Asia the wide ones, too.
_FORMULA_SIGNS = tuple("=+-@＝＋－＠")
# What divides cells of Markdown, or begins code, links, HTML, entities, formulas and headings; and emphasis, which
# underscores within words do not begin.
_MARKDOWN_MARKS = re.compile(r"[\\|`\[\]<>&~$#*]|(?<![^\W_])_|_(?![^\W_])")
# After the end of a row, LaTeX takes these for options of that end.
_LATEX_OPTIONS = re.compile(r"^( *)(?=[\[*])", re.MULTILINE)


@dataclass(frozen=True)
class Column:
    """A column of a table: of a text, and of a page.

    Attributes:
        name: Column of the frame that has its values, and its name in the CSV of a page.
        header: Header of the column.
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
        """Return the cell of a row of the frame; it is empty where the value is missing."""
        value = row[self.name]
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return ""
        return self.format(value, row[self.error]) if self.error else self.format(value)


def column_table(columns: Sequence[Column], rows: Iterable[Mapping[Any, Any]], style: Format) -> str:
    """Return rows of a frame as a table for people; see `printed_table`."""
    cells = [[column.text(row) for column in columns] for row in rows]
    return printed_table(cells, [column.header for column in columns], style)


def machine_table(frame: pd.DataFrame, style: Format) -> str:
    """Return a table as CSV or JSON, which spells control characters itself; missing numbers are blank or null."""
    if style == "csv":
        texts = frame.rename(columns=_csv_cell).apply(
            lambda cells: cells if pd.api.types.is_numeric_dtype(cells) else cells.map(_csv_cell)
        )
        return str(texts.to_csv(index=False, lineterminator="\n")).rstrip("\n")
    records = frame.astype(object).where(frame.notna(), None).to_dict(orient="records")
    return json.dumps(records, indent=2, allow_nan=False)


def printed_table(rows: Sequence[Sequence[str]], headers: Sequence[str], style: Format) -> str:
    """Return cells as a table whose columns are aligned to the right, but for the first.

    In a text the labels of the first column are cut in their middle where lines would be too long. LaTeX's special
    characters are escaped by tabulate.
    """
    rows, headers = [[_shown(cell, style) for cell in row] for row in rows], [_shown(text, style) for text in headers]
    if style == "text":
        rows = _with_short_labels(rows, headers)
    table = str(
        tabulate(
            rows,
            headers=headers,
            tablefmt=_TABULATE_FORMATS[style],
            disable_numparse=True,
            colalign=("left", *["right"] * (len(headers) - 1)),
        )
    )
    return _LATEX_OPTIONS.sub(r"\1{}", latex_powers(table)) if style == "latex" else table


def _with_short_labels(rows: Sequence[Sequence[str]], headers: Sequence[str]) -> Sequence[Sequence[str]]:
    """Return rows with labels that are cut so that lines fit, unless two labels would then be the same."""
    widths = [max(len(header) + _PADDING, *map(len, column)) for header, *column in zip(headers, *rows, strict=True)]
    room = LINE_LENGTH - sum(widths[1:]) - _GAP * (len(widths) - 1)
    cut = [[middle_cut(row[0], max(room, _SHORTEST_LABEL)), *row[1:]] for row in rows]
    return cut if len({row[0] for row in cut}) == len({row[0] for row in rows}) else rows


def prose(lines: Iterable[str], style: Format) -> str:
    """Return lines that stand beside tables; LaTeX takes them as comments."""
    return "\n".join(f"{'% ' * (style == 'latex')}{_shown(line, style)}" for line in lines)


def _shown(text: str, style: Format) -> str:
    """Return a text whose characters have no meaning of their own to terminals and Markdown."""
    return _MARKDOWN_MARKS.sub(r"\\\g<0>", visible(text)) if style == "markdown" else visible(text)


def _csv_cell(value: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula; an apostrophe makes it a text."""
    if not isinstance(value, str):
        return value
    return f"'{visible(value)}" if value.startswith(_FORMULA_SIGNS) else visible(value)
