"""The fields that a store lacks: copied from other stores, or computed as tasks of the cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from sobolev_batch.batch.cluster.execution import Cluster, Task, describe_failure
from sobolev_batch.batch.fields.memory import TaskSizes, reference_in_tasks, size_rows
from sobolev_batch.batch.fields.tasks import (
    FieldSettings,
    Job,
    compute_blocks,
    compute_mesh,
    compute_octaves,
    finish_mesh,
)
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import utc_now
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.workspace import Workspace, complete_records
from sobolev_batch.errors import DamageError, StoreError

_log = logging.getLogger(__name__)

# Most of the time of a copy is spent waiting for disks or object storage.
_THREADS = 4


def copy_fields(workspace: Workspace, others: Sequence[Location]) -> list[int]:
    """Copy the fields that a workspace lacks from other stores that have them, and return their rows.

    The key of a field is a digest of all that it depends on. So it is the same field, whatever the other study calls
    the mesh. Each is checked as it is read.

    Raises:
        StoreError: A location has no store of a study, or cannot be read or written.
    """
    return [i for location in others for i in _copy_from(Store.open(location), workspace)]


def _copy_from(other: Store, workspace: Workspace) -> list[int]:
    stored = {record.key: (row, record) for row, record in complete_records(other.records()).items()}
    matches = {i: stored[key] for i in workspace.pending if (key := workspace.rows[i].key) in stored}
    with ThreadPoolExecutor(_THREADS) as pool:
        outcomes = pool.map(lambda i: _copy_field(other, *matches[i], workspace.store, i), matches)
        copied = [i for i, is_copied in zip(matches, outcomes, strict=True) if is_copied]
    for i in copied:
        _, workspace.records[i] = matches[i]
    _log.info("%s: %d fields copied from %s", workspace.store.path, len(copied), other.path)
    return copied


def _copy_field(source: Store, row: int, record: Record, store: Store, target_row: int) -> bool:
    """Copy a field with its record into a row of another store; return False where the field is damaged."""
    places, checksums = source.block_slices(), list(record.checksums)
    if places != store.block_slices() or len(checksums) != len(places) + source.has_octaves:
        raise StoreError(
            f"{source.path}: it cuts fields into other blocks than {store.path}; run the study without it, or make "
            "both stores by one version of this program"
        )
    try:
        if source.has_octaves:
            # Behind those of the field.
            store.write_octaves(target_row, source.read_octaves([row], [checksums.pop()])[0])
        for place, checksum in zip(places, checksums, strict=True):
            store.write_field(target_row, place, source.read_fields([row], place, [checksum])[0])
    except DamageError as error:
        _log.warning("%s; it is computed here", error)
        return False
    store.write_record(target_row, record)
    return True


def compute_fields(cluster: Cluster, workspace: Workspace, pending: Sequence[int]) -> None:
    """Compute the fields of rows, and take their records into the workspace.

    Raises:
        StoreError: The store could not be written, which is no failure of a mesh.
        ClusterError: The scheduler was lost, or the lattice fits into no worker.
    """
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
        store.write_record(i, record)
        take(i, record)

    for i in pending:
        if rows[i].label in refused:
            give_up(i, refused[rows[i].label])
    settings, reference = FieldSettings.for_plan(plan), reference_in_tasks(plan)

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
