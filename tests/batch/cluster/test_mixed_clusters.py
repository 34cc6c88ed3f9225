"""Clusters of workers with and without a GPU; the GPU is a strict imitation, the processes are real."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from sobolev_batch import Study, open_store, run
from sobolev_batch.batch.cluster.clients import remote_client
from sobolev_batch.batch.cluster.workers import GPU, prepare_workers
from tests.support.processes import tcp_cluster
from tests.support.repository import ROOT
from tests.support.studies import small_table, variable

pytestmark = pytest.mark.all

PRETEND = ["--preload", str(ROOT / "tests" / "support" / "pretend_gpu.py")]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a device that no other test has."""
    name = f"GPU-pretend-{os.getpid()}-{os.urandom(4).hex()}"
    monkeypatch.setenv("PRETEND_GPU", name)
    return name


def study_on(backend: str, **changes: Any) -> Study:
    family = [{"name": "ico", "source": "icosphere", "levels": [0, 1, 2, 3, 4]}]
    return Study.from_table(small_table(transform={"backend": backend}, family=family, **changes))


def meshes(store: Path) -> xr.Dataset:
    found = open_store(store)["meshes"].to_dataset()
    return found.sel(mesh=found["triangles"] > 0)


def test_one_device_serves_one_worker_and_studies_use_what_there_is(
    device: str, finished_store: Path, tmp_path: Path
) -> None:
    # Two find the host's one GPU, one finds none.
    with tcp_cluster(PRETEND, PRETEND, []) as (address, _), remote_client(address) as client:
        workers = prepare_workers(client)
        assert sorted(member.backend for member in workers.members) == ["cpu", "cpu", "gpu"]
        notes = sorted(member.note for member in workers.members if member.backend == "cpu")
        assert notes[0].startswith("no GPU left: other workers have all of the 1 that it may use")
        (equipped,) = (member for member in workers.members if member.backend == "gpu")
        assert equipped.note.startswith("fake, ")
        declared = client.scheduler_info(n_workers=-1)["workers"]
        assert [address for address in declared if declared[address]["resources"].get(GPU)] == [equipped.address]

        assert not run(study_on("gpu"), tmp_path / "gpu.zarr", client).failed
        assert not run(study_on("auto"), tmp_path / "auto.zarr", client).failed
        assert not run(study_on("cpu"), tmp_path / "cpu.zarr", client).failed
    on_gpu, on_any, on_cpu = (meshes(tmp_path / f"{name}.zarr") for name in ("gpu", "auto", "cpu"))
    assert set(on_gpu["worker"].values.tolist()) == {equipped.address}
    assert set(on_gpu["backend"].values.tolist()) == {"cufinufft"}
    # Each worker with what it has, and the store tells by whom.
    for mesh in on_any["mesh"].values.tolist():
        row = on_any.sel(mesh=mesh)
        assert row["backend"].item() == ("cufinufft" if row["worker"].item() == equipped.address else "finufft")
    assert set(on_cpu["backend"].values.tolist()) == {"finufft"}
    expected = variable(open_store(finished_store), "fourier", "fourier")
    for name in ("gpu", "auto", "cpu"):
        found = variable(open_store(tmp_path / f"{name}.zarr"), "fourier", "fourier").sel(mesh=expected["mesh"])
        assert np.abs(found.values - expected.values).max() < 5e-9 * 4 * np.pi
