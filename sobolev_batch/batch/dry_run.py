"""The plan of a study for people: its lattice, tasks, memory, storage, and the time that a run will take."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain, repeat, starmap
from time import process_time
from typing import Any

from distributed import Client

from sobolev_batch.batch.cluster.clients import require_blocking
from sobolev_batch.batch.cluster.workers import Workers, prepare_workers, worker_slowness
from sobolev_batch.batch.field_costs import TaskSizes, is_predictable, row_seconds, size_rows
from sobolev_batch.batch.object_run import ended_before, lacks_nothing
from sobolev_batch.batch.start import StoreLike, require_permission, settled
from sobolev_batch.geometry.surface import Similarity, placement_doubt
from sobolev_batch.machine import available_cores
from sobolev_batch.norms.fields import Quality
from sobolev_batch.parameters import callback, format_bytes
from sobolev_batch.shown import Shown, reasons, together
from sobolev_batch.store.layout import stored_choice
from sobolev_batch.store.location import Location
from sobolev_batch.store.objects import Objects, for_each_object, labelled
from sobolev_batch.store.records import Record
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.pilots import Look
from sobolev_batch.study.plan import Plan, make_plan
from sobolev_batch.study.schema import REFERENCE_LABEL
from sobolev_batch.study.study import Study, StudyLike
from sobolev_batch.tables.pairs import PAIR_BYTES, tile_count
from sobolev_batch.tables.rendering import printed_table
from sobolev_batch.tables.text import beside, duration, spread
from sobolev_batch.transform.fourier import slowness
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.visible import visible

# Processor time to start a process with all libraries, and the time until a cluster of them has started.
_PROCESS_SECONDS, _CLUSTER_SECONDS = 4.0, 6.0
# Objects that a plan looks at: the choice of a lattice takes seconds.
_MOST_OBJECTS = 6
_SUMMARY = ("object", "missing", "CPU time", "memory", "storage", "M + octaves")
# Stored fields tell the speed if there are as many.
_FEWEST_RECORDS = 3


def seconds_of_missing(
    plan: Plan, stored: Mapping[str, Record], workers: Workers, client: Client | None
) -> tuple[dict[str, float], str]:
    """Predict the processor seconds of each surface that is missing, by label; return also what tells the speed."""
    predicted = {row.label: row_seconds(plan, row) for row in plan.rows}
    if not (missing := [label for label in predicted if label not in stored]):
        return {}, ""
    # What programs took is in the time of others, and in no prediction.
    known = [row.label for row in plan.rows if row.label in stored and is_predictable(row)]
    if len(known) >= _FEWEST_RECORDS:
        factor = sum(stored[label].seconds for label in known) / sum(predicted[label] for label in known)
        basis = f"the {len(known)} fields that are stored"
    elif client is None:
        factor, basis = slowness(), "a transform on this machine"
    else:
        factor, basis = worker_slowness(client, workers.members[0].address), "a transform on a worker"
    return {label: factor * predicted[label] for label in missing}, basis


@dataclass(frozen=True)
class ObjectPlan:
    """Forecast of the run of an object.

    Attributes:
        store: Path or URL of its store.
        labels: Labels of all surfaces, the reference among them.
        reference: Label of the reference.
        stored: Labels of the surfaces whose fields the store has already.
        refused: Reason for each surface that fits into no worker, by label.
        failing: Reason for each surface that cannot be read or made, as long as surfaces are quickly looked at.
        doubtful: Reason for each other one that may be in another unit or place than the reference, or was noted where
            its file was read.
        lattice: Lattice of all fields.
        octaves: Number of octaves that are sampled beyond the lattice.
        dtype: Type of the fields, "complex128" or "complex64".
        similarity: Similarity from the meshes' own unit of length to the study's.
        field_bytes: Bytes of one stored field.
        memory_bytes: Projected peak memory of each surface's largest task, by label.
        task_seconds: Processor time of the tasks of each surface that is missing, by label. It leaves out Hausdorff and
            Chamfer distances, and distances of very many pairs.
        unknown: Labels of those that programs or searches make, which takes a time that is not known.
        planning_seconds: Processor time of the choice of a lattice, where a run makes it again.
        lacks_tables: True where no field is missing, and tables, or distances of other kinds, are.
        lines: What is shown: name and text of each line; an empty name goes on with the line before.

    >>> import sobolev_batch as sb
    >>> plan = sb.plan("workflows/icosphere.toml").object
    >>> plan.reference, plan.octaves, plan.dtype, plan.task_seconds
    ('reference', 0, 'complex128', {})
    """

    store: str
    labels: tuple[str, ...]
    reference: str
    stored: tuple[str, ...]
    refused: dict[str, str]
    failing: dict[str, str]
    doubtful: dict[str, str]
    lattice: Lattice
    octaves: int
    dtype: str
    similarity: Similarity
    field_bytes: int
    memory_bytes: dict[str, float]
    task_seconds: dict[str, float]
    unknown: tuple[str, ...]
    planning_seconds: float
    lacks_tables: bool
    lines: tuple[tuple[str, str], ...] = field(repr=False)

    @property
    def total_bytes(self) -> int:
        """Bytes of all stored fields."""
        return self.field_bytes * len(self.labels)

    @property
    def shortest_seconds(self) -> float:
        """Time that its run takes where each surface has a processor for itself."""
        return self.planning_seconds + max(self.task_seconds.values(), default=0.0)

    @property
    def processor_seconds(self) -> float:
        """Processor time that its run takes, without that of starting processes."""
        return self.planning_seconds + sum(self.task_seconds.values())

    def summary(self, name: str) -> tuple[str, ...]:
        """Return its row in the table of several objects."""
        missing, memory = len(self.task_seconds), max(self.memory_bytes.values(), default=0.0)
        return (
            name,
            f"{missing} of {len(self.labels)}",
            duration(self.processor_seconds, digits=2) if missing else "",
            format_bytes(memory) if missing else "",
            format_bytes(self.total_bytes),
            f"{self.lattice.M} + {self.octaves}" if self.octaves else str(self.lattice.M),
        )

    def to_table(self) -> dict[str, Any]:
        """Return the numbers for programs, without what is shown."""
        numbers = {name: value for name, value in vars(self).items() if name != "lines"}
        return {**numbers, "total_bytes": self.total_bytes}


@dataclass(frozen=True)
class StudyPlan(Shown):
    """Forecast of a run of a study; ``print(plan)`` shows what ``sobolev-batch plan`` shows.

    Attributes:
        study: Name of the study.
        store: Path or URL of its store.
        count: Number of its objects.
        weight: How many unfinished objects each of those stands for that were looked at: 1 unless there are many.
        objects: Plan of each object that was looked at and can be carried out, by its name; that of an only object may
            be under "".
        refused: Reason for each other object, by its name.
        seconds: Time that a run will take on the workers, if they have their cores for themselves. It leaves out
            Hausdorff and Chamfer distances, and distances of very many pairs.
        processor_seconds: Processor time that a run will take, that of starting processes included.
        time: What is shown of both, line by line.
        warnings: What would end a run: no folder for its store.

    >>> import sobolev_batch as sb
    >>> plan = sb.plan("workflows/icosphere.toml")
    >>> list(plan.objects), plan.missing, plan.seconds
    ([''], (), 0.0)
    """

    study: str
    store: str
    count: int
    weight: float
    objects: Mapping[str, ObjectPlan]
    refused: Mapping[str, str]
    seconds: float
    processor_seconds: float
    time: tuple[str, ...] = field(repr=False)
    warnings: tuple[str, ...] = ()

    @property
    def object(self) -> ObjectPlan:
        """Plan of the only object; ValueError where there are several, or none."""
        (only,) = self.objects.values()
        return only

    @property
    def missing(self) -> tuple[str, ...]:
        """Labels of the surfaces of these objects whose fields are to be computed, below the names of the objects."""
        return tuple(labelled({name: one.task_seconds for name, one in self.objects.items()}))

    @property
    def total_bytes(self) -> int:
        """Bytes of all stored fields, as far as objects that were looked at tell."""
        looked_at, possible = len(self.objects), self.count - self.weight * len(self.refused)
        return round(sum(one.total_bytes for one in self.objects.values()) * possible / max(1, looked_at))

    def to_table(self) -> dict[str, Any]:
        """Return the numbers for programs, without what is shown."""
        objects = {name: one.to_table() for name, one in self.objects.items()}
        numbers = {name: value for name, value in vars(self).items() if name != "time"}
        return {**numbers, "objects": objects, "missing": self.missing, "total_bytes": self.total_bytes}

    def __str__(self) -> str:
        lines = [*starmap(_beside, zip(chain(["time"], repeat("")), self.time, strict=False))]
        lines += [_beside("warning", text) for text in self.warnings]
        if "" not in self.objects:
            looked = f", of which {len(self.objects) + len(self.refused)} were looked at" if self.weight > 1 else ""
            lines.append(_beside("objects", f"{self.count:,}{looked}; {format_bytes(self.total_bytes)} of fields"))
        lines += [beside(f"{visible(name)}: ", reason) for name, reason in together(self.refused).items()]
        longest_first = sorted(self.objects.items(), key=lambda named: -named[1].processor_seconds)
        if len(longest_first) > 1:
            rows = [one.summary(visible(name)) for name, one in longest_first]
            lines += ["", *printed_table(rows, _SUMMARY, "text").split("\n"), ""]
            for kind in ("failing", "doubtful"):
                found = labelled({name: getattr(one, kind) for name, one in longest_first})
                lines += starmap(_beside, reasons(kind, together(found)))
        for name, one in longest_first[:1]:
            lines += [*([f"{visible(name)}:"] if name else []), *starmap(_beside, one.lines)]
        return "\n".join(lines)


def _beside(name: str, text: str) -> str:
    return beside(f"{name + ':' * bool(name):<14} ", text)


def _study_lines(plan: Plan) -> Iterator[tuple[str, str]]:
    """Yield what is shown of a plan whatever computes it."""
    study, lattice, similarity, tail = plan.study, plan.lattice, plan.similarity, plan.tail
    yield "similarity", f"scale {similarity.scale:.9g}, origin {' '.join(f'{x:.9g}' for x in similarity.origin)}"
    spacing = f"spacing {lattice.spacing:g}, half period {lattice.half_period:g}"
    yield "lattice", f"xi_max {lattice.xi_max:g}, M {lattice.M}, {spacing}"
    yield "orders", ", ".join(f"{order:g}" for order in study.orders)
    if tail is not None:
        shortest = 1 / (tail.highest_frequency * similarity.scale)
        reach = f"to |xi| {tail.highest_frequency:.4g}: wavelengths down to {shortest:.3g} of the files' unit"
        yield "octaves", f"{len(tail.octaves)} beyond the lattice, {reach}; {tail.size:,} samples"
        yield "", f"{format_bytes(tail.size * plan.item_bytes)} per surface"
    accuracy, transform = study.accuracy, plan.transform
    if accuracy is None:
        yield "transform", f"eps {transform.eps:g}, {transform.dtype}, quadrature {transform.quadrature}"
    else:
        allowed = f"{format_bytes(accuracy.allowed_bytes)} for a transform, M <= {accuracy.largest_intervals}"
        yield "accuracy", f"rtol {accuracy.rtol:g} of every distance to {plan.reference}; {allowed}"
        yield "", "a run goes on with a larger lattice, or more octaves, where a distance misses it"
        yield from (("chosen", reason) for reason in plan.choice.reasons)
        yield "transform", f"{transform.dtype}, eps and quadrature for each surface from its distance"
    yield "backend", study.backend
    yield from (("command", command) for command in study.commands)
    if study.commands:
        yield "", "they run only with --allow-commands (in Python: allow_commands=True)"
    if study.proximity is not None:
        points = f"distances of {study.proximity.points:,} points on each mesh"
        yield "proximity", f"{points}; the time above leaves them out"


def _task_lines(plan: Plan, sizes: Mapping[str, TaskSizes]) -> Iterator[tuple[str, str]]:
    """Yield what is computed, and the memory that it takes."""
    if sizes:
        largest = max(sizes, key=lambda label: sizes[label].task_bytes)
        yield "memory", f"up to {format_bytes(sizes[largest].task_bytes)} in a task, of {largest}"
    total_bytes = format_bytes(plan.field_bytes * len(plan.rows))
    yield "storage", f"{format_bytes(plan.field_bytes)} per surface, {total_bytes} in all"
    families = f"{len(plan.study.object.families)} famil{'y' if len(plan.study.object.families) == 1 else 'ies'}"
    reference = "with the reference" if plan.reference == REFERENCE_LABEL else f"reference {plan.reference}"
    yield "study", plan.study.object.title
    yield "surfaces", f"{len(plan.rows)} in {families}, {reference}"
    tasks = sum(len(one.groups) for one in sizes.values())
    yield "tasks", f"{tasks} for {len(sizes)} surfaces; chunks of the lattice: {len(plan.blocks)}"
    if plan.study.pairs == "all":
        needed = PAIR_BYTES * len(plan.study.orders) * len(plan.rows) ** 2
        yield "all pairs", f"{format_bytes(needed)} on disk; tiles: {tile_count(len(plan.rows))}"


def plan(
    study: StudyLike,
    store: StoreLike = None,
    client: Client | None = None,
    *,
    allow_commands: bool = False,
    on_progress: Callable[[str], object] | None = None,
) -> StudyPlan:
    """Return what running a study would do, without computing its fields.

    References are loaded; where the study requests an accuracy, a few other surfaces are made and compared. In place of
    a search that is not finished, they have the mesh that it would try next. An object that cannot be carried out stops
    no other. Of many objects, 6 unfinished ones are looked at, and others count as their mean.

    Args:
        study: Study, or the path of its file.
        store: Path or URL of a new or existing store; default storage/NAME.zarr.
        client: Client of the cluster to plan for; default processes on this machine, one per core.
        allow_commands: True if the commands of the study may run here, which make the few surfaces that are loaded.
        on_progress: Called before each object is planned, with its name and, of several, its place among them.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out.
        AccuracyError: The accuracy that the study requests is out of reach.
        InputError: The study requests more memory than any worker has.
        ClusterError: No worker has the GPU that the study requests, or enough memory for its lattice.
        StoreError: The store cannot be reached, or the location holds something else.

    >>> import sobolev_batch as sb
    >>> found = sb.plan("workflows/icosphere.toml")
    >>> len(found.object.labels), found.missing, found.object.lattice
    (5, (), Lattice(xi_max=5.0, M=48))
    >>> print(found)  # doctest: +ELLIPSIS
    time:          nothing is missing
    memory:        ...
    storage:       ...
    study:         ...
    surfaces:      5 in 1 family, with the reference
    ...
    """
    notify = callback(on_progress)
    study, location = settled(study, store, may_run=allow_commands, may_search=False)
    if client is not None:
        require_blocking(client)
        workers = prepare_workers(client, study.libraries)
    else:
        workers = Workers.of_this_machine(available_cores())
    workers.require_accuracy(study.accuracy)
    bases: set[str] = set()
    names, weight = _looked_at(study, location)
    part = replace(study, objects={name: study.objects[name] for name in names})

    def planned(one: Study, place: Location) -> ObjectPlan:
        place_of = f" ({1 + names.index(one.object.name)} of {len(names)})" * (len(names) > 1)
        notify(f"{one.object.name or one.name}{place_of}")
        return _plan(one, place, workers, client, bases)

    plans, refused = for_each_object(part, location, planned)
    seconds, work, time = _forecast(plans.values(), weight, workers, client is None, bases)
    if refused:
        few = f"{len(refused):,} of {len(plans) + len(refused):,} objects cannot be planned, for the reasons below"
        time = (*(time if plans else ()), few)
    lacking, count = "" if store is None else location.lacks_folder(), len(study.objects)
    warnings = (lacking,) if lacking else ()
    return StudyPlan(study.name, str(location), count, weight, plans, refused, seconds, work, time, warnings)


def _looked_at(study: Study, location: Location) -> tuple[list[str], float]:
    """Return the names of the objects to plan, and how many unfinished ones each of them stands for."""
    if len(names := list(study.objects)) <= _MOST_OBJECTS:
        return names, 1.0
    objects = Objects.read(location)
    recorded = {} if objects is None else objects.recorded()
    left = [name for name in names if ended_before(study.of_object(name), recorded.get(name)) is None]
    chosen = spread(left, _MOST_OBJECTS)
    return chosen, len(left) / max(1, len(chosen))


def _forecast(
    objects: Collection[ObjectPlan], weight: float, workers: Workers, starts_processes: bool, bases: Collection[str]
) -> tuple[float, float, tuple[str, ...]]:
    """Return the seconds of a run, if workers have their cores for themselves, its processor seconds, and both shown.

    Objects are carried out beside each other, and each stands for some.
    """
    if not (missing := round(weight * sum(len(one.task_seconds) for one in objects))):
        lacks_tables = any(one.lacks_tables for one in objects)
        return 0.0, 0.0, ("no field is missing, and tables follow from them" if lacks_tables else "nothing is missing",)
    work = weight * sum(one.processor_seconds for one in objects)
    processes = start = 0.0
    if starts_processes:
        processes, start = _PROCESS_SECONDS * slowness() * (1 + len(workers.members)), _CLUSTER_SECONDS
    alone = sum(one.planning_seconds for one in objects) if len(objects) == weight == 1 else 0.0
    seconds = start + max(alone + (work - alone) / workers.threads, *(one.shortest_seconds for one in objects))
    all_work = processes + work
    fields = f"{missing:,} missing field{'s' * (missing != 1)}"
    tasks = f"{workers.threads} task{'s' * (workers.threads != 1)} at once"
    lines: tuple[str, ...] = (
        f"about {duration(seconds, digits=2)} for {fields}, with {tasks}",
        f"{duration(all_work, digits=2)} of processor time; the speed is that of {' and '.join(sorted(bases))}",
    )
    if unknown := round(weight * sum(len(one.unknown) for one in objects)):
        lines += (f"besides, programs and searches make {unknown:,} of the meshes, and their time is not known",)
    return seconds, all_work, lines


def _plan(study: Study, location: Location, workers: Workers, client: Client | None, bases: set[str]) -> ObjectPlan:
    earlier_choice, started = stored_choice(location), process_time()
    if study.accuracy is not None and earlier_choice is None and not (study.cache and study.cache.may_run):
        # A few meshes decide on the lattice.
        require_permission(study, allow_commands=False)
    plan = make_plan(study, earlier_choice)
    planning_seconds = 0.0 if plan.choice is earlier_choice else process_time() - started
    sizes, refused = size_rows(plan, plan.rows, workers.with_backend(study.backend))
    workspace = Workspace.found(location, plan)
    stored = {} if workspace is None else {workspace.labels[i]: record for i, record in workspace.stored.items()}
    seconds, basis = seconds_of_missing(plan, stored, workers, client)
    bases.update(filter(None, [basis]))
    (failing, doubtful), gpus = _doubts_of(plan, stored), sum(one.backend == "gpu" for one in workers.members)
    capacity = f"for tasks, {format_bytes(workers.allowed_bytes_per_task)} or more of memory a thread"
    return ObjectPlan(
        store=str(location),
        labels=tuple(row.label for row in plan.rows),
        reference=plan.reference,
        stored=tuple(stored),
        refused=refused,
        failing=failing,
        doubtful=doubtful,
        lattice=plan.lattice,
        octaves=0 if plan.tail is None else len(plan.tail.octaves),
        dtype=plan.choice.dtype,
        similarity=plan.similarity,
        field_bytes=plan.field_bytes,
        memory_bytes={label: one.task_bytes for label, one in sizes.items()},
        task_seconds=seconds,
        unknown=tuple(row.label for row in plan.rows if row.label in seconds and not is_predictable(row)),
        planning_seconds=planning_seconds,
        lacks_tables=not seconds and (workspace is None or not lacks_nothing(workspace)),
        lines=(
            *_task_lines(plan, sizes),
            ("store", f"{location}, {len(stored)} of {len(plan.rows)} already stored"),
            *reasons("refused", refused),
            *reasons("failing", failing),
            *reasons("doubtful", doubtful),
            *_study_lines(plan),
            ("workers", f"{len(workers.members)}, with {workers.threads} threads and {gpus} GPUs together; {capacity}"),
        ),
    )


def _doubts_of(plan: Plan, stored: Mapping[str, Record]) -> tuple[dict[str, str], dict[str, str]]:
    """Return why surfaces cannot be read, and what makes one doubt others, by label; none is read twice."""
    others = {row.label: (row.family, row.member) for row in plan.rows if row.label != plan.reference}
    # What is stored need not be read again.
    known = {label: Quality.from_json(stored[label].quality).extent for label in others if label in stored}
    seen = plan.look
    look = Look({**seen.extents, **known}, dict(seen.set_aside), dict(seen.notes), dict(seen.failing))
    look.at_all(others, plan.similarity, plan.reference_extent)
    doubts = {label: placement_doubt(extent, plan.reference_extent) for label, extent in look.extents.items()}
    doubtful = look.notes | look.set_aside | {label: doubt for label, doubt in doubts.items() if doubt is not None}
    return look.failing, {label: doubt for label, doubt in doubtful.items() if label not in look.failing}
