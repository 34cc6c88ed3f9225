"""Take guards out one at a time: python -m tests.mutants [PATH ...] [--count N] [--seed S]."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from tests.mutants.guards import guards
from tests.mutants.trial import try_all
from tests.support.repository import ROOT

PATHS = ("sobolev_batch/batch", "sobolev_batch/surfaces/formats", "sobolev_batch/surfaces/sources")


@click.command()
@click.argument("paths", nargs=-1)
@click.option("--count", type=click.IntRange(min=1), help="How many guards, chosen at random; all by default.")
@click.option("--seed", default=0, show_default=True, help="Of the choice.")
@click.option("--jobs", default=2, show_default=True, help="How many at a time.")
def main(paths: tuple[str, ...], count: int | None, seed: int, jobs: int) -> None:
    """Take guards out of the modules at PATHS; status 1 if the tests pass without one of them."""
    found = [guard for path in paths or PATHS for guard in guards(ROOT, path)]
    chosen = random.Random(seed).sample(found, min(count or len(found), len(found)))
    survivors = 0
    with TemporaryDirectory() as folder:
        for trial in try_all(ROOT, chosen, Path(folder), jobs):
            survivors += not trial.killed_by
            verdict = f"killed by {trial.killed_by}" if trial.killed_by else "SURVIVED"
            click.echo(f"{trial.guard.path}:{trial.guard.line}: {trial.guard.text}: {verdict}")
    click.echo(f"{len(chosen) - survivors} of {len(chosen)} guards are held by a test")
    sys.exit(bool(survivors))


if __name__ == "__main__":
    main()
