"""Workers that leave in the middle of a study hand on their work, and late ones get some.

A gate beside a mesh file holds the worker that loads it in its task for as long as a test wants.
"""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client, Worker

from sobolev_batch import Study, icosphere, open_store, run
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.store.store import Store
from tests.support import gate
from tests.support.processes import PATIENCE_SECONDS, SCHEDULER, WORKER, dask, scheduler_address, stop, wait_until
from tests.support.studies import small_table, variable

pytestmark = pytest.mark.all


class Cluster:
    """A scheduler and workers, each a process, started one by one."""

    def __init__(self, scheduler: subprocess.Popen[str], address: str) -> None:
        self.processes = [scheduler]
        self.address = address

    def start(self, *options: str) -> subprocess.Popen[str]:
        self.processes.append(dask("worker", self.address, *WORKER, "--preload", gate.__file__, *options))
        return self.processes[-1]


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    scheduler = dask(*SCHEDULER)
    made: Cluster | None = None
    try:
        made = Cluster(scheduler, scheduler_address(scheduler))
        yield made
    finally:
        for process in reversed(made.processes if made else [scheduler]):
            stop(process)


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """Four mesh files; `0.off` comes first."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for level in range(4):
        mesh = icosphere(level)
        lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.triangles)} 0"]
        lines += [" ".join(map(repr, vertex)) for vertex in mesh.vertices.tolist()]
        lines += [f"3 {a} {b} {c}" for a, b, c in mesh.triangles.tolist()]
        (folder / f"{level}.off").write_text("\n".join(lines) + "\n")
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    return Study.from_table(small_table(family=family), folder=folder)


class Gate:
    """Holds whoever loads a mesh file, once it is begun, until it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = gate.gate_of(path)
        self.aside = path.with_suffix(".aside")
        os.mkfifo(self.path)

    def set_aside(self) -> None:
        """Let everybody pass but those who wait already."""
        self.path.rename(self.aside)

    def open(self) -> bool:
        """Let those pass who wait; whether there are any."""
        try:
            os.close(os.open(self.aside, os.O_WRONLY | os.O_NONBLOCK))
        except OSError:
            return False
        return True


def check_store(client: Client, study: Study, path: Path, other: Path) -> None:
    """All meshes are complete, and their fields and distances those of an undisturbed run."""
    run(study, other, client)
    assert [record.status for record in Store.open(path).records() if record] == ["complete"] * 5
    ours, theirs = open_store(path), open_store(other)
    for group, name in (("fourier", "fourier"), ("distances", "distance")):
        assert np.array_equal(variable(ours, group, name).values, variable(theirs, group, name).values)
    assert np.isfinite(variable(ours, "fourier", "fourier").values).all()


def test_a_task_of_a_retired_worker_is_done_by_one_that_joined_late(
    cluster: Cluster, client: Client, study: Study, store_path: Path, tmp_path: Path
) -> None:
    processes = [cluster.start(), cluster.start()]
    records: list[Any] = []
    with Client(cluster.address) as ours:
        ours.wait_for_workers(2, timeout=PATIENCE_SECONDS)
        early = set(ours.scheduler_info(n_workers=-1)["workers"])
        held: Gate | None = None

        def disturb(progress: Progress) -> None:
            nonlocal held
            if progress.stage == "cluster":
                held = Gate(study.folder / "0.off")  # what it depends on is known, nothing is submitted yet
            if progress.record is not None:
                records.append(progress.record)
            if progress.stage == "fields" and progress.done == progress.total - 1:
                assert held is not None
                busy = [worker for worker, keys in ours.processing().items() if keys]
                assert len(busy) == 1
                held.set_aside()
                cluster.start()
                ours.wait_for_workers(3, timeout=PATIENCE_SECONDS)
                # The one in the middle of its task, and the one that could have taken it.
                ours.retire_workers(list(early))

        summary = run(study, store_path, ours, on_progress=disturb)
    assert len(summary.computed) == 5
    assert summary.failed == {}
    assert {record.worker for record in records[:-1]} <= early
    assert records[-1].worker not in early
    # What had begun on the retired worker ends there after all: it comes too late, and leaves the store alone.
    assert held is not None
    assert held.open()
    for process in processes:
        process.communicate(timeout=PATIENCE_SECONDS)
    last = next(record for record in Store.open(store_path).records() if record and record.key == records[-1].key)
    assert last.worker not in early
    check_store(client, study, store_path, tmp_path / "undisturbed.zarr")


def test_a_worker_at_the_end_of_its_lifetime_hands_on_its_work(
    cluster: Cluster, client: Client, study: Study, store_path: Path, tmp_path: Path
) -> None:
    leaving = cluster.start()
    left = threading.Event()

    with Client(cluster.address) as ours, following(ours, "remove-worker", left):
        ours.wait_for_workers(1, timeout=PATIENCE_SECONDS)
        first = next(iter(ours.scheduler_info()["workers"]))
        held: Gate | None = None

        def disturb(progress: Progress) -> None:
            nonlocal held
            if progress.stage == "cluster":
                held = Gate(study.folder / "0.off")
                threading.Thread(target=replace, args=(held,)).start()

        def replace(held: Gate) -> None:
            wait_until(lambda: any(ours.run(executing).values()))
            ours.run(end_lifetime)
            assert left.wait(timeout=PATIENCE_SECONDS)
            held.set_aside()
            cluster.start()

        summary = run(study, store_path, ours, on_progress=disturb)
    assert len(summary.computed) == 5
    assert held is not None
    held.open()
    leaving.communicate(timeout=PATIENCE_SECONDS)
    workers = {record.worker for record in Store.open(store_path).records() if record}
    assert workers - {first}
    check_store(client, study, store_path, tmp_path / "undisturbed.zarr")


def executing(dask_worker: Worker) -> int:
    """Return how many tasks the worker is in the middle of."""
    return len(dask_worker.state.executing)


def end_lifetime(dask_worker: Worker) -> None:
    """Do what the worker does by itself at the end of its lifetime."""
    dask_worker.io_loop.add_callback(dask_worker.close_gracefully, reason="worker-lifetime-reached")


@contextmanager
def following(client: Client, action: str, happened: threading.Event) -> Iterator[None]:
    """Set an event when the scheduler does something."""

    def look(event: tuple[float, Any]) -> None:
        if isinstance(event[1], dict) and event[1].get("action") == action:
            happened.set()

    client.subscribe_topic("all", look)
    try:
        yield
    finally:
        client.unsubscribe_topic("all")
