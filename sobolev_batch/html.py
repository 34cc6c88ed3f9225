"""HTML of objects, as notebooks show them. Everything that is not ours is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from sobolev_batch.visible import visible

# More rows of one kind would hide the others.
_MOST_ALIKE = 20
# Notebooks align the cells of tables to the right and keep them short.
_CELL = 'style="text-align: left; vertical-align: top; white-space: pre-wrap"'


def table_html(caption: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and texts as HTML.

    Args:
        caption: Heading of the table.
        rows: Name and text of each row; an empty name goes on with the row before.
    """
    cells = "".join(f"<tr><th {_CELL}>{_shown(name)}</th><td {_CELL}>{_shown(text)}</td></tr>" for name, text in rows)
    return f"<div><strong>{_shown(caption)}</strong><table>{cells}</table></div>"


def reasons(name: str, by_label: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    """Yield rows of what happened to surfaces: label and reason of each, up to some."""
    for label, reason in list(by_label.items())[:_MOST_ALIKE]:
        yield name, f"{label}: {reason}"
    if len(by_label) > _MOST_ALIKE:
        yield name, f"and {len(by_label) - _MOST_ALIKE:,} more"


def _shown(text: str) -> str:
    return escape(visible(text))
