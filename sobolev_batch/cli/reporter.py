"""Progress of a run, shown by the command that runs it or by one that follows it."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from sobolev_batch.cli.output import echo, overwrite, progress_bar

if TYPE_CHECKING:
    from sobolev_batch.batch.cluster.execution import Progress


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
