"""The report of a store: one HTML page that needs no other files."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.plots import (
    convergence_figure,
    evolution_figure,
    has_pairs,
    map_figure,
    matrix_figure,
)
from sobolev_batch.results.figures.spectra import Spectra
from sobolev_batch.results.figures.spectrum_plots import energy_figure, spectrum_figure
from sobolev_batch.results.figures.style import save
from sobolev_batch.results.figures.witness_plots import MOST_ORDERS, witness_figure
from sobolev_batch.results.meshes.render import render
from sobolev_batch.results.meshes.views import Axis, Views, make_views
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.report.charts import chart_data
from sobolev_batch.results.report.limits import ReportLimits
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.groups import finished_group, has_times

_PAGE = "page"
# Orders that printed pictures show; more would make the page heavy.
_MOST_PICTURED_ORDERS = 6
# Thousands of points take less room as pixels.
_LARGEST_SVG_BYTES = 300_000


@dataclass(frozen=True)
class Picture:
    """A picture for paper, and for browsers without scripts.

    Attributes:
        source: Picture as a data: URL; None where it could not be made.
        text: Alternative text, or the reason why there is no picture.
    """

    source: str | None
    text: str


def report(
    store: AnyStore,
    path: str | Path,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis = "z",
) -> Path:
    """Write the report of a store as one HTML page, with tables, plots and meshes, that makes no requests.

    Needs the extra "report".

    Args:
        store: Path, URL or opened DataTree of the store.
        path: File to write.
        folder: Folder where relative paths in the study start; the study makes some meshes again, to be shown.
        witnesses: Labels of those meshes; by default a few that are chosen by their distances.
        up: Axis that points upwards in the meshes' own coordinates.

    Returns:
        The path of the page.

    Raises:
        InputError: A library of the extra is not installed, the store has no tables yet, or a label is unknown.
        StoreError: The location has no store of a study, or the page cannot be written.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> sb.report("storage/icosphere.zarr", "report.html").name  # doctest: +SKIP
    'report.html'
    """
    path = Path(path)
    text = make_report(store, folder=folder, witnesses=witnesses, up=up)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path}: the report cannot be written there: {error.strerror or error}") from error
    return path


def make_report(
    store: AnyStore,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis = "z",
    limits: ReportLimits | None = None,
) -> str:
    """Return the report of a store as HTML; see `report`."""
    try:
        import jinja2
        import plotly.offline
        from jinja2.utils import htmlsafe_json_dumps

        from sobolev_batch.results.report.content import Content, utc_text
    except ImportError as error:
        raise InputError(
            f"a report needs the library {error.name}, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[report]'"
        ) from error
    limits = limits or ReportLimits()
    tree = as_tree(store)
    content = Content.of(tree, Status.of(store), limits)
    with fields_read(store):
        spectra = Spectra.of(tree, most=limits.spectra)
        views = make_views(tree, folder, witnesses, up=up)
    charts = chart_data(tree, spectra, views, limits)
    scripts = [plotly.offline.get_plotlyjs(), _page_file("tables.js"), _page_file("charts.js")]
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_page_file("report.html.jinja")).render(
        content=content,
        charts=charts,
        data=htmlsafe_json_dumps(charts, allow_nan=False, separators=(",", ":")),
        spectra=spectra,
        views=views,
        pictures=_pictures(tree, spectra, views),
        style=_page_file("report.css"),
        scripts=scripts,
        # Whatever names and reasons contain, the browser runs no other script and fetches nothing.
        policy=f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
        f"script-src {' '.join(map(_digest, scripts))}; base-uri 'none'; form-action 'none'",
        written=utc_text(utc_now()),
    )


def _page_file(name: str) -> str:
    return (resources.files("sobolev_batch.results.report") / _PAGE / name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _pictures(tree: xr.DataTree, spectra: Spectra | None, views: Views) -> dict[str, list[Picture]]:
    orders = finished_group(tree, "convergence")["order"].values.tolist()[:_MOST_PICTURED_ORDERS]

    def one_for_each_order(text: str, draw: Callable[[Sequence[float]], Figure]) -> list[Picture]:
        return [Picture(_data_url(draw([order])), f"{text}, order {order:g}") for order in orders]

    pictures = {
        "convergence": one_for_each_order(
            "Relative distance over mean edge length", lambda orders: convergence_figure(tree, orders)
        ),
        "evolution": [],
        "matrix": [],
        "map": [],
        "spectrum": [],
        "energy": [],
        "witness": _witness_pictures(views),
    }
    if has_times(tree):
        pictures["evolution"] = one_for_each_order("Distance over time", lambda orders: evolution_figure(tree, orders))
    if has_pairs(tree):
        pictures["matrix"] = one_for_each_order("Distances of all pairs", lambda orders: matrix_figure(tree, orders))
        pictures["map"] = one_for_each_order("Map of the meshes", lambda orders: map_figure(tree, orders))
    if spectra is not None:
        pictures["spectrum"] = one_for_each_order(
            "Squared distance by wavelength", lambda orders: spectrum_figure(spectra, orders)
        )
        pictures["energy"] = [
            Picture(_data_url(energy_figure(tree, spectra)), "Energy of the differences by wavelength")
        ]
    return pictures


def _witness_pictures(views: Views) -> list[Picture]:
    try:
        rendered = render(views.views, MOST_ORDERS)
    except InputError as error:
        return [Picture(None, str(error))]
    return [
        Picture(_data_url(witness_figure(view, pictures)), f"{view.label}, coloured by its witness function")
        for view, pictures in zip(views.views, rendered, strict=True)
    ]


def _data_url(figure: Figure) -> str:
    # Without a date, equal stores make equal pages.
    data, kind = _saved(figure, format="svg", metadata={"Date": None}), "svg+xml"
    if len(data) > _LARGEST_SVG_BYTES:
        data, kind = _saved(figure, format="png"), "png"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _saved(figure: Figure, **options: object) -> bytes:
    file = io.BytesIO()
    save(figure, file, **options)
    return file.getvalue()
