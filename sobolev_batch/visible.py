"""Text as it is shown: characters that a terminal or page would obey, or hide, are replaced by escapes.

Names of files and messages of other programs may hold any characters. Data keep them; what is shown passes here.
"""

import logging
import re
import sys
import warnings
from traceback import format_exception
from typing import Any, TextIO

# Control characters, separators of lines and paragraphs, marks that turn the direction of text, lone surrogates.
HAZARDOUS = re.compile("[\0-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u206f\ud800-\udfff]")
# The unit of length of files where it has no name.
FILE_UNITS = "file units"


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
