"""Tasks of many runs on a cluster: handed out in turn, in the free memory, taken back, and reported step by step."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from typing import Any, Generic, Literal, Self, TypeVar, cast
from uuid import uuid4

from distributed import CancelledError, Client, Future, as_completed
from distributed.comm import CommClosedError
from distributed.scheduler import KilledWorker

from sobolev_batch.batch.cluster.workers import GPU, MEMORY, Workers
from sobolev_batch.errors import ClusterError, SpaceError, StoreError, one_line
from sobolev_batch.store.records import Record

Result = TypeVar("Result")
Stage = Literal["cluster", "search", "lattice", "fields", "tables", "proximity"]
# Runs that have begun and not ended: at least so many, and so many for each thread of the workers, whose first task may
# be their only one. Each has its plan and its records in memory.
_FEWEST_RUNS, _RUNS_PER_THREAD = 64, 4
# Tasks that the scheduler knows of at a time keep its workers busy, while each costs it memory.
_FEWEST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD = 2000, 20
# What was done in a step of a stage, for people.
_DONE: Mapping[Stage, str] = {
    "lattice": "lattices chosen",
    "fields": "transforms",
    "tables": "parts of tables computed",
    "proximity": "Hausdorff and Chamfer distances measured",
}


@dataclass(frozen=True)
class Progress:
    """One step of a run.

    Attributes:
        stage: "cluster" once there is one, "search" where families are searched for meshes within tolerances,
            "lattice" while one is chosen for an accuracy, "fields" while meshes are transformed, "tables" while
            these are computed, "proximity" while Hausdorff and Chamfer distances are measured.
        done, total: Steps of the stage.
        label: Label of the mesh that was finished, address of the cluster's dashboard, or families; else empty.
        part: Object that is worked on and its number, such as "cow, 2 of 8"; empty where the study names no object.
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
        if self.stage == "search":
            return f"searching meshes of {self.label}: each takes several trials, unless it is kept from before"
        if self.record is not None:
            outcome = self.record.reason or self.record.remark or f"{self.record.seconds:.2f} s"
            return f"{part}[{self.done}/{self.total}] {self.label}: {self.record.status}, {outcome}"
        return f"{part}{count} {_DONE[self.stage]}"


Notify = Callable[[Progress], None]


@dataclass(frozen=True, eq=False)
class Task:
    """A call of a function on a worker.

    Attributes:
        arguments: Arguments of the call. Results take the place of tasks among them.
        projected_bytes: Memory that the call takes at most.
        needs_gpu: True where the call has to run on a worker with a GPU.
        row: Row of the store that the task works for, for the caller.
        label: Label of the mesh that it works for, for people.
        stage: What it does, for people; default the name of the function.
        divided: Tasks that do the same one by one. They take its place where a worker died of it, or beside it.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    projected_bytes: float = 0.0
    needs_gpu: bool = False
    row: int = -1
    label: str = ""
    stage: str = ""
    divided: tuple[Self, ...] = ()


def task_key(stage: str, study: str, part: str, label: str) -> tuple[str, str, str]:
    """Return the key of a task as Dask's dashboard shows it: what it does for which study, its mesh, and a number.

    The dashboard groups tasks by the first of these: all objects (parts) of a study share it.
    """
    # What follows a hyphen may be taken for a number of the task.
    group = f"{stage} {study}".strip().replace("-", "_")
    return group, "/".join(filter(None, (part, label))), uuid4().hex


@dataclass(frozen=True, eq=False)
class Cluster:
    """A cluster that computes a study.

    Attributes:
        client: Client of the cluster; None where this process does the tasks itself, one after the other.
        workers: Workers that the cluster had when the study began.
        study, part: Name of the study, and of its object where it names any, for the names of tasks.
    """

    client: Client
    workers: Workers
    notify: Notify = lambda progress: None
    study: str = ""
    part: str = ""

    def count_steps(self, stage: Stage, total: int) -> Callable[[str, Record | None], None]:
        """Report the start of a stage with its number of steps, and return a function that reports each by label."""
        done = count(1)
        self.notify(Progress(stage, 0, total))
        return lambda label, record: self.notify(Progress(stage, next(done), total, label, record))

    def submit(self, task: Task, claims_memory: bool) -> Future:
        """Submit a task after those among its arguments."""
        arguments = (self.submit(one, claims_memory) if isinstance(one, Task) else one for one in task.arguments)
        resources = {MEMORY: task.projected_bytes} if claims_memory and task.projected_bytes else {}
        if task.needs_gpu:
            resources[GPU] = 1.0
        key = task_key(task.stage or task.function.__name__, self.study, self.part, task.label)
        return self.client.submit(task.function, *arguments, key=key, resources=resources or None)


@dataclass(frozen=True, eq=False)
class Wave:
    """Tasks of a run that may go on beside each other. What comes after them waits for all of them, and for no others.

    Attributes:
        tasks: Read as they are handed out.
        take: Called with each task and its result, or the exception that ended it: a `ClusterError` where no worker has
            the memory, or where every worker died of it. What it raises ends the wave, and is raised where the wave was
            yielded; so is a StoreError of a task, which is not the fault of its mesh.
        projected_bytes: Most memory that any of them takes. Where as many tasks as a worker has threads fit beside each
            other, none has to claim its memory, and the scheduler is free to place them.
    """

    cluster: Cluster
    tasks: Iterable[Task]
    take: Callable[[Task, Any], None]
    projected_bytes: float = 0.0


# A run, or a part of one, as a generator: it yields the waves that it waits for, and returns its result.
Stages = Generator[Wave, None, Result]


def result_of(outcome: Any) -> Any:
    """Return the result of a task that must not fail; its exception is raised."""
    if isinstance(outcome, BaseException):
        raise outcome
    return outcome


def wait_for(cluster: Cluster, tasks: Iterable[Task], take: Callable[[Any], None], most_bytes: float) -> Stages[None]:
    """Wait for tasks that must not fail, and take the result of each; see `Wave`."""
    yield Wave(cluster, tasks, lambda _, outcome: take(result_of(outcome)), most_bytes)


def result_from(cluster: Cluster, task: Task) -> Stages[Any]:
    """Wait for one task, which must not fail, and return its result."""
    found: list[Any] = []
    yield from wait_for(cluster, [task], found.append, task.projected_bytes)
    return found[0]


def outcomes_here(tasks: Sequence[Task]) -> list[Any]:
    """Do tasks one after the other, and return the result of each, or its exception; a StoreError ends it."""

    def done(task: Task) -> Any:
        return task.function(*(done(one) if isinstance(one, Task) else one for one in task.arguments))

    outcomes = []
    for task in tasks:
        try:
            outcomes.append(done(task))
        except StoreError:
            raise
        except Exception as error:
            outcomes.append(error)
    return outcomes


def side_by_side(
    runs: Iterable[tuple[str, Stages[Result]]], is_fatal: Callable[[Exception], bool] = lambda error: False
) -> Iterator[tuple[str, Result | Exception]]:
    """Carry out runs beside each other, so that a worker is free only where none of them has a task for it.

    Tasks whose workers died are tried again alone, when nothing else is left to do: what killed a worker need not be
    the task itself, but another one beside it. Alone, it shows.

    Args:
        runs: Runs by their names, begun as there is room for more tasks.
        is_fatal: Tells of the exception that ended a run whether it ends all of them. It is raised in each.

    Yields:
        The name of each run with its result, or the exception that ended it.

    Raises:
        ClusterError: The scheduler was lost.
    """
    yield from _Loop(iter(runs), is_fatal).outcomes()


def carried_out(stages: Stages[Result]) -> Result:
    """Carry a single run out, and return its result; see `side_by_side`."""
    ((_, outcome),) = side_by_side([("", stages)], is_fatal=lambda error: True)
    return cast(Result, outcome)


class _Run(Generic[Result]):
    """A run that has begun: the wave that it waits for, tasks of this to hand out, and their number on the cluster."""

    wave: Wave
    tasks: Iterator[Task]

    def __init__(self, name: str, stages: Stages[Result]) -> None:
        self.name, self.stages = name, stages
        self.in_flight = 0
        # Their workers died.
        self.suspects: list[Task] = []


class _Loop(Generic[Result]):
    def __init__(self, waiting: Iterator[tuple[str, Stages[Result]]], is_fatal: Callable[[Exception], bool]) -> None:
        self._waiting, self._is_fatal = waiting, is_fatal
        self._begun: list[_Run[Result]] = []
        self._most_runs = _FEWEST_RUNS
        # Those with tasks to hand out, which they do in turn.
        self._ready = deque[_Run[Result]]()
        self._running: dict[Future, tuple[_Run[Result], Task]] = {}
        # Made for the client of the first task.
        self._completed: as_completed = None
        self._alone: Task | None = None
        self._ended = deque[tuple[str, Result | Exception]]()

    def outcomes(self) -> Iterator[tuple[str, Result | Exception]]:
        try:
            while True:
                self._hand_out()
                if self._ended:
                    yield self._ended.popleft()
                elif self._running:
                    self._take_back()
                elif not self._ready and not self._try_alone():
                    break
        except BaseException as error:
            for run in self._begun:
                with suppress(BaseException):
                    run.stages.throw(error)
                with suppress(BaseException):
                    run.stages.close()
            raise
        finally:
            # The client may outlive this loop, and the cluster would go on for it.
            for future in self._running:
                future.release()

    def _hand_out(self) -> None:
        """Submit tasks of all runs in turn, up to what the scheduler should know of; begin runs where none has any.

        Where nothing is running meanwhile, as without a cluster, what has ended is told first.
        """
        while self._alone is None and (self._running or not self._ended) and (self._ready or self._begin()):
            if not self._ready:
                continue
            run = self._ready[0]
            if len(self._running) >= max(_FEWEST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD * run.wave.cluster.workers.threads):
                return
            self._ready.rotate(-1)
            try:
                task = next(run.tasks, None)
            except Exception as error:
                self._advance(run, error)
                continue
            if task is not None:
                self._submit(run, task)
            else:
                self._ready.remove(run)
                self._go_on(run)

    def _begin(self) -> bool:
        """Begin the next run; False where none is waiting, or enough have begun."""
        found = None if len(self._begun) >= self._most_runs else next(self._waiting, None)
        if found is not None:
            self._begun.append(_Run(*found))
            self._advance(self._begun[-1])
        return found is not None

    def _submit(self, run: _Run[Result], task: Task) -> None:
        cluster = run.wave.cluster
        if cluster.client is None:
            try:
                run.wave.take(task, *outcomes_here([task]))
            except Exception as error:
                self._advance(run, error)
            return
        try:
            cluster.workers.require_memory(task.projected_bytes)
        except ClusterError as error:
            self._give(run, task, error)
            return
        if self._completed is None:
            self._completed = as_completed(loop=cluster.client.loop)
            self._most_runs = max(_FEWEST_RUNS, _RUNS_PER_THREAD * cluster.workers.threads)
        future = cluster.submit(task, run.wave.projected_bytes > cluster.workers.allowed_bytes_per_task)
        self._running[future] = run, task
        run.in_flight += 1
        self._completed.add(future)

    def _take_back(self) -> None:
        # Others were given up.
        batch = [future for future in self._completed.next_batch() if future in self._running]
        for future, outcome in zip(batch, _outcomes(batch), strict=True):
            if future not in self._running:
                continue  # An outcome before this one ended the wave.
            run, task = self._running.pop(future)
            run.in_flight -= 1
            if was_alone := task is self._alone:
                self._alone = None
            if not isinstance(outcome, KilledWorker):
                self._give(run, task, outcome)
            elif task.divided:
                run.tasks = chain(task.divided, run.tasks)
                if run not in self._ready:
                    self._ready.append(run)
            elif was_alone:
                reason = (
                    "its tasks ended the worker that they ran on again and again, at last with nothing else beside "
                    f"them, as happens for want of memory ({outcome}); start workers with more memory, or take it "
                    "out of the study"
                )
                self._give(run, task, ClusterError(reason))
            else:
                run.suspects.append(task)
            self._go_on(run)

    def _give(self, run: _Run[Result], task: Task, outcome: Any) -> None:
        try:
            if type(outcome) in (StoreError, SpaceError):
                raise type(outcome)(f"{outcome}; then the same command goes on from what is stored") from outcome
            if isinstance(outcome, StoreError):
                raise outcome
            run.wave.take(task, outcome)
        except Exception as error:
            self._advance(run, error)

    def _go_on(self, run: _Run[Result]) -> None:
        if run in self._begun and not (run in self._ready or run.in_flight or run.suspects):
            self._advance(run)

    def _advance(self, run: _Run[Result], error: Exception | None = None) -> None:
        """Have a run yield its next wave, or end. An error is raised where it waits; its other tasks are given up."""
        if error is not None:
            for future in [future for future, (owner, _) in self._running.items() if owner is run]:
                del self._running[future]
                future.release()
        run.in_flight = 0
        run.suspects.clear()
        with suppress(ValueError):
            self._ready.remove(run)
        try:
            run.wave = next(run.stages) if error is None else run.stages.throw(error)
        except StopIteration as end:
            self._begun.remove(run)
            self._ended.append((run.name, end.value))
        except Exception as failure:
            self._begun.remove(run)
            if self._is_fatal(failure):
                raise
            self._ended.append((run.name, failure))
        else:
            run.tasks = iter(run.wave.tasks)
            self._ready.append(run)

    def _try_alone(self) -> bool:
        """Hand one of the tasks out whose workers died; False where there is none."""
        if not (suspects := [(run, task) for run in self._begun for task in run.suspects]):
            return False
        run, self._alone = min(suspects, key=lambda suspect: suspect[1].row)
        run.suspects.remove(self._alone)
        self._submit(run, self._alone)
        return True


def _outcomes(futures: Sequence[Future]) -> list[Any]:
    """Fetch the results of futures that have ended, or their exceptions, all at once."""
    if not futures:
        return []
    client = futures[0].client
    lost = (
        f"the scheduler at {client.scheduler.address} was lost; the same command goes on from what is stored, "
        "after `sobolev-batch unlock` where it was submit"
    )
    if client.status != "running" or any(future.cancelled() for future in futures):
        raise ClusterError(lost)
    try:
        results = iter(client.gather([future for future in futures if future.status == "finished"]))
        return [next(results) if future.status == "finished" else future.exception() for future in futures]
    except (CommClosedError, CancelledError) as error:
        raise ClusterError(lost) from error


def describe_failure(error: BaseException) -> str:
    """Return why a task failed, in one line."""
    return one_line(error) if isinstance(error, ClusterError) else f"{type(error).__name__}: {one_line(error)}"
