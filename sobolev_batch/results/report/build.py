"""The report of a store: one HTML page that needs no other files."""

from __future__ import annotations

import base64
import gzip
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

from sobolev_batch.batch.collection_store import CollectionStore
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import utc_now
from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.views import Axis, make_views
from sobolev_batch.results.open import AnyStore, as_tree, fields_read, location_of, require_unchanged
from sobolev_batch.results.report.charts import (
    chart_data,
    chart_omissions,
    league_data,
    league_pictures,
    study_pictures,
    unpictured,
)
from sobolev_batch.results.report.content import utc_text
from sobolev_batch.results.status import Status
from sobolev_batch.visible import visible

_FOLDER = "page"
# Of the extra.
_LIBRARIES = ("jinja2", "plotly", "tomli_w")


# A page as HTML, and what it leaves out, for people.
Page = tuple[str, tuple[str, ...]]


def report(
    store: AnyStore,
    path: str | Path,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis = "z",
) -> Path:
    """Write the report of a store as one HTML page, with tables, plots and meshes, that makes no requests.

    The page of a collection has the league of its methods, and the best method for each object. Needs the extra
    "report".

    Args:
        store: Path, URL or opened DataTree of the store, or path or URL of that of a collection.
        path: File to write.
        folder: Folder where relative paths in the study start; the study makes some meshes again, to be shown.
        witnesses: Labels of those meshes, in the store of one object, or patterns such as "scans/*"; by default a few
            that are chosen by their distances.
        up: Axis that points upwards in the meshes' own coordinates.

    Returns:
        The path of the page.

    Raises:
        InputError: A library of the extra is not installed, the store has no tables yet, a label is unknown, or meshes
            of a collection are named.
        StoreError: The location has no store of a study, or the page cannot be written.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> sb.report("storage/icosphere.zarr", "report.html").name  # doctest: +SKIP
    'report.html'
    """
    with written_to(Path(path)) as write:
        write(make_report(store, folder=folder, witnesses=witnesses, up=up)[0])
    return Path(path)


@contextmanager
def written_to(path: Path) -> Iterator[Callable[[str], object]]:
    """Refuse a path that cannot be written before there is anything to write; the old file stays until the new one is.

    Raises:
        StoreError: It is a folder, its folder cannot be written, or the disk is full.
    """
    target = Path(os.path.realpath(path))
    # A device or a pipe has nothing that could stay.
    place = target if target.exists() and not target.is_file() else target.with_name(f".{uuid4().hex}.html")
    try:
        with place.open("w", encoding="utf-8") as file:
            yield file.write
        if place != target:
            place.replace(target)
    except OSError as error:
        raise StoreError(f"{path}: the report cannot be written there: {error.strerror or error}") from error
    finally:
        if place != target:
            place.unlink(missing_ok=True)


def make_report(
    store: AnyStore,
    *,
    folder: str | Path = ".",
    witnesses: Sequence[str] = (),
    up: Axis = "z",
) -> Page:
    """Return the report of a store, and what it leaves out; see `report`."""
    missing = next((library for library in _LIBRARIES if find_spec(library) is None), None)
    if missing is not None:
        raise InputError(
            f"a report needs the library {missing}, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[report]'"
        )
    collection = CollectionStore.read(Location.parse(location_of(store)))
    if collection is None:
        return _study_page(store, folder, witnesses, up)
    if witnesses:
        raise InputError(
            f"{collection.location}: meshes are shown in the report of one object, such as "
            f"{collection.location.below(collection.objects[0])}"
        )
    return _collection_page(collection)


def _study_page(store: AnyStore, folder: str | Path, witnesses: Sequence[str], up: Axis) -> Page:
    from sobolev_batch.results.report.content import study_content

    tree = as_tree(store)
    content = study_content(tree, Status.from_store(store))
    selection = Selection.from_store(tree)
    spectra = selection.spectra if selection.has_spectra else None
    with fields_read(store):
        views, missing = make_views(tree, folder, witnesses, up=up)
    charts = chart_data(tree, spectra, views)
    pictures = study_pictures(selection, views)
    text = _filled("study", content, charts, spectra=spectra, views=views, missing=missing, pictures=pictures)
    require_unchanged(tree)
    cut = chart_omissions(tree, charts, spectra, views, missing)
    return text, (*content["omissions"], *cut, *unpictured(tree, pictures))


def _collection_page(collection: CollectionStore) -> Page:
    from sobolev_batch.results.report.collection import league_content

    content = league_content(collection, Status.of_collection(collection))
    charts = league_data(content["leagues"], content["name"], content["orders"])
    return _filled("league", content, charts, pictures=league_pictures(content["leagues"])), content["omissions"]


def _filled(template: str, content: Any, charts: dict[str, Any], **values: Any) -> str:
    """Return a page from its template, with all that it needs to be drawn."""
    import jinja2
    import plotly.offline
    from jinja2.utils import htmlsafe_json_dumps

    # Two thirds of a page, if the browser were not to unpack it.
    library = plotly.offline.get_plotlyjs()
    scripts = [_page_file("tables.js"), _page_file("charts.js")]
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_page_file),
        autoescape=True,
        finalize=_shown,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(f"{template}.html.jinja").render(
        content=content,
        charts=charts,
        data=htmlsafe_json_dumps(_shown_data(charts), allow_nan=False, separators=(",", ":")),
        style=_page_file("report.css"),
        library=base64.b64encode(gzip.compress(library.encode("utf-8"), mtime=0)).decode("ascii"),
        scripts=scripts,
        # Whatever names and reasons contain, the browser runs no other script and fetches nothing.
        policy=f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
        f"script-src {' '.join(map(_digest, [library, *scripts]))}; base-uri 'none'; form-action 'none'",
        written=utc_text(utc_now()),
        **values,
    )


def _shown(value: Any) -> Any:
    """Return what a page shows of a value; style sheet, scripts and JSON are ours, and marked as safe."""
    return visible(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _shown_data(value: Any) -> Any:
    """Return data of charts with texts as they are shown."""
    match value:
        case dict():
            return {key: _shown_data(entry) for key, entry in value.items()}
        case list() | tuple():
            return list(map(_shown_data, value))
    return _shown(value)


def _page_file(name: str) -> str:
    return (resources.files("sobolev_batch.results.report") / _FOLDER / name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
