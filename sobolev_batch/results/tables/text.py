"""Tables as text: for people (text, markdown, latex) or for programs (csv, json)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal, get_args

import pandas as pd
from tabulate import tabulate

Format = Literal["text", "csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)

_TABULATE_FORMATS = {"text": "simple", "markdown": "github", "latex": "latex_booktabs"}


def machine_table(frame: pd.DataFrame, style: Format) -> str:
    """Return a table as CSV or JSON; missing numbers are blank or null."""
    if style == "csv":
        return str(frame.to_csv(index=False, lineterminator="\n")).rstrip("\n")
    records = frame.astype(object).where(frame.notna(), None).to_dict(orient="records")
    return json.dumps(records, indent=2, allow_nan=False)


def printed_table(rows: Sequence[Sequence[str]], headers: Sequence[str], style: Format) -> str:
    """Return cells as a table whose columns are aligned to the right, but for the first."""
    if style == "markdown":
        rows, headers = [[_escaped(cell) for cell in row] for row in rows], [_escaped(text) for text in headers]
    return str(
        tabulate(
            rows,
            headers=headers,
            tablefmt=_TABULATE_FORMATS[style],
            disable_numparse=True,
            colalign=("left", *["right"] * (len(headers) - 1)),
        )
    )


def _escaped(cell: str) -> str:
    """Return a cell of Markdown whose bars divide nothing."""
    return cell.replace("|", "\\|")


def prose(text: str, style: Format) -> str:
    """Return lines that stand beside tables; LaTeX takes them as comments."""
    return "\n".join(f"% {line}" for line in text.split("\n")) if style == "latex" else text
