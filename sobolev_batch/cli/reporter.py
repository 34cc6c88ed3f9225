"""Progress of a run, shown on standard error."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any, Self

import click

from sobolev_batch.batch.cluster.progress import Progress


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
        if progress.stage == "cluster":
            click.echo(f"dashboard: {progress.label}", err=True)
        elif sys.stderr.isatty():
            self._draw(progress)
        elif progress.record is not None:
            outcome = progress.record.reason or f"{progress.record.seconds:.2f} s"
            click.echo(
                f"[{progress.done}/{progress.total}] {progress.label}: {progress.record.status}, {outcome}", err=True
            )
        elif progress.stage == "reduction" and progress.done == progress.total:
            click.echo("tables reduced", err=True)
        elif progress.stage == "comparisons" and progress.done == progress.total:
            click.echo(f"{progress.total} comparisons with the reference finished", err=True)

    def _draw(self, progress: Progress) -> None:
        if progress.done == 0:
            self._close()
            label = {"fields": "transforms", "reduction": "tables    ", "comparisons": "comparisons"}[progress.stage]
            self._bar = click.progressbar(length=progress.total, label=label, file=sys.stderr, show_pos=True)
            self._bar.__enter__()
        else:
            self._bar.update(1)
        if progress.done == progress.total:
            self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
            self._bar = None
