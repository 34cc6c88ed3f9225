"""Results of a reduction in memory and in tables: distances of all pairs are large."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Study, open_store, run, verify
from sobolev_batch.batch.analysis.tabulate import Results, pairs_bytes
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store import tables
from sobolev_batch.batch.store.store import Store
from tests.support.stores import assert_same_results
from tests.support.studies import small_table


def test_a_table_of_all_pairs_is_written_array_by_array_within_the_memory_that_a_plan_counts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    count, array_bytes = 1000, 8_000_000
    monkeypatch.setattr(tables, "_LARGEST_CHUNK_BYTES", array_bytes // 16)
    labels = np.array([f"f/{i}" for i in range(count)], dtype=object)
    columns = ("row", "family", "name", "level", "status", "vertices", "triangles", "edge_length_mean", "seconds")
    meshes = xr.Dataset({name: ("mesh", np.arange(count)) for name in columns}, coords={"mesh": labels})
    store = Store(Location.parse(tmp_path / "store"))
    tracemalloc.start()
    try:
        results = Results.empty(meshes, "f/0", (-2.0,), every_pair=True)
        results.distances[...] = np.random.default_rng(0).uniform(size=(count, count))
        tables.write_table(store, "distances", results.distances_table())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.5 * pairs_bytes(count, 1) < peak <= pairs_bytes(count, 1)
    stored = store.array("distances/truncation")
    assert stored.chunks[0] * stored.nbytes / count <= array_bytes // 16
    np.testing.assert_array_equal(stored[..., 0], results.distances[1, 0])


def test_tables_in_many_chunks_are_those_in_one(
    monkeypatch: pytest.MonkeyPatch, store_path: Path, finished_store: Path, threads: Client
) -> None:
    monkeypatch.setattr(tables, "_LARGEST_CHUNK_BYTES", 64)
    run(Study.from_table(small_table()), store_path, threads)
    assert len(list((store_path / "distances/distance/c").rglob("*"))) > 5
    assert verify(store_path).is_sound
    assert_same_results(store_path, finished_store)
    assert open_store(store_path)["distances"].sizes["mesh"] == 5


def test_tables_have_coordinates_and_nothing_but_nan_of_a_mesh_that_failed(store_path: Path, threads: Client) -> None:
    table = small_table()
    table["family"].append({"name": "lost", "source": "files", "paths": ["nowhere.ply"]})
    run(Study.from_table(table), store_path, threads)
    tree = xr.open_datatree(store_path, engine="zarr").load()
    for group in ("meshes", "norms", "distances", "convergence"):
        whole = tree[group].to_dataset()
        small = whole.where(whole["triangles"] < 100, drop=True)
        assert small["mesh"].values.tolist() == ["ico/0", "ico/1", "reference"]
        assert small["family"].values.tolist() == ["ico", "ico", "reference"]
        failed = whole.sel(mesh="lost/nowhere").drop_vars(["rank", "row", "resolved", "within"], errors="ignore")
        assert failed["status"] == "failed"
        assert all(values.isnull().all() for values in (*failed.data_vars.values(), failed["vertices"]))
    smallest = tree["convergence"].to_dataset()["relative"].groupby("family").min()
    assert smallest["family"].values.tolist() == ["ico", "lost", "reference"]
    assert smallest.isnull().any("order").values.tolist() == [False, True, False]
