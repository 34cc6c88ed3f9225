"""Heartbeat of a run: a record in its store that is renewed while it runs and completed when it ends."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Self

from sobolev_batch.batch.storage.lock import Lock, this_process, utc_now
from sobolev_batch.batch.store.records import RunRecord, RunState
from sobolev_batch.batch.store.store import Store
from sobolev_batch.errors import LockError, StoreError, one_line

_log = logging.getLogger(__name__)

# The age of the record tells its readers whether the driver still runs.
HEARTBEAT_SECONDS = 10.0
# A driver counts as lost after this silence.
LOST_AFTER_SECONDS = 6 * HEARTBEAT_SECONDS


class Heartbeat:
    """Record in a store that says where a run goes on, and how it ended.

    Args:
        store: Store of the run.
        lock: Lock that the run holds.

    Attributes:
        cluster: Address of the scheduler, once there is one.
        stage: Current stage.
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
        """Check that the run still held the store at the latest beat.

        Raises:
            LockError: The store was released, or another run has it.
        """
        if self._is_lost:
            raise LockError(
                f"{self._store.path}: the store was released while this run was going on, and is no longer its own; "
                "what was recorded counts"
            )

    def write(self, state: RunState, error: str = "") -> None:
        """Replace the record."""
        driver = f"{this_process()}, cluster {self.cluster}" if self.cluster else this_process()
        self._store.write_run(RunRecord(state, driver, self._started, utc_now(), self.stage, error))

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
