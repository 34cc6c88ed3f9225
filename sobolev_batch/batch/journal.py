"""The record of a run in its store: kept up to date while it runs, closed when it ends."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable
from threading import Event, Thread
from types import TracebackType
from typing import Self

from sobolev_batch.batch.records import RunRecord, RunState, utc_now
from sobolev_batch.batch.store import Store

_log = logging.getLogger(__name__)

# Who reads the record knows from its age whether the driver still lives.
HEARTBEAT_SECONDS = 10.0


class Journal:
    """Tells a store that a run is going on, from where, and how it ended.

    Attributes:
        cluster: the address of the scheduler, once there is one.
        stage: what is being done.
        worry: asked at each beat, for what keeps the run from going on; empty while nothing does.
    """

    def __init__(self, store: Store) -> None:
        """Name the store."""
        self.cluster = ""
        self.stage = ""
        self.worry: Callable[[], str] = str
        self._store = store
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
            self.write("done")
        elif not self._is_replaced():
            self.write("failed", "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or repr(error))

    def _is_replaced(self) -> bool:
        """Whether another driver has taken over, as when this one's worker was retired: how that ends counts."""
        there = self._store.read_run()
        return there is not None and there.state == "running" and not there.driver.startswith(_process())

    def write(self, state: RunState, error: str = "") -> None:
        """Replace the store's record."""
        self._store.write_run(RunRecord(state, self._driver, self._started, utc_now(), self.stage, error))

    @property
    def _driver(self) -> str:
        return f"{_process()}, cluster {self.cluster}" if self.cluster else _process()

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_SECONDS):
            try:
                worry = self.worry()
                if worry:
                    _log.warning("%s: %s", self._store.path, worry)
                self.write("running", worry)
            except Exception as error:  # the store may answer again at the next beat
                _log.warning("the run's record could not be written: %s", error)


def _process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"
