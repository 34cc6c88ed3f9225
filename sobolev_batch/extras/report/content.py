"""Texts and tables of a report: of one object, with its verdict, and of several, with their league."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
import tomli_w
import xarray as xr

from sobolev_batch.batch.status import Status
from sobolev_batch.errors import InputError
from sobolev_batch.extras.leagues.costs import COST_NOTE, METHOD_COLUMNS, CostLeague, cost_leagues_of, front_columns
from sobolev_batch.extras.leagues.league import (
    PAIR_COLUMNS,
    RELATIVE,
    League,
    league_columns,
    league_note,
    leagues_of,
    left_out,
    pair_lines,
)
from sobolev_batch.store.objects import Objects
from sobolev_batch.tables.conclusion import TOTALS, VERDICT_COLUMNS, TableRow, counted, study_verdict
from sobolev_batch.tables.convergence import CONNECTION_COLUMNS, MESH, page_columns, tables_of, unit_notes, with_remarks
from sobolev_batch.tables.open import doubts_of, finished_group, open_store, root_attribute, similarity_of
from sobolev_batch.tables.rendering import Column, filled
from sobolev_batch.tables.text import minus, number_text, percent
from sobolev_batch.transform.lattice import Lattice

# Rows of all convergence tables together, of the table of meshes, and of reasons; browsers become slow beyond.
MOST_CONVERGENCE_ROWS, MOST_MESH_ROWS, _MOST_REASONS = 10_000, 5_000, 2_000

_COUNTS = ["vertices", "triangles", "points", *(column.name for column in CONNECTION_COLUMNS)]
_REASON_COLUMNS = MESH, Column("reason", "reason", kind="text")
_MESH_COLUMNS = (
    MESH,
    Column("vertices", "vertices", "{:,.0f}".format),
    Column("triangles", "triangles", "{:,.0f}".format),
    Column("seconds", "seconds", "{:.2f}".format),
    Column("backend", "backend", kind="text"),
    Column("area", "area", "{:.4g}".format),
    *CONNECTION_COLUMNS,
    Column("points", "quadrature points", "{:,.0f}".format),
    Column("worker", "worker", kind="text"),
    Column("finished", "finished, UTC", kind="text"),
)
_OBJECT_COLUMNS = (
    Column("object", "object", kind="label"),
    Column("best", "best method", kind="text"),
    Column("relative", "relative", percent, "relative_error"),
    Column("next", "next", kind="text"),
    Column("ratio", "times as far", number_text, is_marked=True),
    *(Column(name, name.replace("_", " "), "{:,}".format) for name in TOTALS),
)
# The relative distance comes first: a narrow screen shows no more without scrolling.
_LEAGUE_COLUMNS = tuple(sorted(league_columns(RELATIVE), key=lambda one: (one.kind != "label", one.name != RELATIVE)))


@dataclass(frozen=True)
class PageTable:
    """A table of a page.

    Attributes:
        name: Name, for its address on the page and for the file of its CSV.
        columns: Columns, that of the labels first.
        rows: Rows; those of an order follow each other.
        orders: Orders of the rows; None where they belong to all.
        is_sortable: True where clicks on the heads sort it.
        omitted: Number of rows that a page has no room for.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[TableRow]
    orders: Sequence[float] | None = None
    is_sortable: bool = True
    omitted: int = 0

    @property
    def bodies(self) -> list[tuple[float | None, str, list[TableRow]]]:
        """Each order, its text and its rows."""
        if self.orders is None:
            return [(None, "", list(self.rows))]
        return [(s, minus(f"{s:g}"), [row for row in self.rows if row["order"] == s]) for s in self.orders]


def reasons_table(name: str, reasons: Mapping[str, str]) -> PageTable | None:
    """Return the table of reasons by mesh; None where there are none."""
    rows = [{"mesh": label, "reason": reason} for label, reason in list(reasons.items())[:_MOST_REASONS]]
    omitted = len(reasons) - len(rows)
    return PageTable(name, _REASON_COLUMNS, rows, is_sortable=False, omitted=omitted) if rows else None


def common_content(
    study: Mapping[str, Any], frames: Mapping[str, pd.DataFrame], status: Status, failed: Mapping[str, str]
) -> dict[str, Any]:
    """Return what the pages of one object and of several both show.

    The study is the table of its file, the frames are the rows of `table` of each object, failures have reasons by
    label.
    """
    rows, header = pd.concat(frames.values(), ignore_index=True), study["study"]
    return {
        "title": header.get("title") or header["name"],
        "name": header["name"],
        "orders": [minus(f"{order:g}") for order in rows["order"].drop_duplicates()],
        "objects_in_all": len(frames) if "object" in study else 0,
        "meshes_in_all": rows[rows["order"].isin(rows["order"].head(1))],
        "failed": reasons_table("failed", failed),
        "not_compared": reasons_table("lacking", status.not_compared),
        "status": status,
        "study_text": tomli_w.dumps(_without_nulls(study)),
    }


def _without_nulls(value: Any) -> Any:
    """TOML has no null; keys without a value are left out."""
    if isinstance(value, Mapping):
        return {key: _without_nulls(entry) for key, entry in value.items() if entry is not None}
    return [_without_nulls(entry) for entry in value] if isinstance(value, list) else value


def study_content(tree: xr.DataTree, status: Status) -> dict[str, Any]:
    """Return what the template of an open store takes, nothing escaped; InputError where it has no tables yet."""
    meshes, convergence = finished_group(tree, "meshes"), finished_group(tree, "convergence")
    settings, frames = root_attribute(tree, "study"), tables_of(tree)
    families = tuple(dict.fromkeys(meshes["family"].values.tolist()))
    frame, study = frames[""], settings["table"]
    missing = meshes.sel(mesh=meshes["status"] != "complete")
    failed = dict(zip(missing["mesh"].values.tolist(), missing["reason"].values.tolist(), strict=True))
    sentences, rows, omitted = study_verdict(frame, failed)
    orders = frame["order"].drop_duplicates().tolist()
    return {
        **common_content(study, frames, status, failed),
        "versions": root_attribute(tree, "versions"),
        **cost_content({str(study["study"]["name"]): frame}, families),
        "reference": convergence.attrs["reference"],
        "settings": settings,
        "lattice": Lattice(**settings["lattice"]),
        "similarity": similarity_of(tree),
        "sentences": sentences,
        "verdict": PageTable("verdict", filled(VERDICT_COLUMNS, rows), rows, orders, is_sortable=False),
        "verdict_omitted": omitted,
        "convergence": convergence_table(tree, frame, families, MOST_CONVERGENCE_ROWS // convergence.sizes["order"]),
        "meshes": _meshes_table(meshes, families),
        "omissions": [f"verdict: only {omitted} are shown"] if omitted else [],
        "doubtful": reasons_table("doubtful", doubts_of(tree)),
        "rtol": convergence.attrs.get("rtol"),
        "has_proximity": "proximity" in tree.children,
        "units": " ".join(unit_notes([tree])),
    }


def convergence_table(tree: xr.DataTree, frame: pd.DataFrame, families: Sequence[str], most: int) -> PageTable:
    """Return the convergence table of an open store, from the rows of `table`, with a limited number of each order."""
    orders, most = frame["order"].drop_duplicates().tolist(), max(1, most)
    longest = int(frame.groupby("order").size().max()) if len(frame) else 0
    rows = with_remarks(frame).groupby("order", sort=False).head(most)
    rows = rows.assign(color=rows["family"].map(families.index), reasons="failed")
    omitted, records = max(0, longest - most), rows.to_dict(orient="records")
    return PageTable("convergence", page_columns(records), records, orders, omitted=omitted)


def _meshes_table(meshes: xr.Dataset, families: Sequence[str]) -> PageTable:
    frame = meshes.reset_coords().to_dataframe().reset_index()
    # Surfaces in closed form have no counts.
    rows = frame[:MOST_MESH_ROWS].assign(
        **{name: frame[name].astype(object).where(frame["triangles"] > 0, None) for name in _COUNTS},
        color=frame["family"].map(families.index),
        finished=frame["finished"].dt.strftime("%Y-%m-%d %H:%M:%S").fillna(""),
    )
    return PageTable("meshes", _MESH_COLUMNS, rows.to_dict(orient="records"), omitted=len(frame) - len(rows))


def league_content(objects: Objects, status: Status) -> dict[str, Any]:
    """Return what the template of a league takes, nothing escaped; InputError where no object has tables yet."""
    tables = tables_of(objects.location)
    try:
        leagues, no_league = leagues_of(tables, objects.names), ""
    except InputError as error:
        leagues, no_league = (), str(error)
    deviations = list[TableRow]()
    with suppress(InputError):
        deviations = [row for one in leagues_of(tables, objects.names, y="hausdorff") for row in _rows(one, "table")]
    orders = list(dict.fromkeys(float(s) for frame in tables.values() for s in frame["order"]))
    one = objects.location.below(objects.names[0])
    by_order = {league.order: league for league in leagues}
    of_objects = [row for s in orders for row in _object_rows(tables, s, by_order.get(s))]
    of_objects.sort(key=lambda row: (orders.index(row["order"]), -row["missing"], -row.get("relative", np.inf)))
    ranked, pairs = ([row for league in leagues for row in _rows(league, name)] for name in ("table", "pairs"))
    methods = leagues[0].methods if leagues else list(dict.fromkeys(pd.concat(tables.values())["family"]))
    versions = root_attribute(open_store(objects.location.below(next(iter(tables)))), "versions")
    unfinished = {name: "it has no tables yet; run the study again" for name in objects.names if name not in tables}
    missing = unfinished | dict(status.failed)
    return {
        **common_content(objects.table, tables, status, missing),
        "versions": versions,
        **cost_content(tables, methods),
        "leagues": leagues,
        "sentences": [league.verdict(lambda order: minus(f"{order:g}")) for league in leagues],
        "no_league": no_league,
        "differences": tuple(tuple(pair_lines(one)) for one in leagues),
        "note": league_note(leagues).replace("\n", " ") if leagues else "",
        "league": PageTable("league", _LEAGUE_COLUMNS, ranked, [*by_order]),
        "deviations": PageTable("deviations", league_columns("hausdorff"), deviations),
        "unit": next(iter(tables.values())).attrs["unit"],
        "pairs": PageTable("pairs", PAIR_COLUMNS, pairs, [*by_order]) if pairs else None,
        "objects": PageTable("objects", _OBJECT_COLUMNS, of_objects, orders),
        "omissions": [
            f"single meshes: each object has a report of its own, such as that of {one}",
            *(f"{name}, from the league{where}: {why}" for name, where, why in left_out(leagues)),
        ],
    }


def cost_content(tables: Mapping[str, pd.DataFrame], methods: Sequence[str]) -> dict[str, Any]:
    """Return the leagues by cost of objects, from the rows of `table` of each; none where no cost is known."""
    leagues: Sequence[CostLeague] = ()
    with suppress(InputError):
        leagues = cost_leagues_of(tables, tables, methods)
    found = {name: [row for one in leagues for row in _rows(one, name)] for name in ("table", "front")}
    orders = [one.order for one in leagues]
    return {
        "costs": leagues,
        "cost_methods": PageTable("cost-methods", METHOD_COLUMNS, found["table"], orders),
        "cost_front": PageTable("cost-front", front_columns(), found["front"], orders),
        "cost_note": COST_NOTE.replace("\n", " "),
    }


def _rows(league: League | CostLeague, name: Literal["table", "pairs", "front"]) -> list[TableRow]:
    """Return the rows of a table of a league, with the colours of the methods."""
    frame: pd.DataFrame = getattr(league, name)
    colors = frame["method"].map(list(league.methods).index)
    return list(frame.assign(order=league.order, color=colors).to_dict(orient="records"))


def _object_rows(tables: Mapping[str, pd.DataFrame], order: float, league: League | None) -> Iterator[TableRow]:
    """Yield the objects with their best methods at one order."""
    places = {} if league is None else {name: place for place, name in enumerate(league.objects)}
    for name, frame in tables.items():
        row = {"order": order, "object": name, **counted(frame[frame["order"] == order]).sum().to_dict()}
        if league is None or name not in places:
            reason = league.left_out.get(name, "no distances") if league else "methods cannot be compared"
            yield {**row, "absent": f"left out: {reason}"}
        else:
            yield {**row, **_best(league, places[name])}


def _best(league: League, number: int) -> TableRow:
    """Return the best method of an object, and the next one."""
    values, errors = league.values[number], league.errors[number]
    first, *others = np.argsort(values, kind="stable").tolist()
    relative, error = float(np.exp(values[first])), float(np.expm1(errors[first]))
    row = {"best": league.methods[first], "relative": relative, "relative_error": relative * error}
    if not others:
        return {**row, "next": "", "ratio": None}
    second = others[0]
    is_open = values[second] - errors[second] < values[first] + errors[first]
    ratio, mark = float(np.exp(values[second] - values[first])), "within errors" if is_open else ""
    return {**row, "next": league.methods[second], "ratio": ratio, "mark": mark}
