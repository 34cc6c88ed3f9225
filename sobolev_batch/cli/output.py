"""What commands print: results in one of several formats, progress, and that they go on.

All of it passes through here, so that no name reaches a terminal as a command.
"""

from __future__ import annotations

import logging
import shutil
import sys
import textwrap
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
_STAGES = {"lattice": "lattice   ", "fields": "transforms", "tables": "tables    ", "proximity": "proximity "}
CLEAR_LINE = "\r\x1b[K"
# Time after which a silent command says that it goes on, and that between such lines without a terminal.
_PATIENCE_SECONDS, _SECONDS_BETWEEN_LINES = 2.0, 30.0
# The step that a command is at, whether a line stands on the terminal that has not ended, and who may write.
_step, _stands = "", False
_writing = threading.RLock()


@contextmanager
def patience(command: str) -> Iterator[None]:
    """Report on standard error, from two seconds on, that a command goes on, and its step."""
    began, ended = time.monotonic(), threading.Event()
    show_step("")

    def report() -> None:
        wait, is_terminal = _PATIENCE_SECONDS, sys.stderr.isatty()
        while not ended.wait(wait):
            text = f"{command}: {time.monotonic() - began:.0f} s so far{': ' * bool(_step)}{visible(_step)}"
            # A longer line would wrap, and stay.
            most = shutil.get_terminal_size().columns - 1 if is_terminal else None
            _write(text[:most], err=True, nl=not is_terminal)
            wait = 1.0 if is_terminal else _SECONDS_BETWEEN_LINES

    reporter = threading.Thread(target=report, name="sobolev-batch-patience", daemon=True)
    reporter.start()
    try:
        yield
    finally:
        ended.set()
        reporter.join()
        _write("", err=True, nl=False)


def show_step(text: str) -> None:
    """Name the step that a command is at, for whoever waits."""
    global _step
    _step = text


def _write(text: str, *, err: bool, nl: bool = True) -> None:
    """Write a text in the place of a line that stands on the terminal and has not ended, or of a bar."""
    global _stands
    with _writing:
        if _stands or (err and text and sys.stderr.isatty()):
            click.echo(CLEAR_LINE, nl=False, err=True)
        click.echo(text, nl=nl, err=err)
        _stands = bool(text) and not nl


def _fitted(line: str) -> str:
    """Return a line broken where it is longer than the terminal; one with gaps is the row of a table."""
    words, width = line.lstrip(), shutil.get_terminal_size().columns
    indent = 2 * line.removesuffix(words)
    fitted = textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return line if "  " in words else fitted


def echo(line: object = "", *, err: bool = False) -> None:
    """Print one line, on standard error if asked; a terminal shows it on lines of its width."""
    echo_lines(visible(str(line)), err=err)


def echo_lines(text: object, style: str = "text", *, err: bool = False) -> None:
    """Print a text of several lines, whose names are visible already, likewise unless it has a style for programs."""
    shown = visible_lines(str(text))
    if style == "text" and (sys.stderr if err else sys.stdout).isatty():
        shown = "\n".join(map(_fitted, shown.split("\n")))
    _write(shown, err=err)


def echo_result(style: str, text: object, document: Mapping[str, Any]) -> None:
    """Print a result: its text for people, or one JSON document, whose keys docs/commands.md lists."""
    from sobolev_batch.tables.rendering import json_text

    echo_lines(json_text(document) if style == "json" else text, style)


class EchoHandler(logging.Handler):
    """Prints log messages, whose names are visible already, as errors are printed."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        echo_lines(self.format(record), err=True)


def progress_bar(length: int, label: str, *, show_count: bool = True) -> Any:
    """Return a bar on standard error."""
    return click.progressbar(length=length, label=visible(label), file=sys.stderr, show_pos=show_count)


def lengthen(bar: Any, steps: int) -> None:
    """Add steps to a bar: those of another object, which begins when all others may be done."""
    bar.length, bar.finished = bar.length + steps, False


def show_usage_error(error: click.ClickException) -> None:
    """Print what is wrong with a command, as click words it, in the letters of all other errors."""
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        # Its message is the help.
        echo_lines(error.message, err=True)
        return
    text = StringIO()
    error.show(text)
    worded = text.getvalue().removesuffix("\n").replace("Error: ", "error: ", 1)
    # Click sets lists of choices off by tabulators.
    echo_lines(worded.replace(error.message, visible(error.message)).expandtabs(2), err=True)


def replace_line(text: str, before: str) -> str:
    """Show a text in the place of the one before on a terminal, elsewhere on a new line; return the text."""
    if sys.stdout.isatty():
        if text or before:
            # A longer line would wrap, and stay.
            click.echo(CLEAR_LINE + visible(text)[: shutil.get_terminal_size().columns - 1], nl=False)
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
            if progress.stage in ("cluster", "search"):
                echo(progress, err=True)
            elif not sys.stderr.isatty():
                if progress.record is not None or progress.done == progress.total:
                    echo(progress, err=True)
            elif progress.done:
                bar.update(1)
            elif progress.part and bar is not None:
                # Objects go on side by side: one bar has the steps of all that have begun.
                lengthen(bar, progress.total)
            else:
                bars.close()
                label = "all objects" if progress.part else _STAGES[progress.stage]
                bar = bars.enter_context(progress_bar(progress.total, label))
            if progress.done == progress.total and not progress.part:
                bars.close()

        yield show
