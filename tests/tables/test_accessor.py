"""`field.sobolev` on computed and stored fields, single ones and stacks."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.array
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.errors import StoreError
from sobolev_batch.norms.fields import Quality
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from sobolev_batch.tables.accessor import SobolevAccessor
from sobolev_batch.transform.spheres import sphere_inner_product
from tests.support.studies import small_table, variable

ORDERS = [-1.5, -7.0]


@pytest.fixture(scope="module")
def fields() -> tuple[xr.DataArray, xr.DataArray]:
    lattice = sb.Lattice(4.0, 32)
    return sb.fourier_transform(sb.shapes.icosphere(1), lattice), sb.fourier_transform(sb.shapes.Sphere(), lattice)


def test_methods_are_the_functions(fields: tuple[xr.DataArray, xr.DataArray]) -> None:
    a, b = fields
    points = sb.shapes.icosphere(1).vertices
    own: SobolevAccessor = a.sobolev
    xr.testing.assert_identical(own.norm(ORDERS), sb.norm(a, ORDERS))
    xr.testing.assert_identical(own.distance(b, -2), sb.distance(a, b, -2))
    xr.testing.assert_identical(own.spectrum(b, ORDERS, bands=5), sb.spectrum(a, b, ORDERS, bands=5))
    xr.testing.assert_identical(own.spectrum(None, -2), sb.spectrum(a, None, -2))
    xr.testing.assert_allclose(own.witness(b, -2, points), sb.witness(a, b, -2, points), rtol=1e-9)
    assert own.lattice == sb.Lattice(4.0, 32)
    # A surface beside a field is transformed on its lattice.
    assert own.distance(sb.shapes.Sphere(), -2)["distance"].item() == pytest.approx(
        own.distance(b, -2)["distance"].item()
    )


def test_one_pair_reads_no_other_mesh(finished_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree, parsed, parse = sb.open_store(finished_store), [], Quality.from_json

    def from_json(text: str) -> Quality:
        parsed.append(text)
        return parse(text)

    monkeypatch.setattr(Quality, "from_json", from_json)
    monkeypatch.delattr(Records, "read")
    monkeypatch.delattr(Records, "read_one")
    found = tree.sobolev.distance(-3.5, "ico/3")
    assert len(parsed) == 2
    monkeypatch.undo()
    assert found["distance"].item() == pytest.approx(sb.table(tree, -3.5)["distance"].iloc[3], rel=1e-12)


def test_a_tree_that_xarray_has_opened_answers_too(finished_store: Path) -> None:
    plain, own = xr.open_datatree(finished_store, engine="zarr"), sb.open_store(finished_store)
    xr.testing.assert_equal(plain.sobolev.distance(-3.5)["distance"], own.sobolev.distance(-3.5)["distance"])


def test_fields_of_a_store_that_is_not_there_are_not_missing_values(copy: Path) -> None:
    fields = variable(sb.open_store(copy), "fourier", "fourier")
    shutil.rmtree(copy)
    # As for a worker on another machine.
    with pytest.raises(StoreError, match=f"^{re.escape(str(copy))}: it is not there for process"):
        fields.sel(mesh="ico/1").load()


def test_stacks_are_taken_one_by_one(finished_store: Path) -> None:
    tree = sb.open_store(finished_store)
    stored = variable(tree, "fourier", "fourier")
    # One mesh after the other, also where xarray computes with all.
    assert stored.chunksizes["mesh"] == (1,) * 5
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
    field = sb.fourier_transform(sb.shapes.Sphere(0.5), sb.Lattice(4.0, 48))
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
    (
        lambda stack, b: b.sobolev.distance(sb.fourier_transform(sb.shapes.Sphere(), sb.Lattice(4.0, 30)), -2),
        "different lat",
    ),
]


@pytest.mark.parametrize(("ask", "message"), REFUSED)
def test_refusals(ask: Any, message: str, fields: tuple[xr.DataArray, xr.DataArray]) -> None:
    stack = xr.concat(fields, dim="mesh")
    with pytest.raises(sb.errors.InputError, match=message):
        ask(stack, fields[1])
    # Without labels, the dimension alone.
    assert "mesh" not in stack.sobolev.norm(-2).coords


@pytest.mark.process
@pytest.mark.parametrize("name", ["fourier_transform", "open_store", "result_types"])
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


@pytest.fixture(scope="module")
def balls() -> str:
    """Return a store of all pairs of balls, and of a mesh that failed."""
    table = small_table(family=[{"name": f"b{k}", "source": "sphere", "radius": 0.3 + 0.05 * k} for k in range(12)])
    table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
    sb.run(sb.Study.from_table(table), "memory://accessor-balls.zarr", workers=1)
    return "memory://accessor-balls.zarr"


def test_distances_of_all_meshes_at_once(balls: str) -> None:
    tree = sb.open_store(balls)
    every = tree.sobolev.distance([-3.0, -2.5])
    assert every["distance"].dims == ("mesh", "order")
    frame = sb.table(balls, -2.5).set_index("mesh")
    for name in ("distance", "error", "relative", "relative_error", "area_part"):
        found = every[name].sel(order=-2.5).to_series().drop("reference")
        assert found.to_numpy() == pytest.approx(frame[name][found.index].to_numpy(), rel=1e-12, nan_ok=True)
    assert every["family"].sel(mesh="b3/sphere") == "b3"
    some = tree.sobolev.distance(-2.5, ["b3/sphere", "b1/sphere"])
    assert some["mesh"].values.tolist() == ["b3/sphere", "b1/sphere"]
    assert tree.sobolev.distance(-2.5, "b3/sphere")["distance"].dims == ()
    assert tree.sobolev.norm(-2.5)["norm"].sel(mesh="lost/nowhere").isnull()
    for order, label in itertools.product((-2.5, -10.0), ("lost/nowhere", "b99/sphere")):
        with pytest.raises(sb.errors.InputError, match=f"no mesh '{label}' with a field"):
            tree.sobolev.distance(order, label)


class _Counted(str):
    """A label that counts how often it is compared with another."""

    __slots__ = ()
    comparisons = 0

    def __eq__(self, other: object) -> bool:
        _Counted.comparisons += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_labels_of_many_meshes_are_found_without_a_search_for_each(balls: str, monkeypatch: pytest.MonkeyPatch) -> None:
    labels = Store.labels
    monkeypatch.setattr(Store, "labels", lambda store: tuple(map(_Counted, labels(store))))
    meshes = [f"b{k}/sphere" for k in range(12)]
    sb.open_store(balls).sobolev.distance(-3.0, meshes, "b2/sphere")
    # A search would compare half of all labels with each.
    assert 0 < _Counted.comparisons <= 4 * len(meshes)


def test_distances_of_all_meshes_from_another_than_the_reference(balls: str) -> None:
    found = sb.open_store(balls).sobolev.distance(-3.0, other="b2/sphere")
    expected = sb.matrix(balls, -3.0)["b2/sphere"].drop("lost/nowhere")
    pd.testing.assert_series_equal(
        found["distance"].to_series()[expected.index], expected, rtol=1e-9, check_names=False
    )


def test_errors_of_area_and_shape_cover_the_closed_form(balls: str) -> None:
    reference = 0.3 + 0.05 * 2
    found = sb.open_store(balls).sobolev.distance([-3.0, -5.0], [f"b{k}/sphere" for k in range(12)], "b2/sphere")
    own = sb.open_store(balls).sobolev.distance([-3.0, -5.0], [f"b{k}/sphere" for k in range(12)])
    for numbers, radius in ((found, reference), (own, 1.0)):
        b = sb.shapes.Sphere(radius)
        for k, order in itertools.product(range(12), (-3.0, -5.0)):
            row, a = numbers.sel(mesh=f"b{k}/sphere", order=order), sb.shapes.Sphere(0.3 + 0.05 * k)
            square, norm = sphere_inner_product(a, a, order), sphere_inner_product(b, b, order) ** 0.5
            area = abs(sphere_inner_product(a, b, order) - norm**2) / norm
            shape = (square + norm**2 - 2 * sphere_inner_product(a, b, order) - area**2) ** 0.5 if a != b else 0.0
            assert abs(row["area_part"] - area) <= row["area_part_error"] + 1e-15 * norm
            assert abs(row["shape_part"] - shape) <= row["shape_part_error"] + 1e-7 * norm
            # Whatever the lattice, no part exceeds the distance.
            assert row["area_part_error"] <= row["distance"] + row["error"]
    equal = found.sel(mesh="b2/sphere")
    assert (equal["area_part_error"] == 0).all()
    assert (equal["shape_part_error"] == 0).all()
