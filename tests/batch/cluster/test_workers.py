"""What workers find at their start, their versions, what studies that ask for a GPU are told, and those that leave."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from dask import config
from distributed import Client, get_worker

from sobolev_batch import Study, open_store, run, write_mesh
from sobolev_batch.batch.cluster import clients, workers
from sobolev_batch.batch.cluster.clients import local_client, remote_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.cluster.workers import MEMORY, prepare_workers, require_same_versions
from sobolev_batch.errors import ClusterError, InputError
from sobolev_batch.machine import machine_memory
from sobolev_batch.shapes import icosphere
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from tests.support import gate
from tests.support.processes import PATIENCE_SECONDS, WORKER, dask, tcp_cluster, wait_until
from tests.support.repository import install
from tests.support.stores import assert_same_results
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


@pytest.mark.parametrize("count", [0, -3, 10**30, "two", True])
def test_there_are_one_or_more_workers(count: Any) -> None:
    with pytest.raises(InputError, match="workers must be a whole number from 1 to"):
        run("missing.toml", workers=count)


@pytest.mark.parametrize("count", [1, 3])
def test_local_workers_have_equal_parts_of_the_machine(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float] = []

    def start(*, memory_limit: float, **options: object) -> None:
        limits.append(memory_limit)
        raise KeyError("not started")

    monkeypatch.setattr(clients, "LocalCluster", start)
    with pytest.raises(KeyError, match="not started"), local_client(count):
        pass
    assert limits == [machine_memory()[0] // count]


@pytest.mark.all
def test_local_workers_have_the_memory_that_is_given_and_late_ones_are_equipped_too() -> None:
    with local_client(1, "3GB") as client, Client(client.cluster, set_as_default=False) as second:
        first = prepare_workers(client)
        assert [member.allowed_bytes for member in first.members] == [pytest.approx(0.85 * 3e9 - 300e6)]
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


LATER = """
from sobolev_batch.batch.cluster import workers

# Dask may load this twice.
workers.NUMERICS_VERSION = 99
"""


@pytest.mark.process
def test_a_worker_of_another_version_that_joins_is_kept_out_and_the_driver_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "later.py").write_text(LATER)
    with tcp_cluster([]) as (address, _), Client(address) as client:
        (first,) = prepare_workers(client).members
        tasks = [client.submit(_where, i, pure=False) for i in range(200)]
        joiner = dask("worker", address, *WORKER, "--preload", str(tmp_path / "later.py"))
        assert "is kept out" in joiner.communicate(timeout=PATIENCE_SECONDS)[1]
        assert set(client.gather(tasks)) == {first.address}
        wait_until(lambda: "it has numerics of sobolev-batch 99; the study" in caplog.text)
        assert list(client.scheduler_info(n_workers=-1)["workers"]) == [first.address]


def _where(number: int) -> str:
    return str(get_worker().address)


def _die_once(marker: Path) -> str:
    if not marker.exists():
        marker.touch()
        os._exit(1)
    return "alive"


@pytest.mark.all
def test_a_task_that_claims_memory_goes_on_when_its_only_worker_was_restarted(tmp_path: Path) -> None:
    # Without a word from us, Dask would close its nanny as soon as it looks for the worker and finds none.
    with config.set({"distributed.deploy.lost-worker-timeout": "0s"}), local_client(1, "1GB") as client:
        prepare_workers(client)
        task = client.submit(_die_once, tmp_path / "marker", pure=False, resources={MEMORY: 1e8})
        assert task.result(timeout=PATIENCE_SECONDS) == "alive"


@pytest.mark.parametrize(
    ("process", "package", "version", "message"),
    [
        ("workers", "sobolev-batch", "9.9", r"sobolev-batch 9\.9 at the worker tls://\S+ and 1 more, \S+ here"),
        ("workers", "sobolev-batch", None, r"sobolev-batch is missing at the worker tls://"),
        ("workers", "python", "3.9.1.final.0", r"python 3\.9 at the worker tls://.*, 3\.\d+ here"),
        ("scheduler", "dask", "1.0", r"dask 1\.0 at the scheduler tls://"),
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
    assert Records(Store(store_path)).read() == (None,) * 5


def test_other_numerics_and_libraries_that_the_study_needs(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_same_versions(client, ["installed-nowhere"])  # planning reports this
    install(tmp_path, "remesher_of_a_test", "", "")
    monkeypatch.syspath_prepend(str(tmp_path))
    require_same_versions(client)
    with pytest.raises(ClusterError, match=r"remesher-of-a-test is missing at the worker .*, 1\.0 here"):
        require_same_versions(client, ["remesher-of-a-test"])
    monkeypatch.setattr(workers, "NUMERICS_VERSION", -1)
    with pytest.raises(ClusterError, match=r"numerics of sobolev-batch \d+ at the worker .*, -1 here"):
        require_same_versions(client)


@pytest.mark.all
def test_a_worker_that_leaves_hands_on_the_task_that_it_is_in_to_one_that_came_later(
    client: Client, store_path: Path, tmp_path: Path
) -> None:
    for level in range(4):
        write_mesh(icosphere(level), tmp_path / f"{level}.off")
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    study = Study.from_table(small_table(family=family), folder=tmp_path)
    # Holds the worker that loads the first mesh in its task, once it is begun, until the test lets it pass.
    gate_path, gated = gate.gate_of(tmp_path / "0.off"), ["--preload", gate.__file__]
    writers: list[int] = []
    with tcp_cluster(gated) as (address, processes), Client(address) as ours, ThreadPoolExecutor(1) as pool:
        (first,) = ours.scheduler_info()["workers"]

        def replace() -> None:
            # Waits for a reader; everybody else passes.
            writers.append(os.open(gate_path, os.O_WRONLY))
            gate_path.unlink()
            processes.append(dask("worker", address, *WORKER, *gated))
            ours.wait_for_workers(2, timeout=PATIENCE_SECONDS)
            ours.retire_workers([first])

        def disturb(progress: Progress) -> None:
            if progress.stage == "cluster":
                os.mkfifo(gate_path)
                pool.submit(replace)

        summary = run(study, store_path, ours, on_progress=disturb)
        # What had begun on the worker ends there after all: it comes too late, and leaves the store alone.
        os.close(writers[0])
        processes[1].communicate(timeout=PATIENCE_SECONDS)
    assert (len(summary.computed), summary.failed) == (5, {})
    assert {record.worker for record in Records(Store.open(store_path)).read() if record} - {first}
    run(study, tmp_path / "undisturbed.zarr", client)
    assert_same_results(store_path, tmp_path / "undisturbed.zarr")
