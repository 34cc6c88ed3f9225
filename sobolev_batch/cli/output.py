"""What commands print: all of it passes through here, so that no name reaches a terminal as a command."""

from __future__ import annotations

import shutil
import sys
from io import StringIO
from typing import Any

import click

from sobolev_batch.visible import visible, visible_lines

_CLEAR_LINE = "\r\x1b[K"


def echo(line: object = "", *, err: bool = False) -> None:
    """Print one line, on standard error if asked."""
    click.echo(visible(str(line)), err=err)


def echo_lines(text: object, *, err: bool = False) -> None:
    """Print a text of several lines, whose names are visible already."""
    click.echo(visible_lines(str(text)), err=err)


def overwrite(line: str = "") -> None:
    """Replace the last line of the terminal; a longer one would wrap, and stay."""
    click.echo(_CLEAR_LINE + visible(line)[: shutil.get_terminal_size().columns - 1], nl=False)


def progress_bar(length: int, label: str, *, show_count: bool = True) -> Any:
    """Return a bar on standard error."""
    return click.progressbar(length=length, label=visible(label), file=sys.stderr, show_pos=show_count)


def show_usage_error(error: click.ClickException) -> None:
    """Print what is wrong with a command, as click words it."""
    text = StringIO()
    error.show(text)
    echo_lines(text.getvalue().removesuffix("\n").replace(error.message, visible(error.message)), err=True)
