"""Computing the fields that a store lacks: rows handed to the cluster, records taken back."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from distributed import Client, Future

from sobolev_batch.batch.cluster.execution import deal, many_in_flight
from sobolev_batch.batch.cluster.outcomes import DEADLY, is_suspect
from sobolev_batch.batch.cluster.progress import Notify, Progress
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.fields.graph import Submitter
from sobolev_batch.batch.fields.sizing import Layout, lay_out_rows
from sobolev_batch.batch.fields.tasks import Job
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.errors import StoreError

_log = logging.getLogger(__name__)


def compute_fields(
    client: Client,
    crew: Workers,
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    missing: Sequence[int],
    records: list[Record | None],
    notify: Notify,
) -> None:
    """Compute the fields of rows; their records, as they are stored, take their places in the list.

    Raises:
        StoreError: the store could not be written, which is no failure of a mesh; what is not recorded can be
            computed again.
        ClusterError: the scheduler was lost, or the lattice fits into no worker.
    """
    notify(Progress("fields", 0, len(missing)))
    layouts, refused = lay_out_rows(plan, [rows[i] for i in missing], crew.with_backend(plan.study.backend))
    submitter = Submitter.of(client, crew, plan.study.backend, layouts.values(), len(plan.blocks))
    done = 0

    def conclude(i: int, record: Record) -> None:
        nonlocal done
        done += 1
        records[i] = record
        notify(Progress("fields", done, len(missing), rows[i].label, record))

    def give_up(i: int, reason: str) -> None:
        record = Record(key=rows[i].key, status="failed", reason=reason, finished=utc_now())
        _log.error("%s: %s", rows[i].label, reason)
        store.write_record(i, record)
        conclude(i, record)

    for i in missing:
        if rows[i].label in refused:
            give_up(i, refused[rows[i].label])
    todo = [i for i in missing if rows[i].label in layouts]
    # A mesh in pieces occupies all workers by itself, and its pieces the scratch space.
    cut = any(layout.parts > 1 for layout in layouts.values())

    def submit(i: int, rank: int) -> Future:
        layout = layouts[rows[i].label]
        return submitter.field(_job(store, plan, rows[i], i, layout), layout, rank)

    for i, outcome in deal(client, submit, todo, crew.threads + 1 if cut else many_in_flight(crew)):
        if isinstance(outcome, StoreError):
            raise StoreError(f"{outcome}; then the same command goes on from what is stored") from outcome
        if layouts[rows[i].label].parts > 1:
            store.scratch.discard(i)
        if isinstance(outcome, Record):
            conclude(i, outcome)
        else:
            give_up(i, DEADLY.format(outcome) if is_suspect(outcome) else f"{type(outcome).__name__}: {outcome}")
    if cut:
        store.scratch.discard()


def _job(store: Store, plan: Plan, row: Row, number: int, layout: Layout) -> Job:
    return Job(
        store,
        number,
        row.label,
        row.key,
        row.member,
        plan.similarity,
        plan.lattice,
        plan.transform,
        plan.study.orders,
        plan.aim(row),
        layout.transform_bytes,
        plan.study.backend,
        row.fingerprint,
    )
