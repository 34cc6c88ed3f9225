"""Results of a reduction in tables."""

from __future__ import annotations

from pathlib import Path

import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Study, open_store, run, verify
from sobolev_batch.store import layout
from tests.support.stores import assert_same_results
from tests.support.studies import small_table


def test_tables_in_many_chunks_are_those_in_one(
    monkeypatch: pytest.MonkeyPatch, store_path: Path, finished_store: Path, threads: Client
) -> None:
    monkeypatch.setattr(layout, "_LARGEST_CHUNK_BYTES", 16)
    run(Study.from_table(small_table()), store_path, threads)
    assert len(list((store_path / "convergence/distance/c").rglob("*"))) > 5
    assert verify(store_path).is_sound
    assert_same_results(store_path, finished_store)
    assert open_store(store_path)["distances"].sizes["mesh"] == 5


def test_tables_have_coordinates_and_nothing_but_nan_of_a_mesh_that_failed(store_path: Path, threads: Client) -> None:
    table = small_table()
    table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
    run(Study.from_table(table), store_path, threads)
    tree = xr.open_datatree(store_path, engine="zarr").load()
    for group, number in (("norms", "norm"), ("distances", "distance"), ("convergence", "distance")):
        assert list(tree[group].data_vars)[:3] == [number, "error", "error_part"]
        xr.testing.assert_equal(tree[group]["error_part"].sum("part", skipna=False), tree[group]["error"])
    for group in ("meshes", "norms", "distances", "convergence"):
        whole = tree[group].to_dataset()
        small = whole.where(whole["triangles"] < 100, drop=True)
        assert small["mesh"].values.tolist() == ["ico/0", "ico/1", "reference"]
        assert small["family"].values.tolist() == ["ico", "ico", "reference"]
        failed = whole.sel(mesh="lost/nowhere").drop_vars(
            ["rank", "row", "finished", "resolved", "within"], errors="ignore"
        )
        assert failed["status"] == "failed"
        assert all(values.isnull().all() for values in (*failed.data_vars.values(), failed["vertices"]))
    finished = tree["meshes"].to_dataset()["finished"]
    assert finished.dtype.kind == "M"
    assert finished.isnull().sum() == 0
    smallest = tree["convergence"].to_dataset()["relative"].groupby("family").min()
    assert smallest["family"].values.tolist() == ["ico", "lost", "reference"]
    assert smallest.isnull().any("order").values.tolist() == [False, True, False]
