"""The fields that a store lacks, computed as tasks that fit into the workers' memory."""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from typing import Any

from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, Wave, describe_failure, outcomes_here
from sobolev_batch.batch.field_costs import BlockGroups, is_predictable, reference_in_tasks, row_seconds, size_rows
from sobolev_batch.batch.field_tasks import Job, compute_mesh, compute_parts, finish_mesh
from sobolev_batch.store.lock import utc_now
from sobolev_batch.store.records import Record, Records
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.transform.fourier import NUMERICS_VERSION

_log = logging.getLogger(__name__)

# Surfaces predicted to take less are computed several in a task, which is predicted to take no more than the other.
_SMALL_SECONDS, _GROUP_SECONDS = 0.05, 0.3


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

    reference, shared = reference_in_tasks(plan), plan.without_surfaces()

    def tasks() -> Iterator[Task]:
        for i in pending:
            row = rows[i]
            if row.label in refused:
                give_up(i, refused[row.label])
                continue
            groups, allowed_bytes, task_bytes = sizes[row.label]
            yield _field_task(Job(store, i, row, shared, allowed_bytes, reference), groups, task_bytes)

    projected_bytes = max((one.task_bytes for one in sizes.values()), default=0.0)
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


def _in_groups(tasks: Iterator[Task], seconds: Mapping[str, float], most: int) -> Iterator[Task]:
    """Yield tasks of fields, one for up to so many small meshes: each costs the scheduler some milliseconds."""
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
    """Return one task in place of those of several small meshes, which take its place where a worker dies of it."""
    first, *others = tasks
    if not others:
        return first
    return replace(
        first,
        function=outcomes_here,
        # Dask would do the tasks of a list first, each by itself.
        arguments=(tuple(tasks),),
        projected_bytes=max(task.projected_bytes for task in tasks),
        label=f"{first.label} and {len(others)} more",
        divided=tuple(tasks),
    )


def _field_task(job: Job, groups: BlockGroups, projected_bytes: float) -> Task:
    """Return the task that computes and stores a field, after those that it depends on; it gives the record."""
    needs_gpu = job.plan.study.backend == "gpu"
    if len(groups) == 1:
        return Task(compute_mesh, (job, *groups), projected_bytes, needs_gpu, job.row, job.planned.label, stage="field")
    parts = [(blocks, False) for blocks in groups] + [((), True)] * (job.plan.tail is not None)
    label, stage = job.planned.label, "part of field"
    tasks = [Task(compute_parts, (job, *part), projected_bytes, needs_gpu, label=label, stage=stage) for part in parts]
    return Task(finish_mesh, (job, *tasks), row=job.row, label=label, stage="field")
