"""Studies and stores under fire: python -m tests.soak, with --sequences N or --corruptions N."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from tabulate import tabulate

from tests.soak import corruptions, sequences
from tests.soak.trial import Outcome, soak


@click.command()
@click.option("--meshes", default=2000, show_default=True, help="How many.")
@click.option("--seed", default=0, show_default=True, help="Of meshes, kills and failing requests.")
@click.option("--kills", default=40, show_default=True, help="Of workers.")
@click.option("--driver-kills", default=4, show_default=True, help="Of the process that drives the run.")
@click.option("--rate", default=0.05, show_default=True, help="Share of the requests to the storage that fail.")
@click.option(
    "--sequences", "struck", default=0, help="Instead: so many small studies, each on a cluster that is struck 5 times."
)
@click.option("--corruptions", "damaged", default=0, help="Instead: so many damaged files of a finished store.")
def main(meshes: int, seed: int, kills: int, driver_kills: int, rate: float, struck: int, damaged: int) -> None:
    """Run a study while processes are killed and the storage fails; status 1 if anything is lost by that."""
    for talkative in ("distributed", "asyncio"):
        logging.getLogger(talkative).setLevel(logging.CRITICAL)
    with TemporaryDirectory() as folder:
        if struck:
            sys.exit(strike(Path(folder), range(seed, seed + struck)))
        if damaged:
            sys.exit(damage(Path(folder), damaged, seed))
        outcome = soak(Path(folder), meshes, seed, kills, driver_kills, rate)
    shown = [(name, f"{figure:.1f}" if isinstance(figure, float) else f"{figure:,}") for name, figure in rows(outcome)]
    headers = [f"{meshes:,} meshes, seed {seed}", ""]
    click.echo(tabulate(shown, headers=headers, disable_numparse=True, colalign=("left", "right")))
    for difference in outcome.differences:
        click.echo(f"not the same: {difference}")
    sys.exit(bool(outcome.differences))


def strike(folder: Path, seeds: range) -> bool:
    """Show what came of sequences of strikes, and return whether anything was lost."""
    outcomes = []
    plans = {seed: sequences.strikes_of(seed, count=5) for seed in seeds}
    for seed, sequence in zip(seeds, sequences.strike_all(folder, plans), strict=True):
        told = ", ".join(f"{one.role} {one.what} at {one.complete}" for one in sequence.strikes)
        click.echo(f"seed {seed}: {sequence.seconds:.0f} s, {sequence.commands} commands; {told}")
        for difference in sequence.differences:
            click.echo(f"not the same: {difference}")
        outcomes.append(sequence)
    click.echo(tabulate(sorted(sequences.counts(outcomes).items())))
    click.echo(f"the longest took {max(one.seconds for one in outcomes):.0f} s")
    return any(one.differences for one in outcomes)


def damage(folder: Path, count: int, seed: int) -> bool:
    """Show what came of damaged files, and return whether a number changed without a word."""
    found = []
    for corruption in corruptions.corruptions(folder, count, seed):
        found.append(corruption)
        for way, answer in corruption.answers.items():
            if answer in corruptions.BAD:
                click.echo(f"{way}: {answer}: {', '.join(corruption.keys)}, {corruption.kind}")
    table = [[way, *(answers[answer] for answer in corruptions.ANSWERS)] for way, answers in corruptions.counts(found)]
    click.echo(tabulate(table, headers=["", *corruptions.ANSWERS]))
    click.echo(tabulate(sorted(Counter(one.kind for one in found).items())))
    return any(answer in corruptions.BAD for one in found for answer in one.answers.values())


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
