"""Signs of life: a thread renews the record of a run in its store, another asks whether its cluster is alive.

A store whose run has no heartbeat any more can be unlocked. A scheduler or worker that was stopped, or whose machine
hangs, keeps its connections open and says nothing. Dask gives up such a worker after the time
``distributed.scheduler.worker-ttl``. For such a scheduler, a run would wait for ever.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Self

import dask
from dask.utils import parse_timedelta
from distributed import CancelledError, Client

from sobolev_batch.batch.cluster.workers import GPU
from sobolev_batch.errors import ClusterError, LockError, StoreError, one_line
from sobolev_batch.shown import few_of
from sobolev_batch.store.latest_run import LOST_AFTER_SECONDS, RunRecord, RunState
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, this_process, utc_now

_log = logging.getLogger(__name__)

# A few beats may be lost, or take long, before others take the run for lost.
HEARTBEAT_SECONDS = LOST_AFTER_SECONDS / 6
# A silence is told after this time. Workers tell of themselves twice a second, of thousands twice a minute.
_TELL_AFTER_SECONDS = 30.0
_POLL_SECONDS = 5.0
_MOST_NAMED = 4


@contextmanager
def _repeated(act: Callable[[], bool], seconds: float, name: str) -> Iterator[None]:
    """Act every so many seconds in a thread, until the block ends or the action returns False."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(seconds) and act():
            pass

    thread = threading.Thread(target=repeat, name=f"sobolev-batch-{name}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        # It may wait for an answer of the store or of the cluster, which it does for a limited time.
        thread.join()


@dataclass(frozen=True)
class Silence:
    """The time since a process was heard of, for which others listened: they may be stopped for a while themselves.

    The time ``heard`` is by the clock of that process, and is compared with nothing else.
    """

    heard: object = None
    since: str = field(default_factory=lambda: f"{datetime.now(UTC):%H:%M:%S} UTC")
    seconds: float = 0.0

    def after(self, elapsed: float, heard: object = None) -> Self:
        """Return the silence after some more seconds; it begins anew if the process was heard of meanwhile."""
        return replace(self, seconds=self.seconds + elapsed) if heard == self.heard else type(self)(heard)


class Watch:
    """A watch over a cluster: it finds what keeps a run from going on, and ends a run whose scheduler stays silent.

    Attributes:
        obstacle: What keeps the run from going on, for people; empty if nothing does.
    """

    def __init__(self, client: Client, needs_gpu: bool = False) -> None:
        self.address, self.obstacle = str(client.scheduler.address), ""
        self._client, self._needs_gpu = client, needs_gpu
        # A scheduler gets as long as it gives to its workers; without a limit, for ever.
        limit = dask.config.get("distributed.scheduler.worker-ttl")
        self._patience_seconds = parse_timedelta(limit) if limit else math.inf
        self._workers: dict[str, Silence] = {}
        self._scheduler = Silence()
        self._looked = time.monotonic()

    @contextmanager
    def kept(self) -> Iterator[Self]:
        """Keep the watch; ClusterError where the scheduler was silent for too long."""
        try:
            with _repeated(self._look_out, _POLL_SECONDS, "watch"):
                yield self
        except (OSError, CancelledError) as error:
            if not self._has_lost_scheduler:
                raise
            raise ClusterError(
                f"{self._silent_scheduler()}, and was given up; the same command goes on from what is stored"
            ) from error

    @property
    def _has_lost_scheduler(self) -> bool:
        return self._scheduler.seconds > self._patience_seconds

    def _look_out(self) -> bool:
        """Find the obstacle, and return whether the scheduler may still answer."""
        before, self._looked = self._looked, time.monotonic()
        try:
            # More has passed only if this process was stopped too.
            obstacle = self._look(min(self._looked - before, 2 * _POLL_SECONDS))
        except Exception as error:  # A cluster that is closing does not answer, but the run is alive.
            _log.debug("the cluster could not be asked: %r", error)
            return True
        if obstacle != self.obstacle and obstacle:
            _log.warning("%s", obstacle)
        self.obstacle = obstacle
        return not self._has_lost_scheduler

    def _look(self, elapsed: float) -> str:
        try:
            workers = self._ask("identity", n_workers=-1)["workers"]
        except TimeoutError:
            self._scheduler = self._scheduler.after(elapsed)
            if self._has_lost_scheduler:
                # What waits for its answer wakes up, as if it had ended.
                self._client.loop.add_callback(self._hang_up)
            return self._silent_scheduler() if self._scheduler.seconds > _TELL_AFTER_SECONDS else ""
        self._scheduler = Silence()
        self._workers = {
            address: self._workers.get(address, Silence()).after(elapsed, worker["last_seen"])
            for address, worker in workers.items()
        }
        if silent := {name: one.since for name, one in self._workers.items() if one.seconds > _TELL_AFTER_SECONDS}:
            return self._silent_workers(silent)
        if not workers:
            return "no worker is left; waiting for one to start"
        if self._needs_gpu and not any(worker["resources"].get(GPU) for worker in workers.values()):
            return "no worker with a GPU is left, and the study requests one; waiting for one to start"
        return ""

    def _silent_workers(self, silences: Mapping[str, str]) -> str:
        tasks = self._ask("processing", workers=list(silences))
        told = []
        for address, since in list(silences.items())[:_MOST_NAMED]:
            # See `task_key`.
            ours = (key if isinstance(key, tuple) and len(key) == 3 else None for key in tasks.get(address, ()))
            labels = list(dict.fromkeys(str(key[1]) if key else "a task of something else" for key in ours))
            held = f", and has {few_of(labels, _MOST_NAMED)}" if labels else ""
            told.append(f"the worker {address} has said nothing since {since}{held}")
        if len(silences) > _MOST_NAMED:
            told.append(f"and {len(silences) - _MOST_NAMED} more workers have")
        return f"{'; '.join(told)}. Dask gives up whoever stays silent (worker-ttl), and others get the tasks"

    def _silent_scheduler(self) -> str:
        return f"the scheduler at {self.address} has said nothing since {self._scheduler.since}"

    def _hang_up(self) -> None:
        self._client.rpc.remove(self.address)
        self._client.scheduler_comm.comm.abort()

    def _ask(self, operation: str, **arguments: Any) -> Any:
        ask = getattr(self._client.scheduler, operation)
        return self._client.sync(ask, callback_timeout=_POLL_SECONDS, **arguments)


class Heartbeat:
    """The record in a store that says where a run goes on, at which stage, and how it ended."""

    def __init__(self, location: Location, lock: Lock, watch: Watch | None = None) -> None:
        self.stage, self.watch = "", watch
        # Another driver of the same run may take its lock over, as when this one's worker was retired.
        self._store = Store(lock.fenced(location, "holder"))
        self._lost: LockError | None = None
        self._started = utc_now()

    @contextmanager
    def kept(self) -> Iterator[Self]:
        """Renew the record while the run goes on, and write how it ended; LockError if it has lost its store."""
        self.write("running")
        try:
            with _repeated(self._beat, HEARTBEAT_SECONDS, "heartbeat"):
                yield self
        except BaseException as error:
            is_interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
            try:
                self.write("failed", "interrupted" if is_interrupted else one_line(error))
            except LockError:
                pass  # The end of the run that has the store now counts.
            except StoreError as failure:
                # It may be what ended the run, and must not hide that.
                _log.warning("how the run ended could not be written: %s", failure)
            raise
        self.write("done")

    def advance(self, stage: str) -> None:
        """Take down what the run does now; LockError if it had lost its store at the latest beat."""
        if self._lost is not None:
            raise self._lost
        self.stage = stage

    def write(self, state: RunState, error: str = "") -> None:
        """Replace the record, whose driver begins as that of the lock: `unlock` tells by it whose heartbeat it is."""
        driver = f"{this_process()}, cluster {self.watch.address}" if self.watch else this_process()
        RunRecord(state, driver, self._started, utc_now(), self.stage, error).write(self._store)

    def _beat(self) -> bool:
        try:
            self.write("running", self.watch.obstacle if self.watch else "")
        except LockError as error:
            self._lost = error
        except Exception as error:  # The store may answer again at the next beat.
            _log.warning("the run's record could not be written: %s", error)
        return self._lost is None
