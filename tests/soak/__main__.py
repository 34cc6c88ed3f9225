"""A study under fire: python -m tests.soak [--meshes N] [--seed S] [--kills K]."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from tabulate import tabulate

from tests.soak.trial import Outcome, soak


@click.command()
@click.option("--meshes", default=2000, show_default=True, help="How many.")
@click.option("--seed", default=0, show_default=True, help="Of meshes, kills and failing requests.")
@click.option("--kills", default=40, show_default=True, help="Of workers.")
@click.option("--driver-kills", default=4, show_default=True, help="Of the process that drives the run.")
@click.option("--rate", default=0.05, show_default=True, help="Share of the requests to the storage that fail.")
def main(meshes: int, seed: int, kills: int, driver_kills: int, rate: float) -> None:
    """Run a study while processes are killed and the storage fails; status 1 if anything is lost by that."""
    for talkative in ("distributed", "asyncio"):
        logging.getLogger(talkative).setLevel(logging.CRITICAL)
    with TemporaryDirectory() as folder:
        outcome = soak(Path(folder), meshes, seed, kills, driver_kills, rate)
    shown = [(name, f"{figure:.1f}" if isinstance(figure, float) else f"{figure:,}") for name, figure in rows(outcome)]
    headers = [f"{meshes:,} meshes, seed {seed}", ""]
    click.echo(tabulate(shown, headers=headers, disable_numparse=True, colalign=("left", "right")))
    for difference in outcome.differences:
        click.echo(f"not the same: {difference}")
    sys.exit(bool(outcome.differences))


def rows(outcome: Outcome) -> list[tuple[str, int | float]]:
    """The figures of a trial with their names."""
    return [
        ("workers killed", outcome.workers),
        ("drivers killed", outcome.drivers),
        ("requests", outcome.requests),
        *((f"of them failed: {kind}", count) for kind, count in sorted(outcome.failures.items())),
        ("fields stored once more", outcome.stored_again),
        ("seconds of the clean run, into a folder", outcome.clean_seconds),
        ("seconds of the soaked run", outcome.soaked_seconds),
        ("seconds lost", outcome.soaked_seconds - outcome.clean_seconds),
        ("differences", len(outcome.differences)),
    ]


if __name__ == "__main__":
    main()
