"""Rows of tables that leagues are made from, put together by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

GONE = {"name": "gone", "reference": {"source": "files", "paths": ["nowhere.ply"]}}


def balls(**radii: float) -> list[dict[str, Any]]:
    """Return objects of a collection whose references are spheres."""
    return [
        {"name": label, "reference": {"source": "sphere", "radius": radius}, "scaling": {"mode": "none"}}
        for label, radius in radii.items()
    ]


def methods_of(egg: str = "egg") -> list[dict[str, Any]]:
    """Return two families of two meshes each."""
    return [
        {"name": "ico", "source": "icosphere", "levels": [1, 2]},
        {"name": egg, "source": "ellipsoid", "axes": [1.0, 1.0, 0.8], "levels": [1, 2]},
    ]


def method_rows(distances: Mapping[str, Mapping[int, float]], error: float = 0.0, order: float = -2.0) -> pd.DataFrame:
    """Return rows of a table from relative distances by method and triangles."""
    rows = [
        {
            "order": order,
            "mesh": f"{method}/{triangles}",
            "family": method,
            "triangles": triangles,
            "edge_length": triangles**-0.5,
            "relative": value,
            "relative_error": error * value,
        }
        for method, by_size in distances.items()
        for triangles, value in by_size.items()
    ]
    return pd.DataFrame(rows)
