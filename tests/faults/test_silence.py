"""Workers and schedulers that are stopped, and never say so: a run tells of them, and ends or goes on without them."""

from __future__ import annotations

import logging
import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import dask
import pytest
from distributed import Client

from sobolev_batch import ClusterError, Study, run
from sobolev_batch.batch.cluster import watch
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.watch import Watch
from tests.faults.conftest import LABELS
from tests.faults.fatal import Moment
from tests.support.processes import tcp_cluster, wait_until
from tests.support.stores import assert_same_results


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(watch, "_POLL_SECONDS", 1.0)
    monkeypatch.setattr(watch, "_TELL_AFTER_SECONDS", 3.0)
    # Of schedulers that are other processes, and of those in this one.
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "10s")
    with dask.config.set({"distributed.scheduler.worker-ttl": "10s"}):
        yield


@pytest.fixture
def stopped(strike: Callable[..., Moment]) -> Iterator[Moment]:
    """A worker of any cluster that is started meanwhile is stopped before it writes the field of ico/2."""
    moment = strike("field", 2, number=signal.SIGSTOP)
    yield moment
    for pid in moment.pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.all
@pytest.mark.parametrize("nanny", ["--nanny", "--no-nanny"])
def test_what_a_silent_worker_has_is_told_and_done_by_others(
    nanny: str, stopped: Moment, study: Study, store_path: Path, finished_store: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with tcp_cluster([nanny], [nanny]) as (address, _), Client(address) as client, caplog.at_level(logging.WARNING):
        summary = run(study, store_path, client)
    assert len(stopped.pids) == 1
    assert (summary.computed, summary.failed) == (LABELS, {})
    assert_same_results(store_path, finished_store)
    told = re.search(r"the worker (\S+) has said nothing since \d\d:\d\d:\d\d UTC, and has (.*?)\. Dask", caplog.text)
    assert told is not None, caplog.text
    assert "ico/2" in told[2]


@pytest.mark.all
def test_a_worker_of_a_cluster_of_ones_own_is_started_again(
    stopped: Moment, study: Study, store_path: Path, finished_store: Path
) -> None:
    with local_client(1) as client:
        summary = run(study, store_path, client)
    assert len(stopped.pids) == 1
    assert (summary.computed, summary.failed) == (LABELS, {})
    assert_same_results(store_path, finished_store)


@pytest.mark.all
def test_a_worker_that_was_stopped_before_the_run_is_given_up(study: Study, store_path: Path) -> None:
    with tcp_cluster([], []) as (address, (_, worker, _)), Client(address) as client:
        os.kill(worker.pid, signal.SIGSTOP)
        assert run(study, store_path, client).computed == LABELS


@pytest.mark.all
def test_a_scheduler_that_is_silent_ends_the_run(study: Study, store_path: Path, finished_store: Path) -> None:
    with tcp_cluster([]) as (address, (scheduler, _)):

        def stop_scheduler(progress: object) -> None:
            if getattr(progress, "label", "") == "ico/1":
                os.kill(scheduler.pid, signal.SIGSTOP)

        try:
            with (
                Client(address, timeout=5) as client,
                pytest.raises(ClusterError, match="the same command goes on from what is stored"),
            ):
                run(study, store_path, client, on_progress=stop_scheduler)
        finally:
            os.kill(scheduler.pid, signal.SIGCONT)
    assert "ico/0" in run(study, store_path, workers=1).reused
    assert_same_results(store_path, finished_store)


@pytest.mark.all
def test_a_cluster_without_workers_is_told() -> None:
    def told(address: str, needs_gpu: bool) -> str:
        with Client(address) as client, Watch(client, needs_gpu).kept() as kept:
            return wait_until(lambda: kept.obstacle)

    with tcp_cluster() as (address, _):
        assert told(address, False) == "no worker is left; waiting for one to start"
    with tcp_cluster([]) as (address, _):
        assert told(address, True).startswith("no worker with a GPU is left, and the study requests one")


def test_a_silence_counts_only_what_was_heard_missing() -> None:
    silence = watch._silence(1.0, watch._silence(1.0, watch._silence(1.0), 5.0), 2.5)
    assert silence[2] == 7.5
    assert watch._silence(2.0, silence, 100.0)[2] == 0.0
