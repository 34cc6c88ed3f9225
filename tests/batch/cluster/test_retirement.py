"""Workers that leave in the middle of a study hand on their work, and late ones get some.

A gate beside a mesh file holds the worker that loads it in its task for as long as a test wants.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from distributed import Client

from sobolev_batch import Study, icosphere, run, write_mesh
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.store.store import Store
from tests.support import gate
from tests.support.processes import PATIENCE_SECONDS, WORKER, dask, tcp_cluster, wait_until
from tests.support.stores import assert_same_results
from tests.support.studies import small_table

pytestmark = pytest.mark.all


Cluster = tuple[str, list[subprocess.Popen[str]]]
GATED = ["--preload", gate.__file__]


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    """A scheduler with one worker."""
    with tcp_cluster(GATED) as started:
        yield started


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """Four mesh files; `0.off` comes first."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for level in range(4):
        write_mesh(icosphere(level), folder / f"{level}.off")
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    return Study.from_table(small_table(family=family), folder=folder)


class Gate:
    """Holds the first who loads a mesh file, once it is begun, until it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = gate.gate_of(path)
        os.mkfifo(self.path)

    def await_one(self) -> None:
        """Wait until somebody is at the gate, and let everybody else pass."""
        self.writer = wait_until(self._writer)
        self.path.unlink()

    def _writer(self) -> int | None:
        try:
            return os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:  # nobody reads
            return None

    def open(self) -> None:
        """Let those pass who wait."""
        if self.writer is not None:
            os.close(self.writer)


def test_a_worker_that_leaves_hands_on_the_task_that_it_is_in(
    cluster: Cluster, client: Client, study: Study, store_path: Path, tmp_path: Path
) -> None:
    address, processes = cluster
    leaving = processes[1]
    gates: list[Gate] = []
    with Client(address) as ours, ThreadPoolExecutor(1) as pool:
        (first,) = ours.scheduler_info()["workers"]

        def replace() -> None:
            gates[0].await_one()
            processes.append(dask("worker", address, *WORKER, *GATED))
            ours.wait_for_workers(2, timeout=PATIENCE_SECONDS)
            ours.retire_workers([first])

        def disturb(progress: Progress) -> None:
            if progress.stage == "cluster":
                gates.append(Gate(study.folder / "0.off"))
                pool.submit(replace)

        summary = run(study, store_path, ours, on_progress=disturb)
    assert (len(summary.computed), summary.failed) == (5, {})
    # What had begun on the worker ends there after all: it comes too late, and leaves the store alone.
    gates[0].open()
    leaving.communicate(timeout=PATIENCE_SECONDS)
    assert {record.worker for record in Store.open(store_path).records() if record} - {first}
    run(study, tmp_path / "undisturbed.zarr", client)
    assert [record.status for record in Store.open(store_path).records() if record] == ["complete"] * 5
    assert_same_results(store_path, tmp_path / "undisturbed.zarr")
