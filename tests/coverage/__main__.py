"""Run the whole coverage check: python -m tests.coverage [--seed N] [--cases N]."""

from __future__ import annotations

import sys
from typing import Any

import click
import pandas as pd

from tests.coverage.cases import all_cases
from tests.coverage.judging import PARTS, judge, judged

LEAST_COVERED, LARGEST_MEDIAN = 0.99, 30.0
_SLOWEST = 10


@click.command()
@click.option("--seed", default=0, show_default=True, help="Seed of the random cases.")
@click.option("--cases", "count", default=420, show_default=True, help="Least number of cases.")
def main(count: int, seed: int) -> None:
    """Compare reported errors with true ones over random cases; status 1 if they fall short."""
    pairs = list(all_cases(seed, count))
    with click.progressbar(pairs, label=f"{len(pairs)} pairs", file=sys.stderr) as shown:
        rows = [row for cases in shown for row in judge(cases)]
    sys.exit(not show(judged(rows)))


def show(table: pd.DataFrame) -> bool:
    """Print all that was found; tell whether the errors keep their promise."""
    measured, refused = table[table["measured"]], table[table["refused"].notna()]
    columns = {"cases": ("covered", "size"), "covered": ("covered", "sum"), "telling": ("ratio", "count")}
    columns |= {f"{name} ratio": ("ratio", name) for name in ("median", "max", "min")}
    for by in (["kind", "order"], ["kind"], ["order"], lambda _: "all"):
        summary = measured.groupby(by).agg(**columns)
        click.echo(summary.to_string(float_format="{:.3g}".format))
    for row in measured[~measured["covered"]].to_dict("records"):
        click.echo(f"not covered: {described(row)}")
    for row in refused[refused["unexpected"] | refused["broken"]].to_dict("records"):
        kept = ", and refused that too" if row["broken"] else ""
        click.echo(f"refused: {row['case']}: offered {row['refused']:.2g}{kept}")
    for row in table.nlargest(_SLOWEST, "seconds").to_dict("records"):
        click.echo(f"{row['seconds']:.1f} s: {row['case']}")
    share, median = measured["covered"].mean(), measured["ratio"].median()
    click.echo(
        f"covered {100 * share:.2f} % of {len(measured)}, median ratio {median:.3g}, "
        f"{len(refused)} refused, {refused['unexpected'].sum()} of them unexpectedly"
    )
    return bool(share >= LEAST_COVERED and median <= LARGEST_MEDIAN)


def described(row: dict[str, Any]) -> str:
    """Return a line that identifies a case and what came of it."""
    parts = ", ".join(f"{name} {row[name]:.2g}" for name in PARTS)
    return (
        f"{row['case']}: {row['value']:.8g} ± {row['reported']:.2g} ({parts}), "
        f"truly {row['truth']:.8g} ± {row['uncertainty']:.1g}"
    )


if __name__ == "__main__":
    main()
