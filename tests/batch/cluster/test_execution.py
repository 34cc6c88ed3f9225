"""Tasks and their outcomes, and a scheduler that dies in the middle of a run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from distributed import Client, Future, KilledWorker, LocalCluster
from distributed.utils import key_split

from sobolev_batch import Study, StudyCollection, plan, run, submit
from sobolev_batch.batch.cluster.execution import Cluster, Progress, Task, describe_failure
from sobolev_batch.batch.cluster.watch import Watch
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers, prepare_workers
from sobolev_batch.batch.status import Status
from sobolev_batch.errors import ClusterError, DamageError, InputError, StoreError
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from tests.support.processes import tcp_cluster
from tests.support.studies import balls, methods_of, small_table


@pytest.fixture
def cluster(client: Client) -> Cluster:
    # It declares memory, which tasks may claim.
    prepare_workers(client)
    return Cluster(client, Workers((WorkerInfo("tcp://a", 1, 2e9, "cpu", ""),)))


def test_each_task_comes_back_with_its_outcome(cluster: Cluster) -> None:
    outcomes = {task.row: outcome for task, outcome in cluster.run(Task(divmod, (7, k), row=k) for k in range(3))}
    assert (outcomes[1], outcomes[2]) == ((7, 0), (3, 1))
    assert isinstance(outcomes[0], ZeroDivisionError)
    assert describe_failure(outcomes[0]).startswith("ZeroDivisionError: ")
    with pytest.raises(ZeroDivisionError):
        list(cluster.results([Task(divmod, (7, 0))]))


def few_at_a_time(cluster: Cluster, count: int) -> Cluster:
    return replace(cluster, in_flight=count, in_flight_per_thread=0)


def _append(path: Path) -> int:
    with path.open("a") as file:
        file.write("called\n")
    return 3


def _total(number: int, others: list[int]) -> int:
    return number + sum(others)


def test_a_task_among_the_arguments_of_others_is_done_once(cluster: Cluster, tmp_path: Path) -> None:
    first = Task(_append, (tmp_path / "calls",))
    ((_, total),) = cluster.run([Task(_total, (first, [first, Task(abs, (-4,)), 5]))])
    assert total == 3 + 3 + 4 + 5
    assert (tmp_path / "calls").read_text() == "called\n"


def test_tasks_that_fit_into_no_worker_are_not_tried(cluster: Cluster, tmp_path: Path) -> None:
    large = [Task(_append, (tmp_path / "calls",), 3e9) for _ in range(5)]
    outcomes = [outcome for _, outcome in few_at_a_time(cluster, 1).run([*large, Task(abs, (-4,), 1e6)], 3e9)]
    assert outcomes.pop() == 4
    assert all(isinstance(outcome, ClusterError) for outcome in outcomes)
    assert describe_failure(outcomes[0]).startswith(
        "it takes about 3.0GB in one task, and no worker has more than 2.0GB"
    )
    assert len(outcomes) == 5
    assert not (tmp_path / "calls").exists()


def test_tasks_are_read_as_they_are_handed_out(cluster: Cluster) -> None:
    read: list[int] = []

    def tasks() -> Iterator[Task]:
        for k in range(9):
            read.append(k)
            yield Task(abs, (-k,))

    done = 0
    for _ in few_at_a_time(cluster, 2).run(tasks()):
        done += 1
        assert len(read) <= done + 1
    assert (done, read) == (9, list(range(9)))


def test_tasks_whose_workers_died_are_tried_alone(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[list[int], int]] = []
    worker: Any = SimpleNamespace(address="tcp://127.0.0.1:1")

    def run_once(
        self: Cluster, tasks: Iterable[Task], claims_memory: bool, in_flight: int
    ) -> Iterator[tuple[Task, object]]:
        given = list(tasks)
        asked.append(([task.row for task in given], in_flight))
        for task in given:
            dies = task.row == 3 or (task.row == 1 and in_flight > 1)
            yield task, KilledWorker(f"task-{task.row}", worker, 1) if dies else task.row

    monkeypatch.setattr(Cluster, "_run_once", run_once)
    outcomes = {task.row: outcome for task, outcome in cluster.run(Task(abs, (-4,), row=row) for row in (3, 2, 1))}
    assert asked[1:] == [([1, 3], 1)]
    assert (outcomes[1], outcomes[2]) == (1, 2)
    assert "at last with nothing else beside them" in str(outcomes[3])


def _fail(error: Exception) -> None:
    raise error


def test_failures_of_the_store_end_all(cluster: Cluster) -> None:
    with pytest.raises(StoreError, match="disk full; then the same command goes on from what is stored"):
        list(cluster.run([Task(_fail, (StoreError("disk full"),))]))
    with pytest.raises(DamageError) as caught:
        list(cluster.run([Task(_fail, (DamageError("message", "what", 3),))]))
    assert caught.value.row == 3


@pytest.mark.all
@pytest.mark.process
def test_a_lost_scheduler_ends_the_run_and_blames_no_mesh(store_path: Path, threads: Client) -> None:
    family = [{"name": f"ball{i}", "source": "sphere", "radius": 0.5 + 0.001 * i} for i in range(200)]
    study = Study.from_table(small_table(family=family, norm={"orders": [-3.0]}, compare=None))
    with tcp_cluster([]) as (address, (scheduler, _)):

        def end(progress: Progress) -> None:
            if progress.stage == "fields" and progress.done == 3:
                scheduler.kill()
                scheduler.wait()

        client = Client(address)
        # Now that it is connected: it looks a second for a scheduler that is gone, instead of half a minute.
        client._timeout = 1
        with pytest.raises(ClusterError, match=r"the scheduler at .* was lost; the same command goes on"):
            run(study, store_path, client, on_progress=end)
    records = Records(Store(store_path)).read()
    assert all(record is None or record.status == "complete" for record in records)
    assert sum(record is not None for record in records) >= 3
    status = Status.from_store(store_path)
    assert status.run is not None
    assert (status.run.state, status.failed) == ("failed", {})
    again = run(study, store_path, threads)
    assert (len(again.reused) >= 3, again.failed) == (True, {})


def test_the_dashboard_names_tasks_by_stage_study_and_mesh(threads: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    keys: list[tuple[str, str, str]] = []
    hand_over = threads.submit

    def recorded(*arguments: Any, key: tuple[str, str, str], **options: Any) -> Future:
        keys.append(key)
        return hand_over(*arguments, key=key, **options)

    monkeypatch.setattr(threads, "submit", recorded)
    table = small_table(study={"name": "my-scans 2024-06"}, object=balls(cow=1.0, egg=1.1), family=methods_of())
    run(StudyCollection.from_table(table), "memory://names.zarr", threads)
    field = "field my_scans 2024_06"
    # The name of the one group of all objects and the one of the prefix, which progress bars show, are the same.
    assert {(key[0], key_split(key)) for key in keys if key[0].startswith("field")} == {(field, field)}
    assert all(key_split(key).endswith(" my_scans 2024_06") for key in keys)
    meshes = ["ico/1", "ico/2", "egg/1", "egg/2", "reference"]
    shown = sorted(label for group, label, _ in keys if group == field)
    assert shown == sorted(f"{name}/{mesh}" for name in ("cow", "egg") for mesh in meshes)
    assert len(set(keys)) == len(keys)

    def transforms(dask_scheduler: Any) -> int:
        return int(dask_scheduler.task_prefixes[field].state_counts["memory"])

    assert threads.run_on_scheduler(transforms) == 10


def test_an_asynchronous_client_is_refused_before_anything_is_made() -> None:
    client: Any = SimpleNamespace(asynchronous=True)
    for act in (run, submit, plan):
        with pytest.raises(InputError, match=r"the client is asynchronous.*give a Client without asynchronous=True"):
            act(Study.from_table(small_table()), "memory://asynchronous.zarr", client)


def test_a_run_prints_its_progress(capsys: pytest.CaptureFixture[str]) -> None:
    with (
        LocalCluster(processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
    ):
        run(Study.from_table(small_table()), "memory://progress.zarr", client, on_progress=print)
    first, start, *fields = capsys.readouterr().out.splitlines()
    assert first.startswith("dashboard: http://")
    assert start == "0 of 5 transforms"
    assert re.fullmatch(r"\[1/5\] \S+: complete, \d\.\d\d s", fields[0])


def test_a_failure_of_the_storage_is_not_blamed_on_a_scheduler_that_answers(threads: Client) -> None:
    with pytest.raises(OSError, match="no room"), Watch(threads).kept():
        raise OSError("no room")
