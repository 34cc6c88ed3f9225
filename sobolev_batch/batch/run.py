"""Running a study: what is missing becomes tasks, and what is stored becomes tables."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
from distributed import Client

from sobolev_batch.batch.analysis.compare import Comparer
from sobolev_batch.batch.analysis.reduce import are_tabulated, tabulate_fields
from sobolev_batch.batch.cluster.clients import local_client, thread_client
from sobolev_batch.batch.cluster.progress import Notify, Progress
from sobolev_batch.batch.cluster.store_access import require_reach
from sobolev_batch.batch.cluster.worker_plugin import enlist, worry_about
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.fields.compute import compute_fields
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, locked
from sobolev_batch.batch.store.create import prepare_store, require_usable
from sobolev_batch.batch.store.heartbeat import Heartbeat
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store, stored_choice
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.study.plan import Plan, Row, make_plan
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.verify import damaged_rows
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.errors.budget import NormEstimate

_log = logging.getLogger(__name__)

# A study whose distances fall short of the accuracy asked for is computed again on a larger lattice,
# this often in all.
_MOST_ROUNDS = 3
# Fields that turn out damaged are computed again; where that goes on, something destroys them.
_MOST_REPAIRS = 3


Found = TypeVar("Found")


@dataclass(frozen=True)
class Summary:
    """What a run did.

    Attributes:
        store: the path or URL of the store.
        computed: labels of the meshes whose fields were computed now.
        reused: labels of those that were already there.
        failed: the reason for each mesh that could not be computed.
        not_compared: for each mesh whose field is there, and whose witness function or Hausdorff and Chamfer
            distances, which the study asks for, are not: which of them, and why.
    """

    store: str
    computed: tuple[str, ...]
    reused: tuple[str, ...]
    failed: Mapping[str, str]
    not_compared: Mapping[str, str] = field(default_factory=dict)


def run(
    study: Study,
    store: str | Path | Location,
    client: Client | None = None,
    *,
    workers: int | None = None,
    memory: str | None = None,
    on_progress: Notify | None = None,
) -> Summary:
    """Compute what a store lacks of a study, then its norms, distances and convergence tables.

    Args:
        study: what to compute.
        store: path or URL of a new or existing store; the workers must reach it under the same name.
        client: of the cluster to compute on. Without one, a cluster of single-threaded processes on
            this machine serves for the time of the call; a script that relies on it must guard its
            main part by ``if __name__ == "__main__"``, as all that starts processes must. Where
            nothing is missing, none is started.
        workers: of the cluster on this machine; default one per core.
        memory: of each of them, such as "4GB"; default an equal part of the machine's.
        on_progress: called in this thread at each step.

    Returns:
        What was computed, what was there, what failed. A mesh that fails does not raise.

    Raises:
        StudyError, MeshError, LatticeError: the study cannot be carried out.
        AccuracyError: the accuracy that the study asks for is out of reach; nothing was computed.
        StoreError: the store cannot be reached or written, belongs to another study, or is being
            written by another run (ClaimError).
        ClusterError: no worker has the GPU that the study asks for, or memory enough for its lattice;
            the scheduler was lost.
    """
    location = Location.of(store)
    cluster: AbstractContextManager[Client]
    if client is None:
        # In threads, where no other process would see the store.
        cluster = thread_client(workers) if location.is_in_memory else local_client(workers, memory)
    else:
        location, cluster = location.absolute(), nullcontext(client)
    lock = Lock.of_this_process()
    require_usable(location)
    with locked(location, lock):
        if client is not None:
            require_reach(client, location, lock)
        return carry_out(study, location, lock, cluster, on_progress or (lambda progress: None))


def carry_out(
    study: Study, location: Location, lock: Lock, cluster: AbstractContextManager[Client], notify: Notify
) -> Summary:
    """Run a study in a store that this process has claimed; see `run`.

    Args:
        study: what to compute.
        location: of the store.
        lock: on it.
        cluster: gives the client, if anything is to be computed.
        notify: called at each step.
    """
    plan = make_plan(study, stored_choice(location))
    # Planning may take minutes.
    lock.require(location)
    work = _Work.of(location, plan)
    computed: set[int] = set()
    not_compared: dict[str, str] = {}
    with Heartbeat(work.store, lock) as journal:
        missing = work.missing()
        if missing or not work.is_tabulated or not work.comparer.is_done:
            with cluster as client:
                journal.cluster = client.scheduler.address
                journal.write("running")
                notify(Progress("cluster", 0, 0, client.dashboard_link))
                crew = enlist(client, study.libraries)
                # Asked before anything is computed: a GPU that nobody has would be waited for.
                crew.with_backend(study.backend)
                journal.find_obstacle = lambda: worry_about(client, study.backend)
                work.store.scratch.discard()

                def note(progress: Progress) -> None:
                    journal.require_lock()
                    journal.stage = f"{progress.stage}, {progress.done} of {progress.total}"
                    notify(progress)

                work.withdraw_what_follows_from(missing)
                for rounds_left in reversed(range(_MOST_ROUNDS)):
                    repaired, found = work.settle(client, crew, missing, note)
                    computed.update(missing, repaired)
                    choice = _grown(work.plan, found) if rounds_left else None
                    if choice is None:
                        break
                    # The records are laid out anew, that of the run with them.
                    with journal.paused():
                        work = _Work.of(location, work.plan.with_choice(choice))
                    journal.write("running")
                    missing = work.missing()
                repaired, not_compared = work.compare(client, crew, note)
                computed.update(repaired)
    return work.summary(computed, not_compared)


@dataclass(frozen=True, eq=False)
class _Work:
    """What is to be done in a store, and what is done.

    Attributes:
        store, plan: as they are called.
        rows: the plan's, in the order in which the store holds them.
        records: of the rows, kept up to date.
    """

    store: Store
    plan: Plan
    rows: tuple[Row, ...]
    records: list[Record | None]

    @classmethod
    def of(cls, location: Location, plan: Plan) -> Self:
        store = prepare_store(location, plan)
        return cls(store, plan, rows_of(store, plan), list(store.records()))

    @property
    def is_tabulated(self) -> bool:
        return are_tabulated(self.store, self.plan, self.rows, self.records)

    @property
    def comparer(self) -> Comparer:
        """What compares the meshes with the reference as the study asks."""
        return Comparer.of(self.store, self.plan, self.rows, self.records)

    def missing(self) -> list[int]:
        """The rows whose fields are to be computed; records of fields that are not there are withdrawn."""
        if any(self.records):
            whole = self.store.rows_with_complete_fields()
            self._withdraw(
                [
                    i
                    for i, record in enumerate(self.records)
                    if record is not None and record.status == "complete" and i not in whole
                ],
                "it is not there, or not all of it",
            )
        return rows_without_field(self.records, self.rows)

    def withdraw_what_follows_from(self, rows: Sequence[int]) -> None:
        """Withdraw what readers would take for facts about fields that are going to be replaced."""
        replaced = {i for i in rows if self.records[i] is not None}
        if replaced:
            Tables(self.store).invalidate()
            self.store.write_qualities(
                [record.quality if record and i not in replaced else "" for i, record in enumerate(self.records)]
            )

    def settle(
        self, client: Client, crew: Workers, missing: Sequence[int], notify: Notify
    ) -> tuple[set[int], NormEstimate | None]:
        """Compute fields and tables, and again what turns out damaged; these rows, and distances if they are new."""

        def attempt(missing: Sequence[int]) -> NormEstimate | None:
            compute_fields(client, crew, self.store, self.plan, self.rows, missing, self.records, notify)
            return tabulate_fields(client, crew, self.store, self.plan, self.rows, self.records, notify)

        return self._repairing(client, missing, attempt)

    def compare(self, client: Client, crew: Workers, notify: Notify) -> tuple[set[int], dict[str, str]]:
        """Make the comparisons that are asked for; rows whose fields turned out damaged, and why meshes are without."""

        def attempt(damaged: Sequence[int]) -> dict[str, str]:
            if damaged:
                compute_fields(client, crew, self.store, self.plan, self.rows, damaged, self.records, notify)
                tabulate_fields(client, crew, self.store, self.plan, self.rows, self.records, notify)
            return self.comparer.carry_out(client, crew, notify)

        return self._repairing(client, (), attempt)

    def _repairing(
        self, client: Client, missing: Sequence[int], attempt: Callable[[Sequence[int]], Found]
    ) -> tuple[set[int], Found]:
        """What an attempt finds, given the rows that are missing; and the rows that turned out damaged on the way."""
        repaired: set[int] = set()
        for attempts_left in reversed(range(_MOST_REPAIRS + 1)):
            try:
                return repaired, attempt(missing)
            except DamageError as error:
                if not attempts_left:
                    raise
                _log.warning("%s", error)
                # Where one is damaged, others may be.
                missing = damaged_rows(client, self.store, self.records)
                self._withdraw(missing, "its values are not what was stored")
                repaired.update(missing)
        raise AssertionError("unreachable: the last attempt returns or raises")

    def summary(self, computed: set[int], not_compared: Mapping[str, str]) -> Summary:
        failed = {
            row.label: record.reason if record else "not computed"
            for row, record in zip(self.rows, self.records, strict=True)
            if record is None or record.status == "failed"
        }
        return Summary(
            self.store.path,
            tuple(row.label for i, row in enumerate(self.rows) if i in computed and row.label not in failed),
            tuple(row.label for i, row in enumerate(self.rows) if i not in computed),
            failed,
            not_compared,
        )

    def _withdraw(self, rows: Sequence[int], reason: str) -> None:
        for i in rows:
            _log.warning("the field of %s is damaged (%s) and is computed again", self.rows[i].label, reason)
            self.store.write_record(i, None)
            self.records[i] = None


def rows_without_field(records: Sequence[Record | None], rows: Sequence[Row]) -> list[int]:
    """The rows whose fields are to be computed."""
    return [i for i, record in enumerate(records) if record is None or not record.completes(rows[i].key)]


def rows_of(store: Store, plan: Plan) -> tuple[Row, ...]:
    """The plan's rows in the order in which the store holds them."""
    by_label = {row.label: row for row in plan.rows}
    return tuple(by_label[label] for label in store.labels())


def _grown(plan: Plan, found: NormEstimate | None) -> LatticeChoice | None:
    """A larger lattice where distances to the reference fall short of the accuracy that is asked for."""
    if plan.study.accuracy is None or found is None:
        return None
    known = ~np.isnan(found.values).any(axis=0)
    complete = NormEstimate(*(part[:, known] for part in found))
    return plan.choice.grown(complete, plan.study.orders, plan.study.accuracy)
