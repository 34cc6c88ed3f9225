"""A study that takes a second, and access to its store."""

from __future__ import annotations

from typing import Any

import xarray as xr

from sobolev_batch import Lattice

SMALL_LATTICE = Lattice(3.0, 16)


def small_table(**changes: Any) -> dict[str, Any]:
    """Return a study of four icospheres that takes a second; sections that are None are left out."""
    table: dict[str, Any] = {
        "study": {"name": "small"},
        "lattice": {"xi_max": SMALL_LATTICE.xi_max, "M": SMALL_LATTICE.M},
        "norm": {"orders": [-10.0, -3.0]},
        "reference": {"source": "sphere"},
        "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3]}],
    }
    return {key: value for key, value in {**table, **changes}.items() if value is not None}


def variable(tree: xr.DataTree, group: str, name: str) -> xr.DataArray:
    """Return a variable of one group of a store."""
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
