"""A run of a study: its objects side by side on a cluster, in a store that the run has to itself."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.util import find_spec

from distributed import Client

from sobolev_batch.batch import object_run
from sobolev_batch.batch.cluster.clients import check_cluster, local_client, memory_limit, thread_client
from sobolev_batch.batch.cluster.execution import Cluster, Notify, Progress, Stages, carried_out, side_by_side
from sobolev_batch.batch.cluster.watch import Heartbeat, Watch
from sobolev_batch.batch.cluster.workers import prepare_workers, require_store_access
from sobolev_batch.batch.object_run import Ended
from sobolev_batch.batch.start import StoreLike, ready_to_run
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.machine import available_cores, require_machine_memory
from sobolev_batch.parameters import callback
from sobolev_batch.reduction.searched import SearchedSource
from sobolev_batch.shown import Shown, reasons
from sobolev_batch.sources.names import quoted
from sobolev_batch.store.create import give_up, require_usable, reserve
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, locked, utc_now
from sobolev_batch.store.objects import Objects, ends_all, labelled
from sobolev_batch.store.records import ObjectRecord
from sobolev_batch.study.study import Study, StudyLike
from sobolev_batch.tables.all_objects import write_all
from sobolev_batch.visible import visible

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Summary(Shown):
    """The outcome of a run.

    Attributes:
        store: Path or URL of the store.
        computed: Labels of the meshes whose fields were computed now.
        reused: Labels of the meshes whose fields were already stored.
        failed: Reason for each mesh whose field could not be computed, by its label, or that of an object by its name.
        not_compared: Reason for each mesh whose field is stored, but not the Hausdorff and Chamfer distances that the
            study requests.
        imprecise: Largest relative error of the distances of each mesh that are less accurate than the study requires.
        failures: Number of meshes whose fields could not be computed, those of whole objects too.

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
    failures: int = 0

    def __str__(self) -> str:
        counts = f"{len(self.computed)} computed, {len(self.reused)} reused, {self.failures} failed"
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
        only: Objects, families or members to compute, such as "cow", "mmg" or "cow/mmg/0.1", or patterns such as
            "mmg/0.0*", with the reference; default all. Tables have the others as missing, until a run without it
            computes them.

    Returns:
        Meshes that were computed, that were reused, and that failed. A mesh that fails does not raise. Of several
        objects, neither does one that cannot be carried out; labels begin with the name of the object.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out, or runs commands and may not.
        AccuracyError: The accuracy that the study requests is out of reach; nothing was computed.
        StoreError: The store cannot be reached or written, is another study's, or another run writes it (LockError).
        ClusterError: No worker has the GPU or the memory that the study requests; or the scheduler was lost.
        InputError: The memory is no size, or not there; or the client is none of Dask's, or asynchronous, or given
            beside workers or memory.

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
    check_cluster(client, workers, memory)
    study, location = ready_to_run(study, store, allow_commands=allow_commands, only=only)
    location = location if client is None else location.absolute()
    notify, lock = callback(on_progress), Lock.of_this_process()
    require_usable(location, of_objects="" not in study.objects)
    with ExitStack() as stack:

        def start() -> Client:
            started = client or stack.enter_context(_own_cluster(study, location, workers, memory))
            # Without bokeh, a cluster of this process has a page that says no more than that.
            if client or find_spec("bokeh"):
                notify(Progress("cluster", 0, 0, started.dashboard_link))
            families = (family for one in study.objects.values() for family in one.families)
            if searched := dict.fromkeys(one.name for one in families if isinstance(one.source, SearchedSource)):
                notify(Progress("search", 0, 0, ", ".join(searched)))
            return started

        with locked(location, lock):
            if client is not None:
                with Watch(client).kept():
                    require_store_access(client, location, lock)
            try:
                return carry_out(study, location, lock, start, notify)
            except SobolevBatchError:
                give_up(lock.fenced(location))
                raise


def carry_out(
    study: Study, location: Location, lock: Lock, start: Callable[[], Client], notify: Notify = lambda progress: None
) -> Summary:
    """Run a study in a store that this process has locked; a client is asked for once, if anything is missing.

    What ends the run of an only object without a name is raised, and what ends those of all objects.
    """
    place, numbers, at_hand = lock.fenced(location), {name: n for n, name in enumerate(study.objects, 1)}, None
    objects = None if "" in study.objects else Objects.prepared(place, study)
    if objects is None and (at_hand := object_run.workspace_at_hand(study, place)) is None:
        reserve(place, study.title)
    with Heartbeat(location, lock).kept() as heartbeat, ExitStack() as stack:

        def beat(name: str, progress: Progress) -> None:
            part = f"{name}, {numbers[name]} of {len(numbers)}" if name else ""
            begin = f"{name}: " if name else ""
            heartbeat.advance(f"{begin}{progress.stage}, {progress.done} of {progress.total}")
            notify(replace(progress, part=part))

        @cache
        def cluster() -> Cluster:
            client = start()
            heartbeat.watch = stack.enter_context(Watch(client, study.backend == "gpu").kept())
            workers = prepare_workers(client, study.libraries)
            # This is asked before anything is computed: tasks would wait for a GPU that nobody has.
            workers.with_backend(study.backend).require_accuracy(study.accuracy)
            return Cluster(client, workers, study=study.name)

        def cluster_of(name: str) -> Cluster:
            return replace(cluster(), notify=partial(beat, name), part=name)

        if objects is None:
            if at_hand is None or (ended := object_run.ended_already(at_hand)) is None:
                ended = carried_out(object_run.run_object(study, place, cluster_of(""), at_hand))
            return _summary(location, {"": ended})
        runs = _Runs(study, place, objects, cluster_of)
        for name, outcome in side_by_side(runs.begun(), ends_all):
            runs.end(name, outcome)
        runs.tabulate()
    return _summary(location, {name: runs.ended[name] for name in study.objects if name in runs.ended})


class _Runs:
    """The runs of objects that have names: which have to begin, how each ended, and what the root keeps of it."""

    def __init__(self, study: Study, place: Location, objects: Objects, cluster_of: Callable[[str], Cluster]) -> None:
        self.study, self.place, self.objects, self.cluster_of = study, place, objects, cluster_of
        self.recorded, self.ended = objects.recorded(), dict[str, Ended]()

    def begun(self) -> Iterator[tuple[str, Stages[Ended]]]:
        """Yield the runs of objects of which anything may be missing."""
        objects, root, whole = self.objects, self.objects.root, frozenset[str]()
        # A run of a part may have left the others no more than its own orders.
        if "convergence" in root.documents and tuple(root.read("convergence/order").tolist()) == self.study.orders:
            whole = self.place.names().intersection(objects.tabulated)
        for name in self.study.objects:
            one, record = self.study.of_object(name), self.recorded.get(name)
            with suppress(InputError):  # Its run says what cannot be listed.
                if self.study.only and not one.object.chosen(self.study.only):
                    continue
            if (before := object_run.ended_before(one, record if name in whole else None)) is not None:
                self.ended[name] = before
                continue
            # What is wrong with the cluster is no fault of an object, and is raised.
            cluster = self.cluster_of(name)
            if record is not None and record.key:
                # This run may change its store and be killed, and the study may then be as before: no key may say so.
                objects.records.write(objects.rows[name], replace(record, key=""))
            yield name, object_run.run_object(one, self.place, cluster)

    def end(self, name: str, outcome: Ended | Exception) -> None:
        """Keep how the run of an object ended."""
        if isinstance(outcome, Exception):
            _log.error("%s: %s", name, outcome)
            total = 1
            with suppress(InputError):
                total = len(self.study.objects[name].members)
            outcome = Ended(ObjectRecord(reason=str(outcome), total=total, finished=utc_now()))
        self.ended[name] = outcome
        # With its key, the next run would trust the old rows at the root, should this one be killed.
        has_old_rows = outcome.tables is not None and name in self.objects.tabulated
        record = replace(outcome.record, key="", settings={}) if has_old_rows else outcome.record
        self.objects.records.write(self.objects.rows[name], record)

    def tabulate(self) -> None:
        """Write the tables of all objects at the root, if rows of any changed, came, went or have another place.

        Objects that the run left out keep theirs if these are of the study's settings now.
        """
        objects, ended = self.objects, self.ended
        changed = {name: one.tables for name, one in ended.items() if one.tables is not None}
        # Objects that could not be carried out lose their rows.
        lost = {name for name, one in ended.items() if one.record.reason} | changed.keys()
        left_out = (name for name in objects.tabulated if name in objects.rows and name not in ended)
        of_study, recorded = self.study.objects, self.recorded
        if others := [one for one in left_out if not object_run.has_rows_of_now(of_study[one], recorded.get(one))]:
            _log.warning(
                "%s: %d objects that this run left out, such as %s, have rows of other settings, and none in the "
                "tables of all until a run of them", *(objects.location, len(others), quoted(others[0])),
            )  # fmt: skip
            lost.update(others)
        kept = [name for name in objects.names if name in objects.tabulated and name not in lost]
        if changed or kept != [*objects.tabulated]:
            write_all(objects.root, objects.names, changed.values(), kept)
        self._collect_records()
        objects.root.remember()

    def _collect_records(self) -> None:
        """Collect the records of objects in pages, with the keys of those whose new rows are at the root now."""
        objects, known = self.objects, {**self.recorded, **{name: one.record for name, one in self.ended.items()}}
        alone = {*objects.records.collect([known.get(name) for name in objects.names])}
        for name in objects.tabulated:
            if name in self.ended and self.ended[name].tables is not None and objects.rows[name] in alone:
                objects.records.write(objects.rows[name], known[name])


def _own_cluster(
    study: Study, location: Location, workers: int | None, memory: float | str | None
) -> AbstractContextManager[Client]:
    """Return a cluster on this machine, not yet started, after a look at whether the machine has the memory."""
    if study.accuracy is not None and study.accuracy.asks_for_memory:
        require_machine_memory(study.accuracy.allowed_bytes, "[accuracy]: memory")
    if memory is not None:
        # Threads have no limit, and a wrong one is refused all the same.
        memory_limit(memory, workers or available_cores())
    # No other process sees a store in memory, so threads compute it.
    return thread_client(workers) if location.is_in_memory else local_client(workers, memory)


def _summary(location: Location, ended: Mapping[str, Ended]) -> Summary:
    records = {name: one.record for name, one in ended.items()}
    refused = {name: record.reason for name, record in records.items() if record.reason}
    return Summary(
        store=str(location),
        computed=tuple(labelled({name: dict.fromkeys(one.computed) for name, one in ended.items()})),
        reused=tuple(labelled({name: dict.fromkeys(one.reused) for name, one in ended.items()})),
        failed=refused | labelled({name: record.failed for name, record in records.items()}),
        not_compared=labelled({name: record.not_compared for name, record in records.items()}),
        imprecise=labelled({name: record.imprecise for name, record in records.items()}),
        failures=sum(record.failures for record in records.values()),
    )
