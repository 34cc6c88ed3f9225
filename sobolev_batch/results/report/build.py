"""The report of a store: one HTML page that needs nothing besides itself."""

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

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.plots import (
    MOST_VIEWS,
    convergence_figure,
    map_figure,
    matrix_figure,
    save,
    spectrum_figure,
    witness_figure,
)
from sobolev_batch.results.figures.spectra import Wavelengths
from sobolev_batch.results.meshes.render import render
from sobolev_batch.results.meshes.views import Axis, Gallery, make_gallery
from sobolev_batch.results.open import fields_read, open_store
from sobolev_batch.results.report.charts import make_exhibits
from sobolev_batch.results.status import Status
from sobolev_batch.results.tables.convergence import finished_group

_PAGE = "page"
# Orders whose pictures are also there as they are printed; more would make the page heavy.
_MOST_STILL_ORDERS = 6
# Thousands of points take less room as dots.
_LARGEST_DRAWING_BYTES = 300_000


@dataclass(frozen=True)
class Still:
    """A picture as it is printed, or shown where scripts are off.

    Attributes:
        source: the picture as a data: URL; None where it could not be made.
        text: what it shows, for those who do not see it, or why there is none.
    """

    source: str | None
    text: str


def write_report(
    place: str | Path | Location,
    output: str | Path,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis = "z",
) -> Path:
    """Write the report of a store as one HTML page without links to anything outside it.

    Args:
        place: path or URL of the store.
        output: the file to write.
        folder: where relative paths in the study start; of meshes that are still there, the witness is shown.
        witnesses: labels of those meshes; by default a few that are chosen by their distances.
        up: the axis that points upwards in the meshes' own coordinates.

    Returns:
        The path of the page.

    Raises:
        InputError: a library of the extra "report" is not installed, the store has no tables yet, or a label
            is unknown.
        StoreError: no store is there, or the page cannot be written.
    """
    output = Path(output)
    text = make_report(place, folder=folder, witnesses=witnesses, up=up)
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{output}: the report cannot be written there: {error.strerror or error}") from error
    return output


def make_report(
    place: str | Path | Location, *, folder: str | Path = ".", witnesses: Sequence[str] = (), up: Axis = "z"
) -> str:
    """The report of a store as HTML; see `write_report`."""
    try:
        import jinja2
        import plotly.offline
        from jinja2.utils import htmlsafe_json_dumps

        from sobolev_batch.results.report.content import Account, moment
    except ImportError as error:
        raise InputError(
            f"a report needs the library {error.name}, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[report]'"
        ) from error
    tree = open_store(place)
    account = Account.of(tree, Status.of(place))
    with fields_read(place):
        spectra = Wavelengths.of_store(tree)
        gallery = make_gallery(tree, tree.attrs["study"]["table"], folder, witnesses, up=up)
    exhibits = make_exhibits(tree, spectra, gallery)
    scripts = [plotly.offline.get_plotlyjs(), _part("tables.js"), _part("charts.js")]
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_part("report.html.jinja")).render(
        account=account,
        exhibits=exhibits,
        data=htmlsafe_json_dumps(exhibits, allow_nan=False, separators=(",", ":")),
        spectra=spectra,
        gallery=gallery,
        stills=_stills(tree, spectra, gallery),
        style=_part("report.css"),
        scripts=scripts,
        # Nothing else may run, and nothing be fetched, whatever names and reasons hold.
        policy=f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
        f"script-src {' '.join(map(_fingerprint, scripts))}; base-uri 'none'; form-action 'none'",
        written=moment(utc_now()),
    )


def _part(name: str) -> str:
    return (resources.files("sobolev_batch.results.report") / _PAGE / name).read_text(encoding="utf-8")


def _fingerprint(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _stills(tree: xr.DataTree, spectra: Wavelengths | None, gallery: Gallery) -> dict[str, list[Still]]:
    orders = finished_group(tree, "convergence")["order"].values.tolist()[:_MOST_STILL_ORDERS]
    found = {
        "convergence": _drawn(
            lambda s: convergence_figure(tree, [s]), "Relative distance over mean edge length", orders
        ),
        "matrix": [],
        "map": [],
        "spectrum": [],
        "witness": _seen(gallery),
    }
    if tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]:
        found["matrix"] = _drawn(lambda s: matrix_figure(tree, [s]), "Distances of all pairs", orders)
        found["map"] = _drawn(lambda s: map_figure(tree, [s]), "Map of the meshes", orders)
    if spectra is not None:
        found["spectrum"] = _drawn(lambda s: spectrum_figure(spectra, [s]), "Shares of wavelengths", orders)
    return found


def _drawn(draw: Callable[[float], Figure], what: str, orders: Sequence[float]) -> list[Still]:
    return [Still(_source(draw(order)), f"{what}, order {order:g}") for order in orders]


def _seen(gallery: Gallery) -> list[Still]:
    try:
        rendered = render(gallery.portraits, MOST_VIEWS)
    except InputError as error:
        return [Still(None, str(error))]
    return [
        Still(_source(witness_figure(portrait, pictures)), f"{portrait.label}, coloured by its witness function")
        for portrait, pictures in zip(gallery.portraits, rendered, strict=True)
    ]


def _source(figure: Figure) -> str:
    # Without a date, equal stores make equal pages.
    drawn = _saved(figure, format="svg", metadata={"Date": None})
    kind = "svg+xml"
    if len(drawn) > _LARGEST_DRAWING_BYTES:
        drawn, kind = _saved(figure, format="png"), "png"
    return f"data:image/{kind};base64,{base64.b64encode(drawn).decode('ascii')}"


def _saved(figure: Figure, **options: object) -> bytes:
    file = io.BytesIO()
    save(figure, file, **options)
    return file.getvalue()
