"""Heartbeat of a run: a record in its store that is renewed while it runs and completed when it ends.

A store whose run has no heartbeat any more can be unlocked.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from sobolev_batch.errors import LockError, StoreError, one_line
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, age_seconds, break_lock, this_process, utc_now
from sobolev_batch.store.records import Records, RunRecord, RunState

_log = logging.getLogger(__name__)

# The age of the record tells its readers whether the driver still runs.
HEARTBEAT_SECONDS = 10.0
# A driver counts as lost after this silence.
LOST_AFTER_SECONDS = 6 * HEARTBEAT_SECONDS


class Heartbeat:
    """Record in a store that says where a run goes on, and how it ended.

    Attributes:
        cluster: Address of the scheduler, once there is one.
        find_obstacle: Function that is called at each beat and returns what keeps the run from going on, if anything.
    """

    def __init__(self, store: Store, lock: Lock) -> None:
        self.cluster = ""
        self.stage = ""
        self.find_obstacle: Callable[[], str] = str
        self._store = store
        self._lock = lock
        self._is_lost = False
        self._writing = threading.Lock()
        self._started = utc_now()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="sobolev-batch-heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self.write("running")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        if error is None:
            self._lock.require(self._store.location)
            self.write("done")
            return
        try:
            # If another driver took over, as when this one's worker was retired, its own end counts.
            if self._lock.is_held(self._store.location):
                ended = isinstance(error, KeyboardInterrupt | SystemExit)
                self.write("failed", "interrupted" if ended else one_line(error))
        except StoreError as failure:
            # It may be what ended the run, and must not hide that.
            _log.warning("how the run ended could not be written: %s", failure)

    def paused(self) -> AbstractContextManager[object]:
        """Return a context in which nothing is written."""
        return self._writing

    def require_lock(self) -> None:
        """Check that the run still held the store at the latest beat."""
        if self._is_lost:
            raise LockError(
                f"{self._store.path}: the store was unlocked while this run was going on, and is no longer its own; "
                "what was recorded counts"
            )

    def write(self, state: RunState, error: str = "") -> None:
        """Replace the record."""
        driver = f"{this_process()}, cluster {self.cluster}" if self.cluster else this_process()
        Records(self._store).write_run(RunRecord(state, driver, self._started, utc_now(), self.stage, error))

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_SECONDS):
            try:
                if not self._lock.is_held(self._store.location):
                    self._is_lost = True
                    return
                with self._writing:
                    self.write("running", self.find_obstacle())
            except Exception as error:  # the store may answer again at the next beat
                _log.warning("the run's record could not be written: %s", error)


def unlock(store: str | Path | Location, *, force: bool = False) -> Lock | None:
    """Remove the lock of a run that cannot do so itself, because it or its machine was killed.

    A run that is still going on notices within seconds, and ends.

    Args:
        store: Path or URL of the store.
        force: Whether to also remove the lock of a run that was alive a moment ago.

    Returns:
        The lock, or None if the store had none. Its `driver` names the process that held it since the UTC time `since`.

    Raises:
        LockError: The run was alive a moment ago.
        StoreError: There is no store, or it cannot be read or written; or it is that of a collection, whose objects
            have locks of their own.

    >>> import sobolev_batch as sb
    >>> sb.unlock("memory://new.zarr")
    Traceback (most recent call last):
        ...
    sobolev_batch.errors.StoreError: memory://new.zarr: it holds no store of a study
    """
    location = Location.parse(store)
    lock = Lock.read(location)
    if lock is None:
        Store.open(location)
        return None
    if not force and lock.holder_is_alive:
        raise LockError(f"{location}: {lock.driver} is alive; stop it, or unlock the store all the same by --force")
    silence = math.inf if force or lock.holder_is_gone else _silence_seconds(location, lock)
    if silence < -LOST_AFTER_SECONDS:
        raise LockError(
            f"{location}: the last sign of life of {lock.driver} is {-silence:.0f} s ahead of the clock here, so its "
            "age is unknown; stop it, or if it is gone, unlock the store by --force"
        )
    if silence < LOST_AFTER_SECONDS:
        raise LockError(
            f"{location}: {lock.driver} was alive {max(silence, 0):.0f} s ago; stop it, or wait until it has been "
            f"silent for {LOST_AFTER_SECONDS:.0f} s; --force unlocks the store all the same"
        )
    break_lock(location)
    return lock


def _silence_seconds(location: Location, lock: Lock) -> float:
    """Return the time since the latest heartbeat of a lock's holder."""
    moments = [lock.since] if lock.run else []
    # If the store cannot be read, only the lock itself is known.
    with suppress(StoreError):
        store = Store(location)
        run = Records(store).read_run() if store.exists() else None
        if run is not None and run.driver.startswith(lock.driver):
            moments.append(run.seen)
    return min(map(age_seconds, moments), default=math.inf)
