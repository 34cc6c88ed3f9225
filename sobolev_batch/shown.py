"""What notebooks show of a value: its text, or its tables, as HTML in which nothing is markup but our own."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

from sobolev_batch.visible import visible

if TYPE_CHECKING:
    import pandas as pd

# More rows of one kind, or at either end of a text in a notebook, would hide the others.
_MOST_ALIKE = 20
# Labels in one line.
_MOST_NAMED = 3
# Notebooks align the cells of tables to the right and keep them short.
_CELL_STYLE = 'style="text-align: left; vertical-align: top; white-space: pre-wrap"'


class Shown:
    """A value that notebooks show as ``print`` does, its first line above the others."""

    def _repr_html_(self) -> str:
        caption, *lines = str(self).splitlines()
        if len(lines) > 2 * _MOST_ALIKE + 1:
            lines[_MOST_ALIKE:-_MOST_ALIKE] = [f"and {len(lines) - 2 * _MOST_ALIKE:,} more"]
        rows = "".join(f"<tr><td {_CELL_STYLE}>{escape(visible(line))}</td></tr>" for line in lines)
        return _below(caption, f"<table>{rows}</table>")


def shown_tables(caption: str, *tables: pd.DataFrame) -> str:
    """Return tables below a caption, as notebooks show them."""
    # pandas escapes names.
    texts = (table.to_html(index=False, float_format="{:.3g}".format) for table in tables if len(table))
    return _below(caption, "".join(texts))


@contextmanager
def progress_line(on_progress: Callable[[Any], object] | None) -> Iterator[Callable[[Any], object]]:
    """Give a function that tells of progress: the given one, or in a notebook one that shows the last text, or none."""
    # Whoever has no notebook has not imported it.
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if on_progress is not None or not hasattr(shell, "kernel"):
        yield on_progress or str
        return
    from IPython.display import display

    line = display({"text/plain": ""}, raw=True, display_id=True)
    try:
        yield lambda text: line.update({"text/plain": visible(str(text))}, raw=True)
    finally:
        line.update({"text/plain": ""}, raw=True)


def reasons(name: str, by_label: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    """Yield rows of what happened to surfaces: label and reason of each, up to some."""
    for label, reason in list(by_label.items())[:_MOST_ALIKE]:
        yield name, f"{label}: {reason}"
    if len(by_label) > _MOST_ALIKE:
        yield name, f"and {len(by_label) - _MOST_ALIKE:,} more"


def few_of(labels: Sequence[str], most: int = _MOST_NAMED) -> str:
    """Return a few labels, and how many more there are."""
    more = len(labels) - most
    return ", ".join(labels[:most]) + (f" and {more:,} more" if more > 0 else "")


def together(by_label: Mapping[str, str]) -> dict[str, str]:
    """Return each reason once, by a few of the labels that have it."""
    labels: dict[str, list[str]] = {}
    for label, reason in by_label.items():
        labels.setdefault(reason, []).append(label)
    return {few_of(own): reason for reason, own in labels.items()}


def _below(caption: str, content: str) -> str:
    return f"<div><strong>{escape(visible(caption))}</strong>{content}</div>"
