"""What workers find at their start, their versions, and what studies that ask for a GPU are told."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import dask
import pytest
from distributed import Client

from sobolev_batch import ClusterError, InputError, Study, open_store, run
from sobolev_batch.batch.cluster import workers
from sobolev_batch.batch.cluster.clients import local_client, remote_client
from sobolev_batch.batch.cluster.workers import MEMORY, prepare_workers, require_same_versions
from sobolev_batch.batch.store.store import Store
from sobolev_batch.parameters import machine_memory
from tests.support.processes import PATIENCE_SECONDS, tcp_cluster
from tests.support.studies import small_table


@pytest.mark.all
@pytest.mark.process
def test_a_gpu_that_no_worker_has_is_refused_at_once_and_auto_computes_without(store_path: Path) -> None:
    on_gpu, anywhere = (Study.from_table(small_table(transform={"backend": backend})) for backend in ("gpu", "auto"))
    # One of the workers declares a resource that it does not have.
    with tcp_cluster([], ["--resources", "GPU=1"]) as (address, _), remote_client(address) as client:
        with pytest.raises(ClusterError, match=r"requests backend 'gpu', and none of the 2 workers can .*'auto'"):
            run(on_gpu, store_path, client)
        summary = run(anywhere, store_path, client)
    assert (len(summary.computed), summary.failed) == (5, {})
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
        assert workers[member.address]["resources"] == {MEMORY: member.allowed_bytes}
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


@pytest.mark.parametrize(
    ("process", "package", "version", "message"),
    [
        ("workers", "sobolev-batch", "9.9", r"sobolev-batch 9\.9 at the worker tcp://\S+ and 1 more, \S+ here"),
        ("workers", "sobolev-batch", None, r"sobolev-batch is missing at the worker tcp://"),
        ("workers", "python", "3.9.1.final.0", r"python 3\.9 at the worker tcp://.*, 3\.\d+ here"),
        ("scheduler", "dask", "1.0", r"dask 1\.0 at the scheduler tcp://"),
    ],
)
def test_differences_are_reported_before_anything_is_computed(
    process: str, package: str, version: str | None, message: str,
    client: Client, study: Study, store_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    ask = client.get_versions

    def answer(**options: Any) -> dict[str, Any]:
        answers: dict[str, Any] = ask(**options)
        for reply in answers["workers"].values() if process == "workers" else [answers["scheduler"]]:
            reply["packages"][package] = version
        return answers

    monkeypatch.setattr(client, "get_versions", answer)
    with pytest.raises(ClusterError, match=message):
        run(study, store_path, client)
    assert Store(store_path).records() == (None,) * 5


def test_a_checkout_with_other_numerics(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "NUMERICS_VERSION", -1)
    with pytest.raises(ClusterError, match=r"numerics of sobolev-batch \d+ at the worker .*, -1 here"):
        require_same_versions(client)


def test_a_library_that_the_study_needs(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_same_versions(client, ["installed-nowhere"])  # planning reports this
    information = tmp_path / "remesher_of_a_test-2.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: remesher-of-a-test\nVersion: 2.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    require_same_versions(client)
    with pytest.raises(ClusterError, match=r"remesher-of-a-test is missing at the worker .*, 2\.0 here"):
        require_same_versions(client, ["remesher-of-a-test"])
