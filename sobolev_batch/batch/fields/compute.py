"""The fields that a store lacks: handed to the cluster as tasks, and their records taken back."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from sobolev_batch.batch.cluster.execution import Cluster, Task, describe_failure
from sobolev_batch.batch.cluster.progress import Steps
from sobolev_batch.batch.fields.graph import field_task
from sobolev_batch.batch.fields.sizing import reference_in_tasks, size_rows
from sobolev_batch.batch.fields.tasks import FieldSettings, Job
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
        for rank, i in enumerate(i for i in pending if rows[i].label in sizes):
            row = rows[i]
            allowed_bytes = sizes[row.label].allowed_bytes
            job = Job(store, i, row, settings, plan.distance_target(row), allowed_bytes, reference)
            yield field_task(job, sizes[row.label], rank)

    # A mesh in batches occupies all workers by itself, and its batches the scratch space.
    is_split = any(size.batches > 1 for size in sizes.values())
    projected_bytes = max((size.projected_bytes for size in sizes.values()), default=0.0)
    in_flight = cluster.workers.threads + 1 if is_split else None
    for task, outcome in cluster.run(tasks(), projected_bytes, in_flight):
        if sizes[rows[task.row].label].batches > 1:
            store.scratch.discard(task.row)
        if isinstance(outcome, Record):
            take(task.row, outcome)
        else:
            give_up(task.row, describe_failure(outcome))
    if is_split:
        store.scratch.discard()
