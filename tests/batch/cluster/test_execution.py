"""Tasks and their outcomes, and a scheduler that dies in the middle of a run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from distributed import Client, Event, Future, KilledWorker, LocalCluster, as_completed
from distributed.utils import key_split

from sobolev_batch import Study, plan, reduce, run, shapes, submit
from sobolev_batch.batch.cluster import execution
from sobolev_batch.batch.cluster.execution import (
    Cluster,
    Progress,
    Stages,
    Task,
    Wave,
    describe_failure,
    result_of,
    side_by_side,
)
from sobolev_batch.batch.cluster.watch import Watch
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers, prepare_workers
from sobolev_batch.batch.status import status
from sobolev_batch.errors import ClusterError, DamageError, InputError, StoreError
from sobolev_batch.geometry.formats.writing import write_mesh
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records
from tests.support.processes import tcp_cluster
from tests.support.studies import balls, methods_of, small_table


@pytest.fixture
def cluster(client: Client) -> Cluster:
    # It declares memory, which tasks may claim.
    prepare_workers(client)
    return Cluster(client, Workers((WorkerInfo("tcp://a", 1, 2e9, "cpu", ""),)))


def outcomes_of(cluster: Cluster, tasks: Iterable[Task], projected_bytes: float = 0.0) -> list[tuple[Task, Any]]:
    """Have tasks done as the only wave of a run."""
    found: list[tuple[Task, Any]] = []

    def stages() -> Stages[str]:
        yield Wave(cluster, tasks, lambda task, outcome: found.append((task, outcome)), projected_bytes)
        return "done"

    assert list(side_by_side([("", stages())], is_fatal=lambda error: True)) == [("", "done")]
    return found


def test_each_task_comes_back_with_its_outcome(cluster: Cluster) -> None:
    tasks = (Task(divmod, (7, k), row=k) for k in range(3))
    outcomes = {task.row: outcome for task, outcome in outcomes_of(cluster, tasks)}
    assert (outcomes[1], outcomes[2]) == ((7, 0), (3, 1))
    assert isinstance(outcomes[0], ZeroDivisionError)
    assert describe_failure(outcomes[0]).startswith("ZeroDivisionError: ")
    assert result_of(outcomes[1]) == (7, 0)
    with pytest.raises(ZeroDivisionError):
        result_of(outcomes[0])


def few_at_a_time(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(execution, "_FEWEST_IN_FLIGHT", count)
    monkeypatch.setattr(execution, "_IN_FLIGHT_PER_THREAD", 0)


def _total(*numbers: int) -> int:
    return sum(numbers)


def test_the_results_of_tasks_are_arguments_of_others(cluster: Cluster) -> None:
    ((_, total),) = outcomes_of(cluster, [Task(_total, (Task(abs, (-3,)), Task(abs, (-4,)), 5))])
    assert total == 3 + 4 + 5


def test_tasks_that_fit_into_no_worker_are_not_tried(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_at_a_time(monkeypatch, 1)
    large = [Task(Path.touch, (tmp_path / "calls",), 3e9) for _ in range(5)]
    tasks = [*large, Task(abs, (-4,), 1e6)]
    outcomes = [outcome for _, outcome in outcomes_of(cluster, tasks, 3e9)]
    assert outcomes.pop() == 4
    assert all(isinstance(outcome, ClusterError) for outcome in outcomes)
    assert describe_failure(outcomes[0]).startswith(
        "it takes about 3.0GB in one task, and no worker has more than 2.0GB"
    )
    assert len(outcomes) == 5
    assert not (tmp_path / "calls").exists()


def test_tasks_are_read_as_they_are_handed_out(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    few_at_a_time(monkeypatch, 2)
    read: list[int] = []

    def tasks() -> Iterator[Task]:
        for k in range(9):
            read.append(k)
            yield Task(abs, (-k,))

    done = 0

    def take(task: Task, outcome: Any) -> None:
        nonlocal done
        done += 1
        assert len(read) <= done + 2

    def stages() -> Stages[None]:
        yield Wave(cluster, tasks(), take)

    assert list(side_by_side([("", stages())])) == [("", None)]
    assert (done, read) == (9, list(range(9)))


def test_tasks_whose_workers_died_are_tried_alone(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    worker: Any = SimpleNamespace(address="tcp://127.0.0.1:1")
    fetched, submit_task = execution._outcomes, Cluster.submit
    tried: list[tuple[int, int]] = []
    outcomes: dict[int, Any] = {}

    def submitted(self: Cluster, task: Task, *arguments: Any) -> Future:
        tried.append((task.row, len(outcomes)))
        return submit_task(self, task, *arguments)

    def died(futures: Sequence[Future]) -> list[Any]:
        rows = fetched(futures)
        dies = {3, 1} if len(tried) <= 4 else {3}
        return [KilledWorker(f"task-{row}", worker, 1) if row in dies else row for row in rows]

    def stages(*rows: int) -> Stages[None]:
        yield Wave(
            cluster,
            [Task(abs, (-row,), row=row) for row in rows],
            lambda task, found: outcomes.update({task.row: found}),
        )

    monkeypatch.setattr(execution, "_outcomes", died)
    monkeypatch.setattr(Cluster, "submit", submitted)
    # What is beside a task may be of another run.
    list(side_by_side([("a", stages(3, 2)), ("b", stages(4, 1))]))
    assert tried[4:] == [(1, 2), (3, 3)]
    assert (outcomes[1], outcomes[2], outcomes[4]) == (1, 2, 4)
    assert "at last with nothing else beside them" in str(outcomes[3])


def test_a_group_whose_worker_died_is_divided(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    worker: Any = SimpleNamespace(address="tcp://127.0.0.1:1")
    fetched, outcomes = execution._outcomes, list[tuple[int, Any]]()

    def died(futures: Sequence[Future]) -> list[Any]:
        return [KilledWorker("group", worker, 1) if isinstance(one, int) else one for one in fetched(futures)]

    def stages() -> Stages[str]:
        pieces = tuple(Task(str, (row,), row=row) for row in (1, 2))
        yield Wave(cluster, [Task(abs, (-12,), divided=pieces)], lambda task, found: outcomes.append((task.row, found)))
        return "after"

    monkeypatch.setattr(execution, "_outcomes", died)
    assert list(side_by_side([("", stages())])) == [("", "after")]
    assert sorted(outcomes) == [(1, "1"), (2, "2")]


def test_a_run_in_place_is_the_same_and_told_before_the_next_begins() -> None:
    seen, cluster = list[Any](), Cluster(None, Workers.of_this_machine(1))

    def stages() -> Stages[str]:
        tasks = [Task(abs, (-1,)), Task(_total, (Task(abs, (-2,)), 3)), Task(_fail, (ValueError("bad mesh"),))]
        yield Wave(cluster, tasks, lambda task, outcome: seen.append(outcome))
        try:
            yield Wave(cluster, [Task(_fail, (StoreError("disk full"),)), Task(abs, (-9,))], ignore)
        except StoreError as error:
            return str(error)
        return ""

    assert next(side_by_side([("first", stages()), ("second", stages())])) == ("first", "disk full")
    assert seen[:2] == [1, 5]
    assert [str(one) for one in seen[2:]] == ["bad mesh"]


def _fail(error: Exception) -> None:
    raise error


def test_failures_of_the_store_are_raised_where_the_run_waits(cluster: Cluster) -> None:
    with pytest.raises(StoreError, match="disk full; then the same command goes on from what is stored"):
        outcomes_of(cluster, [Task(_fail, (StoreError("disk full"),))])
    with pytest.raises(DamageError) as caught:
        outcomes_of(cluster, [Task(_fail, (DamageError("message", "what", 3),))])
    assert caught.value.row == 3

    def mended() -> Stages[int | None]:
        try:
            yield Wave(cluster, [Task(_fail, (DamageError("message", "what", 3),)), Task(abs, (-1,))], ignore)
        except DamageError as error:
            yield Wave(cluster, [Task(abs, (-2,))], ignore)
            return error.row
        return None

    assert list(side_by_side([("", mended())])) == [("", 3)]


def ignore(task: Task, outcome: Any) -> None:
    """Make nothing of an outcome."""


def _meet(own: str, other: str) -> bool:
    Event(own).set()
    return bool(Event(other).wait(timeout=60))


def test_runs_go_on_beside_each_other(cluster: Cluster) -> None:
    met: list[bool] = []

    def stages(own: str, other: str) -> Stages[str]:
        # The first wave of one run needs that of the other, and so do the second ones.
        for step in "12":
            task = Task(_meet, (own + step, other + step))
            yield Wave(cluster, [task], lambda _, outcome: met.append(outcome))
        return own

    names = dict(side_by_side([("first", stages("here", "there")), ("second", stages("there", "here"))]))
    assert names == {"first": "here", "second": "there"}
    assert met == [True] * 4


def test_the_end_of_one_run_is_none_of_the_others(cluster: Cluster) -> None:
    closed: list[str] = []

    def stages(name: str) -> Stages[str]:
        try:
            yield Wave(cluster, [Task(abs, (-1,)) for _ in range(3)], ignore)
            if name == "bad":
                raise InputError("a mesh of another unit")
            yield Wave(cluster, [Task(abs, (-1,))], ignore)
            return name
        finally:
            closed.append(name)

    runs = ["good", "bad", "other"]
    outcomes = dict(side_by_side((name, stages(name)) for name in runs))
    assert (outcomes["good"], outcomes["other"]) == ("good", "other")
    assert isinstance(outcomes["bad"], InputError)
    closed.clear()
    with pytest.raises(InputError, match="another unit"):
        list(side_by_side(((name, stages(name)) for name in runs), is_fatal=lambda error: True))
    # All of them gave up what they had.
    assert set(closed) >= {"bad", "other"}


def test_a_run_ends_once_where_many_of_its_tasks_fail(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    def all_at_once(self: as_completed, block: bool = True) -> list[Future]:
        return [next(self) for _ in range(self.count())] if block else []

    def stages(error: Exception | None) -> Stages[str]:
        function, argument = (abs, -1) if error is None else (_fail, error)
        yield Wave(cluster, [Task(function, (argument,)) for _ in range(4)], lambda _, outcome: result_of(outcome))
        return "done"

    monkeypatch.setattr(as_completed, "next_batch", all_at_once)
    outcomes = dict(side_by_side([("bad", stages(InputError("no mesh"))), ("good", stages(None))]))
    assert isinstance(outcomes["bad"], InputError)
    assert outcomes["good"] == "done"


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
    found = status(store_path)
    assert found.run is not None
    assert (found.run.state, found.failed) == ("failed", {})
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
    run(Study.from_table(table), "memory://names.zarr", threads)
    field = "field my_scans 2024_06"
    # The name of the one group of all objects and the one of the prefix, which progress bars show, are the same.
    assert {(key[0], key_split(key)) for key in keys if key[0].startswith("field")} == {(field, field)}
    assert all(key_split(key).endswith(" my_scans 2024_06") for key in keys)
    meshes = ["ico/1", "ico/2", "egg/1", "egg/2", "reference"]
    shown = [label.partition(" and ") for group, label, _ in keys if group == field]
    # Small meshes share tasks, which the first of them names.
    assert {first for first, *_ in shown} < {f"{name}/{mesh}" for name in ("cow", "egg") for mesh in meshes}
    assert sum(1 + int(more.split()[0] if more else 0) for *_, more in shown) == 2 * len(meshes)
    assert len(set(keys)) == len(keys)

    def transforms(dask_scheduler: Any) -> int:
        return int(dask_scheduler.task_prefixes[field].state_counts["memory"])

    assert threads.run_on_scheduler(transforms) == len(shown)


def test_an_asynchronous_client_and_an_address_are_refused_before_anything_is_made() -> None:
    asynchronous: Any = Mock(spec=Client, asynchronous=True)
    address: Any = "tcp://127.0.0.1:8786"
    for act in (run, submit, plan):
        with pytest.raises(InputError, match=r"the client is asynchronous.*give a Client without asynchronous=True"):
            act(Study.from_table(small_table()), "memory://asynchronous.zarr", asynchronous)
        with pytest.raises(
            InputError, match=rf"client must be a dask\.distributed\.Client, found '{address}'; give Client"
        ):
            act(Study.from_table(small_table()), "memory://asynchronous.zarr", address)


@pytest.mark.parametrize("own", [{"workers": 2}, {"memory": "4GB"}])
def test_processes_to_start_and_a_client_are_not_taken_together(own: dict[str, Any], threads: Client) -> None:
    with pytest.raises(InputError, match="workers and memory are for processes that are started here, and those of a"):
        run(Study.from_table(small_table()), "memory://both.zarr", threads, **own)
    if "workers" in own:
        with pytest.raises(InputError, match="leave them out, or the client"):
            reduce(shapes.icosphere(1), "1%", client=threads, **own)


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


def test_small_meshes_travel_in_groups(threads: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    keys: list[str] = []
    hand_over = threads.submit

    def recorded(*arguments: Any, key: tuple[str, str, str], **options: Any) -> Future:
        keys.append(key[0])
        return hand_over(*arguments, key=key, **options)

    monkeypatch.setattr(threads, "submit", recorded)
    for k in range(40):
        write_mesh(shapes.icosphere(0), tmp_path / f"{k}.off")
    (tmp_path / "7.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n")
    table = small_table(family=[{"name": "f", "source": "files", "paths": ["*.off"]}], compare=None)
    summary = run(Study.from_table(table, folder=tmp_path), "memory://groups.zarr", threads)
    # Each has its record, and one bad mesh stops no other.
    assert (len(summary.computed), list(summary.failed)) == (40, ["f/7"])
    assert sum(key.startswith("field") for key in keys) <= 6
