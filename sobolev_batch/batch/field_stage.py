"""The fields that a store lacks, computed as tasks that fit into the workers' memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, repeat
from typing import Any

import numpy as np

from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, Wave, describe_failure
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.field_tasks import Job, compute_group, compute_mesh, compute_parts, finish_mesh
from sobolev_batch.errors import ClusterError
from sobolev_batch.norms.tail.values import SurfaceSize
from sobolev_batch.sources.registry import ExpectedSize
from sobolev_batch.store.lock import utc_now
from sobolev_batch.store.records import Record, Records
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Plan, Row
from sobolev_batch.transform.fourier import NUMERICS_VERSION, TransformSettings, field_seconds, projected_bytes
from sobolev_batch.transform.lattice import Block

_log = logging.getLogger(__name__)

# Measured peak of describing a mesh and moving it to the study's unit, for each triangle.
MESH_BYTES = 100.0
# With less, the batches of points of a transform become so small that it is slow.
LEAST_TRANSFORM_BYTES = 256e6
# For the choice of quadrature rules, for each triangle.
_CHOICE_BYTES = 100.0
# Of a sample of octaves: its frequency, weight, place and value, and what makes them.
_SAMPLE_BYTES = 150.0
# Surfaces predicted to take less are computed several in a task, which is predicted to take no more than the other.
_SMALL_SECONDS, _GROUP_SECONDS = 0.05, 0.3
# Time to describe and record a surface, and that of each of its triangles.
_ROW_SECONDS, _TRIANGLE_SECONDS = 0.015, 5e-6
# Groups of blocks of the lattice. The blocks of a group are computed in one task.
_Groups = tuple[tuple[Block, ...], ...]
# The groups of a row, the memory that one transform may take besides mesh and block, and that of a task.
Sizes = tuple[_Groups, float, float]
# Every task of a study with octaves loads the reference too, but for a larger one.
_LARGEST_REFERENCE = 3 << 20


def compute_fields(cluster: Cluster, workspace: Workspace, pending: Sequence[int]) -> Stages[None]:
    """Compute the fields of rows, and take their records into the workspace; a StoreError is no mesh's failure."""
    plan, store, rows = workspace.plan, workspace.store, workspace.rows
    advance = cluster.count_steps("fields", len(pending))
    workers = cluster.workers.with_backend(plan.study.backend)
    sizes, refused = size_rows(plan, [rows[i] for i in pending], workers)

    def take(i: int, record: Record) -> None:
        workspace.records[i] = record
        advance(rows[i].label, record)

    def give_up(i: int, reason: str) -> None:
        record = Record(key=rows[i].key, status="failed", reason=reason, finished=utc_now())
        _log.error("%s: %s", rows[i].label, reason)
        Records(store).write(i, record)
        take(i, record)

    reference = _reference_in_tasks(plan)

    def tasks() -> Iterator[Task]:
        for i in pending:
            row = rows[i]
            if row.label in refused:
                give_up(i, refused[row.label])
                continue
            groups, allowed_bytes, task_bytes = sizes[row.label]
            yield _field_task(Job.for_row(plan, row, store, i, allowed_bytes, reference), groups, task_bytes)

    projected_bytes = max((task_bytes for *_, task_bytes in sizes.values()), default=0.0)
    seconds = {rows[i].label: row_seconds(plan, rows[i]) for i in pending if is_predictable(rows[i])}
    most = max(1, len(sizes) // (2 * workers.threads))

    def take_outcome(task: Task, outcome: Any) -> None:
        if task.divided:
            outcomes = outcome if isinstance(outcome, list) else repeat(outcome)
            for one, its_outcome in zip(task.divided, outcomes, strict=False):
                take_outcome(one, its_outcome)
        elif not isinstance(outcome, Record):
            give_up(task.row, describe_failure(outcome))
        elif (found := outcome.numerics) != NUMERICS_VERSION:
            give_up(task.row, f"{outcome.worker} computed it by numerics of version {found}, not {NUMERICS_VERSION}")
        else:
            take(task.row, outcome)

    yield Wave(cluster, _in_groups(tasks(), seconds, most), take_outcome, projected_bytes)


def is_predictable(row: Row) -> bool:
    """Tell whether the size of a surface is known before it is made: nobody knows how long a program takes."""
    return math.isfinite(row.member.expected_size().factor)


def _in_groups(tasks: Iterator[Task], seconds: Mapping[str, float], most: int) -> Iterator[Task]:
    """Yield tasks of fields, with up to so many of small meshes in one: each costs the scheduler some milliseconds."""
    group: list[Task] = []
    for task in tasks:
        predicted = seconds.get(task.label, math.inf) if task.function is compute_mesh else math.inf
        if predicted > _SMALL_SECONDS:
            yield task
            continue
        group.append(task)
        if len(group) >= most or sum(seconds[one.label] for one in group) > _GROUP_SECONDS:
            yield _grouped(group)
            group = []
    if group:
        yield _grouped(group)


def _grouped(tasks: Sequence[Task]) -> Task:
    """Return one task that does several of small meshes, which take its place where a worker dies of it."""
    first, *others = tasks
    if not others:
        return first
    return replace(
        first,
        function=compute_group,
        arguments=([task.arguments for task in tasks],),
        projected_bytes=max(task.projected_bytes for task in tasks),
        label=f"{first.label} and {len(others)} more",
        divided=tuple(tasks),
    )


def _field_task(job: Job, groups: _Groups, projected_bytes: float) -> Task:
    """Return the task that computes and stores a field, after those that it depends on; it gives the record."""
    needs_gpu = job.backend == "gpu"
    if len(groups) == 1:
        return Task(compute_mesh, (job, *groups), projected_bytes, needs_gpu, job.index, job.row.label, stage="field")
    parts = [(blocks, False) for blocks in groups] + [((), True)] * (job.tail is not None)
    label, stage = job.row.label, "part of field"
    tasks = [Task(compute_parts, (job, *part), projected_bytes, needs_gpu, label=label, stage=stage) for part in parts]
    return Task(finish_mesh, (job, tasks), row=job.index, label=label, stage="field")


def size_rows(plan: Plan, rows: Sequence[Row], workers: Workers) -> tuple[dict[str, Sizes], dict[str, str]]:
    """Return what the tasks of rows take, by their labels, and the reason for each row that fits into no worker."""
    octaves = _octave_memory(plan)

    def sizes_for(size: ExpectedSize) -> Sizes:
        return size_tasks(plan.blocks, plan.transform, size, workers, len(rows), octaves)

    # Where not even a mesh without triangles fits, the lattice is too large: a ClusterError for all rows.
    sizes_for(ExpectedSize())
    sizes, refused = {}, {}
    for row in rows:
        try:
            sizes[row.label] = sizes_for(row.member.expected_size())
        except ClusterError as error:
            refused[row.label] = f"the mesh is too large: {error}"
    return sizes, refused


def _reference_in_tasks(plan: Plan) -> Row | None:
    """Return the reference as tasks of octaves load it beside their mesh; None without octaves, or if it is huge."""
    row = next(row for row in plan.rows if row.label == plan.reference)
    is_small = row.member.expected_size().triangles <= _LARGEST_REFERENCE
    return row if plan.tail is not None and is_small else None


def _octave_memory(plan: Plan) -> tuple[Block, float] | None:
    """Return the largest block that octaves transform, and the bytes of their samples and of the reference."""
    if plan.tail is None:
        return None
    blocks = [lattice.half for sampling in plan.tail.octaves for lattice in sampling.lattices]
    reference = _reference_in_tasks(plan)
    triangles = 0 if reference is None else reference.member.expected_size().triangles
    largest = max([plan.blocks[0], *blocks], key=lambda block: block.size)
    return largest, _SAMPLE_BYTES * plan.tail.size + MESH_BYTES * triangles


def size_tasks(
    blocks: Sequence[Block],
    transform: TransformSettings,
    size: ExpectedSize,
    workers: Workers,
    rows: int,
    octaves: tuple[Block, float] | None = None,
) -> Sizes:
    """Fit a row's tasks into the memory of workers.

    Each task holds the mesh. Its transform adds up batches of points, as large as the memory allows. Every task is kept
    within what a worker has for each of its threads, as long as that leaves a transform enough to work in; a task that
    takes more runs beside fewer others.
    Octaves are given by the largest block that they transform, and the bytes that they hold.
    """
    block, octave_bytes = (blocks[0], 0.0) if octaves is None else octaves
    block_bytes = float(block.size * np.dtype(transform.dtype).itemsize)
    mesh_bytes = MESH_BYTES * size.triangles
    # The mesh, the block, and a block that it is added to or compared with.
    held_bytes = mesh_bytes + 2 * block_bytes + octave_bytes
    least_bytes = LEAST_TRANSFORM_BYTES + _CHOICE_BYTES * size.triangles
    loading_bytes = max(size.projected_bytes, mesh_bytes)
    workers.require_memory(max(loading_bytes, held_bytes + least_bytes))
    allowed_bytes = max(least_bytes, workers.allowed_bytes_per_task - held_bytes)
    # The transform seldom takes all that it may, but a mesh may turn out larger than its file suggested.
    wanted_bytes = projected_bytes(block, transform, triangles=size.triangles) - block_bytes
    computing_bytes = held_bytes + min(allowed_bytes, max(wanted_bytes, least_bytes))
    # A task computes as many blocks as leaves two tasks for every thread: each task loads the mesh anew.
    count = min(len(blocks), max(1, math.ceil(2 * workers.threads / max(rows, 1))))
    ends = [len(blocks) * k // count for k in range(count + 1)]
    groups = tuple(tuple(blocks[first:last]) for first, last in pairwise(ends))
    return groups, allowed_bytes, max(loading_bytes, computing_bytes)


def row_seconds(plan: Plan, row: Row) -> float:
    """Return the predicted time of a row's tasks, on the machine that constants were measured on."""
    expected = row.member.expected_size()
    size = SurfaceSize(expected.triangles, plan.reference_area)
    # An accuracy takes coarser settings where it can; what they save is little beside octaves.
    transform = field_seconds(expected.triangles, plan.reference_area, plan.lattice, plan.transform)
    octaves = () if plan.tail is None else plan.tail.octaves
    sampling = sum(size.sampling_seconds(octave) for octave in octaves)
    return _ROW_SECONDS + _TRIANGLE_SECONDS * expected.triangles + expected.seconds + transform + sampling
