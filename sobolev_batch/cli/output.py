"""What commands print, progress too: all of it passes through here, so that no name reaches a terminal as a command."""

from __future__ import annotations

import shutil
import sys
from io import StringIO
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import click

from sobolev_batch.visible import visible, visible_lines

if TYPE_CHECKING:
    from sobolev_batch.batch.cluster.execution import Progress

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


class ProgressLine:
    """A line on standard output that is updated in place; elsewhere than on a terminal, a new one for each change."""

    def __init__(self) -> None:
        self._shown = ""

    def show(self, text: str) -> None:
        """Replace the line."""
        if sys.stdout.isatty():
            overwrite(text)
        elif text != self._shown:
            echo(text)
        self._shown = text

    def close(self) -> None:
        """Remove the line from a terminal."""
        if self._shown and sys.stdout.isatty():
            overwrite()


class Reporter:
    """Shows progress on standard error: a bar on a terminal, elsewhere a line for each step."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def __call__(self, progress: Progress) -> None:
        """Show one step."""
        part = f"{progress.part}: " if progress.part else ""
        if progress.stage == "cluster":
            echo(f"dashboard: {progress.label}", err=True)
        elif sys.stderr.isatty():
            self._draw(progress)
        elif progress.record is not None:
            outcome = progress.record.reason or f"{progress.record.seconds:.2f} s"
            count = f"[{progress.done}/{progress.total}]"
            echo(f"{part}{count} {progress.label}: {progress.record.status}, {outcome}", err=True)
        elif progress.stage == "reduction" and progress.done == progress.total:
            echo(f"{part}tables reduced", err=True)
        elif progress.stage == "proximity" and progress.done == progress.total:
            echo(f"{part}{progress.total} Hausdorff and Chamfer distances measured", err=True)

    def _draw(self, progress: Progress) -> None:
        if progress.done == 0:
            self._close()
            stage = {"fields": "transforms", "reduction": "tables    ", "proximity": "proximity "}[progress.stage]
            label = f"{progress.part}: {stage}" if progress.part else stage
            self._bar = progress_bar(progress.total, label)
            self._bar.__enter__()
        else:
            self._bar.update(1)
        if progress.done == progress.total:
            self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
            self._bar = None
