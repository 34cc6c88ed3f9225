"""Studies and stores under fire: python -m tests.soak --sequences N, --corruptions N, or --mixed-states."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from tabulate import tabulate

from tests.soak.corruptions import ANSWERS, BAD, WAYS, Corruption, corruptions, mixed_states
from tests.soak.strikes import strike_all, strikes_of


@click.command()
@click.option("--sequences", default=0, help="How many studies, each on a cluster that is struck.")
@click.option("--meshes", default=60, show_default=True, help="Of each study.")
@click.option("--strikes", default=5, show_default=True, help="On each study.")
@click.option("--rate", default=0.0, show_default=True, help="Share of the requests to the storage that fail.")
@click.option("--corruptions", "damaged", default=0, help="How many damaged files of a finished store.")
@click.option(
    "--mixed-states", "mixed", is_flag=True, help="Restore each set of groups of a store to an earlier state."
)
@click.option("--seed", default=0, show_default=True, help="Of strikes, failing requests and damage.")
def main(sequences: int, meshes: int, strikes: int, rate: float, damaged: int, mixed: bool, seed: int) -> None:
    """Disturb studies and damage stores; status 1 if anything is lost by that, or changes without a word."""
    for talkative in ("distributed", "asyncio"):
        logging.getLogger(talkative).setLevel(logging.CRITICAL)
    with TemporaryDirectory() as folder:
        is_bad = strike(Path(folder), range(seed, seed + sequences), meshes, strikes, rate) if sequences else False
        is_bad |= tell(corruptions(Path(folder), damaged, seed)) if damaged else False
        is_bad |= tell(mixed_states(Path(folder))) if mixed else False
    sys.exit(is_bad)


def strike(folder: Path, seeds: range, meshes: int, count: int, rate: float) -> bool:
    found, is_bad = Counter[str](), False
    plans = {seed: strikes_of(seed, count, meshes) for seed in seeds}
    for seed, outcome in zip(seeds, strike_all(folder, plans, meshes, rate), strict=True):
        told = ", ".join(f"{one.role} {one.what} at {one.complete}" for one in outcome.strikes)
        click.echo(f"seed {seed}: {outcome.seconds:.0f} s, {outcome.commands} commands; {told}")
        for difference in outcome.differences:
            click.echo(f"not the same: {difference}")
        found += Counter(f"{one.role} {one.what}" for one in outcome.strikes) + outcome.failures
        is_bad |= bool(outcome.differences)
    click.echo(tabulate(sorted(found.items())))
    return is_bad


def tell(damaged: Iterator[Corruption]) -> bool:
    """Show what came of damaged stores, and return whether a number changed without a word."""
    found, kinds = {way: Counter[str]() for way in WAYS}, Counter[str]()
    for corruption in damaged:
        kinds[corruption.kind] += 1
        for way, answer in corruption.answers.items():
            found[way][answer] += 1
            if answer in BAD:
                click.echo(f"{way}: {answer}: {', '.join(corruption.keys[:3])}, {corruption.kind}")
    click.echo(tabulate([[way, *(found[way][answer] for answer in ANSWERS)] for way in WAYS], headers=["", *ANSWERS]))
    click.echo(f"{kinds.total()} in all, of {len(kinds)} kinds")
    return any(found[way][answer] for way in WAYS for answer in BAD)


if __name__ == "__main__":
    main()
