"""Charts of a report: data as JSON for the page that draws them, and pictures for paper and without scripts."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.drawing import LEAGUE, MOST_MESHES, PLOTS, clustered_order, embedded
from sobolev_batch.results.figures.selection import Selection, Spectra
from sobolev_batch.results.figures.style import save
from sobolev_batch.results.figures.views import MeshView, render
from sobolev_batch.results.figures.witness_plots import MOST_ORDERS, witness_figure
from sobolev_batch.results.open import (
    complete_meshes,
    families_of,
    finished_group,
    has_times,
    is_sequence,
    label_of,
    reference_of,
)
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.evolution import evolution
from sobolev_batch.results.tables.league import League
from sobolev_batch.results.tables.matrix import pairs_of
from sobolev_batch.results.tables.text import minus

# Orders that printed pictures show; more would make the page heavy.
MOST_PICTURED_ORDERS = 6
# Points of all convergence charts together, and numbers of all matrices: 10 bytes each, on a page of up to 15 MB.
MOST_POINTS, MOST_NUMBERS = 50_000, 400_000
# Colours of plots, which have few, and quality of those that have many. SVG takes up to six times as much room.
_COLORS, _QUALITY = 128, 90

Json = dict[str, Any]


def chart_data(tree: xr.DataTree, spectra: Spectra | None, views: Sequence[MeshView]) -> Json:
    """Return the data of all charts of an open store.

    Texts are not escaped; the page does so. Missing numbers are null.
    """
    orders = finished_group(tree, "convergence")["order"].values.tolist()
    return {
        "name": tree.attrs["study"]["table"]["study"]["name"],
        "orders": [minus(f"{order:g}") for order in orders],
        "families": list(dict.fromkeys(families_of(tree).values())),
        "reference": reference_of(tree),
        "convergence": _convergence(tree, orders, MOST_POINTS // len(orders)),
        "evolution": _evolution(tree, MOST_POINTS // len(orders)),
        "matrix": _matrices(tree, orders),
        "spectrum": None if spectra is None else _spectra(spectra),
        "energy": None if spectra is None else _energy(spectra, families_of(tree)),
        "witness": [_view(view) for view in views],
    }


def league_data(leagues: Sequence[League], name: str, orders: Sequence[str]) -> Json:
    """Return the data of the charts of a collection, which may have no league; see `chart_data`."""
    return {
        "name": name,
        "orders": list(orders),
        "families": list(leagues[0].methods) if leagues else [],
        "size": label_of(leagues[0].x) if leagues else "",
        "league": [[_method(method, league) for method in league.methods] for league in leagues],
    }


def _method(method: str, league: League) -> Json:
    curve = league.mean_curve(method)
    return {
        "family": method,
        "sizes": _numbers(np.exp(curve.sizes)),
        "values": _numbers(np.exp(curve.values)),
        "errors": _numbers(curve.bars, digits=2),
    }


def chart_omissions(
    tree: xr.DataTree, charts: Json, spectra: Spectra | None, views: Sequence[MeshView], missing: Mapping[str, str]
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
    if spectra is not None and spectra.omission:
        yield f"spectra: only those of {spectra.omission} are shown"
    if 0 < len(views) < compared:
        yield f"witness functions: only {len(views)} of {compared:,} meshes are drawn; --witness chooses them"
    for label, reason in missing.items():
        yield f"the witness function of {label}: {reason}"
    for view in views:
        if len(view.triangles) < view.original_triangles:
            yield f"triangles: {view.label} is drawn with {len(view.triangles):,} of {view.original_triangles:,}"


def _convergence(tree: xr.DataTree, orders: list[float], most: int) -> list[list[Json]]:
    """Return for each order and family the points with their errors."""
    frame = _drawable(tree)
    return [
        [
            _family(str(family), rows.sort_values("edge_length"))
            for family, rows in frame[frame["order"] == order][:most].groupby("family", sort=False)
        ]
        for order in orders
    ]


def _drawable(tree: xr.DataTree) -> pd.DataFrame:
    """Return the rows of `table` that have a place on logarithmic axes."""
    frame = table(tree)
    return frame[(frame["relative"] > 0) & frame["edge_length"].notna()]


def _family(family: str, rows: Any) -> Json:
    return {
        "family": family,
        "joined": is_sequence(rows),
        "labels": rows["mesh"].tolist(),
        "triangles": rows["triangles"].tolist(),
        "sizes": _numbers(rows["edge_length"]),
        "values": _numbers(rows["relative"]),
        "errors": _numbers(rows["relative_error"]),
    }


def _evolution(tree: xr.DataTree, most: int) -> list[list[Json]] | None:
    """Return for each order and family that moves the distances over time; None if there is none, or too many times."""
    if not has_times(tree):
        return None
    found = evolution(tree)
    if found.sizes["family"] * found.sizes["time"] > most:
        return None
    return [
        [
            {
                "family": family,
                "times": line["time"].values.tolist(),
                "values": _numbers(line["distance"].values),
                "errors": _numbers(line["error"].values, digits=2),
            }
            for family in found["family"].values.tolist()
            for line in [found.sel(order=order, family=family).dropna("time", subset=["distance"])]
        ]
        for order in found["order"].values
    ]


def _matrices(tree: xr.DataTree, orders: list[float]) -> Json | None:
    """Return for each order the lower triangle of distances and errors, an order of similar meshes, and the map."""
    most = min(MOST_MESHES, int(math.sqrt(MOST_NUMBERS / len(orders))))
    matrices = [pairs for order in orders if (pairs := pairs_of(tree, order, most)) is not None]
    if not matrices or not matrices[0].sizes["mesh"]:
        return None
    family_of, labels = families_of(tree), matrices[0]["mesh"].values.tolist()
    return {
        "labels": labels,
        "families": [family_of[label] for label in labels],
        "total": len(complete_meshes(tree)),
        "orders": [_matrix(matrix) for matrix in matrices],
    }


def _matrix(pairs: xr.Dataset) -> Json:
    distances = pairs["distance"].values
    points, explained = embedded(distances)
    return {
        "values": [_numbers(row[:i]) for i, row in enumerate(distances)],
        "errors": [_numbers(row[:i], digits=2) for i, row in enumerate(pairs["error"].values)],
        "clustered": clustered_order(distances).tolist(),
        "points": [_numbers(axis, digits=5) for axis in points.T],
        "explained": None if math.isnan(explained) else round(explained, 4),
    }


def _spectra(spectra: Spectra) -> Json:
    return {
        "labels": spectra.labels,
        "bands": spectra.bands,
        "shares": [[_numbers(row, digits=3) for row in spectra.shares[:, k]] for k in range(len(spectra.orders))],
    }


def _energy(spectra: Spectra, family_of: Mapping[str, str]) -> Json:
    return {
        "labels": spectra.labels,
        "families": [family_of[label] for label in spectra.labels],
        "wavelengths": _numbers(spectra.wavelengths),
        "values": [_numbers(row) for row in spectra.energies],
        "errors": [_numbers(row, digits=2) for row in spectra.energy_errors],
    }


def _view(view: MeshView) -> Json:
    # Two bytes are enough for most indices.
    index = "<u2" if len(view.vertices) <= 1 << 16 else "<i4"
    return {
        "label": view.label,
        "triangles": view.original_triangles,
        "shown": len(view.triangles),
        "points": [_packed(axis, "<f4") for axis in view.vertices.T],
        "corners": [_packed(corner, index) for corner in view.triangles.T],
        "values": [_packed(values, "<f4") for values in view.values],
    }


def _numbers(values: Any, digits: int = 4) -> list[float | None]:
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values]


def _packed(values: Any, dtype: str) -> Mapping[str, str]:
    """Return an array as plotly.js reads it."""
    data = np.ascontiguousarray(values, dtype=dtype)
    return {"dtype": dtype[1:], "bdata": base64.b64encode(data.tobytes()).decode("ascii")}


# A picture for paper, and for browsers without scripts: its source as a data: URL, or None where it could not be made,
# and its alternative text, or the reason why there is no picture.
Picture = Mapping[str, str | None]
Pictures = dict[str, list[Picture]]


def study_pictures(selection: Selection, views: Sequence[MeshView]) -> Pictures:
    """Return the pictures of an open store, by the chart that they stand for."""
    pictures: Pictures = {
        name: [
            {
                "source": _data_url(plot.figure(selection, [item])),
                "text": plot.text + ("" if item is None else f", order {item:g}"),
            }
            for item in plot.items(selection)[:MOST_PICTURED_ORDERS]
        ]
        for name, plot in PLOTS.items()
    }
    return {**pictures, "witness": _witness_pictures(views)}


def unpictured(tree: xr.DataTree, pictures: Pictures) -> Iterator[str]:
    """Yield what the pictures of an open store leave out, for people."""
    orders = finished_group(tree, "convergence", load=False).sizes["order"]
    if orders > MOST_PICTURED_ORDERS:
        yield f"pictures for paper: only those of {MOST_PICTURED_ORDERS} of {orders} orders are included"
    yield from (
        f"pictures of meshes for paper: {picture['text']}"
        for picture in pictures["witness"]
        if picture["source"] is None
    )


def league_pictures(leagues: Sequence[League]) -> Pictures:
    """Return a picture of the league of each order."""
    return {
        "league": [
            {"source": _data_url(LEAGUE.figure(leagues, [one])), "text": f"{LEAGUE.text}, order {one.order:g}"}
            for one in leagues[:MOST_PICTURED_ORDERS]
        ]
    }


def _witness_pictures(views: Sequence[MeshView]) -> list[Picture]:
    try:
        rendered = render(views, MOST_ORDERS)
    except InputError as error:
        return [{"source": None, "text": str(error)}]
    return [
        {
            "source": _data_url(witness_figure(view, drawn), is_shaded=True),
            "text": f"{view.label}, coloured by its witness function",
        }
        for view, drawn in zip(views, rendered, strict=True)
    ]


def _data_url(figure: Figure, *, is_shaded: bool = False) -> str:
    """Return a figure as WebP: without loss in a palette, or with a little loss where it is shaded."""
    file = io.BytesIO()
    save(figure, file, "png")
    image = Image.open(file).convert("RGB")
    if not is_shaded:
        image = image.quantize(_COLORS, dither=Image.Dither.NONE).convert("RGB")
    data = io.BytesIO()
    image.save(data, "webp", lossless=not is_shaded, quality=_QUALITY, method=4)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode('ascii')}"
