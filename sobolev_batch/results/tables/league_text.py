"""Leagues and changes as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import pandas as pd

from sobolev_batch.results.tables import Format
from sobolev_batch.results.tables.league import League
from sobolev_batch.results.tables.statistics import least_objects
from sobolev_batch.results.tables.text import Column, column_table, machine_table, prose

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


def percent_text(value: float) -> str:
    """Return a fraction in per cent, with ? for one that nothing bounds."""
    return "" if math.isnan(value) else "?" if math.isinf(value) else f"{100 * value:.3g} %"


def number_text(value: float) -> str:
    """Return a number with three digits, with ? for one that nothing bounds."""
    return "" if math.isnan(value) else "?" if math.isinf(value) else f"{value:.3g}"


def _interval(shown: Callable[[float], str]) -> Callable[[float, float], str]:
    """Return the format of intervals, with ? for an end that nothing bounds."""
    return lambda low, high: f"{shown(low)} to {shown(high)}"


LEAGUE_COLUMNS = (
    Column("method", "method", kind="label"),
    Column("rank", "rank", lambda first, last: f"{first}" if first == last else f"{first}-{last}", "last_rank"),
    Column("relative", "relative", percent_text),
    Column("low", "95 % interval", _interval(percent_text), "high"),
    Column("rate", "rate", number_text),
    Column("rate_low", "95 % interval", _interval(number_text), "rate_high"),
    Column("objects", "objects"),
)
PAIR_COLUMNS = (
    Column("method", "method", kind="label"),
    Column("other", "other", kind="text"),
    Column("ratio", "ratio", number_text),
    Column("low", "95 % interval", _interval(number_text), "high"),
    Column("p", "p", "{:.2g}".format),
    Column("nearer", "nearer", kind="text"),
)
_CHANGE_COLUMNS = (
    Column("method", "method"),
    Column("verdict", "verdict"),
    Column("ratio", "new/old", number_text),
    Column("low", "95 % interval", _interval(number_text), "high"),
    Column("p", "p", "{:.2g}".format),
    Column("meshes", "meshes"),
    Column("worst_ratio", "largest new/old", lambda ratio, mesh: f"{number_text(ratio)}, {mesh}", "worst"),
)


def format_league(leagues: Sequence[League], style: Format = "text") -> str:
    """Return leagues as text; see `league`."""
    if style in ("csv", "json"):
        frames = [league.table.assign(order=league.order) for league in leagues]
        frame = pd.concat(frames, ignore_index=True)
        return machine_table(frame[["order", *frame.columns.drop("order")]], style)
    sections = []
    for league in leagues:
        count = len(league.scores.objects)
        caption = prose([f"League at order {league.order:g}, over {count} object{'s' if count > 1 else ''}"], style)
        table = column_table(LEAGUE_COLUMNS[:-1], league.table.to_dict(orient="records"), style)
        sections += [caption, table, prose(pair_lines(league), style)]
    notes = LEAGUE_NOTE.format(x=leagues[0].x).splitlines()
    notes += [f"{name} is left out{where}: {reason}." for name, where, reason in left_out(leagues)]
    return "\n\n".join([*filter(None, sections), prose(notes, style)])


def left_out(leagues: Sequence[League]) -> Iterator[tuple[str, str, str]]:
    """Yield the objects that leagues leave out, at which of their orders (nothing for all of them), and why."""
    orders: dict[tuple[str, str], list[float]] = {}
    for league in leagues:
        for name, reason in league.scores.left_out.items():
            orders.setdefault((name, reason), []).append(league.order)
    for (name, reason), at in orders.items():
        where = "" if len(at) == len(leagues) else f" at order {', '.join(f'{s:g}' for s in at)}"
        yield name, where, reason


def format_changes(changes: pd.DataFrame, style: Format = "text") -> str:
    """Return the result of `compare_studies` as text."""
    if style in ("csv", "json"):
        return machine_table(changes, style)
    sections = []
    for order, frame in changes.groupby("order", sort=False):
        sections += [
            prose([f"New study against the old one at order {order:g}"], style),
            column_table(_CHANGE_COLUMNS, frame.to_dict(orient="records"), style),
        ]
    units = "objects" if (changes["objects"] > 1).all() else "meshes"
    notes = _CHANGES_NOTE.format(units=units).splitlines()
    least = least_objects(changes["method"].nunique())
    if (changes[units] < least).any():
        notes.append(f"With fewer than {least} {units}, the test decides nothing; look at the intervals.")
    return "\n\n".join([*sections, prose(notes, style)])


def pair_lines(league: League) -> list[str]:
    """Return a line for each pair of methods that differ."""
    lines = []
    for row in league.pairs.itertuples():
        if row.nearer:
            farther, ratio = (row.other, 1 / row.ratio) if row.nearer == row.method else (row.method, row.ratio)
            lines.append(f"{row.nearer} is {ratio:.3g} times nearer than {farther} (p = {row.p:.2g}).")
    count, methods = len(league.scores.objects), len(league.table)
    if not lines and methods > 1:
        least = least_objects(len(league.pairs))
        lines.append(
            "No two methods differ beyond chance and error."
            if count >= least
            else f"The test cannot tell {methods} methods from chance with {count} object{'s' if count > 1 else ''}; "
            f"take {least} or more."
        )
    return lines
