"""`field.sobolev` on computed and stored fields, single ones and stacks."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array
import numpy as np
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.accessor import SobolevAccessor
from sobolev_batch.spectral.fields import Quality
from tests.support.studies import variable

ORDERS = [-1.5, -7.0]


@pytest.fixture(scope="module")
def fields() -> tuple[xr.DataArray, xr.DataArray]:
    lattice = sb.Lattice(4.0, 32)
    return sb.fourier_transform(sb.icosphere(1), lattice), sb.fourier_transform(sb.Sphere(), lattice)


def test_methods_are_the_functions(fields: tuple[xr.DataArray, xr.DataArray]) -> None:
    a, b = fields
    points = sb.icosphere(1).vertices
    own: SobolevAccessor = a.sobolev
    xr.testing.assert_identical(own.norm(ORDERS), sb.norm(a, ORDERS))
    xr.testing.assert_identical(own.distance(b, -2), sb.distance(a, b, -2))
    xr.testing.assert_identical(own.spectrum(b, ORDERS, bands=5), sb.spectrum(a, b, ORDERS, bands=5))
    xr.testing.assert_identical(own.spectrum(None, -2), sb.spectrum(a, None, -2))
    xr.testing.assert_allclose(own.witness(b, -2, points), sb.witness(a, b, -2, points), rtol=1e-9)
    assert own.lattice == sb.Lattice(4.0, 32)
    # A surface beside a field is transformed on its lattice.
    assert own.distance(sb.Sphere(), -2)["distance"].item() == pytest.approx(own.distance(b, -2)["distance"].item())


def test_one_pair_reads_no_other_mesh(finished_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree, parsed, parse = sb.open_store(finished_store), [], Quality.from_json

    def from_json(text: str) -> Quality:
        parsed.append(text)
        return parse(text)

    monkeypatch.setattr(Quality, "from_json", from_json)
    monkeypatch.delattr(Store, "records")
    found = tree.sobolev.distance("ico/3", "reference", -3.0)
    assert len(parsed) == 2
    expected = variable(tree, "convergence", "distance").sel(mesh="ico/3", order=-3.0)
    assert found["distance"].item() == pytest.approx(expected.item(), rel=1e-12)
    tree.sobolev.norm("ico/3", -3.0)
    assert len(parsed) == 3


def test_stacks_are_taken_one_by_one(finished_store: Path) -> None:
    tree = sb.open_store(finished_store)
    stored = variable(tree, "fourier", "fourier")
    levels = stored.sel(mesh=["ico/1", "ico/3"])
    norms = levels.sobolev.norm(ORDERS)
    assert norms["norm"].dims == ("mesh", "order")
    assert norms["mesh"].values.tolist() == ["ico/1", "ico/3"]
    distances = levels.sobolev.distance(stored.sel(mesh="reference"), [-10.0, -3.0])
    tables = variable(tree, "convergence", "distance").sel(mesh=["ico/1", "ico/3"], order=[-10.0, -3.0])
    assert distances["distance"].values == pytest.approx(tables.values, rel=1e-9)
    bands = levels.sobolev.spectrum(None, -2.0)
    assert bands["squared"].dims == ("mesh", "band")
    assert bands["lower"].dims == ("band",)
    for i, label in enumerate(["ico/1", "ico/3"]):
        one = stored.sel(mesh=label)
        assert norms["norm"].values[i] == pytest.approx(sb.norm(one, ORDERS)["norm"].values, rel=1e-13)


@pytest.mark.slow
def test_a_stack_is_not_held_at_once() -> None:
    field = sb.fourier_transform(sb.Sphere(0.5), sb.Lattice(4.0, 48))
    values = dask.array.ones((40, *field.shape), dtype=np.complex128, chunks=(1, *field.shape))
    lazy = xr.DataArray(values, dims=("mesh", *field.dims), coords={**field.coords, "mesh": np.arange(40)})
    lazy.isel(mesh=slice(1)).sobolev.norm(-2.0)
    tracemalloc.start()
    try:
        found = lazy.sobolev.norm(-2.0)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found["norm"].shape == (40,)
    assert peak < lazy.nbytes / 4


REFUSED: list[tuple[Callable[[xr.DataArray, xr.DataArray], object], str]] = [
    (lambda stack, b: stack.sobolev.witness(b, -2, np.zeros((1, 3))), "select one mesh"),
    (lambda stack, b: stack.expand_dims(time=2).sobolev.norm(-2), "one dimension, found time, mesh"),
    (lambda stack, b: stack.isel(mesh=slice(0)).sobolev.norm(-2), "no fields along mesh"),
    (lambda stack, b: xr.DataArray(np.zeros(3)).sobolev.lattice, "needs the coordinates"),
    (lambda stack, b: b.sobolev.distance(sb.fourier_transform(sb.Sphere(), sb.Lattice(4.0, 30)), -2), "different lat"),
]


@pytest.mark.parametrize(("ask", "message"), REFUSED)
def test_refusals(ask: Any, message: str, fields: tuple[xr.DataArray, xr.DataArray]) -> None:
    stack = xr.concat(fields, dim="mesh")
    with pytest.raises(sb.InputError, match=message):
        ask(stack, fields[1])
    # Without labels, the dimension alone.
    assert "mesh" not in stack.sobolev.norm(-2).coords


@pytest.mark.process
@pytest.mark.parametrize("name", ["fourier_transform", "open_store", "SobolevAccessor"])
def test_is_registered_when_fields_are_made_and_not_before(name: str) -> None:
    code = f"""
import sys
import sobolev_batch as sb
assert "xarray" not in sys.modules
sb.{name}
import xarray
assert "sobolev" in dir(xarray.DataArray)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
