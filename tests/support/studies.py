"""A study that takes a second, access to its store, and rows of tables that are put together by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
import xarray as xr

from sobolev_batch import Lattice

SMALL_LATTICE = Lattice(3.0, 16)

GONE = {"name": "gone", "reference": {"source": "files", "paths": ["nowhere.ply"]}}


def small_table(**changes: Any) -> dict[str, Any]:
    """Return a study of four icospheres that takes a second; sections that are None are left out."""
    table: dict[str, Any] = {
        "study": {"name": "small"},
        "lattice": {"xi_max": SMALL_LATTICE.xi_max, "M": SMALL_LATTICE.M},
        "norm": {"orders": [-10.0, -3.0]},
        "compare": {"pairs": "all"},
        "reference": {"source": "sphere"},
        "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3]}],
    }
    return {key: value for key, value in {**table, **changes}.items() if value is not None}


def variable(tree: xr.DataTree, group: str, name: str) -> xr.DataArray:
    return tree[group].to_dataset()[name]


def changed(path: str, value: Any) -> dict[str, Any]:
    """Return the small study with another value for a dotted key."""
    table = small_table()
    *sections, key = path.split(".")
    node: Any = table
    for section in sections:
        node = node[int(section)] if section.isdigit() else node.setdefault(section, {})
    node[key] = value
    return table


def balls(**radii: float) -> list[dict[str, Any]]:
    return [
        {"name": label, "reference": {"source": "sphere", "radius": radius}, "scaling": {"mode": "none"}}
        for label, radius in radii.items()
    ]


def methods_of(egg: str = "egg") -> list[dict[str, Any]]:
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
