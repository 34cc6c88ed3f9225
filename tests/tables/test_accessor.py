"""`tree.sobolev`: norms, distances and spectra of stored meshes."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.errors import StoreError
from sobolev_batch.norms.fields import Quality
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from sobolev_batch.transform.spheres import sphere_inner_product
from tests.support.studies import small_table, variable


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


@pytest.mark.process
@pytest.mark.parametrize("name", ["open_store", "result_types"])
def test_is_registered_when_stores_are_opened_and_not_before(name: str) -> None:
    code = f"""
import sys
import sobolev_batch as sb
assert "xarray" not in sys.modules
sb.{name}
import xarray
assert "sobolev" in dir(xarray.DataTree)
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
