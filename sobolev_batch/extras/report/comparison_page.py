"""The page of one comparison: the verdict, both meshes with their deviations, and how large these are, on one sheet."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sobolev_batch.cli.comparison import Comparison
from sobolev_batch.errors import from_extra, write_file
from sobolev_batch.geometry.closest import signs
from sobolev_batch.geometry.deviation import largest_deviation
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.proximity import sampled_distances
from sobolev_batch.geometry.surface import centering
from sobolev_batch.norms.causes import spectrum
from sobolev_batch.parameters import length_in
from sobolev_batch.tables.rendering import Column
from sobolev_batch.testing.difference import picture_fields

with from_extra("report", "a report needs"):
    from sobolev_batch.extras.figures.views import FRONT, distance_view, upwards
    from sobolev_batch.extras.report.build import filled, numbers, view_data
    from sobolev_batch.extras.report.content import PageTable

# Points whose distances the histogram counts, on each mesh, and its bars.
_POINTS, _BARS = 40_000, 40
# Larger meshes are simplified, and small ones divided into about as many triangles. A page takes 40 bytes for each.
_MOST_TRIANGLES, _ENOUGH_TRIANGLES = 150_000, 32_000
# Colours end where no more of the area is farther away, if that is this much less than the largest deviation.
_FARTHEST_AREA, _OUTLYING = 0.005, 1.5
_HEADERS = ("distance of points", "A to B", "B to A", "larger")


def comparison_page(path: Path, comparison: Comparison, verdict: str = "") -> None:
    """Write the page of a comparison whose proximity was measured, with a verdict on top; StoreError if that fails."""
    meshes = comparison.first, comparison.second
    largest = (comparison.deviations or largest_deviation(*meshes)).both
    signed = all(signs(mesh, mesh.vertices[:1]) is not None for mesh in meshes)
    # Numbers in single precision have too few digits far from the origin.
    middle = np.mean(comparison.second.extent.box, axis=0)
    shown = [Mesh(mesh.vertices - middle, mesh.triangles) for mesh in meshes]
    turn = upwards(shown[1].vertices[shown[1].used_vertices])
    views = [
        distance_view(name, mesh, other, comparison.unit, _MOST_TRIANGLES, enough=_ENOUGH_TRIANGLES, signed=signed)
        for name, mesh, other in zip(comparison.options.names, shown, shown[::-1], strict=True)
    ]
    place = np.roll(np.array(largest.place) - middle, turn)
    # From the side of the bounding box that is nearest to the place.
    towards = place / np.maximum(np.ptp(views[1].vertices, axis=0)[(np.arange(3) - turn) % 3], 1e-9)
    eye = towards / (np.linalg.norm(towards) or 1.0) + FRONT / 2
    histogram, limit = _histogram(meshes, largest.upper, signed=signed)
    options = comparison.options
    asked = None if options.allowed_fraction is not None else options.within
    length = limit if asked is None else length_in(asked, options.unit)
    columns = [Column(name, name, kind="text" if i else "label") for i, name in enumerate(_HEADERS)]
    rows = [dict(zip(_HEADERS, row, strict=True)) for row in comparison.rows]
    charts = {
        "orders": [],
        "name": options.a.stem,
        "families": list(comparison.options.names),
        "unit": comparison.unit,
        "pair": {
            "views": [view_data(replace(view, vertices=np.roll(view.vertices, turn, axis=1))) for view in views],
            "place": numbers(place),
            "eye": numbers(eye / np.linalg.norm(eye)),
            "limit": float(f"{length:.3g}"),
            "signed": signed,
        },
        "histogram": histogram,
        "bands": _bands(comparison),
    }
    content = {
        "title": " and ".join(comparison.options.names),
        "orders": [],
        "versions": {"sobolev-batch": version("sobolev-batch")},
        "sentences": [f"{verdict}."] * bool(verdict) + list(comparison.sentences),
        "names": comparison.options.names,
        "triangles": [
            f"{view.original_triangles:,} triangles"
            + (f", shown with {count:,}" if (count := len(view.triangles)) < view.original_triangles else "")
            for view in views
        ],
        "limit": f"{length:.3g}",
        "is_cut": length < largest.lower,
        "distances": PageTable("distances", columns, rows, is_sortable=False),
        "details": list(comparison.details),
        "remarks": comparison.remarks,
        "omissions": [],
    }
    write_file(path, filled("comparison", content, charts)[0].encode(), "the report")


def _histogram(meshes: Sequence[Mesh], largest: float, *, signed: bool) -> tuple[dict[str, Any], float]:
    """Return shares of the area of each mesh, by the distance from the other one, and where colours end."""
    edges = np.linspace(-largest if signed else 0.0, largest, _BARS + 1)
    rng = np.random.default_rng(0)
    found = [sampled_distances(mesh, other, rng, _POINTS, signed=signed) for mesh, other in (meshes, meshes[::-1])]
    shares = [numbers(np.histogram(distances, edges)[0] / _POINTS) for distances in found]
    usual = max(float(np.quantile(np.abs(distances), 1 - _FARTHEST_AREA)) for distances in found)
    limit = usual if 0 < usual * _OUTLYING < largest else largest
    return {"x": numbers((edges[1:] + edges[:-1]) / 2), "shares": shares}, limit


def _bands(comparison: Comparison) -> dict[str, Any]:
    """Return the shares of the squared distance at the first order by wavelength, longest first, in the files' unit."""
    order = comparison.options.chosen_orders[0]
    pair = [comparison.similarity.apply(mesh) for mesh in (comparison.first, comparison.second)]
    fields = picture_fields(list(map(centering(pair).apply, pair)), order)
    bands = spectrum(*fields, order, similarity=comparison.similarity)
    whole = max(float(comparison.results["distance"].sel(order=order)) ** 2, float(bands["total"]))
    shares = bands["squared"].values / whole if whole else np.zeros(bands.sizes["band"])
    ends = [f"{length:.3g}" for length in bands["own_shortest_wavelength"].values]
    # What is shorter than the lattice of pictures has the rest.
    return {
        "texts": [f"> {ends[0]}", *map(" – ".join, pairwise(ends)), f"< {ends[-1]}"],
        "shares": numbers([*shares, max(0.0, 1.0 - shares.sum()) if whole else 0.0]),
    }
