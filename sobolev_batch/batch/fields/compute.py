"""The fields that a store lacks: handed to the cluster as tasks, and their records taken back."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from sobolev_batch.batch.cluster.execution import Cluster, Task, describe_failure
from sobolev_batch.batch.cluster.progress import Steps
from sobolev_batch.batch.fields.memory import TaskSizes, reference_in_tasks, size_rows
from sobolev_batch.batch.fields.tasks import (
    FieldSettings,
    Job,
    compute_blocks,
    compute_mesh,
    compute_octaves,
    finish_mesh,
)
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.workspace import Workspace

_log = logging.getLogger(__name__)


def compute_fields(cluster: Cluster, workspace: Workspace, pending: Sequence[int]) -> None:
    """Compute the fields of rows, and take their records into the workspace.

    Raises:
        StoreError: The store could not be written, which is no failure of a mesh.
        ClusterError: The scheduler was lost, or the lattice fits into no worker.
    """
    plan, store, rows = workspace.plan, workspace.store, workspace.rows
    steps = Steps(cluster.notify, "fields", len(pending))
    workers = cluster.workers.with_backend(plan.study.backend)
    sizes, refused = size_rows(plan, [rows[i] for i in pending], workers)

    def take(i: int, record: Record) -> None:
        workspace.records[i] = record
        steps.advance(rows[i].label, record)

    def give_up(i: int, reason: str) -> None:
        record = Record(key=rows[i].key, status="failed", reason=reason, finished=utc_now())
        _log.error("%s: %s", rows[i].label, reason)
        store.write_record(i, record)
        take(i, record)

    for i in pending:
        if rows[i].label in refused:
            give_up(i, refused[rows[i].label])
    settings, reference = FieldSettings.of(plan), reference_in_tasks(plan)

    def tasks() -> Iterator[Task]:
        for i in pending:
            row = rows[i]
            if row.label in sizes:
                allowed_bytes = sizes[row.label].allowed_bytes
                job = Job(store, i, row, settings, plan.distance_target(row), allowed_bytes, reference)
                yield _field_task(job, sizes[row.label])

    projected_bytes = max((size.projected_bytes for size in sizes.values()), default=0.0)
    for task, outcome in cluster.run(tasks(), projected_bytes):
        if isinstance(outcome, Record):
            take(task.row, outcome)
        else:
            give_up(task.row, describe_failure(outcome))


def _field_task(job: Job, sizes: TaskSizes) -> Task:
    """Return the task that computes and stores a field, after those that it depends on; it gives the record."""
    needs_gpu = job.settings.backend == "gpu"
    if len(sizes.block_groups) == 1:
        (blocks,) = sizes.block_groups
        return Task(compute_mesh, (job, blocks), sizes.projected_bytes, needs_gpu, job.index, job.row.label)
    groups = [Task(compute_blocks, (job, blocks), sizes.projected_bytes, needs_gpu) for blocks in sizes.block_groups]
    if job.settings.tail is not None:
        groups.append(Task(compute_octaves, (job,), sizes.projected_bytes, needs_gpu))
    return Task(finish_mesh, (job, groups), row=job.index, label=job.row.label)
