"""Tasks on a cluster: handed out a few at a time, in the free memory, and their outcomes taken back.

Each step is reported to those who watch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Literal, Self
from uuid import uuid4

from distributed import CancelledError, Client, Future, as_completed
from distributed.comm import CommClosedError
from distributed.scheduler import KilledWorker

from sobolev_batch.batch.cluster.workers import GPU, MEMORY, Workers, prepare_workers
from sobolev_batch.errors import ClusterError, StoreError, one_line
from sobolev_batch.store.records import Record
from sobolev_batch.study.study import Study

Stage = Literal["cluster", "fields", "reduction", "proximity"]


@dataclass(frozen=True)
class Progress:
    """One step of a run.

    Attributes:
        stage: "cluster" once there is one, "fields" while meshes are transformed, "reduction" while
            tables are computed, "proximity" while Hausdorff and Chamfer distances are measured.
        done, total: Steps of the stage.
        label: Label of the mesh that was finished, or address of the cluster's dashboard; else empty.
        part: Object of a collection that is worked on, and its number, such as "cow, 2 of 8"; else empty.
    """

    stage: Stage
    done: int
    total: int
    label: str = ""
    record: Record | None = None
    part: str = ""

    def __str__(self) -> str:
        part, count = f"{self.part}: " if self.part else "", f"{self.done} of {self.total}"
        if self.stage == "cluster":
            return f"dashboard: {self.label}"
        if self.record is not None:
            outcome = self.record.reason or f"{self.record.seconds:.2f} s"
            return f"{part}[{self.done}/{self.total}] {self.label}: {self.record.status}, {outcome}"
        if self.stage == "proximity":
            return f"{part}{count} Hausdorff and Chamfer distances measured"
        return f"{part}{count} {'transforms' if self.stage == 'fields' else 'tables reduced'}"


Notify = Callable[[Progress], None]


@dataclass(frozen=True, eq=False)
class Task:
    """A call of a function on a worker.

    Attributes:
        arguments: Arguments of the call. Results take the place of tasks among them, also within a list.
        projected_bytes: Memory that the call takes at most.
        needs_gpu: True where the call has to run on a worker with a GPU.
        row: Row of the store that the task works for, for the caller.
        label: Label of the mesh that it works for, for people.
        stage: What it does, for people; default the name of the function.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    projected_bytes: float = 0.0
    needs_gpu: bool = False
    row: int = -1
    label: str = ""
    stage: str = ""


def task_key(stage: str, study: str, part: str, label: str) -> tuple[str, str, str]:
    """Return the key of a task as Dask's dashboard shows it: what it does for which study, its mesh, and a number.

    The dashboard groups tasks by the first of these: all objects (parts) of a study share it.
    """
    # What follows a hyphen may be taken for a number of the task.
    group = f"{stage} {study.removesuffix(f' {part}')}".strip().replace("-", "_")
    return group, "/".join(filter(None, (part, label))), uuid4().hex


@dataclass(frozen=True, eq=False)
class Cluster:
    """A cluster that computes a study.

    Attributes:
        workers: Workers that the cluster had when the study began.
        notify: Callback for each step of progress.
        in_flight: Number of small tasks that the scheduler knows of at a time, at least: enough to keep workers
            busy, while each costs the scheduler memory.
        in_flight_per_thread: The same for each thread of the workers.
        study, part: Name of the study, and of its object in a collection, for the names of tasks.
    """

    client: Client
    workers: Workers
    notify: Notify = lambda progress: None
    in_flight: int = 2000
    in_flight_per_thread: int = 20
    study: str = ""
    part: str = ""

    @classmethod
    def prepare(cls, client: Client, study: Study, notify: Notify = lambda progress: None) -> Self:
        """Prepare the workers of a cluster for a study; see `prepare_workers`."""
        return cls(client, prepare_workers(client, study.libraries), notify, study=study.name, part=study.part)

    def count_steps(self, stage: Stage, total: int) -> Callable[[str, Record | None], None]:
        """Report the start of a stage with its number of steps, and return a function that reports each by label."""
        done = count(1)
        self.notify(Progress(stage, 0, total))
        return lambda label, record: self.notify(Progress(stage, next(done), total, label, record))

    def run(self, tasks: Iterable[Task], projected_bytes: float = 0.0) -> Iterator[tuple[Task, Any]]:
        """Have tasks done. Those whose workers died are tried again alone, after all others.

        Args:
            tasks: Tasks, read as they are handed out.
            projected_bytes: Most memory that any of them takes. Where as many tasks as a worker has threads fit
                beside each other, none has to claim its memory, and the scheduler is free to place them.

        Yields:
            Each task with its result, or with the exception that ended it: a `ClusterError` where no worker has
            the memory, or where every worker died of it.

        Raises:
            StoreError: A task could not read or write the store, which is not the fault of its mesh.
            ClusterError: The scheduler was lost.
        """
        claims_memory = projected_bytes > self.workers.allowed_bytes_per_task
        most = max(self.in_flight, self.in_flight_per_thread * self.workers.threads)
        suspects: list[Task] = []
        for task, outcome in self._run_once(tasks, claims_memory, most):
            # It need not be what killed them: another task beside it may have been. Alone, it shows.
            if isinstance(outcome, KilledWorker):
                suspects.append(task)
            else:
                yield task, outcome
        suspects.sort(key=lambda task: task.row)
        for task, outcome in self._run_once(suspects, claims_memory, 1):
            yield task, _deadly(outcome) if isinstance(outcome, KilledWorker) else outcome

    def results(self, tasks: Iterable[Task], projected_bytes: float = 0.0) -> Iterator[tuple[Task, Any]]:
        """Have tasks done that must not fail; see `run`. The first exception is raised."""
        for task, outcome in self.run(tasks, projected_bytes):
            if isinstance(outcome, BaseException):
                raise outcome
            yield task, outcome

    def _run_once(self, tasks: Iterable[Task], claims_memory: bool, in_flight: int) -> Iterator[tuple[Task, Any]]:
        running: dict[Future, Task] = {}
        remaining = iter(tasks)
        completed = as_completed(loop=self.client.loop)

        def hand_out(number: int) -> list[tuple[Task, ClusterError]]:
            """Submit `count` tasks, and return those before them that fit into no worker."""
            refused = []
            for task in remaining:
                try:
                    self.workers.require_memory(task.projected_bytes)
                except ClusterError as error:
                    refused.append((task, error))
                    continue
                future = self._submit(task, claims_memory, {}, task.label)
                running[future] = task
                completed.add(future)
                number -= 1
                if not number:
                    break
            return refused

        try:
            yield from hand_out(in_flight)
            for batch in completed.batches():
                outcomes = self._outcomes(batch)
                yield from zip([running.pop(future) for future in batch], outcomes, strict=True)
                # Only now: a task that is tried alone has to be alone.
                yield from hand_out(len(batch))
        finally:
            # The client may outlive this run, and the cluster would go on for it.
            for future in running:
                future.release()

    def _submit(self, task: Task, claims_memory: bool, futures: dict[int, Future], label: str) -> Future:
        """Submit a task after those among its arguments, each of these once."""

        def submitted(argument: Any) -> Any:
            if isinstance(argument, list):
                return [submitted(item) for item in argument]
            return self._submit(argument, claims_memory, futures, label) if isinstance(argument, Task) else argument

        if id(task) not in futures:
            resources = {MEMORY: task.projected_bytes} if claims_memory and task.projected_bytes else {}
            if task.needs_gpu:
                resources[GPU] = 1.0
            futures[id(task)] = self.client.submit(
                task.function,
                *map(submitted, task.arguments),
                key=task_key(task.stage or task.function.__name__, self.study, self.part, label),
                resources=resources or None,
            )
        return futures[id(task)]

    def _outcomes(self, futures: Sequence[Future]) -> list[Any]:
        """Fetch the results of futures that have ended, or their exceptions, all at once."""
        lost = (
            f"the scheduler at {self.client.scheduler.address} was lost; the same command goes on from what is stored, "
            "after `sobolev-batch unlock` where it was submit"
        )
        if self.client.status != "running" or any(future.cancelled() for future in futures):
            raise ClusterError(lost)
        try:
            results = iter(self.client.gather([future for future in futures if future.status == "finished"]))
            outcomes = [next(results) if future.status == "finished" else future.exception() for future in futures]
        except (CommClosedError, CancelledError) as error:
            raise ClusterError(lost) from error
        for outcome in outcomes:
            if type(outcome) is StoreError:
                raise StoreError(f"{outcome}; then the same command goes on from what is stored") from outcome
            if isinstance(outcome, StoreError):
                raise outcome
        return outcomes


def describe_failure(error: BaseException) -> str:
    """Return why a task failed, in one line."""
    return one_line(error) if isinstance(error, ClusterError) else f"{type(error).__name__}: {one_line(error)}"


def _deadly(error: KilledWorker) -> ClusterError:
    return ClusterError(
        "its tasks ended the worker that they ran on again and again, at last with nothing else beside them, as "
        f"happens for want of memory ({error}); start workers with more memory, or take it out of the study"
    )
