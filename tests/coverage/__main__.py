"""Run the whole coverage check: python -m tests.coverage [--seed N] [--cases N]."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product

import click
from tabulate import tabulate

from tests.coverage.cases import Case, all_cases
from tests.coverage.judging import PARTS, Findings, Refusal, Tally, Verdict, judge
from tests.coverage.kinds import KINDS, ORDERS

LEAST_COVERED, LARGEST_MEDIAN = 0.99, 30.0
_SLOWEST = 10


@click.command()
@click.option("--seed", default=0, show_default=True, help="Seed of the random cases.")
@click.option("--cases", "count", default=420, show_default=True, help="Least number of cases.")
def main(count: int, seed: int) -> None:
    """Compare reported errors with true ones over random cases; status 1 if they fall short."""
    pairs = list(all_cases(seed, count))
    with click.progressbar(pairs, label=f"{len(pairs)} pairs", file=sys.stderr) as shown:
        found = [judge(cases) for cases in shown]
    sys.exit(not show(found))


def show(found: Sequence[Findings]) -> bool:
    """Print all that was found; tell whether the errors keep their promise."""
    verdicts = [verdict for one in found for verdict in one.verdicts]
    refusals = [refusal for one in found for refusal in one.refusals]
    groups = [
        (f"{kind} {order:g}", [v for v in verdicts if v.case.kind == kind and v.case.order == order])
        for kind, order in product(KINDS, ORDERS)
    ]
    orders = [(f"all {order:g}", [v for v in verdicts if v.case.order == order]) for order in ORDERS]
    kinds = [(f"{kind}, all", [v for v in verdicts if v.case.kind == kind]) for kind in KINDS]
    rows = [_row(name, group) for name, group in (*groups, *kinds, *orders, ("all", verdicts)) if group]
    headers = ["pair, order", "cases", "covered", "telling", "median ratio", "largest ratio", "least ratio"]
    click.echo(tabulate(rows, headers=headers, floatfmt=".3g"))
    for verdict in verdicts:
        if not verdict.covered:
            click.echo(f"not covered: {described(verdict)}")
    for refusal in refusals:
        if refusal.unexpected or not refusal.answered:
            click.echo(f"refused: {_described_refusal(refusal)}")
    taken = [(v.seconds, _described_case(v.case)) for v in verdicts]
    taken += [(r.seconds, f"{_described_case(r.case)}, refused") for r in refusals]
    for seconds, description in sorted(taken, reverse=True)[:_SLOWEST]:
        click.echo(f"{seconds:.1f} s: {description}")
    tally = Tally(tuple(verdicts))
    share = tally.covered / len(verdicts)
    unexpected = sum(refusal.unexpected for refusal in refusals)
    click.echo(
        f"covered {100 * share:.2f} % of {len(verdicts)}, median ratio {tally.median_ratio:.3g}, "
        f"{len(refusals)} refused, {unexpected} of them unexpectedly"
    )
    return share >= LEAST_COVERED and tally.median_ratio <= LARGEST_MEDIAN


def described(verdict: Verdict) -> str:
    """Return a line that identifies a verdict and its case."""
    parts = ", ".join(f"{name} {part:.2g}" for name, part in zip(PARTS, verdict.parts, strict=True))
    return (
        f"{_described_case(verdict.case)}: {verdict.value:.8g} ± {verdict.reported:.2g} ({parts}), "
        f"truly {verdict.truth.value:.8g} ± {verdict.truth.uncertainty:.1g}"
    )


def _described_refusal(refusal: Refusal) -> str:
    kept = "" if refusal.answered else ", and refused that too"
    return f"{_described_case(refusal.case)}: offered {refusal.reachable:.2g}{kept}"


def _described_case(case: Case) -> str:
    return f"{case.kind}, pair {case.index}, order {case.order:g}, {case.setting}"


def _row(name: str, verdicts: list[Verdict]) -> list[str | int | float]:
    tally = Tally(tuple(verdicts))
    ratios = tally.ratios or [float("nan")]
    return [name, len(verdicts), tally.covered, len(tally.ratios), tally.median_ratio, max(ratios), min(ratios)]


if __name__ == "__main__":
    main()
