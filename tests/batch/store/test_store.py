"""The store's layout, what it refuses, and that it reads without this package."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from distributed import Client

from sobolev_batch import StoreError, Study, open_store, run
from sobolev_batch.batch.store.create import prepare_store
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import Plan, make_plan
from tests.support.repository import blocks
from tests.support.stores import READER, contents
from tests.support.studies import small_table


def small_plan(**changes: object) -> Plan:
    return make_plan(Study.from_table(small_table(**changes)))


def test_fields_that_were_not_computed_are_nan_and_zeros_are_kept(store_path: Path) -> None:
    plan = small_plan()
    store = prepare_store(store_path, plan)
    (place,) = store.places()
    store.write_field(3, place, np.zeros(plan.lattice.shape, dtype=complex))
    fields = store.read_fields([0, 3], place)
    assert np.isnan(fields[0]).all()
    assert (fields[1] == 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"study": {"name": "other"}}, "the study 'small', not 'other'"),
        ({"lattice": {"xi_max": 3.0, "M": 18}}, "a lattice of xi_max 3 and M 16, not xi_max 3 and M 18"),
        ({"transform": {"dtype": "complex64"}}, "dtype 'complex128', not 'complex64'"),
    ],
)
def test_refuses_the_store_of_another_study_and_leaves_it_alone(
    store_path: Path, changes: dict[str, object], message: str
) -> None:
    prepare_store(store_path, small_plan())
    before = contents(store_path)
    with pytest.raises(StoreError, match=message):
        prepare_store(store_path, small_plan(**changes))
    assert contents(store_path) == before


def test_new_meshes_become_new_rows(store_path: Path) -> None:
    store = prepare_store(store_path, small_plan())
    store.write_record(0, Record("k", "complete"))
    more = [
        {"name": "more", "source": "icosphere", "levels": [0, 1]},
        {"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3]},
    ]
    grown = prepare_store(store_path, small_plan(family=more))
    assert grown.labels()[:5] == ("ico/0", "ico/1", "ico/2", "ico/3", "reference")
    assert grown.labels()[5:] == ("more/0", "more/1")
    assert [record is None for record in grown.records()] == [False, True, True, True, True, True, True]


def test_opening_what_is_no_store_or_a_newer_one(store_path: Path) -> None:
    with pytest.raises(StoreError, match="it holds no store of a study"):
        Store.open(store_path)
    zarr.create_group(str(store_path.with_name("other.zarr")))
    with pytest.raises(StoreError, match="not one of a study"):
        prepare_store(store_path.with_name("other.zarr"), small_plan())
    prepare_store(store_path, small_plan())
    zarr.open_group(str(store_path), mode="r+").attrs["schema_version"] = 99
    with pytest.raises(StoreError, match="its schema has version 99, this program reads"):
        Store.open(store_path)


def test_plain_xarray_reads_everything_without_this_package(finished_store: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", READER, str(finished_store)], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert 0.003 < float(done.stdout) < 0.006


@pytest.mark.parametrize("octaves", [0, 1])
def test_zarr_and_numpy_alone_compute_norms_and_distances(octaves: int, store_path: Path, threads: Client) -> None:
    lattice = {"xi_max": 3.0, "M": 16, "octaves": octaves}
    run(Study.from_table(small_table(lattice=lattice)), store_path, threads)
    tree = open_store(store_path)
    (function,) = (block for block in blocks("docs/store.md", "python") if "def squared_norm" in block)
    names: dict[str, Any] = {}
    exec(function, names)
    store = zarr.open_group(str(store_path), mode="r")
    norms, convergence, reference = tree["norms"].to_dataset(), tree["convergence"].to_dataset(), 4
    for row, label in enumerate(Store.open(store_path).labels()):
        for order in (-10.0, -3.0):
            norm, distance = (table.sel(mesh=label, order=order) for table in (norms, convergence))
            squared = names["squared_norm"](store, row, None, order) + norm["beyond"].item()
            assert squared == pytest.approx(norm["norm"].item() ** 2, rel=1e-13)
            squared = names["squared_norm"](store, row, reference, order) + distance["beyond"].item()
            assert squared == pytest.approx(distance["distance"].item() ** 2, rel=1e-13)
    assert (norms["beyond"] > 0).all() == (convergence["beyond"].drop_sel(mesh="reference") > 0).all() == bool(octaves)


def test_every_array_carries_a_checksum(store_path: Path) -> None:
    prepare_store(store_path, small_plan())
    metadata = [json.loads(path.read_text()) for path in store_path.rglob("zarr.json")]
    arrays = [entry for entry in metadata if entry["node_type"] == "array"]
    assert len(arrays) >= 6
    for entry in arrays:
        assert entry["codecs"][-1]["name"] == "crc32c"
