"""The report of a store: one HTML page that needs no other files, with the data of its charts."""

import base64
import gzip
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from sobolev_batch.batch.status import status
from sobolev_batch.errors import InputError, from_extra, write_file
from sobolev_batch.extras.leagues.costs import CostLeague
from sobolev_batch.extras.leagues.evolution import evolution, has_times
from sobolev_batch.extras.leagues.league import League
from sobolev_batch.extras.leagues.statistics import label_of
from sobolev_batch.parameters import path_of
from sobolev_batch.shown import together
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import utc_now
from sobolev_batch.store.objects import Objects
from sobolev_batch.tables.convergence import table, with_remarks
from sobolev_batch.tables.open import (
    AnyStore,
    as_tree,
    complete_meshes,
    finished_group,
    location_of,
    reference_of,
    require_unchanged,
    root_attribute,
    study_unit,
    unit_of,
)
from sobolev_batch.tables.text import duration, minus
from sobolev_batch.visible import visible

with from_extra("report", "a report needs"):
    import jinja2
    import plotly.offline
    from jinja2.utils import htmlsafe_json_dumps

    from sobolev_batch.extras.figures.drawing import MOST_MESHES, clustered_order
    from sobolev_batch.extras.figures.selection import Selection, families_of, is_sequence, pairs_of
    from sobolev_batch.extras.figures.views import Axis, MeshView, make_views
    from sobolev_batch.extras.report.content import PageTable, league_content, study_content

# Points of all convergence charts together, and numbers of all matrices: 10 bytes each, on a page of up to 15 MB.
MOST_POINTS, MOST_NUMBERS = 50_000, 400_000

Json = dict[str, Any]


def report(
    store: AnyStore,
    path: str | Path,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis | None = None,
) -> Path:
    """Write the report of a store as one HTML page, with tables, plots and meshes, that makes no requests.

    The page of several objects has the league of their methods, and the best method for each object. Needs the
    extra "report".

    Args:
        store: Path, URL or opened DataTree of the store, or path or URL of that of several objects.
        path: File to write.
        folder: Folder where relative paths in the study start; the study makes some meshes again, to be shown.
        witnesses: Labels of those meshes, in the store of one object, or patterns such as "scans/*"; by default a few
            that are chosen by their distances.
        up: Axis that points upwards in the meshes' own coordinates; default the one that they seem to rest on, y or z.

    Returns:
        The path of the page.

    Raises:
        InputError: A library of the extra is not installed, the store has no tables yet, a label is unknown, or meshes
            are named in the store of several objects.
        StoreError: The location has no store of a study, or the page cannot be written.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> sb.report("storage/icosphere.zarr", "report.html").name  # doctest: +SKIP
    'report.html'
    """
    output = path_of(path)
    write_file(output, make_report(store, folder=folder, witnesses=witnesses, up=up)[0].encode(), "the report")
    return output


def make_report(
    store: AnyStore, *, folder: str | Path = ".", witnesses: Sequence[str] = (), up: Axis | None = None
) -> tuple[str, tuple[str, ...]]:
    """Return the report of a store, and what it leaves out, for people; see `report`."""
    objects = Objects.read(Location.parse(location_of(store)))
    if objects is None:
        tree = as_tree(store)
        content = study_content(tree, status(store))
        selection = Selection.from_store(tree)
        spectra = selection.spectra if selection.has_spectra else None
        omission = "" if spectra is None else spectra.attrs["omission"]
        views, missing = make_views(tree, folder, witnesses, up=up)
        charts = {**chart_data(tree, spectra, views), "costs": cost_data(content["costs"])}
        # Who names meshes leaves out the others.
        content["omissions"] += chart_omissions(tree, charts, omission, () if witnesses else views, missing)
        page = filled("study", content, charts, omission=omission, views=views, missing=missing)
        require_unchanged(tree)
        return page
    if witnesses:
        one = objects.location.below(objects.names[0])
        raise InputError(f"{objects.location}: meshes are shown in the report of one object, such as {one}")
    content = league_content(objects, status(store))
    charts = league_data(content["leagues"], content["name"], content["orders"])
    families = content["costs"][0].methods if content["costs"] else charts["families"]
    return filled("league", content, {**charts, "families": list(families), "costs": cost_data(content["costs"])})


def filled(template: str, content: dict[str, Any], charts: Json, **values: Any) -> tuple[str, tuple[str, ...]]:
    """Return a page from its template, with all that it needs to be drawn, and what it leaves out."""
    # Two thirds of a page, if the browser were not to unpack it.
    library = plotly.offline.get_plotlyjs()
    scripts = [_page_file("tables.js"), _page_file("charts.js")]
    text = page_template(template).render(
        content=content,
        charts=charts,
        data=htmlsafe_json_dumps(_shown_data(charts), allow_nan=False, separators=(",", ":")),
        style=_page_file("report.css"),
        library=base64.b64encode(gzip.compress(library.encode("utf-8"), mtime=0)).decode("ascii"),
        scripts=scripts,
        # Whatever names and reasons contain, the browser runs no other script and fetches nothing.
        policy=f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
        f"script-src {' '.join(map(_digest, [library, *scripts]))}; base-uri 'none'; form-action 'none'",
        written=utc_now(),
        **values,
    )
    tables = [table for table in content.values() if isinstance(table, PageTable) and table.omitted]
    return text, (*(f"the table {one.name}: {one.omitted:,} more rows" for one in tables), *content["omissions"])


def page_template(name: str) -> jinja2.Template:
    """Return a template of pages, which escapes and shows whatever is in double braces."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_page_file),
        autoescape=True,
        finalize=_shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["duration"] = duration
    return environment.get_template(f"{name}.html.jinja")


def _shown(value: Any) -> Any:
    """Return what a page shows of a value; style sheet, scripts and JSON are ours, and marked as safe."""
    return visible(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _shown_data(value: Any) -> Any:
    match value:
        case dict():
            return {key: _shown_data(entry) for key, entry in value.items()}
        case list() | tuple():
            return list(map(_shown_data, value))
    return _shown(value)


def _page_file(name: str) -> str:
    return (resources.files("sobolev_batch.extras.report") / "page" / name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def chart_data(tree: xr.DataTree, spectra: xr.Dataset | None, views: Sequence[MeshView]) -> Json:
    """Return the data of all charts of an open store, with texts not escaped, and null for missing numbers."""
    orders = finished_group(tree, "convergence")["order"].values.tolist()
    return {
        "name": root_attribute(tree, "study")["table"]["study"]["name"],
        "orders": [minus(f"{order:g}") for order in orders],
        "unit": study_unit(tree),
        "edge_unit": unit_of(tree)[0],
        "families": list(dict.fromkeys(families_of(tree).values())),
        "convergence": _convergence(tree, orders, MOST_POINTS // len(orders)),
        "evolution": _evolution(tree, MOST_POINTS // len(orders)),
        "matrix": _matrices(tree, orders),
        "spectrum": None if spectra is None else _spectra(spectra),
        "energy": None if spectra is None else _energy(spectra, families_of(tree)),
        "witness": [view_data(view) for view in views],
    }


def league_data(leagues: Sequence[League], name: str, orders: Sequence[str]) -> Json:
    """Return the data of the charts of several objects, which may have no league; see `chart_data`."""
    return {
        "name": name,
        "orders": list(orders),
        "families": list(leagues[0].methods) if leagues else [],
        "size": label_of(leagues[0].x) if leagues else "",
        "league": [[_mean_line(league, method) for method in league.table["method"]] for league in leagues],
    }


def _mean_line(league: League, method: str) -> Json:
    sizes, means = league.mean_curve(method)
    middle, low, high = means.T
    return _line(method, sizes, middle, high - middle, lower=numbers(middle - low, 2))


def cost_data(leagues: Sequence[CostLeague]) -> list[Json] | None:
    """Return for each order the members that all objects have, method by method, and their front; None without any."""
    return [
        {
            "lines": [
                _line(method, rows[league.x], rows["relative"], rows["relative_error"], labels=rows["member"].tolist())
                for method, rows in league.means.groupby("method", sort=False)
            ],
            "front": {"x": numbers(league.front[league.x]), "y": numbers(league.front["relative"])},
        }
        for league in leagues
    ] or None


def _line(family: str, places: Any, values: Any, errors: Any, **others: Any) -> Json:
    """Return the data of a line with error bars in the colour of a family."""
    return {"family": family, "x": numbers(places), "y": numbers(values), "errors": numbers(errors, 2), **others}


def chart_omissions(
    tree: xr.DataTree, charts: Json, omission: str, views: Sequence[MeshView], missing: Mapping[str, str]
) -> Iterator[str]:
    """Yield what the charts of an open store leave out, and the reasons for meshes without views, for people."""
    compared = len(set(complete_meshes(tree)) - {reference_of(tree)})
    drawn = sum(len(family["labels"]) for order in charts["convergence"] for family in order)
    if drawn < (total := len(_drawable(tree))):
        yield f"the chart of convergence: only {drawn:,} of {total:,} distances are drawn"
    if charts["matrix"] and len(charts["matrix"]["labels"]) < charts["matrix"]["total"]:
        yield f"all pairs: only {len(charts['matrix']['labels'])} of {charts['matrix']['total']:,} meshes are shown"
    if charts["evolution"] is None and has_times(tree):
        yield "the chart of distances over time: they are too many"
    if omission:
        yield f"spectra: only those of {omission} are shown"
    if 0 < len(views) < compared:
        yield f"witness functions: only {len(views)} of {compared:,} meshes are drawn; --mesh chooses them"
    for labels, reason in together(missing).items():
        yield f"the witness function of {labels}: {reason}"


def _convergence(tree: xr.DataTree, orders: list[float], most: int) -> list[list[Json]]:
    """Return for each order and family the points with their errors."""
    frame = _drawable(tree)
    found: list[list[Json]] = []
    for order in orders:
        found.append([])
        for family, rows in frame[frame["order"] == order][:most].groupby("family", sort=False):
            line = _line(str(family), rows["edge_length"], rows["relative"], rows["relative_error"])
            labels, triangles = rows["mesh"].tolist(), rows["triangles"].tolist()
            found[-1].append({**line, "joined": is_sequence(rows), "labels": labels, "triangles": triangles})
    return found


def _drawable(tree: xr.DataTree) -> pd.DataFrame:
    frame = with_remarks(table(tree)).sort_values("edge_length", kind="stable")
    return frame[(frame["relative"] > 0) & frame["edge_length"].notna()]


def _evolution(tree: xr.DataTree, most: int) -> list[list[Json]] | None:
    """Return for each order and family that moves the distances over time; None if there is none, or too many times."""
    if not has_times(tree):
        return None
    found = evolution(tree)
    if found.sizes["family"] * found.sizes["time"] > most:
        return None
    return [
        [
            {**_line(family, [], line["distance"].values, line["error"].values), "x": line["time"].values.tolist()}
            for family in found["family"].values.tolist()
            for line in [found.sel(order=order, family=family).dropna("time", subset=["distance"])]
        ]
        for order in found["order"].values
    ]


def _matrices(tree: xr.DataTree, orders: list[float]) -> Json | None:
    """Return for each order the lower triangle of distances and errors, and an order of similar meshes."""
    most = min(MOST_MESHES, int(math.sqrt(MOST_NUMBERS / len(orders))))
    matrices = [pairs for order in orders if (pairs := pairs_of(tree, order, most)) is not None]
    if not matrices or not matrices[0].sizes["mesh"]:
        return None
    return {
        "labels": matrices[0]["mesh"].values.tolist(),
        "total": len(complete_meshes(tree)),
        "orders": [
            {
                "values": [numbers(row[:i]) for i, row in enumerate(pairs["distance"].values)],
                "errors": [numbers(row[:i], digits=2) for i, row in enumerate(pairs["error"].values)],
                "clustered": clustered_order(pairs["distance"].values).tolist(),
            }
            for pairs in matrices
        ],
    }


def _spectra(spectra: xr.Dataset) -> Json:
    shares = spectra["share"].transpose("order", "mesh", "band").values
    return {
        "labels": spectra["mesh"].values.tolist(),
        "bands": spectra["text"].values.tolist(),
        "shares": [[numbers(row, digits=3) for row in of_order] for of_order in shares],
    }


def _energy(spectra: xr.Dataset, family_of: Mapping[str, str]) -> list[Json]:
    columns = (spectra[name].values for name in ("mesh", "energy", "energy_error"))
    return [
        _line(family_of[label], spectra["wavelength"].values, energies, errors, label=label)
        for label, energies, errors in zip(*columns, strict=True)
    ]


def view_data(view: MeshView) -> Json:
    """Return the data of a mesh that plotly.js draws."""
    # Two bytes are enough for most indices.
    index = "<u2" if len(view.vertices) <= 1 << 16 else "<i4"
    return {
        "label": view.label,
        "triangles": view.original_triangles,
        "shown": len(view.triangles),
        "points": [_packed(axis, "<f4") for axis in view.vertices.T],
        "corners": [_packed(corner, index) for corner in view.triangles.T],
        "values": [_packed(values, "<f4") for values in view.values],
        "limits": numbers(view.color_limits),
        "extent": numbers(np.ptp(view.vertices, axis=0)),
    }


def numbers(values: Any, digits: int = 4) -> list[float | None]:
    """Return numbers with some digits, and null for those that are missing."""
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values]


def _packed(values: Any, dtype: str) -> Mapping[str, str]:
    """Return an array as plotly.js reads it."""
    data = np.ascontiguousarray(values, dtype=dtype)
    return {"dtype": dtype[1:], "bdata": base64.b64encode(data.tobytes()).decode("ascii")}
