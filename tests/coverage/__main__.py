"""Run the coverage check: python -m tests.coverage [--seed N] [--cases N] [--first N] [--kind KIND ...]."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import click
import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch import distance, fourier_transform, norm
from sobolev_batch.errors import AccuracyError
from sobolev_batch.norms.estimate import PARTS
from tests.coverage.cases import KINDS, Case, all_cases

LEAST_COVERED, LARGEST_MEDIAN = 0.99, 10.0
_SLOWEST = 10
# A case is telling if its true error is more than this many times the uncertainty of the truth.
_TELLING = 10.0
# Memory for an rtol, so that hundreds of cases take minutes.
_MEMORY = 500_000_000
# A larger rtol is no answer.
_LARGEST_RTOL = 0.5
# Accuracies that should be within reach: at orders up to this one, from this rtol on.
_EXPECTED_ORDER, _EXPECTED_RTOL = -1.0, 1e-2


@click.command()
@click.option("--seed", default=0, show_default=True, help="Seed of the random cases.")
@click.option("--cases", "count", default=465, show_default=True, help="Least number of cases.")
@click.option("--first", default=0, show_default=True, help="Number of the first pair, as rows tell it.")
@click.option("--kind", "kinds", type=click.Choice(tuple(KINDS)), multiple=True, help="Only pairs of this kind.")
def main(count: int, seed: int, first: int, kinds: tuple[str, ...]) -> None:
    """Compare reported errors with true ones over random cases; status 1 if they fall short."""
    rows = []
    for cases in all_cases(seed, count, kinds or tuple(KINDS), first):
        for row in judge(cases):
            click.echo(described(row))
            rows.append(row)
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


def described(row: Mapping[str, Any]) -> str:
    refused = "" if np.isnan(row["refused"]) else f"refused, offered {row['refused']:.2g}: "
    parts = ", ".join(f"{name} {row[name]:.2g}" for name in PARTS)
    ratio = abs(row["value"] - row["truth"]) / row["reported"] if row["reported"] else np.nan
    return (
        f"{row['case']}: {refused}{row['value']:.8g} ± {row['reported']:.2g} ({parts}), "
        f"truly {row['truth']:.8g} ± {row['uncertainty']:.1g}; off/error {ratio:.2g}, {row['seconds']:.1f} s"
    )


def judge(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Measure the cases of one pair, without those of whose truth nothing is known.

    Returns:
        A row for each case: the `case`, its `kind` and `order`; the reported distance as `value`, its error as
        `reported`, and the parts of it; the true distance as `truth`, and its `uncertainty`; the processor time as
        `seconds`, in equal shares for orders that are asked together. If the accuracy is refused, `refused` is the rtol
        that is offered in its place, and the distance is measured to one and a half of that; it is `broken` if that is
        refused too.
    """
    truths = cases[0].pair.truths([case.order for case in cases])
    known = [(case, truth) for case, truth in zip(cases, truths, strict=True) if truth is not None]
    groups = [known] if cases[0].together and known else [[each] for each in known]
    rows: list[dict[str, Any]] = []
    for group in groups:
        asked = _asked([case for case, _ in group])
        for (case, truth), row in zip(group, asked, strict=True):
            about = {"case": case, "kind": case.kind, "order": case.order}
            rows.append(about | row | {"truth": truth.value, "uncertainty": truth.uncertainty})
    return rows


def _asked(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Return what one call that asks for all of some cases finds, or refuses."""
    found: list[dict[str, Any]] = [dict.fromkeys(("value", "reported", *PARTS), np.nan) for _ in cases]
    row: dict[str, Any] = {"measured": True, "refused": np.nan, "broken": False}
    start = time.process_time()
    try:
        found = _measured(cases, cases[0].settings)
    except AccuracyError as refusal:
        row |= {"refused": refusal.reachable, "measured": False}
        if 1.5 * refusal.reachable <= _LARGEST_RTOL:
            try:
                found, row["measured"] = _measured(cases, {"rtol": 1.5 * refusal.reachable}), True
            except AccuracyError:
                row["broken"] = True
    return [row | {"seconds": (time.process_time() - start) / len(cases)} | each for each in found]


def _measured(cases: Sequence[Case], settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    found: xr.Dataset
    surfaces, orders = cases[0].pair.surfaces, [case.order for case in cases]
    name = "norm" if cases[0].pair.alone else "distance"
    if cases[0].pair.alone:
        found = norm(surfaces[0], orders, memory=_MEMORY, **settings)
    elif "rtol" in settings:
        found = distance(*surfaces, orders, memory=_MEMORY, **settings)
    else:
        a, b = (fourier_transform(surface, order=orders, **settings) for surface in surfaces)
        found = distance(a, b, orders)
    rows = []
    for at in (found.sel(order=order) for order in orders):
        parts = {part: at["error_part"].sel(part=part).item() for part in PARTS}
        rows.append({"value": at[name].item(), "reported": at["error"].item(), **parts})
    return rows


def judged(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return a table of rows, with whether reported errors cover true ones.

    The true error is as uncertain as the truth. A case is `covered` if it may be covered within that uncertainty; NaN
    never covers. Its `ratio` is the reported error over the true one, where the true one is ten times as large as the
    uncertainty, and so tells something. A refusal is `unexpected` if the accuracy should have been within reach.
    """
    table = pd.DataFrame(rows)
    true_error = (table["value"] - table["truth"]).abs()
    table["covered"] = true_error <= table["reported"] + table["uncertainty"]
    table["ratio"] = (table["reported"] / true_error).where(true_error > _TELLING * table["uncertainty"])
    rtols = pd.Series([case.settings.get("rtol", 0.0) for case in table["case"]])
    within_reach = (rtols >= _EXPECTED_RTOL) & (table["order"] <= _EXPECTED_ORDER)
    table["unexpected"] = table["refused"].notna() & within_reach
    return table


if __name__ == "__main__":
    main()
