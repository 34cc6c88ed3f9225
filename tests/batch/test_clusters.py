"""Real schedulers and workers, as users start them, and the ports that a local cluster opens."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import dask as dask_settings
import numpy as np
import psutil
import pytest

from sobolev_batch import ClusterError, Study, open_store, run
from sobolev_batch.batch.cluster import local_client, remote_client
from tests.batch.conftest import variable
from tests.batch.processes import SCHEDULER, dask, scheduler_address, stop, tcp_cluster


@pytest.fixture
def tcp_scheduler() -> Iterator[str]:
    """The address of a `dask scheduler` with two `dask worker` processes."""
    with tcp_cluster([], []) as (address, _):
        yield address


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
        address = scheduler_address(scheduler)
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


def _die_once(mark: Path) -> int:
    """End this process the first time; its id the second."""
    if not mark.exists():
        mark.touch()
        os._exit(1)
    return os.getpid()


def test_a_local_worker_that_died_is_not_given_up(tmp_path: Path) -> None:
    # Without a word from us, Dask would close its nanny as soon as it looks for the worker and finds none.
    with dask_settings.config.set({"distributed.deploy.lost-worker-timeout": "0s"}), local_client(1) as client:
        first = client.submit(os.getpid, pure=False).result(timeout=60)
        assert client.submit(_die_once, tmp_path / "mark").result(timeout=120) != first
