"""Computing the fields that a store lacks: rows handed to the cluster, records taken back."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from distributed import Client, Future, as_completed

from sobolev_batch.batch.crew import Crew
from sobolev_batch.batch.layout import Layout, lay_out_rows
from sobolev_batch.batch.outcomes import is_suspect, outcomes
from sobolev_batch.batch.plan import Plan, Row
from sobolev_batch.batch.progress import Notify, Progress
from sobolev_batch.batch.records import Record, utc_now
from sobolev_batch.batch.store import Store
from sobolev_batch.batch.submitter import Submitter
from sobolev_batch.batch.tasks import Job
from sobolev_batch.errors import StoreError

_log = logging.getLogger(__name__)

# Rows that the scheduler knows of at a time: enough to deal out well, while each costs it memory.
_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD = 2000, 20

_DEADLY = (
    "its tasks ended the worker that they ran on again and again, at last with nothing else beside them, as "
    "happens for want of memory ({}); start workers with more memory, or take it out of the study"
)


def compute_fields(
    client: Client,
    crew: Crew,
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    missing: Sequence[int],
    records: list[Record | None],
    notify: Notify,
) -> None:
    """Compute the fields of rows; their records, as they are stored, take their places in the list.

    Raises:
        StoreError: the store could not be written; what is not recorded can be computed again.
        ClusterError: the scheduler was lost, or the lattice fits into no worker.
    """
    notify(Progress("fields", 0, len(missing)))
    layouts, refused = lay_out_rows(plan, [rows[i] for i in missing], crew.with_backend(plan.study.backend))
    submitter = Submitter.of(client, crew, plan.study.backend, layouts.values(), len(plan.blocks))
    dealer = _Dealer(client, submitter, store, plan, rows, layouts)
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
    in_flight = crew.threads + 1 if cut else max(_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD * crew.threads)
    suspects = []
    for i, outcome in dealer.deal(todo, in_flight):
        if is_suspect(outcome):
            suspects.append(i)
        elif isinstance(outcome, Record):
            conclude(i, outcome)
        else:
            give_up(i, f"{type(outcome).__name__}: {outcome}")
    for i, outcome in dealer.deal(sorted(suspects), 1):
        if isinstance(outcome, Record):
            conclude(i, outcome)
        else:
            give_up(i, _DEADLY.format(outcome) if is_suspect(outcome) else f"{type(outcome).__name__}: {outcome}")
    if cut:
        store.scratch.discard()


@dataclass(frozen=True, eq=False)
class _Dealer:
    """Deals out rows, so many at a time, and takes back what became of each."""

    client: Client
    submitter: Submitter
    store: Store
    plan: Plan
    rows: Sequence[Row]
    layouts: dict[str, Layout]

    def deal(self, todo: Sequence[int], in_flight: int) -> Iterator[tuple[int, object]]:
        """Rows with their records, or with what a task has raised.

        Raises:
            StoreError: a task could not write its results; that is no failure of its mesh.
        """
        futures: dict[Future, int] = {}
        remaining = enumerate(todo)
        completed = as_completed(loop=self.client.loop)

        def hand_over(count: int) -> None:
            for rank, i in islice(remaining, count):
                future = self._submit(i, rank)
                futures[future] = i
                completed.add(future)

        try:
            hand_over(in_flight)
            for batch in completed.batches():
                found = outcomes(self.client, batch)
                for i, outcome in zip([futures.pop(future) for future in batch], found, strict=True):
                    if isinstance(outcome, StoreError):
                        raise StoreError(f"{outcome}; then the same command goes on from what is stored") from outcome
                    if self.layouts[self.rows[i].label].parts > 1:
                        self.store.scratch.discard(i)
                    yield i, outcome
                # Only now: a row that is dealt with nothing beside it has to be alone.
                hand_over(len(batch))
        finally:
            # A client may outlive this run, and the cluster would go on for it.
            for future in futures:
                future.release()

    def _submit(self, i: int, rank: int) -> Future:
        row, plan = self.rows[i], self.plan
        layout = self.layouts[row.label]
        job = Job(
            self.store,
            i,
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
        return self.submitter.field(job, layout, rank)
