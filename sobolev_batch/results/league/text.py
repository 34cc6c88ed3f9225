"""Leagues and changes as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import pandas as pd

from sobolev_batch.results.league.league import League
from sobolev_batch.results.league.statistics import least_objects
from sobolev_batch.results.tables.defaults import Format
from sobolev_batch.results.tables.text import machine_table, printed_table, prose

LEAGUE_NOTE = """\
Relative distances are geometric means over the objects, at equal {x}. Their 95 % intervals
leave out what the objects themselves differ by, and hold the errors of the distances. A rank
such as 1-3 says which places the intervals allow. Rates are orders of convergence in the edge
length. Two methods differ where the permutation test of pairs says so, at the level of 5 %
for all pairs together."""
_CHANGES_NOTE = """\
A ratio below 1 says that the new study is nearer to the references. It is the geometric mean
over the {units}, with its 95 % interval. The verdict is that of the permutation test of pairs, at
the level of 5 % for all methods together."""


def format_league(leagues: Sequence[League], style: Format = "text") -> str:
    """Return leagues as text; see `league`."""
    if style in ("csv", "json"):
        frames = [one.table.assign(order=one.order) for one in leagues]
        frame = pd.concat(frames, ignore_index=True)
        return machine_table(frame[["order", *frame.columns.drop("order")]], style)
    sections = []
    for one in leagues:
        count = len(one.scores.objects)
        caption = prose([f"League at order {one.order:g}, over {count} object{'s' if count > 1 else ''}"], style)
        rows = [
            [
                row.method,
                f"{row.rank}" if row.rank == row.last_rank else f"{row.rank}-{row.last_rank}",
                percent_text(row.relative),
                interval_text(row.low, row.high, percent_text),
                number_text(row.rate),
                interval_text(row.rate_low, row.rate_high, number_text),
            ]
            for row in one.table.itertuples()
        ]
        headers = ["method", "rank", "relative", "95 % interval", "rate", "95 % interval"]
        sections += [caption, printed_table(rows, headers, style), prose(pair_lines(one), style)]
    notes = LEAGUE_NOTE.format(x=leagues[0].x).splitlines()
    notes += [f"{name} is left out{where}: {reason}." for name, where, reason in left_out(leagues)]
    return "\n\n".join([*filter(None, sections), prose(notes, style)])


def left_out(leagues: Sequence[League]) -> Iterator[tuple[str, str, str]]:
    """Yield the objects that leagues leave out, at which of their orders (nothing for all of them), and why."""
    orders: dict[tuple[str, str], list[float]] = {}
    for one in leagues:
        for name, reason in one.scores.left_out.items():
            orders.setdefault((name, reason), []).append(one.order)
    for (name, reason), at in orders.items():
        where = "" if len(at) == len(leagues) else f" at order {', '.join(f'{s:g}' for s in at)}"
        yield name, where, reason


def format_changes(changes: pd.DataFrame, style: Format = "text") -> str:
    """Return the result of `compare_studies` as text."""
    if style in ("csv", "json"):
        return machine_table(changes, style)
    sections = []
    for order, frame in changes.groupby("order", sort=False):
        rows = [
            [
                row.method,
                row.verdict,
                number_text(row.ratio),
                interval_text(row.low, row.high, number_text),
                f"{row.p:.2g}",
                f"{row.meshes}",
                f"{number_text(row.worst_ratio)}, {row.worst}",
            ]
            for row in frame.itertuples()
        ]
        headers = ["method", "verdict", "new/old", "95 % interval", "p", "meshes", "largest new/old"]
        sections += [
            prose([f"New study against the old one at order {order:g}"], style),
            printed_table(rows, headers, style),
        ]
    units = "objects" if (changes["objects"] > 1).all() else "meshes"
    notes = _CHANGES_NOTE.format(units=units).splitlines()
    least = least_objects(changes["method"].nunique())
    if (changes[units] < least).any():
        notes.append(f"With fewer than {least} {units}, the test decides nothing; look at the intervals.")
    return "\n\n".join([*sections, prose(notes, style)])


def pair_lines(one: League) -> list[str]:
    """Return a line for each pair of methods that differ."""
    lines = []
    for row in one.pairs.itertuples():
        if row.nearer:
            farther, ratio = (row.other, 1 / row.ratio) if row.nearer == row.method else (row.method, row.ratio)
            lines.append(f"{row.nearer} is {ratio:.3g} times nearer than {farther} (p = {row.p:.2g}).")
    count, methods = len(one.scores.objects), len(one.table)
    if not lines and methods > 1:
        least = least_objects(len(one.pairs))
        lines.append(
            "No two methods differ beyond chance and error."
            if count >= least
            else f"The test cannot tell {methods} methods from chance with {count} object{'s' if count > 1 else ''}; "
            f"take {least} or more."
        )
    return lines


def percent_text(value: float) -> str:
    """Return a fraction in per cent, with ? for one that nothing bounds."""
    return "" if math.isnan(value) else "?" if math.isinf(value) else f"{100 * value:.3g} %"


def number_text(value: float) -> str:
    """Return a number with three digits, with ? for one that nothing bounds."""
    return "" if math.isnan(value) else "?" if math.isinf(value) else f"{value:.3g}"


def interval_text(low: float, high: float, shown: Callable[[float], str]) -> str:
    """Return an interval, with ? for an end that nothing bounds."""
    return "" if math.isnan(low) else f"{shown(low)} to {shown(high)}"
