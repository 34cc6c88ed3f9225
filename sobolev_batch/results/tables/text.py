"""Tables as text: for people (text, markdown, latex) or for programs (csv, json)."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pandas as pd
from tabulate import tabulate

from sobolev_batch.results.tables.defaults import Format
from sobolev_batch.results.tables.formatting import latex_powers, middle_cut

_TABULATE_FORMATS = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}

# Longest line of text tables, and the least that remains of a label.
LINE_LENGTH = 100
_SHORTEST_LABEL = 20
# Spaces between columns, and beside headers, by tabulate.
_GAP, _PADDING = 2, 2


def machine_table(frame: pd.DataFrame, style: Format) -> str:
    """Return a table as CSV or JSON; missing numbers are blank or null."""
    if style == "csv":
        return str(frame.to_csv(index=False, lineterminator="\n")).rstrip("\n")
    records = frame.astype(object).where(frame.notna(), None).to_dict(orient="records")
    return json.dumps(records, indent=2, allow_nan=False)


def printed_table(rows: Sequence[Sequence[str]], headers: Sequence[str], style: Format) -> str:
    """Return cells as a table whose columns are aligned to the right, but for the first.

    In a text the labels of the first column are cut in their middle where lines would be too long.
    """
    if style == "markdown":
        rows, headers = [[_escaped(cell) for cell in row] for row in rows], [_escaped(text) for text in headers]
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
    return latex_powers(table) if style == "latex" else table


def _with_short_labels(rows: Sequence[Sequence[str]], headers: Sequence[str]) -> Sequence[Sequence[str]]:
    """Return rows with labels that are cut so that lines fit, unless two labels would then be the same."""
    widths = [max(len(header) + _PADDING, *map(len, column)) for header, *column in zip(headers, *rows, strict=True)]
    room = LINE_LENGTH - sum(widths[1:]) - _GAP * (len(widths) - 1)
    cut = [[middle_cut(row[0], max(room, _SHORTEST_LABEL)), *row[1:]] for row in rows]
    return cut if len({row[0] for row in cut}) == len({row[0] for row in rows}) else rows


def _escaped(cell: str) -> str:
    """Return a cell of Markdown whose bars divide nothing."""
    return cell.replace("|", "\\|")


def prose(text: str, style: Format) -> str:
    """Return lines that stand beside tables; LaTeX takes them as comments."""
    return "\n".join(f"% {line}" for line in text.split("\n")) if style == "latex" else text
