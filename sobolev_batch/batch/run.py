"""A run of a study: pending fields become tasks, and stored fields become tables."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from distributed import Client

from sobolev_batch import compiled
from sobolev_batch.batch.cluster.clients import local_client, memory_limit, require_blocking, thread_client
from sobolev_batch.batch.cluster.execution import (
    Cluster,
    Notify,
    Progress,
    Stages,
    Task,
    Wave,
    result_of,
    side_by_side,
)
from sobolev_batch.batch.cluster.watch import Heartbeat, Watch
from sobolev_batch.batch.cluster.workers import prepare_workers, require_store_access
from sobolev_batch.batch.field_stage import compute_fields
from sobolev_batch.batch.proximity_stage import have_proximities, measure_proximities
from sobolev_batch.batch.start import StoreLike, ready_to_run
from sobolev_batch.batch.table_stage import are_tabulated, tabulate_fields
from sobolev_batch.batch.verify import damaged_rows
from sobolev_batch.errors import DamageError, InputError, StoreError
from sobolev_batch.machine import available_cores, require_machine_memory
from sobolev_batch.norms.accuracy.tolerance import NEXT_TO_EQUAL
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.shown import Shown, reasons
from sobolev_batch.store.collection_store import CollectionStore, labelled
from sobolev_batch.store.create import require_usable
from sobolev_batch.store.layout import stored_choice
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, locked
from sobolev_batch.store.records import Records
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Plan, make_plan
from sobolev_batch.study.study import Study, StudyLike
from sobolev_batch.visible import visible

_log = logging.getLogger(__name__)

# A study whose distances miss the accuracy requested is computed again on a larger lattice,
# this often in all.
_MOST_ROUNDS = 3
# Fields that turn out damaged are computed again; where that goes on, something destroys them.
_MOST_REPAIRS = 3


@dataclass(frozen=True)
class Summary(Shown):
    """The outcome of a run.

    Attributes:
        store: Path or URL of the store.
        computed: Labels of the meshes whose fields were computed now.
        reused: Labels of the meshes whose fields were already stored.
        failed: Reason for each mesh whose field could not be computed, by its label.
        not_compared: Reason for each mesh whose field is stored, but not the Hausdorff and Chamfer distances that the
            study requests.
        imprecise: Largest relative error of the distances of each mesh that are less accurate than the study requires.

    >>> import sobolev_batch as sb
    >>> from sobolev_batch.result_types import Summary
    >>> summary = Summary("results.zarr", computed=("ico/2",), reused=("ico/1",), failed={"f/a": "no triangles"})
    >>> sorted(summary.failed)
    ['f/a']
    """

    store: str
    computed: tuple[str, ...]
    reused: tuple[str, ...]
    failed: Mapping[str, str]
    not_compared: Mapping[str, str] = field(default_factory=dict)
    imprecise: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        counts = f"{len(self.computed)} computed, {len(self.reused)} reused, {len(self.failed)} failed"
        errors = {label: f"error of {100 * error:.2g} %" for label, error in self.imprecise.items()}
        kinds = {"failed": self.failed, "not compared": self.not_compared, "imprecise": errors}
        lines = [f"{name}: {text}" for name, by_label in kinds.items() for name, text in reasons(name, by_label)]
        return "\n".join(map(visible, [f"{counts}; store: {self.store}", *lines]))


def run(
    study: StudyLike,
    store: StoreLike = None,
    client: Client | None = None,
    *,
    workers: int | None = None,
    memory: float | str | None = None,
    on_progress: Notify | None = None,
    allow_commands: bool = False,
    only: Sequence[str] = (),
) -> Summary:
    """Compute the fields that a store lacks of a study, then norms, distances and convergence tables.

    What would make the run useless, such as too few objects for a league, is logged as a warning first; see `plan`.

    Args:
        study: Study, whose objects are carried out side by side, or the path of its file.
        store: Path or URL of a new or existing store, which all workers reach under this name; default
            storage/NAME.zarr. A store in memory:// is computed by threads of this process, and gone when it ends.
        client: Client of the cluster to compute on. By default single-threaded processes on this machine are started
            where anything is missing; a script must then guard its main part by ``if __name__ == "__main__"``.
        workers: Number of these processes; by default one for each core.
        memory: Memory of each of them, in bytes or as a text such as "4GB"; by default equal parts of the machine's.
        on_progress: Callback for each step, such as `print`; it is called in this thread.
        allow_commands: True if the study may run its commands on the workers and here: you trust its file.
        only: Families or members FAMILY/MEMBER to compute, or patterns such as "mmg/0.0*", with the reference; default
            all. Tables have the others as missing, until a run without it computes them.

    Returns:
        Meshes that were computed, that were reused, and that failed. A mesh that fails does not raise. Of several
        objects, neither does one that cannot be carried out; labels begin with the name of the object.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out, or runs commands and may not.
        AccuracyError: The accuracy that the study requests is out of reach; nothing was computed.
        StoreError: The store cannot be reached or written, belongs to another study, or is being written by another run
            (LockError).
        ClusterError: No worker has the GPU or the memory that the study requests; or the scheduler was lost.
        InputError: The memory is no size, or not there; or the client is asynchronous.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "balls"},
    ...     "lattice": {"xi_max": 3.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ball", "source": "sphere", "radius": 0.5}],
    ... })
    >>> summary = sb.run(study, "memory://run-example.zarr", workers=1)
    >>> summary.computed
    ('ball/sphere', 'reference')
    >>> sb.run(study, "memory://run-example.zarr").reused
    ('ball/sphere', 'reference')
    """
    if client is not None:
        require_blocking(client)
    study, location = ready_to_run(study, store, allow_commands=allow_commands, only=only)
    location = location if client is None else location.absolute()
    notify = on_progress or _ignore
    if "" not in study.objects:
        CollectionStore.prepared(location, study)
    names = list(study.objects)
    with ExitStack() as stack:

        @cache
        def start() -> tuple[Client, Watch]:
            """Start the cluster of all objects, which is not needed where nothing is missing."""
            own = nullcontext(client) if client is not None else _own_cluster(study, location, workers, memory)
            started = stack.enter_context(own)
            needs_gpu = study.backend == "gpu"
            watch = stack.enter_context(Watch(started, needs_gpu).kept())
            return started, watch

        known_workers = cache(lambda libraries: prepare_workers(start()[0], libraries))

        @cache
        def announce() -> None:
            # Without bokeh, a cluster of this process has a page that says no more than that.
            if client is not None or find_spec("bokeh"):
                notify(Progress("cluster", 0, 0, start()[0].dashboard_link))

        def equip(study: Study) -> tuple[Cluster, Watch]:
            started, watch = start()
            announce()
            return Cluster(started, known_workers(study.libraries), study=study.name, part=study.object.name), watch

        def run_object(name: str, study: Study, place: Location) -> Stages[Summary]:
            part = f"{name}, {names.index(name) + 1} of {len(names)}" if name else ""
            lock = Lock.of_this_process()
            require_usable(place)
            with locked(place, lock):
                if client is not None and name == names[0]:
                    # The others lie beside it.
                    require_store_access(start()[0], place, lock)
                notify_of_part = partial(_notify_of, notify, part)
                return (yield from carry_out(study, place, lock, equip, notify_of_part))

        return _outcome_of_all(study, location, run_object)


def _notify_of(notify: Notify, part: str, progress: Progress) -> None:
    notify(replace(progress, part=part))


def _outcome_of_all(
    study: Study, location: Location, run_object: Callable[[str, Study, Location], Stages[Summary]]
) -> Summary:
    """Run all objects of a study beside each other.

    What ends the run of an object is raised where it is the only one. Of several, a StoreError ends all: the stores of
    the others would not fare better.
    """
    summaries: dict[str, Summary] = {}
    refused: dict[str, str] = {}

    def is_fatal(error: Exception) -> bool:
        return "" in study.objects or isinstance(error, StoreError) or not isinstance(error, InputError)

    runs = (
        (name, run_object(name, study.of_object(name), location.below(name) if name else location))
        for name in study.objects
    )
    for name, outcome in side_by_side(runs, is_fatal):
        if isinstance(outcome, Exception):
            refused[name] = str(outcome)
            _log.error("%s: %s", name, outcome)
        else:
            summaries[name] = outcome
    in_order = {name: summaries[name] for name in study.objects if name in summaries}
    return summaries[""] if "" in summaries else _of_all(location, in_order, refused)


def _ignore(progress: Progress) -> None:
    """Report a step of a run to nobody."""


def _own_cluster(
    study: Study, location: Location, workers: int | None, memory: float | str | None
) -> AbstractContextManager[Client]:
    """Return a cluster on this machine, not yet started, after a look at whether the machine has the memory."""
    if study.accuracy is not None and study.accuracy.asks_for_memory:
        require_machine_memory(study.accuracy.allowed_bytes, "[accuracy]: memory")
    if memory is not None:
        # Otherwise a store would be made before the cluster refuses it.
        memory_limit(memory, workers or available_cores())
    # In threads, where no other process would see the store.
    return thread_client(workers) if location.is_in_memory else local_client(workers, memory)


def _of_all(location: Location, summaries: Mapping[str, Summary], refused: Mapping[str, str]) -> Summary:
    """Return the outcome of the objects of a collection together."""

    def of_all(part: str) -> dict[str, Any]:
        entries = {name: getattr(summary, part) for name, summary in summaries.items()}
        return labelled({name: dict.fromkeys(own) if isinstance(own, tuple) else own for name, own in entries.items()})

    computed, reused, failed = of_all("computed"), of_all("reused"), {**refused, **of_all("failed")}
    return Summary(str(location), (*computed,), (*reused,), failed, of_all("not_compared"), of_all("imprecise"))


def carry_out(
    study: Study,
    location: Location,
    lock: Lock,
    equip: Callable[[Study], tuple[Cluster, Watch]],
    notify: Notify = _ignore,
) -> Stages[Summary]:
    """Run a study in a store that this process has locked; a cluster is asked for if anything is missing."""
    plan: Plan | None = None
    if study.accuracy is not None and stored_choice(location) is None:
        # Pilots are made and compared, which takes as long as some of the study's tasks.
        plan = yield from _planned(study, replace(equip(study)[0], notify=notify))
    workspace = Workspace.of_study(study, location, lock, plan)
    with Heartbeat(workspace.store, lock).kept() as heartbeat:
        if lacks_nothing(workspace):
            # The last run may have been killed before it did.
            Records(workspace.store).collect(workspace.records)
            return _summary(workspace, set())

        def beat(progress: Progress) -> None:
            heartbeat.advance(f"{progress.stage}, {progress.done} of {progress.total}")
            notify(progress)

        cluster, heartbeat.watch = equip(study)
        cluster = replace(cluster, notify=beat)
        heartbeat.write("running")
        # Asked before anything is computed: a GPU that nobody has would be waited for.
        cluster.workers.with_backend(study.backend)
        cluster.workers.require_accuracy(study.accuracy)
        return (yield from _compute(cluster, heartbeat, workspace))


def _planned(study: Study, cluster: Cluster) -> Stages[Plan]:
    """Plan a study on a worker."""
    cluster.workers.require_accuracy(study.accuracy)
    plans: list[Plan] = []
    advance = cluster.count_steps("lattice", 1)
    task = Task(plan_by_itself, (study,), stage="plan")
    yield Wave(cluster, [task], lambda _, outcome: plans.append(result_of(outcome)))
    advance("", None)
    return plans[0]


def plan_by_itself(study: Study) -> Plan:
    """Plan a study, with digits that do not depend on what else the process computes."""
    with compiled.by_itself():
        # Workers plan many.
        compiled.use()
        return make_plan(study)


def _compute(cluster: Cluster, heartbeat: Heartbeat, workspace: Workspace) -> Stages[Summary]:
    """Compute what a workspace lacks, on larger lattices until the accuracy is reached, and measure proximities."""
    rows, study = workspace.pending, workspace.plan.study
    workspace.withdraw_results_of(rows)
    computed: set[int] = set()
    for rounds_left in reversed(range(_MOST_ROUNDS)):
        repaired, distances = yield from _compute_repairing(cluster, workspace, rows)
        computed.update(rows, repaired)
        if not rounds_left or distances is None or study.accuracy is None:
            break
        choice = workspace.plan.choice.grown(distances, study.orders, study.accuracy)
        if choice is None:
            break
        # The records are laid out anew, that of the run with them.
        with heartbeat.paused():
            workspace = Workspace.prepared(workspace.store.location, workspace.plan.with_choice(choice))
        heartbeat.write("running")
        rows = workspace.pending
    yield from measure_proximities(cluster, workspace)
    Records(workspace.store).collect(workspace.records)
    return _summary(workspace, computed)


def _compute_repairing(
    cluster: Cluster, workspace: Workspace, rows: Sequence[int]
) -> Stages[tuple[set[int], NormEstimate | None]]:
    """Compute fields and tables, and damaged fields again; return their rows, and distances if they are new."""
    repairs, repaired = 0, set[int]()
    while True:
        try:
            yield from compute_fields(cluster, workspace, rows)
            return repaired, (yield from tabulate_fields(cluster, workspace))
        except DamageError as error:
            if repairs == _MOST_REPAIRS:
                raise
            repairs += 1
            _log.warning("%s", error)
            # Where one is damaged, others may be.
            rows = yield from damaged_rows(cluster, workspace)
            workspace.withdraw(rows, "its values are not what was stored")
            repaired.update(rows)


def lacks_nothing(workspace: Workspace) -> bool:
    """Return True where nothing of a plan is missing in its store: fields, tables and distances of other kinds."""
    return not workspace.pending and are_tabulated(workspace) and have_proximities(workspace)


def _summary(workspace: Workspace, computed: set[int]) -> Summary:
    labels, complete = workspace.labels, workspace.complete
    return Summary(
        workspace.store.path,
        tuple(labels[i] for i in workspace.rows if i in computed and i in complete),
        tuple(labels[i] for i in workspace.rows if i not in computed and i in complete),
        workspace.failures,
        workspace.not_compared,
        _imprecise(workspace),
    )


def _imprecise(workspace: Workspace) -> dict[str, float]:
    """Return the largest relative error of each mesh whose distances miss the accuracy, by its label."""
    if workspace.plan.study.accuracy is None:
        return {}
    labels = workspace.store.read_strings("convergence/mesh")
    distances, errors, relative, within = (
        np.asarray(workspace.store.read(f"convergence/{name}", ...))
        for name in ("distance", "error", "relative", "within")
    )
    # Of what is next to equal to the reference, no computation gives digits.
    short = ~within.astype(bool) & (relative > NEXT_TO_EQUAL)
    return {
        label: float(np.max(errors[i][short[i]] / distances[i][short[i]]))
        for i, label in enumerate(labels)
        if short[i].any()
    }
