"""A study that takes a second, as a table and as a file, and how its store is read."""

from __future__ import annotations

from typing import Any

import xarray as xr

from sobolev_batch import Lattice

SMALL_LATTICE = Lattice(3.0, 16)


def small_table(**changes: Any) -> dict[str, Any]:
    """A study of four icospheres that takes a second."""
    table: dict[str, Any] = {
        "study": {"name": "small"},
        "lattice": {"xi_max": SMALL_LATTICE.xi_max, "M": SMALL_LATTICE.M},
        "norm": {"orders": [-10.0, -3.0]},
        "reference": {"source": "sphere"},
        "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3]}],
    }
    return {**table, **changes}


def variable(tree: xr.DataTree, group: str, name: str) -> xr.DataArray:
    """A variable of one group of a store."""
    return tree[group].to_dataset()[name]


def changed(path: str, value: Any) -> dict[str, Any]:
    table = small_table()
    *sections, key = path.split(".")
    place: Any = table
    for section in sections:
        place = place[int(section)] if section.isdigit() else place.setdefault(section, {})
    place[key] = value
    return table
