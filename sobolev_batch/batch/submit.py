"""Handing a study over to a cluster, which then needs nobody to wait for it."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from distributed import Client, Future, Status, fire_and_forget, get_worker, worker_client

from sobolev_batch.batch.cluster.store_access import require_reach
from sobolev_batch.batch.cluster.worker_plugin import enlist
from sobolev_batch.batch.run import carry_out, rows_of, rows_without_field
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, acquire, release
from sobolev_batch.batch.store.create import prepare_store, require_usable
from sobolev_batch.batch.store.heartbeat import Heartbeat
from sobolev_batch.batch.store.store import Store, stored_choice
from sobolev_batch.batch.study.plan import make_plan
from sobolev_batch.batch.study.study import Study
from sobolev_batch.errors import ClusterError, StoreError

_log = logging.getLogger(__name__)

_ACCEPT_SECONDS = 30.0
_POLL_SECONDS = 0.05


@dataclass(frozen=True)
class Submission:
    """A study that a cluster has taken over.

    Attributes:
        store: where to follow it and where its results come.
        surfaces: of the study.
        missing: those whose fields are to be computed.
    """

    store: str
    surfaces: int
    missing: int


def submit(study: Study, store: str | Path | Location, client: Client) -> Submission:
    """Hand a study over to a cluster and return; it goes on without this process.

    One of the workers drives it, in a thread besides those for tasks; should that worker be lost,
    another one takes over from what is stored. ``sobolev-batch status`` tells how far it is.

    Args:
        study: what to compute.
        store: path or URL of a new or existing store, that this process and all workers reach alike.
        client: of the cluster; it may be closed afterwards.

    Raises:
        StudyError, MeshError, LatticeError, AccuracyError, StoreError: see `run`; nothing was handed over.
        ClusterError: no worker has the GPU that the study asks for, or the scheduler did not take it.
    """
    location = Location.of(store).absolute()
    require_usable(location)
    lock = Lock.of_this_process(outlives_process=True)
    acquire(location, lock)
    try:
        return _hand_over(study, location, lock, client)
    except BaseException:
        release(location, lock)
        raise


def _hand_over(study: Study, location: Location, lock: Lock, client: Client) -> Submission:
    require_reach(client, location, lock)
    plan = make_plan(study, stored_choice(location))
    enlist(client, study.libraries).with_backend(study.backend)
    place = prepare_store(location, plan)
    missing = rows_without_field(place.records(), rows_of(place, plan))
    journal = Heartbeat(place, lock)
    journal.cluster = client.scheduler.address
    journal.write("submitted")
    key = f"sobolev-batch-drive-{uuid4().hex}"
    # Before all tasks of other studies, which it takes no thread from: it leaves its own at once.
    future = client.submit(
        drive, dict(study.table), str(study.folder.absolute()), place.path, lock.run, key=key, pure=False, priority=1
    )
    fire_and_forget(future)
    _await_acceptance(client, future)
    return Submission(place.path, len(plan.rows), len(missing))


def drive(table: Mapping[str, Any], folder: str, store: str, run: str) -> None:
    """Run a study from a worker of the cluster that computes it, with the claim of its submission.

    It does not fail: what goes wrong is in the store, and running into it again would not help.
    """
    location = Location.of(store)
    lock = Lock.of_this_process(run, outlives_process=True)
    try:
        there = Lock.read(location)
        if there is None or there.run != run:
            _log.warning("%s: the store was released since the study was submitted, or is done; left alone", store)
            return
        acquire(location, lock)
        with worker_client() as client:
            study = Study.from_table(table, folder=folder)
            carry_out(study, location, lock, nullcontext(client), lambda progress: None)
    except Exception as error:
        if get_worker().status != Status.running:
            # Dask has another worker drive, which takes the claim over.
            _log.warning("%s: this worker leaves before the end of the study it drove", store)
            return
        _log.error("%s: the study could not be carried out: %s", store, error)
        # Most of what goes wrong is known by now to the run's own journal, but not that a file of the
        # study is missing on this machine.
        with suppress(StoreError):  # it may be what failed
            if lock.is_held(location):
                Heartbeat(Store(store), lock).write("failed", f"{error} (on the worker that drove the study)")
    release(location, lock)


def _await_acceptance(client: Client, future: Future) -> None:
    """Return when the scheduler itself wants the task: the client may be killed from then on."""
    deadline = time.monotonic() + _ACCEPT_SECONDS
    while not future.done():
        # A lambda travels by value, so the scheduler need not have this package.
        if client.run_on_scheduler(
            lambda dask_scheduler, key: (
                key in dask_scheduler.tasks
                and any(state.client_key == "fire-and-forget" for state in dask_scheduler.tasks[key].who_wants or ())
            ),
            key=future.key,
        ):
            return
        if time.monotonic() > deadline:
            raise ClusterError(
                f"the scheduler at {client.scheduler.address} did not take the study within {_ACCEPT_SECONDS:g} s; "
                "see its log"
            )
        time.sleep(_POLL_SECONDS)
