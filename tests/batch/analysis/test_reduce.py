"""Results of a reduction in memory and in tables: distances of all pairs are large."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client

from sobolev_batch import Study, open_store, run, verify
from sobolev_batch.batch.analysis.tabulate import Results
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store import tables
from sobolev_batch.batch.store.store import Store
from sobolev_batch.spectral.budget import NormEstimate
from tests.support.stores import assert_same_tables
from tests.support.studies import small_table


def test_tiles_enter_the_order_of_tables_without_a_copy() -> None:
    meshes = xr.Dataset({"row": ("mesh", [7, 3, 5])}, coords={"mesh": ["a", "b", "c"]})
    results = Results.empty(meshes, "a", (-2.0, -1.0), every_pair=True)
    whole = results.distances
    pairs = np.random.default_rng(0).uniform(size=(5, 2, 2, 1))
    results.enter_tile(NormEstimate(*pairs), [5, 7], [3])
    assert results.distances is whole
    np.testing.assert_array_equal(whole[..., [2, 0], :][..., [1]], pairs)
    np.testing.assert_array_equal(whole[..., 1, [2, 0]], pairs[..., 0])
    assert np.isnan(whole[..., [0, 1, 2], [0, 1, 2]]).all()


def test_a_large_table_is_written_array_by_array(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    count, names = 1000, ("a", "b", "c", "d", "e")
    array_bytes = count * count * 8
    monkeypatch.setattr(tables, "_LARGEST_CHUNK_BYTES", array_bytes // 16)
    values = np.random.default_rng(0).uniform(size=(1, count, count))
    # The order comes first in memory and last in a table.
    dataset = xr.Dataset({name: (("mesh", "other", "order"), np.moveaxis(values, 0, -1)) for name in names})
    store = Store(Location.parse(tmp_path / "store"))
    tracemalloc.start()
    try:
        tables.write_table(store, "distances", dataset)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < len(names) * array_bytes
    stored = store.array("distances/e")
    assert stored.chunks[0] * stored.nbytes / count <= array_bytes // 16
    np.testing.assert_array_equal(stored[...], np.moveaxis(values, 0, -1))


def test_tables_in_many_chunks_are_those_in_one(
    monkeypatch: pytest.MonkeyPatch, store_path: Path, finished_store: Path, threads: Client
) -> None:
    monkeypatch.setattr(tables, "_LARGEST_CHUNK_BYTES", 64)
    run(Study.from_table(small_table()), store_path, threads)
    assert len(list((store_path / "distances/distance/c").rglob("*"))) > 5
    assert verify(store_path).is_sound
    assert_same_tables(store_path, finished_store)
    assert open_store(store_path)["distances"].sizes["mesh"] == 5
