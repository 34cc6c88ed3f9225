"""Run the whole coverage check: python -m tests.coverage [--seed N] [--cases N]."""

from __future__ import annotations

import sys
from itertools import product

import click
from tabulate import tabulate

from tests.coverage.cases import KINDS, ORDERS, all_cases
from tests.coverage.judging import Tally, Verdict, judge

LEAST_COVERED, LARGEST_MEDIAN = 0.99, 30.0


@click.command()
@click.option("--seed", default=0, show_default=True, help="Seed of the random cases.")
@click.option("--cases", "count", default=400, show_default=True, help="Least number of cases.")
def main(count: int, seed: int) -> None:
    """Compare reported errors with true ones over random cases; status 1 if they fall short."""
    pairs = list(all_cases(seed, count))
    with click.progressbar(pairs, label=f"{len(pairs)} pairs", file=sys.stderr) as shown:
        verdicts = [verdict for cases in shown for verdict in judge(cases)]
    groups = [
        (f"{kind} {order:g}", [v for v in verdicts if v.case.kind == kind and v.case.order == order])
        for kind, order in product(KINDS, ORDERS)
    ]
    rows = [_row(name, group) for name, group in groups if group]
    headers = ["pair, order", "cases", "covered", "telling", "median ratio", "largest ratio", "least ratio"]
    click.echo(tabulate([*rows, _row("all", verdicts)], headers=headers, floatfmt=".3g"))
    for verdict in verdicts:
        if not verdict.covered:
            click.echo(f"not covered: {described(verdict)}")
    tally = Tally(tuple(verdicts))
    share = tally.covered / len(verdicts)
    refused = sum(map(len, pairs)) - len(verdicts)
    click.echo(f"covered {100 * share:.2f} %, median ratio {tally.median_ratio:.3g}, {refused} refused")
    sys.exit(share < LEAST_COVERED or not tally.median_ratio <= LARGEST_MEDIAN)


def described(verdict: Verdict) -> str:
    """Return a line that identifies a verdict and its case."""
    case = verdict.case
    return (
        f"{case.kind}, pair {case.index}, order {case.order:g}, {case.setting}: {verdict.value:.8g} ± "
        f"{verdict.reported:.2g}, truly {verdict.truth.value:.8g} ± {verdict.truth.uncertainty:.1g}"
    )


def _row(name: str, verdicts: list[Verdict]) -> list[str | int | float]:
    tally = Tally(tuple(verdicts))
    ratios = tally.ratios or [float("nan")]
    return [name, len(verdicts), tally.covered, len(tally.ratios), tally.median_ratio, max(ratios), min(ratios)]


if __name__ == "__main__":
    main()
