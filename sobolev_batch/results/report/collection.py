"""Texts and tables of the report of a collection: its league, its pairs of methods, and its objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
import pandas as pd

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.errors import InputError
from sobolev_batch.results.open import open_store
from sobolev_batch.results.report.content import PageTable, Row, common_content
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import tables_of
from sobolev_batch.results.tables.league import (
    LEAGUE_COLUMNS,
    LEAGUE_NOTE,
    PAIR_COLUMNS,
    League,
    leagues_of,
    left_out,
    number_text,
    pair_lines,
    percent_text,
)
from sobolev_batch.results.tables.text import Column, minus, percent

_OBJECT_COLUMNS = (
    Column("object", "object", kind="label"),
    Column("best", "best method", kind="text"),
    Column("relative", "relative", percent, "relative_error"),
    Column("next", "next", kind="text"),
    Column("ratio", "times as far", number_text, is_marked=True),
    Column("meshes", "meshes", "{:,}".format),
    Column("missing", "missing", "{:,}".format),
    Column("above_rtol", "above rtol", "{:,}".format),
)
# The relative distance comes first: a narrow screen shows no more without scrolling.
_LEAGUE_COLUMNS = tuple(sorted(LEAGUE_COLUMNS, key=lambda column: (column.kind != "label", column.name != "relative")))

_NO_LEAGUE = "Methods cannot be compared over the objects."
# Methods that a sentence names.
_MOST_NAMED = 3


def league_content(collection: CollectionStore, status: Status) -> dict[str, Any]:
    """Return what the template of a collection takes, nothing escaped; InputError where no object has tables yet."""
    tables = tables_of(collection.existing_stores)
    try:
        leagues, no_league = leagues_of(tables, collection.objects), ""
    except InputError as error:
        leagues, no_league = (), str(error)
    orders = list(dict.fromkeys(float(s) for frame in tables.values() for s in frame["order"]))
    one = collection.location.below(collection.objects[0])
    by_order = {league.order: league for league in leagues}
    objects = [row for s in orders for row in _object_rows(tables, s, by_order.get(s))]
    ranked, pairs = ([row for league in leagues for row in _rows(league, name)] for name in ("table", "pairs"))
    versions = open_store(collection.location.below(next(iter(tables)))).attrs["versions"]
    return {
        **common_content(collection.title, collection.table, tables, status, status.failed, versions),
        "leagues": leagues,
        "no_league": no_league,
        "sentences": tuple(map(sentence_of, leagues)) or (_NO_LEAGUE,) * len(orders),
        "differences": tuple(tuple(pair_lines(one)) for one in leagues),
        "note": LEAGUE_NOTE.format(x=leagues[0].x).replace("\n", " ") if leagues else "",
        "league": PageTable("league", _LEAGUE_COLUMNS, ranked, [*by_order]),
        "pairs": PageTable("pairs", PAIR_COLUMNS, pairs, [*by_order]) if pairs else None,
        "objects": PageTable("objects", _OBJECT_COLUMNS, objects, orders),
        "omissions": [
            f"single meshes: each object has a report of its own, such as that of {one}",
            *(f"{name}, from the league{where}: {why}" for name, where, why in left_out(leagues)),
        ],
    }


def sentence_of(league: League) -> str:
    """Return a sentence on which method is nearest at one order."""
    table, count = league.table, len(league.objects)
    first, amount = table["method"].iloc[0], percent_text(table["relative"].iloc[0])
    at_order = minus(f"at order {league.order:g}")
    over = f"over {count} objects" if count > 1 else f"on {league.objects[0]}"
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


def _rows(league: League, name: Literal["table", "pairs"]) -> list[Row]:
    """Return the rows of a table of a league, with the colours of the methods."""
    frame: pd.DataFrame = getattr(league, name)
    colors = frame["method"].map(league.methods.index)
    return list(frame.assign(order=league.order, color=colors).to_dict(orient="records"))


def _object_rows(tables: Mapping[str, pd.DataFrame], order: float, league: League | None) -> Iterator[Row]:
    """Yield the objects with their best methods at one order."""
    for name, frame in tables.items():
        meshes = frame[frame["order"] == order]
        known = meshes[meshes["distance"].notna()]
        row = {
            "order": order,
            "object": name,
            "meshes": len(known),
            "missing": len(meshes) - len(known),
            "above_rtol": int((known["resolved"].astype(bool) & ~known["within"].astype(bool)).sum()),
        }
        if league is None or name not in league.objects:
            reason = league.left_out.get(name, "no distances") if league else "methods cannot be compared"
            yield {**row, "absent": f"left out: {reason}"}
        else:
            yield {**row, **_best(league, league.objects.index(name))}


def _best(league: League, number: int) -> Row:
    """Return the best method of an object, and the next one."""
    values, errors = league.values[number], league.errors[number]
    first, *others = np.argsort(values, kind="stable").tolist()
    relative = float(np.exp(values[first]))
    row = {
        "best": league.methods[first],
        "relative": relative,
        "relative_error": relative * float(np.expm1(errors[first])),
    }
    if not others:
        return {**row, "next": "", "ratio": None}
    second = others[0]
    is_open = values[second] - errors[second] < values[first] + errors[first]
    return {
        **row,
        "next": league.methods[second],
        "ratio": float(np.exp(values[second] - values[first])),
        "mark": "within errors" if is_open else "",
    }
