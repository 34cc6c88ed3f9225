"""What workers find at their start, and what studies that ask for a GPU are told."""

from __future__ import annotations

import os
from pathlib import Path

import dask
import pytest
from distributed import Client

from sobolev_batch import ClusterError, InputError, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client, remote_client
from sobolev_batch.batch.cluster.workers import GPU, MEMORY, prepare_workers
from sobolev_batch.parameters import machine_memory
from tests.support.processes import PATIENCE_SECONDS, tcp_cluster
from tests.support.studies import small_table


def study_on(backend: str) -> Study:
    return Study.from_table(small_table(transform={"backend": backend}))


@pytest.mark.all
@pytest.mark.process
def test_a_gpu_that_no_worker_has_is_refused_at_once_and_auto_computes_without(
    store_path: Path,
) -> None:
    # One of the workers declares a resource that it does not have.
    with tcp_cluster([], ["--resources", "GPU=1"]) as (address, _), remote_client(address) as client:
        with pytest.raises(ClusterError) as caught:
            run(study_on("gpu"), store_path, client)
        message = str(caught.value)
        assert "the study requests backend 'gpu', and none of the 2 workers can compute on one" in message
        assert "ask for backend 'auto'" in message
        summary = run(study_on("auto"), store_path, client)
    assert len(summary.computed) == 5
    assert not summary.failed
    meshes = open_store(store_path)["meshes"].to_dataset()
    assert set(meshes["backend"].values.tolist()) == {"closed form", "finufft"}
    assert len(set(meshes["worker"].values.tolist())) == 2


def test_workers_declare_their_memory(client: Client) -> None:
    prepared = prepare_workers(client)
    assert prepared.threads == 2
    workers = client.scheduler_info(n_workers=-1)["workers"]
    for member in prepared.members:
        assert member.backend == "cpu"
        assert member.note
        declared = workers[member.address]["resources"]
        assert declared == {MEMORY: member.allowed_bytes}
        assert GPU not in declared
        limit = workers[member.address]["memory_limit"]
        assert limit == machine_memory()[0] // len(workers)
        assert 0.5 < member.allowed_bytes / limit < 0.85


@pytest.mark.all
def test_local_workers_have_the_memory_that_is_given_and_late_ones_are_equipped_too() -> None:
    with local_client(1, "3GB") as client, Client(client.scheduler.address, set_as_default=False) as second:
        first = prepare_workers(client)
        (member,) = first.members
        assert member.note
        assert member.allowed_bytes == pytest.approx(0.85 * 3e9 - 300e6)
        # This client registers nothing and waits for nothing of its own accord.
        assert prepare_workers(second) == first
        client.cluster.scale(2)
        client.wait_for_workers(2, timeout=PATIENCE_SECONDS)
        assert len(prepare_workers(client).members) == 2
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        assert all(worker["resources"][MEMORY] > 0 for worker in workers)


@pytest.mark.parametrize("memory", ["much", "-1", "0", "0.5", "1e3", "10MB", "inf", "nan", "50%", ""])
def test_a_memory_that_no_worker_can_live_in(memory: str) -> None:
    with pytest.raises(InputError, match=r"memory (of a worker )?must be .*found "):
        local_client(1, memory).__enter__()


def _die_once(marker: Path) -> str:
    if not marker.exists():
        marker.touch()
        os._exit(1)
    return "alive"


@pytest.mark.all
def test_a_task_that_claims_memory_goes_on_when_its_only_worker_was_restarted(tmp_path: Path) -> None:
    # Without a word from us, Dask would close its nanny as soon as it looks for the worker and finds none.
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "0s"}), local_client(1, "1GB") as client:
        prepare_workers(client)
        task = client.submit(_die_once, tmp_path / "marker", pure=False, resources={MEMORY: 1e8})
        assert task.result(timeout=PATIENCE_SECONDS) == "alive"
