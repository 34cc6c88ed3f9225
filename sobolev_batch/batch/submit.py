"""A study handed over to a cluster, which goes on with it alone."""

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from distributed import Client, Future, Status, fire_and_forget, get_worker, worker_client

from sobolev_batch.batch.cluster.clients import require_blocking
from sobolev_batch.batch.cluster.execution import task_key
from sobolev_batch.batch.cluster.watch import Heartbeat, Watch
from sobolev_batch.batch.cluster.workers import prepare_workers, require_store_access
from sobolev_batch.batch.run import carry_out
from sobolev_batch.batch.start import StoreLike, ready_to_run
from sobolev_batch.errors import ClusterError, StoreError, one_line
from sobolev_batch.store.create import require_usable
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, acquire, release
from sobolev_batch.store.objects import Objects, for_each_object
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.study import Study, StudyLike

_log = logging.getLogger(__name__)

_ACCEPTANCE_SECONDS = 60.0
_POLL_SECONDS = 0.05


@dataclass(frozen=True)
class Submission:
    """A study that a cluster has taken over.

    Attributes:
        store: Path or URL of the store.
        surfaces: Number of surfaces of the study.
        missing: Number of surfaces whose fields are to be computed, as far as the store tells.
        refused: Reason for each object whose surfaces cannot be listed, by its name.

    >>> import sobolev_batch as sb
    >>> submission = sb.result_types.Submission("s3://bucket/results.zarr", surfaces=6, missing=4)
    >>> f"{submission.missing} of {submission.surfaces} to compute"
    '4 of 6 to compute'
    """

    store: str
    surfaces: int
    missing: int
    refused: Mapping[str, str] = field(default_factory=dict)


def submit(
    study: StudyLike, store: StoreLike, client: Client, *, allow_commands: bool = False, only: Sequence[str] = ()
) -> Submission:
    """Hand a study over to a cluster and return; it goes on without this process.

    One of the workers drives it, in a thread besides those for tasks; should that worker be lost, another takes over
    from what is stored. ``sobolev-batch status`` shows the progress. An object that cannot be carried out stops none.

    Args:
        study: Study, or the path of its file.
        store: Path or URL of a new or existing store, which this process and all workers reach under this name; None
            for storage/NAME.zarr.
        client: Client of the cluster; it may be closed afterwards.
        allow_commands: True if the study may run its commands on the workers and here: you trust its file.
        only: See `run`.

    Raises:
        StudyError, MeshError, LatticeError, AccuracyError, StoreError: See `run`; nothing was handed over.
        ClusterError: No worker has the GPU that the study requests, or the scheduler did not take the study in time.

    >>> import sobolev_batch as sb
    >>> with Client("tls://scheduler:8786") as client:  # doctest: +SKIP
    ...     sb.submit("study.toml", "s3://bucket/results.zarr", client).missing
    2
    """
    require_blocking(client)
    study, location = ready_to_run(study, store, allow_commands=allow_commands, only=only)
    location, lock = location.absolute(), Lock.of_this_process(outlives_process=True)
    require_usable(location, of_objects="" not in study.objects)
    acquire(location, lock)
    try:
        with Watch(client).kept() as watch:
            require_store_access(client, location, lock)
            workers = prepare_workers(client, study.libraries)
        workers.with_backend(study.backend)
        workers.require_accuracy(study.accuracy)
        submission = _prepared(study, lock.fenced(location))
        heartbeat = Heartbeat(location, lock, watch)
        heartbeat.write("submitted")
        # The worker was started in another folder.
        objects = {name: replace(one, folder=one.folder.absolute()) for name, one in study.objects.items()}
        study, key = replace(study, objects=objects), task_key("drive", study.name, "", "")
        # It goes before the tasks of other studies, and takes no thread from them, since it leaves its own at once.
        try:
            future = client.submit(drive, study, location.name, lock.run, key=key, pure=False, priority=1)
            fire_and_forget(future)
            _await_acceptance(client, future)
        except BaseException as error:
            with suppress(StoreError):  # it must not hide the error
                heartbeat.write("failed", f"it was not handed over: {one_line(error)}")
            raise
    except BaseException:
        release(location, lock)
        raise
    return submission


def _prepared(study: Study, location: Location) -> Submission:
    """Make the store of a study. An only object is planned, so that what is wrong is said; others are listed."""
    if "" in study.objects:
        workspace = Workspace.of_study(study, location)
        return Submission(location.name, len(workspace.rows), len(workspace.pending))
    recorded = Objects.prepared(location, study).recorded()
    listed, refused = for_each_object(study, location, lambda one, _: one.object.members)
    complete = sum(recorded[name].complete for name in listed if name in recorded)
    surfaces = sum(map(len, listed.values()))
    return Submission(location.name, surfaces, surfaces - complete, refused)


def drive(study: Study, store: str, run: str) -> None:
    """Run a study from a worker, with the lock of its submission; the store says what went wrong, nothing is raised."""
    location = Location.parse(store)
    lock = Lock.of_this_process(run, outlives_process=True)
    try:
        if (present := Lock.read(location)) is None or present.run != run:
            _log.warning("%s: the store was unlocked since the study was submitted, or is done; left alone", store)
            return
        acquire(location, lock)
        with worker_client() as client:
            carry_out(study, location, lock, lambda: client)
    except Exception as error:
        if get_worker().status != Status.running:
            # Dask has another worker drive, which takes the lock over.
            _log.warning("%s: this worker leaves before the end of the study it drove", store)
            return
        _log.error("%s: the study could not be carried out: %s", store, error)
        # The run's own heartbeat has written most errors by now, but not that a file of the study is missing here.
        with suppress(StoreError):  # it may be what failed
            Heartbeat(location, lock).write("failed", f"{error} (on the worker that drove the study)")
    release(location, lock)


def _await_acceptance(client: Client, future: Future) -> None:
    """Return when the scheduler itself wants the task: the client may be killed from then on."""
    deadline = time.monotonic() + _ACCEPTANCE_SECONDS
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
                f"the scheduler at {client.scheduler.address} did not take the study within {_ACCEPTANCE_SECONDS:g} s; "
                "see its log"
            )
        time.sleep(_POLL_SECONDS)
