"""What commands print: results in one of several formats, progress, and that they go on.

All of it passes through here, so that no name reaches a terminal as a command.
"""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import StringIO
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.visible import visible, visible_lines

if TYPE_CHECKING:
    from sobolev_batch.batch.cluster.execution import Progress

# Labels of bars, of one length.
_STAGES = {"lattice": "lattice   ", "fields": "transforms", "reduction": "tables    ", "proximity": "proximity "}
_CLEAR_LINE = "\r\x1b[K"
# Time after which a silent command says that it goes on, and that between such lines without a terminal.
_PATIENCE_SECONDS, _SECONDS_BETWEEN_LINES = 2.0, 30.0
_is_answered = threading.Event()
_reporter: threading.Thread | None = None


@contextmanager
def patience(command: str) -> Iterator[None]:
    """Report on standard error, from two seconds on and until something is printed, that a command goes on."""
    global _reporter
    began, is_terminal = time.monotonic(), sys.stderr.isatty()

    def report() -> None:
        wait, shown = _PATIENCE_SECONDS, False
        while not _is_answered.wait(wait):
            text = f"{command}: {time.monotonic() - began:.0f} s so far"
            click.echo(f"{_CLEAR_LINE}{text}" if is_terminal else text, nl=not is_terminal, err=True)
            wait, shown = 1.0 if is_terminal else _SECONDS_BETWEEN_LINES, True
        if shown and is_terminal:
            click.echo(_CLEAR_LINE, nl=False, err=True)

    _is_answered.clear()
    _reporter = threading.Thread(target=report, name="sobolev-batch-patience", daemon=True)
    _reporter.start()
    try:
        yield
    finally:
        _answer()


def _answer() -> None:
    """End the report of `patience`, whose line would be in the way."""
    _is_answered.set()
    if _reporter is not None:
        _reporter.join()


def echo(line: object = "", *, err: bool = False) -> None:
    """Print one line, on standard error if asked."""
    _answer()
    click.echo(visible(str(line)), err=err)


def echo_lines(text: object, *, err: bool = False) -> None:
    """Print a text of several lines, whose names are visible already."""
    _answer()
    click.echo(visible_lines(str(text)), err=err)


def echo_result(style: str, text: object, document: Mapping[str, Any]) -> None:
    """Print a result: its text for people, or one JSON document, whose keys docs/commands.md lists."""
    from sobolev_batch.tables.rendering import json_text

    echo_lines(json_text(document) if style == "json" else text)


def progress_bar(length: int, label: str, *, show_count: bool = True) -> Any:
    """Return a bar on standard error."""
    return click.progressbar(length=length, label=visible(label), file=sys.stderr, show_pos=show_count)


def show_usage_error(error: click.ClickException) -> None:
    """Print what is wrong with a command, as click words it."""
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        # Its message is the help.
        echo_lines(error.message, err=True)
        return
    text = StringIO()
    error.show(text)
    shown = text.getvalue().removesuffix("\n").replace(error.message, visible(error.message))
    # Click sets lists of choices off by tabulators.
    echo_lines(shown.expandtabs(2), err=True)


def replace_line(text: str, before: str) -> str:
    """Show a text in the place of the one before on a terminal, elsewhere on a new line; return the text."""
    if sys.stdout.isatty():
        if text or before:
            # A longer line would wrap, and stay.
            click.echo(_CLEAR_LINE + visible(text)[: shutil.get_terminal_size().columns - 1], nl=False)
    elif text not in ("", before):
        echo(text)
    return text


@contextmanager
def progress_reports() -> Iterator[Callable[[Progress], None]]:
    """Give a function that shows progress on standard error: a bar on a terminal, elsewhere a line for each step."""
    with ExitStack() as bars:
        bar: Any = None

        def show(progress: Progress) -> None:
            nonlocal bar
            if progress.stage == "cluster":
                echo(progress, err=True)
            elif not sys.stderr.isatty():
                if progress.record is not None or progress.done == progress.total:
                    echo(progress, err=True)
            elif progress.done:
                bar.update(1)
            elif progress.part and bar is not None:
                # Objects go on side by side: one bar has the steps of all that have begun.
                bar.length += progress.total
                bar.update(0)
            else:
                bars.close()
                label = "all objects" if progress.part else _STAGES[progress.stage]
                bar = bars.enter_context(progress_bar(progress.total, label))
            if progress.done == progress.total and not progress.part:
                bars.close()

        yield show
