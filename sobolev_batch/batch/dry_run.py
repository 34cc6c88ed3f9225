"""The plan of a study for people: its lattice, tasks, memory, storage, and the time that a run will take."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, overload

from distributed import Client

from sobolev_batch.batch.cluster.clients import require_blocking
from sobolev_batch.batch.cluster.workers import Workers, prepare_workers, worker_slowness
from sobolev_batch.batch.field_stage import Sizes, size_rows
from sobolev_batch.batch.run import lacks_nothing
from sobolev_batch.batch.start import StoreLike, require_permission, settled, warnings_of
from sobolev_batch.geometry.surface import Similarity, placement_doubt
from sobolev_batch.machine import available_cores
from sobolev_batch.norms.fields import Quality
from sobolev_batch.norms.tail.values import SurfaceSize
from sobolev_batch.parameters import format_bytes
from sobolev_batch.shown import Shown, reasons
from sobolev_batch.store.collection_store import for_each_object
from sobolev_batch.store.layout import stored_choice
from sobolev_batch.store.location import Location
from sobolev_batch.store.records import Record
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.pilots import Look
from sobolev_batch.study.plan import Plan, Row, make_plan
from sobolev_batch.study.study import Study, StudyCollection, StudyLike
from sobolev_batch.tables.pairs import PAIR_BYTES, tile_count
from sobolev_batch.tables.text import beside, duration
from sobolev_batch.transform.fourier import field_seconds, slowness
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.visible import visible

# Time to describe and record a surface, and that of each of its triangles.
_ROW_SECONDS, _TRIANGLE_SECONDS = 0.1, 5e-6
# Processor time to start a process with all libraries, and the time until a cluster of them has started.
_PROCESS_SECONDS, _CLUSTER_SECONDS = 4.0, 6.0
# Stored fields tell the speed if there are as many.
_FEWEST_RECORDS = 3


def forecast(
    plan: Plan, stored: Mapping[str, Record], workers: Workers, client: Client | None, planning_seconds: float
) -> tuple[float, float, list[str]]:
    """Predict the time of a run on workers, of a client if it does not start them, without the stored fields, by label.

    Return the seconds from the start to the end, if the workers have their cores for themselves; seconds of a
    processor, of all tasks and processes, planning included where a run plans again; and lines that show both.
    """
    missing = [row.label for row in plan.rows if row.label not in stored]
    if not missing:
        return 0.0, 0.0, ["nothing is missing"]
    predicted = {row.label: _row_seconds(plan, row) for row in plan.rows}
    if len(stored) >= _FEWEST_RECORDS:
        spent = sum(record.seconds for record in stored.values())
        factor = spent / sum(predicted[label] for label in stored)
        basis = f"the {len(stored)} fields that are stored"
    elif client is None:
        factor, basis = slowness(), "a transform on this machine"
    else:
        factor, basis = worker_slowness(client, workers.members[0].address), "a transform on a worker"
    times = [factor * predicted[label] for label in missing]
    processes, start = (0.0, 0.0) if client else (_PROCESS_SECONDS * (1 + len(workers.members)), _CLUSTER_SECONDS)
    processor_seconds = planning_seconds + processes + sum(times)
    seconds = planning_seconds + start + max(sum(times) / workers.threads, *times)
    fields = f"{len(missing)} missing field{'s' * (len(missing) != 1)}"
    tasks = f"{workers.threads} task{'s' * (workers.threads != 1)} at once"
    lines = [
        f"about {duration(seconds, digits=2)} for {fields}, with {tasks}",
        f"{duration(processor_seconds, digits=2)} of processor time; the speed is that of {basis}",
    ]
    return seconds, processor_seconds, lines


def _row_seconds(plan: Plan, row: Row) -> float:
    """Return the predicted time of a row's tasks, on the machine that constants were measured on."""
    expected = row.member.expected_size()
    size = SurfaceSize(expected.triangles, plan.reference_area)
    # An accuracy takes coarser settings where it can; what they save is little beside octaves.
    transform = field_seconds(expected.triangles, plan.reference_area, plan.lattice, plan.transform)
    octaves = () if plan.tail is None else plan.tail.octaves
    sampling = sum(size.sampling_seconds(octave) for octave in octaves)
    return _ROW_SECONDS + _TRIANGLE_SECONDS * expected.triangles + expected.seconds + transform + sampling


@dataclass(frozen=True)
class StudyPlan(Shown):
    """Forecast of a run of a study; ``print(plan)`` shows what ``sobolev-batch plan`` shows.

    Attributes:
        study: Study.
        store: Path or URL of its store.
        labels: Labels of all surfaces, the reference among them.
        reference: Label of the reference.
        stored: Labels of the surfaces whose fields the store has already.
        refused: Reason for each surface that fits into no worker, by label.
        doubtful: Reason for each surface that cannot be read, or may be in another unit or place than the reference, as
            long as surfaces are quickly looked at.
        lattice: Lattice of all fields.
        octaves: Number of octaves that are sampled beyond the lattice.
        dtype: Type of the fields, "complex128" or "complex64".
        similarity: Similarity from the meshes' own unit of length to the study's.
        field_bytes: Bytes of one stored field.
        memory_bytes: Projected peak memory of each surface's largest task, by label.
        seconds: Time that a run will take on the workers, if they have their cores for themselves. It leaves out
            Hausdorff and Chamfer distances, and distances of very many pairs.
        processor_seconds: Processor time that a run will take, that of starting processes included.
        lines: What is shown: name and text of each line; an empty name goes on with the line before.
        warnings: What would make a run useless or end it, see `warnings_of`.

    >>> import sobolev_batch as sb
    >>> plan = sb.plan("workflows/icosphere.toml")
    >>> plan.reference, plan.octaves, plan.dtype
    ('reference', 0, 'complex128')
    """

    study: Study
    store: str
    labels: tuple[str, ...]
    reference: str
    stored: tuple[str, ...]
    refused: dict[str, str]
    doubtful: dict[str, str]
    lattice: Lattice
    octaves: int
    dtype: str
    similarity: Similarity
    field_bytes: int
    memory_bytes: dict[str, float]
    seconds: float
    processor_seconds: float
    lines: tuple[tuple[str, str], ...] = field(repr=False)
    warnings: tuple[str, ...] = ()

    @property
    def total_bytes(self) -> int:
        """Bytes of all stored fields."""
        return self.field_bytes * len(self.labels)

    def to_table(self) -> dict[str, Any]:
        """Return the numbers for programs, with the name of the study and without what is shown."""
        numbers = {name: value for name, value in vars(self).items() if name != "lines"}
        return {**numbers, "study": self.study.name, "total_bytes": self.total_bytes}

    def __str__(self) -> str:
        lines = (*self.lines, *(("warning", text) for text in self.warnings))
        return "\n".join(beside(f"{name + ':' * bool(name):<14} ", text) for name, text in lines)


def _study_lines(plan: Plan) -> Iterator[tuple[str, str]]:
    """Yield what is shown of a plan whatever computes it."""
    study, lattice, similarity, tail = plan.study, plan.lattice, plan.similarity, plan.tail
    yield "study", study.title
    families = f"{len(study.families)} famil{'y' if len(study.families) == 1 else 'ies'}"
    yield "surfaces", f"{len(plan.rows)} in {families}, reference {plan.reference}"
    yield "similarity", f"scale {similarity.scale:.9g}, origin {' '.join(f'{x:.9g}' for x in similarity.origin)}"
    spacing = f"spacing {lattice.spacing:g}, half period {lattice.half_period:g}"
    yield "lattice", f"xi_max {lattice.xi_max:g}, M {lattice.M}, {spacing}"
    yield "orders", ", ".join(f"{order:g}" for order in study.orders)
    if tail is not None:
        shortest = 1 / (tail.highest_frequency * similarity.scale)
        yield (
            "octaves",
            f"{len(tail.octaves)} beyond the lattice, to |xi| {tail.highest_frequency:.4g}: wavelengths down to "
            f"{shortest:.3g} of the files' unit; {tail.size:,} samples",
        )
        yield "", f"{format_bytes(tail.size * plan.item_bytes)} per surface"
    accuracy, transform = study.accuracy, plan.transform
    if accuracy is None:
        yield "transform", f"eps {transform.eps:g}, {transform.dtype}, quadrature {transform.quadrature}"
    else:
        allowed = f"{format_bytes(accuracy.allowed_bytes)} for a transform, M <= {accuracy.largest_intervals}"
        yield "accuracy", f"rtol {accuracy.rtol:g} of every distance to {plan.reference}; {allowed}"
        yield from (("chosen", reason) for reason in plan.choice.reasons)
        yield "transform", f"{transform.dtype}, eps and quadrature for each surface from its distance"
    yield "backend", study.backend
    yield from (("command", command) for command in study.commands)
    if study.commands:
        yield "", "they run only with --allow-commands (in Python: allow_commands=True)"
    if study.proximity is not None:
        yield "proximity", f"Hausdorff and Chamfer distances, from {study.proximity.points:,} points on each mesh"


def _task_lines(
    plan: Plan,
    workers: Workers,
    sizes: Mapping[str, Sizes],
    refused: Mapping[str, str],
    doubtful: Mapping[str, str],
) -> Iterator[tuple[str, str]]:
    gpus = sum(member.backend == "gpu" for member in workers.members)
    yield (
        "workers",
        f"{len(workers.members)}, with {workers.threads} threads and {gpus} GPUs together; for tasks, "
        f"{format_bytes(workers.allowed_bytes_per_task)} or more of memory a thread",
    )
    tasks = sum(len(groups) for groups, *_ in sizes.values())
    yield "tasks", f"{tasks} for {len(sizes)} surfaces; chunks of the lattice: {len(plan.blocks)}"
    if sizes:
        largest, (*_, task_bytes) = max(sizes.items(), key=lambda item: item[1][-1])
        yield "memory", f"up to {format_bytes(task_bytes)} in a task, of {largest}"
    if plan.study.pairs == "all":
        needed = PAIR_BYTES * len(plan.study.orders) * len(plan.rows) ** 2
        yield "all pairs", f"{tile_count(len(plan.rows))} tiles, {format_bytes(needed)} on disk"
    yield from reasons("refused", refused)
    yield from reasons("doubtful", doubtful)


@dataclass(frozen=True)
class CollectionPlan(Shown):
    """Forecast of a run of a collection; ``print(plan)`` shows the plan of each object.

    Attributes:
        objects: Plan of each object that can be carried out, by its name.
        refused: Reason for each other object, by its name.
        warnings: What would make a run useless or end it, see `warnings_of`.

    >>> import sobolev_batch as sb
    >>> plan = sb.result_types.CollectionPlan({}, {"cow": "the reference cannot be made: cow.ply: it is empty"})
    >>> print(plan)
    cow: the reference cannot be made: cow.ply: it is empty
    0 objects: about 0 s, 0B of fields
    """

    objects: Mapping[str, StudyPlan]
    refused: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Time that a run will take; see `StudyPlan.seconds`."""
        return sum(one.seconds for one in self.objects.values())

    @property
    def total_bytes(self) -> int:
        """Bytes of all stored fields."""
        return sum(one.total_bytes for one in self.objects.values())

    @property
    def total(self) -> str:
        """Number of objects, time and bytes, as a line."""
        return (
            f"{len(self.objects)} objects: about {duration(self.seconds, digits=2)}, "
            f"{format_bytes(self.total_bytes)} of fields"
        )

    def to_table(self) -> dict[str, Any]:
        """Return the numbers for programs; see `StudyPlan.to_table`."""
        objects = {name: one.to_table() for name, one in self.objects.items()}
        return {**vars(self), "objects": objects, "seconds": self.seconds, "total_bytes": self.total_bytes}

    def __str__(self) -> str:
        lines = [f"{visible(name)}:\n{one}" for name, one in self.objects.items()]
        lines += [beside(f"{visible(name)}: ", reason) for name, reason in self.refused.items()]
        lines += [beside("warning: ", text) for text in self.warnings]
        return "\n".join([*lines, self.total])


@overload
def plan(
    study: Study, store: StoreLike = None, client: Client | None = None, *, allow_commands: bool = False
) -> StudyPlan: ...
@overload
def plan(
    study: StudyCollection, store: StoreLike = None, client: Client | None = None, *, allow_commands: bool = False
) -> CollectionPlan: ...
@overload
def plan(
    study: StudyLike, store: StoreLike = None, client: Client | None = None, *, allow_commands: bool = False
) -> StudyPlan | CollectionPlan: ...
def plan(
    study: StudyLike, store: StoreLike = None, client: Client | None = None, *, allow_commands: bool = False
) -> StudyPlan | CollectionPlan:
    """Return what running a study would do, without computing anything.

    The reference is loaded, and a few other surfaces where the study requests an accuracy. An object of a collection
    that cannot be carried out stops no other.

    Args:
        study: Study, collection, or the path of the file of either.
        store: Path or URL of a new or existing store; default storage/NAME.zarr.
        client: Client of the cluster to plan for; default processes on this machine, one per core.
        allow_commands: True if the commands of the study may run here, which make the few surfaces that are loaded.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out.
        AccuracyError: The accuracy that the study requests is out of reach.
        InputError: The study requests more memory than any worker has.
        ClusterError: No worker has the GPU that the study requests, or enough memory for its lattice.
        StoreError: The store cannot be reached, or the location holds something else.

    >>> import sobolev_batch as sb
    >>> found = sb.plan("workflows/icosphere.toml")
    >>> len(found.labels), len(found.stored), found.lattice
    (5, 5, Lattice(xi_max=5.0, M=48))
    >>> print(found)  # doctest: +ELLIPSIS
    study:         ...
    surfaces:      5 in 1 family, reference reference
    ...
    """
    study, location = settled(study, store, may_run=allow_commands)
    plans, refused = for_each_object(study, location, lambda _, part, place: _plan(part, place, client))
    warnings = warnings_of(study, location)
    return replace(plans[""], warnings=warnings) if "" in plans else CollectionPlan(plans, refused, warnings)


def _plan(study: Study, location: Location, client: Client | None) -> StudyPlan:
    if client is not None:
        require_blocking(client)
    workers = Workers.of_this_machine(available_cores()) if client is None else prepare_workers(client, study.libraries)
    workers.require_accuracy(study.accuracy)
    earlier_choice, started = stored_choice(location), time.process_time()
    if study.accuracy is not None and earlier_choice is None and not (study.cache and study.cache.may_run):
        # A few meshes decide on the lattice.
        require_permission(study, allow_commands=False)
    study_plan = make_plan(study, earlier_choice)
    planning_seconds = 0.0 if study_plan.choice is earlier_choice else time.process_time() - started
    sizes, refused = size_rows(study_plan, study_plan.rows, workers.with_backend(study.backend))
    workspace = Workspace.found(location, study_plan)
    stored = {} if workspace is None else {workspace.labels[i]: record for i, record in workspace.stored.items()}
    seconds, processor_seconds, (first, *others) = forecast(study_plan, stored, workers, client, planning_seconds)
    if workspace is not None and len(stored) == len(study_plan.rows) and not lacks_nothing(workspace):
        first = "no field is missing, and tables follow from them"
    doubtful, count = _doubts_of(study_plan, stored), len(study_plan.rows)
    total_bytes = format_bytes(study_plan.field_bytes * count)
    lines = [
        *_study_lines(study_plan),
        *_task_lines(study_plan, workers, sizes, refused, doubtful),
        ("storage", f"{format_bytes(study_plan.field_bytes)} per surface, {total_bytes} in all"),
        ("store", f"{location}, {len(stored)} of {count} already stored"),
        ("time", first),
        *(("", line) for line in others),
        *([("", "Hausdorff and Chamfer distances take more")] if study.proximity is not None else []),
    ]
    return StudyPlan(
        study=study_plan.study,
        store=str(location),
        labels=tuple(row.label for row in study_plan.rows),
        reference=study_plan.reference,
        stored=tuple(stored),
        refused=refused,
        doubtful=doubtful,
        lattice=study_plan.lattice,
        octaves=0 if study_plan.tail is None else len(study_plan.tail.octaves),
        dtype=study_plan.choice.dtype,
        similarity=study_plan.similarity,
        field_bytes=study_plan.field_bytes,
        memory_bytes={label: task_bytes for label, (*_, task_bytes) in sizes.items()},
        seconds=seconds,
        processor_seconds=processor_seconds,
        lines=tuple(lines),
    )


def _doubts_of(study_plan: Plan, stored: Mapping[str, Record]) -> dict[str, str]:
    """Return why surfaces cannot be read, or hardly be compared with the reference, by label; none is read twice."""
    others = {row.label: row for row in study_plan.rows if row.label != study_plan.reference}
    # What is stored need not be read again.
    known = {label: Quality.from_json(stored[label].quality).extent for label in others if label in stored}
    look = Look({**study_plan.look.extents, **known}, dict(study_plan.look.set_aside))
    members = {label: (row.family, row.member) for label, row in others.items()}
    look.at_all(members, study_plan.similarity, study_plan.reference_extent)
    doubts = {label: placement_doubt(extent, study_plan.reference_extent) for label, extent in look.extents.items()}
    return look.set_aside | {label: doubt for label, doubt in doubts.items() if doubt is not None}
