"""Stores held against each other."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import xarray as xr

from tests.batch.conftest import variable

TABLES = (("norms", "norm"), ("norms", "error"), ("distances", "distance"), ("convergence", "distance"))


def assert_same_fields(one: Path | str, other: Path | str, besides: Collection[str] = ()) -> None:
    """The fields of two stores are the same, bit for bit, and none is missing."""
    with xr.open_datatree(one, engine="zarr") as left, xr.open_datatree(other, engine="zarr") as right:
        a, b = variable(left, "fourier", "fourier"), variable(right, "fourier", "fourier")
        assert a["mesh"].values.tolist() == b["mesh"].values.tolist()
        for label in a["mesh"].values.tolist():
            if label not in besides:
                assert not np.isnan(a.sel(mesh=label).values).any(), label
                assert np.array_equal(a.sel(mesh=label).values, b.sel(mesh=label).values), label


def assert_same_tables(one: Path | str, other: Path | str) -> None:
    """The tables of two stores agree to rounding."""
    with xr.open_datatree(one, engine="zarr") as left, xr.open_datatree(other, engine="zarr") as right:
        for group, name in TABLES:
            a, b = variable(left, group, name), variable(right, group, name)
            np.testing.assert_allclose(a.values, b.values, rtol=1e-12, atol=0, err_msg=f"{group}/{name}")
        for name in ("status", "digest"):
            a, b = variable(left, "meshes", name), variable(right, "meshes", name)
            assert a.values.tolist() == b.values.tolist()
