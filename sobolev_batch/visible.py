"""Text as it is shown, also in HTML: characters that a terminal or page would obey, or hide, are replaced by escapes.

Names of files and messages of other programs may hold any characters. Data keep them as they are; whatever is shown
to people passes through here.
"""

from __future__ import annotations

import logging
import re
import sys
import warnings
from collections.abc import Iterable, Mapping
from html import escape
from traceback import format_exception
from typing import Any, TextIO

# Control characters, separators of lines and paragraphs, marks that turn the direction of text, lone surrogates.
HAZARDOUS = re.compile("[\0-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u206f\ud800-\udfff]")
# The unit of length of files where it has no name.
FILE_UNITS = "file units"
# More rows of one kind, or at either end of a text in a notebook, would hide the others.
_MOST_ALIKE = 20
# Notebooks align the cells of tables to the right and keep them short.
_CELL_STYLE = 'style="text-align: left; vertical-align: top; white-space: pre-wrap"'


def visible(text: str) -> str:
    r"""Return a text on one line, with escapes in place of characters that are commands or cannot be shown.

    >>> visible("a\x1b[31m\nb.ply"), visible("Ä 日本 😀.ply")
    ('a\\x1b[31m\\nb.ply', 'Ä 日本 😀.ply')
    """
    return HAZARDOUS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def visible_lines(text: str) -> str:
    """Return the same of a text of several lines, whose names must have been made `visible` before."""
    return "\n".join(map(visible, text.split("\n")))


class VisibleRecord(logging.LogRecord):
    """A log record whose message is visible, on one line, whichever handler writes it."""

    def __init__(self, *args: Any, **fields: Any) -> None:
        super().__init__(*args, **fields)
        if self.exc_info and self.exc_info[1] is not None:
            # Formatters take the traceback from here.
            self.exc_text = visible_lines("".join(format_exception(self.exc_info[1])).rstrip("\n"))

    def getMessage(self) -> str:  # noqa: N802  # the name is that of the standard library
        """Return the message."""
        return visible(super().getMessage())


def make_messages_visible() -> None:
    """Make all log records and warnings of this process visible, also those of libraries."""
    logging.setLogRecordFactory(VisibleRecord)
    warnings.showwarning = _show_warning


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    text = warnings.formatwarning(visible(str(message)), category, filename, lineno, line)
    (file or sys.stderr).write(visible_lines(text))


def table_html(caption: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return rows of names and texts as an HTML table; an empty name goes on with the row before."""
    cells = "".join(
        f"<tr><th {_CELL_STYLE}>{_escaped(name)}</th><td {_CELL_STYLE}>{_escaped(text)}</td></tr>"
        for name, text in rows
    )
    return f"<div><strong>{_escaped(caption)}</strong><table>{cells}</table></div>"


class Shown:
    """A value that notebooks show as ``print`` does, its first line above the others."""

    def _repr_html_(self) -> str:
        caption, *lines = str(self).splitlines()
        if len(lines) > 2 * _MOST_ALIKE + 1:
            lines[_MOST_ALIKE:-_MOST_ALIKE] = [f"and {len(lines) - 2 * _MOST_ALIKE:,} more"]
        return table_html(caption, [("", line) for line in lines])


def reasons(name: str, by_label: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    """Yield rows of what happened to surfaces: label and reason of each, up to some."""
    for label, reason in list(by_label.items())[:_MOST_ALIKE]:
        yield name, f"{label}: {reason}"
    if len(by_label) > _MOST_ALIKE:
        yield name, f"and {len(by_label) - _MOST_ALIKE:,} more"


def _escaped(text: str) -> str:
    return escape(visible(text))
