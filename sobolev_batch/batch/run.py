"""A run of a study: pending fields become tasks, and stored fields become tables."""

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
from sobolev_batch.batch.cluster.execution import Cluster
from sobolev_batch.batch.cluster.progress import Notify, Progress
from sobolev_batch.batch.cluster.store_access import require_store_access
from sobolev_batch.batch.cluster.worker_plugin import waiting_reason
from sobolev_batch.batch.fields.compute import compute_fields
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, locked
from sobolev_batch.batch.store.create import require_usable
from sobolev_batch.batch.store.heartbeat import Heartbeat
from sobolev_batch.batch.store.store import stored_choice
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.study.plan import Plan, make_plan
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.verify import damaged_rows
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.errors.budget import NormEstimate

_log = logging.getLogger(__name__)

# A study whose distances fall short of the accuracy asked for is computed again on a larger lattice,
# this often in all.
_MOST_ROUNDS = 3
# Fields that turn out damaged are computed again; where that goes on, something destroys them.
_MOST_REPAIRS = 3

Result = TypeVar("Result")


@dataclass(frozen=True)
class Summary:
    """The outcome of a run.

    Attributes:
        store: Path or URL of the store.
        computed: Labels of the meshes whose fields were computed now.
        reused: Labels of the meshes whose fields were already stored.
        failed: Reason for each mesh whose field could not be computed, by its label.
        not_compared: For each mesh whose field is stored, but not the witness function or the Hausdorff and Chamfer
            distances that the study asks for: the comparison that is missing, and the reason.

    >>> import sobolev_batch as sb
    >>> summary = sb.Summary("results.zarr", computed=("ico/2",), reused=("ico/1",), failed={"f/a": "no triangles"})
    >>> sorted(summary.failed)
    ['f/a']
    """

    store: str
    computed: tuple[str, ...]
    reused: tuple[str, ...]
    failed: Mapping[str, str]
    not_compared: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def _of(cls, workspace: Workspace, computed: set[int], not_compared: Mapping[str, str]) -> Self:
        labels, failed = workspace.labels, workspace.failures
        return cls(
            workspace.store.path,
            tuple(label for i, label in enumerate(labels) if i in computed and label not in failed),
            tuple(label for i, label in enumerate(labels) if i not in computed),
            failed,
            not_compared,
        )


def run(
    study: Study,
    store: str | Path | Location,
    client: Client | None = None,
    *,
    workers: int | None = None,
    memory: float | str | None = None,
    on_progress: Notify | None = None,
) -> Summary:
    """Compute the fields that a store lacks of a study, then norms, distances and convergence tables.

    Args:
        study: Study to carry out.
        store: Path or URL of a new or existing store. All workers must reach it under the same name. A store
            in memory://, which is gone when the process ends, is computed by threads of this process.
        client: Client of the cluster to compute on. By default a cluster of single-threaded processes on
            this machine is started for the time of the call, unless nothing is missing. A script that relies on
            it must guard its main part by ``if __name__ == "__main__"``, as all that starts processes must.
        workers: Number of workers of the cluster on this machine; by default one for each core.
        memory: Memory of each of these workers, in bytes or as a text such as "4GB"; by default the
            machine's, divided equally.
        on_progress: Callback for each step; it is called in this thread.

    Returns:
        Meshes that were computed, that were reused, and that failed. A mesh that fails does not raise.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out.
        AccuracyError: The accuracy that the study asks for is out of reach; nothing was computed.
        StoreError: The store cannot be reached or written, belongs to another study, or is being
            written by another run (LockError).
        ClusterError: No worker has the GPU that the study asks for, or enough memory for its lattice; or
            the scheduler was lost.
        InputError: The memory is not a size, or too little for a worker.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "balls"},
    ...     "lattice": {"xi_max": 3.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ball", "source": "sphere", "radius": 0.5}],
    ... })
    >>> summary = sb.run(study, "memory://run-example.zarr", workers=1)
    >>> summary.computed
    ('ball/sphere', 'reference')
    >>> sb.run(study, "memory://run-example.zarr").reused
    ('ball/sphere', 'reference')
    >>> tree = sb.open_store("memory://run-example.zarr")
    >>> tree["distances"]["distance"].sizes["mesh"]
    2
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
            require_store_access(client, location, lock)
        return carry_out(study, location, lock, cluster, on_progress or (lambda progress: None))


def carry_out(
    study: Study, location: Location, lock: Lock, clients: AbstractContextManager[Client], notify: Notify
) -> Summary:
    """Run a study in a store that this process has locked; see `run`.

    Args:
        study: Study to carry out.
        location: Location of the store.
        lock: Lock of the store.
        clients: Context that gives the client, entered if anything is missing.
        notify: Callback for each step.
    """
    plan = make_plan(study, stored_choice(location))
    # Planning may take minutes.
    lock.require(location)
    workspace = Workspace.prepared(location, plan)
    with Heartbeat(workspace.store, lock) as heartbeat:
        workspace.withdraw_lost_fields()
        if not workspace.pending and are_tabulated(workspace) and Comparer.of(workspace).is_done:
            return Summary._of(workspace, set(), {})
        with clients as client:
            heartbeat.cluster = client.scheduler.address
            heartbeat.write("running")
            notify(Progress("cluster", 0, 0, client.dashboard_link))

            def beat(progress: Progress) -> None:
                heartbeat.require_lock()
                heartbeat.stage = f"{progress.stage}, {progress.done} of {progress.total}"
                notify(progress)

            cluster = Cluster.of(client, study.libraries, beat)
            # Asked before anything is computed: a GPU that nobody has would be waited for.
            cluster.workers.with_backend(study.backend)
            heartbeat.find_obstacle = lambda: waiting_reason(client, study.backend)
            workspace.store.scratch.discard()
            return _Run(cluster, heartbeat).carry_out(workspace)


@dataclass(frozen=True, eq=False)
class _Run:
    """The computation of everything that a workspace lacks.

    Attributes:
        cluster: Cluster to compute on.
        heartbeat: Heartbeat of the run.
    """

    cluster: Cluster
    heartbeat: Heartbeat

    def carry_out(self, workspace: Workspace) -> Summary:
        """Compute, on larger lattices until the accuracy is reached, and compare."""
        rows = workspace.pending
        workspace.withdraw_results_of(rows)
        computed: set[int] = set()
        for rounds_left in reversed(range(_MOST_ROUNDS)):
            repaired, distances = self._repairing(workspace, rows, self._compute)
            computed.update(rows, repaired)
            choice = _larger_lattice(workspace.plan, distances) if rounds_left else None
            if choice is None:
                break
            # The records are laid out anew, that of the run with them.
            with self.heartbeat.paused():
                workspace = Workspace.prepared(workspace.store.location, workspace.plan.with_choice(choice))
            self.heartbeat.write("running")
            workspace.withdraw_lost_fields()
            rows = workspace.pending
        repaired, not_compared = self._repairing(workspace, (), self._compare)
        return Summary._of(workspace, computed | repaired, not_compared)

    def _compute(self, workspace: Workspace, rows: Sequence[int]) -> NormEstimate | None:
        """Compute the fields of rows and the tables, and return the distances to the reference if they are new."""
        compute_fields(self.cluster, workspace, rows)
        return tabulate_fields(self.cluster, workspace)

    def _compare(self, workspace: Workspace, rows: Sequence[int]) -> dict[str, str]:
        """Compute the fields of rows again, make the comparisons, and return those that could not be made."""
        if rows:
            self._compute(workspace, rows)
        return Comparer.of(workspace).run(self.cluster)

    def _repairing(
        self, workspace: Workspace, rows: Sequence[int], attempt: Callable[[Workspace, Sequence[int]], Result]
    ) -> tuple[set[int], Result]:
        """Repeat an attempt with the rows that turn out damaged, and return these rows and its result."""
        repaired: set[int] = set()
        for attempts_left in reversed(range(_MOST_REPAIRS + 1)):
            try:
                return repaired, attempt(workspace, rows)
            except DamageError as error:
                if not attempts_left:
                    raise
                _log.warning("%s", error)
                # Where one is damaged, others may be.
                rows = damaged_rows(self.cluster, workspace)
                workspace.withdraw(rows, "its values are not what was stored")
                repaired.update(rows)
        raise AssertionError("unreachable: the last attempt returns or raises")


def _larger_lattice(plan: Plan, distances: NormEstimate | None) -> LatticeChoice | None:
    """Return a larger lattice where distances to the reference miss the accuracy that is asked for."""
    if plan.study.accuracy is None or distances is None:
        return None
    complete = ~np.isnan(distances.values).any(axis=0)
    return plan.choice.grown(
        NormEstimate(*(array[:, complete] for array in distances)), plan.study.orders, plan.study.accuracy
    )
