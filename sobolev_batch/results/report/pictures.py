"""Pictures of a page, for paper and for browsers without scripts."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import xarray as xr
from matplotlib.figure import Figure
from PIL import Image

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.convergence_plots import LEAGUE
from sobolev_batch.results.figures.plots import PLOTS
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import save
from sobolev_batch.results.figures.witness_plots import MOST_ORDERS, witness_figure
from sobolev_batch.results.league.league import League
from sobolev_batch.results.meshes.render import render
from sobolev_batch.results.meshes.views import Views
from sobolev_batch.results.tables.groups import finished_group

# Orders that printed pictures show; more would make the page heavy.
MOST_PICTURED_ORDERS = 6
# Colours of plots, which have few, and quality of those that have many. SVG takes up to six times as much room.
_COLORS, _QUALITY = 128, 90


@dataclass(frozen=True)
class Picture:
    """A picture for paper, and for browsers without scripts.

    Attributes:
        source: Picture as a data: URL; None where it could not be made.
        text: Alternative text, or the reason why there is no picture.
    """

    source: str | None
    text: str


Pictures = dict[str, list[Picture]]


def study_pictures(selection: Selection, views: Views) -> Pictures:
    """Return the pictures of an open store, by the chart that they stand for."""
    pictures = {
        name: [
            Picture(
                _data_url(plot.figure(selection, [item])), plot.text + ("" if item is None else f", order {item:g}")
            )
            for item in plot.items(selection)[:MOST_PICTURED_ORDERS]
        ]
        for name, plot in PLOTS.items()
        if name != "transform"
    }
    return {**pictures, "witness": _witness_pictures(views)}


def _text(text: str, order: float | None) -> str:
    return text if order is None else f"{text}, order {order:g}"


def unpictured(tree: xr.DataTree, pictures: Pictures) -> Iterator[str]:
    """Yield what the pictures of an open store leave out, for people."""
    orders = finished_group(tree, "convergence", load=False).sizes["order"]
    if orders > MOST_PICTURED_ORDERS:
        yield f"pictures for paper: only those of {MOST_PICTURED_ORDERS} of {orders} orders are there"
    yield from (f"pictures of meshes for paper: {one.text}" for one in pictures["witness"] if one.source is None)


def league_pictures(leagues: Sequence[League]) -> Pictures:
    """Return a picture of the league of each order."""
    return {
        "league": [
            Picture(_data_url(LEAGUE.figure(leagues, [one])), f"{LEAGUE.text}, order {one.order:g}")
            for one in leagues[:MOST_PICTURED_ORDERS]
        ]
    }


def _witness_pictures(views: Views) -> list[Picture]:
    try:
        rendered = render(views.views, MOST_ORDERS)
    except InputError as error:
        return [Picture(None, str(error))]
    return [
        Picture(
            _data_url(witness_figure(view, drawn), is_shaded=True), f"{view.label}, coloured by its witness function"
        )
        for view, drawn in zip(views.views, rendered, strict=True)
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
