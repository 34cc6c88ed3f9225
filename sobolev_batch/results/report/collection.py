"""Texts and tables of the report of a collection: its league, its pairs of methods, and its objects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pandas as pd

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.errors import InputError
from sobolev_batch.results.league.league import League, leagues_of
from sobolev_batch.results.league.text import (
    LEAGUE_NOTE,
    interval_text,
    left_out,
    number_text,
    pair_lines,
    percent_text,
)
from sobolev_batch.results.open import open_store
from sobolev_batch.results.report.cells import Body, Cell, Heading, PageTable, TableRow
from sobolev_batch.results.report.content import large_count, run_facts, source_text, study_text
from sobolev_batch.results.report.limits import ReportLimits
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import tables_of
from sobolev_batch.results.tables.formatting import Digits, duration, minus

_LEAGUE_HEADINGS = (
    Heading("method", "method", "label"),
    Heading("relative", "relative"),
    Heading("95 % interval", "low", second="high"),
    Heading("rank", "rank", second="last_rank"),
    Heading("rate", "rate"),
    Heading("95 % interval", "rate_low", second="rate_high"),
    Heading("objects", "objects"),
)
_PAIR_HEADINGS = (
    Heading("method", "method", "label"),
    Heading("other", "other", "text"),
    Heading("ratio", "ratio"),
    Heading("95 % interval", "low", second="high"),
    Heading("p", "p"),
    Heading("nearer", "nearer", "text"),
)
_OBJECT_HEADINGS = (
    Heading("object", "object", "label"),
    Heading("best method", "best", "text"),
    Heading("relative", "relative", second="relative_error"),
    Heading("next", "next", "text"),
    Heading("times as far", "ratio"),
    Heading("meshes", "meshes"),
    Heading("missing", "missing"),
    Heading("above rtol", "above_rtol"),
)

_NO_LEAGUE = "Methods cannot be compared over the objects."
# Methods that a sentence names.
_MOST_NAMED = 3


@dataclass(frozen=True)
class CollectionContent:
    """Texts and tables of the report of a collection, none of them escaped.

    Attributes:
        title: Title of the collection.
        name: Name of the collection, for names of files.
        leagues: League of each order; none where methods cannot be compared.
        no_league: Why there is none, else empty.
        sentences: A sentence for each order.
        differences: For each order, a sentence for each pair of methods that differ.
        note: What the numbers of the league mean.
        orders: Orders as they are shown.
        league: Methods, at each order.
        pairs: Pairs of methods, at each order; None where there is one method.
        objects: Objects with their best methods, at each order.
        failed: Reason for each mesh or object that failed or is missing.
        not_compared: Comparisons of each mesh that could not be made, and why.
        summary: Key figures, by keyword.
        settings: Settings of the collection, by keyword.
        run: Facts about the latest run, by keyword.
        versions: Versions, by library.
        study_text: Collection as TOML.
        omissions: What the page leaves out.
    """

    title: str
    name: str
    leagues: tuple[League, ...]
    no_league: str
    sentences: tuple[str, ...]
    differences: tuple[tuple[str, ...], ...]
    note: str
    orders: tuple[str, ...]
    league: PageTable
    pairs: PageTable | None
    objects: PageTable
    failed: PageTable | None
    not_compared: PageTable | None
    summary: Mapping[str, str]
    settings: Mapping[str, str]
    run: Mapping[str, str]
    versions: Mapping[str, str]
    study_text: str
    omissions: tuple[str, ...]

    @classmethod
    def of(cls, collection: CollectionStore, status: Status, limits: ReportLimits) -> Self:
        """Return the content for the store of a collection.

        Raises:
            InputError: No object has tables yet.
        """
        tables = tables_of(collection.begun)
        try:
            leagues, no_league = leagues_of(tables, collection.objects), ""
        except InputError as error:
            leagues, no_league = (), str(error)
        orders = list(dict.fromkeys(float(s) for frame in tables.values() for s in frame["order"]))
        objects = tuple(Body(_object_rows(tables, s, _at(leagues, s)), s) for s in orders)
        pairs = tuple(Body(_pair_rows(one), one.order) for one in leagues)
        shown, failures = limits.reasons, status.failed
        return cls(
            title=collection.title,
            name=collection.name,
            leagues=leagues,
            no_league=no_league,
            sentences=tuple(map(sentence_of, leagues)) or (_NO_LEAGUE,) * len(orders),
            differences=tuple(tuple(pair_lines(one)) for one in leagues),
            note=LEAGUE_NOTE.format(x=leagues[0].x).replace("\n", " ") if leagues else "",
            orders=tuple(minus(f"{s:g}") for s in orders),
            league=PageTable("league", _LEAGUE_HEADINGS, tuple(Body(_league_rows(one), one.order) for one in leagues)),
            pairs=PageTable("pairs", _PAIR_HEADINGS, pairs) if any(body.rows for body in pairs) else None,
            objects=PageTable("objects", _OBJECT_HEADINGS, objects),
            failed=PageTable.of_reasons("failed", "mesh", dict(list(failures.items())[:shown])),
            not_compared=PageTable.of_reasons("lacking", "mesh", dict(list(status.not_compared.items())[:shown])),
            summary=dict(_summary(tables, orders)),
            settings=dict(_settings(collection.table)),
            run=dict(run_facts(status)),
            versions=open_store(collection.location.below(next(iter(tables)))).attrs["versions"],
            study_text=study_text(collection.table),
            omissions=tuple(_omissions(collection, status, leagues, shown)),
        )


def _at(leagues: Sequence[League], order: float) -> League | None:
    return next((one for one in leagues if one.order == order), None)


def sentence_of(league: League) -> str:
    """Return a sentence on which method is nearest at one order."""
    table, count = league.table, len(league.scores.objects)
    first, amount = table["method"].iloc[0], percent_text(table["relative"].iloc[0])
    at_order = minus(f"at order {league.order:g}")
    over = f"over {count} objects" if count > 1 else f"on {league.scores.objects[0]}"
    if len(table) == 1:
        return f"{first} differs from the references by {amount} {over} {at_order}."
    leaders = table[table["rank"] == 1]["method"].tolist()
    if len(leaders) == 1:
        return f"{first} is nearest to the references {over} {at_order}: it differs by {amount}."
    if count == 1:
        return f"{first} is nearest {over} {at_order}: it differs by {amount}. One object ranks no methods."
    names = f"{', '.join(leaders[:-1])} and {leaders[-1]}"
    if len(leaders) > _MOST_NAMED:
        names = f"{len(leaders)} of {len(table)} methods"
    return f"The intervals do not separate {names} {over} {at_order}. {first} has the smallest mean, {amount}."


def _league_rows(league: League) -> tuple[TableRow, ...]:
    return tuple(
        TableRow(
            row.method,
            (
                Cell.of_number(row.relative, percent_text(row.relative)),
                _interval(row.low, row.high, interval_text(row.low, row.high, percent_text)),
                _ranks(row.rank, row.last_rank),
                Cell.of_number(row.rate, number_text(row.rate)),
                _interval(row.rate_low, row.rate_high, interval_text(row.rate_low, row.rate_high, number_text)),
                Cell.of_count(row.objects),
            ),
            league.scores.methods.index(row.method),
        )
        for row in league.table.itertuples()
    )


def _pair_rows(league: League) -> tuple[TableRow, ...]:
    return tuple(
        TableRow(
            row.method,
            (
                Cell.of_text(row.other),
                Cell.of_number(row.ratio, number_text(row.ratio)),
                _interval(row.low, row.high, interval_text(row.low, row.high, number_text)),
                Cell.of_number(row.p, f"{row.p:.2g}"),
                Cell.of_text(row.nearer),
            ),
            league.scores.methods.index(row.method),
        )
        for row in league.pairs.itertuples()
    )


def _ranks(first: int, last: int) -> Cell:
    return Cell(f"{first}" if first == last else f"{first}–{last}", first, second=last)


def _interval(low: float, high: float, text: str) -> Cell:
    """Return the cell of an interval, of which an end may be infinite."""
    return Cell("") if math.isnan(low) else Cell(text, low, second=high)


def _object_rows(tables: Mapping[str, pd.DataFrame], order: float, league: League | None) -> tuple[TableRow, ...]:
    """Return the objects with their best methods at one order."""
    rows = []
    for name, frame in tables.items():
        meshes = frame[frame["order"] == order]
        known = meshes[meshes["distance"].notna()]
        counts = (
            Cell.of_count(len(known)),
            Cell.of_count(len(meshes) - len(known)),
            Cell.of_count(int((known["resolved"].astype(bool) & ~known["within"].astype(bool)).sum())),
        )
        if league is None or name not in league.scores.objects:
            reason = league.scores.left_out.get(name, "no distances") if league else "methods cannot be compared"
            rows.append(TableRow(name, (Cell(f"left out: {reason}"),)))
        else:
            rows.append(TableRow(name, (*_best_cells(league, league.scores.objects.index(name)), *counts)))
    return tuple(rows)


def _best_cells(league: League, number: int) -> tuple[Cell, ...]:
    """Return the cells of the best method of an object, and of the next one."""
    scores = league.scores
    values, errors = scores.values[number], scores.errors[number]
    first, *others = np.argsort(values, kind="stable").tolist()
    relative = float(np.exp(values[first]))
    error = relative * float(np.expm1(errors[first]))
    best = (
        Cell.of_text(scores.methods[first]),
        Cell.of_number(relative, Digits.percent(relative, error).together, second=error),
    )
    if not others:
        return (*best, Cell(""), Cell(""))
    second, ratio = others[0], float(np.exp(values[others[0]] - values[first]))
    is_open = values[second] - errors[second] < values[first] + errors[first]
    mark = "within errors" if is_open else ""
    return (*best, Cell.of_text(scores.methods[second]), Cell.of_number(ratio, number_text(ratio), mark))


def _summary(tables: Mapping[str, pd.DataFrame], orders: Sequence[float]) -> Iterator[tuple[str, str]]:
    once = [frame[frame["order"] == frame["order"].iloc[0]] for frame in tables.values()]
    meshes = pd.concat(once, ignore_index=True)
    yield "objects", f"{len(tables):,}"
    yield "methods", f"{meshes['family'].nunique():,}"
    yield "meshes compared", f"{int(meshes['distance'].notna().sum()):,} of {len(meshes):,}"
    yield "orders" if len(orders) > 1 else "order", minus(", ".join(f"{s:g}" for s in orders))
    yield "triangles in all", large_count(int(meshes["triangles"].sum()))
    yield "computing time", duration(float(meshes["seconds"].sum()))


def _settings(table: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for family in table.get("family", ()):
        yield f"method {family['name']}", source_text(family)
    if "reference" in table:
        yield "reference", source_text(table["reference"])
    if "accuracy" in table:
        yield "accuracy", f"rtol {table['accuracy']['rtol']:g} of every distance to the reference"


def _omissions(collection: CollectionStore, status: Status, leagues: Sequence[League], shown: int) -> Iterator[str]:
    one = collection.location.below(collection.objects[0])
    yield f"single meshes: each object has a report of its own, such as that of {one}"
    yield from (f"{name}, from the league{where}: {why}" for name, where, why in left_out(leagues))
    if len(status.failed) > shown:
        yield f"missing meshes: only {shown:,} of {len(status.failed):,} are listed"
