"""The record of a run in its store: kept up to date while it runs, closed when it ends."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Self

from sobolev_batch.batch.storage.lock import Claim, this_process
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.records import RunRecord, RunState
from sobolev_batch.batch.store.store import Store
from sobolev_batch.errors import ClaimError, StoreError

_log = logging.getLogger(__name__)

# Who reads the record knows from its age whether the driver still lives.
HEARTBEAT_SECONDS = 10.0
# A driver that was silent for so long is taken for lost.
PATIENCE_SECONDS = 6 * HEARTBEAT_SECONDS


class Heartbeat:
    """Tells a store that a run is going on, from where, and how it ended.

    Attributes:
        cluster: the address of the scheduler, once there is one.
        stage: what is being done.
        worry: asked at each beat, for what keeps the run from going on; empty while nothing does.
    """

    def __init__(self, store: Store, claim: Claim) -> None:
        """Name the store, and the claim that it is held by."""
        self.cluster = ""
        self.stage = ""
        self.worry: Callable[[], str] = str
        self._store = store
        self._claim = claim
        self._is_lost = False
        self._lock = Lock()
        self._started = utc_now()
        self._ended = Event()
        self._thread = Thread(target=self._beat, name="sobolev-batch-journal", daemon=True)

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
            self._claim.require(self._store.location)
            self.write("done")
            return
        try:
            # Another driver may have taken over, as when this one's worker was retired: how that ends counts.
            if self._claim.is_on(self._store.location):
                ended = isinstance(error, KeyboardInterrupt | SystemExit)
                self.write("failed", "interrupted" if ended else str(error) or repr(error))
        except StoreError as failure:
            # It may be what ended the run, and must not hide that.
            _log.warning("how the run ended could not be written: %s", failure)

    def paused(self) -> AbstractContextManager[object]:
        """Keep it from writing for a while."""
        return self._lock

    def _worry(self) -> str:
        try:
            return self.worry()
        except Exception as error:  # a cluster that is closing does not answer; the run is alive all the same
            _log.debug("the cluster could not be asked: %r", error)
            return ""

    def require_claim(self) -> None:
        """Check that the store was still this run's at the latest beat.

        Raises:
            ClaimError: it was released, or somebody else has it.
        """
        if self._is_lost:
            raise ClaimError(
                f"{self._store.path}: the store was released while this run was going on, and is no longer its own; "
                "what was recorded counts"
            )

    def write(self, state: RunState, error: str = "") -> None:
        """Replace the store's record."""
        self._store.write_run(RunRecord(state, self._driver, self._started, utc_now(), self.stage, error))

    @property
    def _driver(self) -> str:
        return f"{this_process()}, cluster {self.cluster}" if self.cluster else this_process()

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_SECONDS):
            try:
                if not self._claim.is_on(self._store.location):
                    self._is_lost = True
                    return
                with self._lock:
                    worry = self._worry()
                    if worry:
                        _log.warning("%s: %s", self._store.path, worry)
                    self.write("running", worry)
            except Exception as error:  # the store may answer again at the next beat
                _log.warning("the run's record could not be written: %s", error)
