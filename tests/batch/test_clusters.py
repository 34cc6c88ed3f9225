"""Real schedulers and workers, as users start them, and the ports that a local cluster opens."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from distributed import Client

from sobolev_batch import ClusterError, Study, open_store, run
from sobolev_batch.batch.cluster import local_client, remote_client
from tests.batch.conftest import variable

SCHEDULER = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]


def dask(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "dask", *arguments], stderr=subprocess.PIPE, text=True)


def stop(process: subprocess.Popen[str]) -> None:
    """End a process, by force if it does not go of itself: a worker may wait for a peer that is gone."""
    process.terminate()
    try:
        process.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


@pytest.fixture
def tcp_scheduler() -> Iterator[str]:
    """The address of a `dask scheduler` with two `dask worker` processes."""
    scheduler = dask(*SCHEDULER)
    processes = [scheduler]
    try:
        assert scheduler.stderr is not None
        address = next(found[0] for line in scheduler.stderr if (found := re.search(r"tcp://127\.0\.0\.1:\d+", line)))
        worker = ["worker", address, "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        processes += [dask(*worker) for _ in range(2)]
        with Client(address) as client:
            client.wait_for_workers(2, timeout=60)
        yield address
    finally:
        for process in reversed(processes):
            stop(process)


def test_a_study_on_a_scheduler_with_two_workers_over_tcp(
    tcp_scheduler: str, study: Study, finished_store: Path, store_path: Path
) -> None:
    with remote_client(tcp_scheduler) as client:
        summary = run(study, store_path, client)
    assert len(summary.computed) == 5
    ours, theirs = open_store(store_path), open_store(finished_store)
    assert np.array_equal(variable(ours, "fourier", "fourier").values, variable(theirs, "fourier", "fourier").values)
    assert np.array_equal(
        variable(ours, "distances", "distance").values, variable(theirs, "distances", "distance").values
    )
    workers = set(variable(ours, "meshes", "worker").values.tolist())
    assert len(workers) == 2


def test_no_scheduler_there() -> None:
    with (
        pytest.raises(ClusterError, match=r"no Dask scheduler answers at 'tcp://127\.0\.0\.1:9'"),
        remote_client("tcp://127.0.0.1:9"),
    ):
        pass


def test_a_scheduler_without_workers() -> None:
    scheduler = dask(*SCHEDULER)
    try:
        assert scheduler.stderr is not None
        address = next(found[0] for line in scheduler.stderr if (found := re.search(r"tcp://127\.0\.0\.1:\d+", line)))
        with pytest.raises(ClusterError, match="has no workers; start some with: dask worker"), remote_client(address):
            pass
    finally:
        stop(scheduler)


def test_a_local_cluster_listens_on_loopback_only() -> None:
    this = psutil.Process()
    with local_client(1):
        processes = [this, *this.children(recursive=True)]
        listening = [
            connection.laddr.ip
            for process in processes
            for connection in process.net_connections(kind="inet")
            if connection.status == psutil.CONN_LISTEN
        ]
    assert len(listening) >= 3  # scheduler, dashboard, worker
    assert set(listening) <= {"127.0.0.1", "::1"}
