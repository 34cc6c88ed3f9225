"""What the pictures of a report show, as JSON for the page that draws them."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.results.figures.embedding import Map, alike_together
from sobolev_batch.results.figures.plots import MOST_MESHES
from sobolev_batch.results.figures.spectra import Wavelengths
from sobolev_batch.results.meshes.views import Gallery, Portrait
from sobolev_batch.results.report.content import minus
from sobolev_batch.results.tables.convergence import convergence_frame, finished_group
from sobolev_batch.results.tables.matrix import Matrix

Exhibit = dict[str, Any]

# Numbers of all matrices together: 10 bytes each, on a page that is to stay below 15 MB.
_MOST_MATRIX_NUMBERS = 400_000
_MOST_POINTS = 50_000


def make_exhibits(tree: xr.DataTree, spectra: Wavelengths | None, gallery: Gallery) -> Exhibit:
    """All pictures of an open store.

    Every text is as it was found; the page escapes it. Numbers that are missing are null.
    """
    convergence, meshes = finished_group(tree, "convergence"), finished_group(tree, "meshes")
    orders = convergence["order"].values.tolist()
    return {
        "orders": [minus(f"{order:g}") for order in orders],
        "families": list(dict.fromkeys(meshes["family"].values.tolist())),
        "reference": convergence.attrs["reference"],
        "convergence": _convergence(tree, orders),
        "matrix": _matrices(tree, meshes, orders),
        "spectrum": None if spectra is None else _spectra(spectra),
        "witness": [_portrait(portrait) for portrait in gallery.portraits],
    }


def _convergence(tree: xr.DataTree, orders: list[float]) -> list[list[Exhibit]]:
    """Per order, per family: points with their errors."""
    frame = convergence_frame(tree)
    frame = frame[(frame["relative"] > 0) & frame["edge_length"].notna()]
    found = []
    for order in orders:
        here = frame[frame["order"] == order][: _MOST_POINTS // len(orders)]
        found.append(
            [
                {
                    "family": family,
                    "joined": bool((lines["level"] >= 0).all()),
                    "labels": lines["mesh"].tolist(),
                    "triangles": lines["triangles"].tolist(),
                    "sizes": _numbers(lines["edge_length"]),
                    "values": _numbers(lines["relative"]),
                    "errors": _numbers(lines["relative_error"]),
                }
                for family, lines in (
                    (family, lines.sort_values("edge_length")) for family, lines in here.groupby("family", sort=False)
                )
            ]
        )
    return found


def _matrices(tree: xr.DataTree, meshes: xr.Dataset, orders: list[float]) -> Exhibit | None:
    """Per order the lower triangle of distances and errors, an order of alike meshes, and the map."""
    most = min(MOST_MESHES, int(math.sqrt(_MOST_MATRIX_NUMBERS / len(orders))))
    matrices = [matrix for order in orders if (matrix := Matrix.of(tree, order, most)) is not None]
    if not matrices or not matrices[0].labels:
        return None
    family_of = dict(zip(meshes["mesh"].values.tolist(), meshes["family"].values.tolist(), strict=True))
    labels = matrices[0].labels
    return {
        "labels": labels,
        "families": [family_of[label] for label in labels],
        "of": int((meshes["status"].values == "complete").sum()),
        "orders": [_matrix(matrix) for matrix in matrices],
    }


def _matrix(matrix: Matrix) -> Exhibit:
    found = Map.of(matrix.values)
    return {
        "values": [_numbers(row[:i]) for i, row in enumerate(matrix.values)],
        "errors": [_numbers(row[:i], digits=2) for i, row in enumerate(matrix.errors)],
        "alike": alike_together(matrix.values).tolist(),
        "places": [_numbers(axis, digits=5) for axis in found.places.T],
        "share": None if math.isnan(found.share) else round(found.share, 4),
    }


def _spectra(spectra: Wavelengths) -> Exhibit:
    return {
        "labels": spectra.labels,
        "of": spectra.of,
        "bands": spectra.bands,
        "shares": [[_numbers(row, digits=3) for row in spectra.shares[:, k]] for k in range(len(spectra.orders))],
    }


def _portrait(portrait: Portrait) -> Exhibit:
    return {
        "label": portrait.label,
        "triangles": portrait.whole,
        "shown": len(portrait.triangles),
        "places": [_packed(axis, "<f4") for axis in portrait.vertices.T],
        "corners": [_packed(corner, "<i4") for corner in portrait.triangles.T],
        "values": [_packed(values, "<f4") for values in portrait.values],
    }


def _numbers(values: Any, digits: int = 4) -> list[float | None]:
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values]


def _packed(values: Any, dtype: str) -> Mapping[str, str]:
    """An array as plotly.js takes it."""
    data = np.ascontiguousarray(values, dtype=dtype)
    return {"dtype": dtype[1:], "bdata": base64.b64encode(data.tobytes()).decode("ascii")}
