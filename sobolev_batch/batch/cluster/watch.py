"""The watch over a cluster: it reports what keeps a run from going on, and ends a run whose scheduler stays silent.

A process that was stopped, or whose machine hangs, keeps its connections open and says nothing. Dask gives up such a
worker after the time ``distributed.scheduler.worker-ttl``. For such a scheduler, a run would wait for ever.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed import CancelledError, Client
from distributed.comm import CommClosedError

from sobolev_batch.batch.cluster.workers import GPU
from sobolev_batch.errors import ClusterError

_log = logging.getLogger(__name__)

# A silence is told after this time. Workers tell of themselves every half a second, among thousands every half a
# minute.
_TELL_AFTER_SECONDS = 30.0
_POLL_SECONDS = 5.0
_MOST_NAMED = 4

# When a process was last heard of, the time from which on it has said nothing, and the seconds since. The first is
# compared with nothing else: clocks differ, and this process may itself be stopped for a while, in which it hears
# nobody.
_Silence = tuple[object, str, float]


class Watch:
    """A watch over the cluster of a run, in a thread of its own.

    Attributes:
        obstacle: What keeps the run from going on, for people; empty if nothing does.
    """

    def __init__(self, client: Client, needs_gpu: bool = False) -> None:
        self.obstacle = ""
        self._client, self._needs_gpu = client, needs_gpu
        # A scheduler gets as long as it gives to its workers; without a limit, for ever.
        limit = dask.config.get("distributed.scheduler.worker-ttl")
        self._patience_seconds = parse_timedelta(limit) if limit else math.inf
        self._address = str(client.scheduler.address)
        self._workers: dict[str, _Silence] = {}
        self._scheduler = _silence(None)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look_out, name="sobolev-batch-watch", daemon=True)

    @contextmanager
    def kept(self) -> Iterator[Watch]:
        """Keep the watch; ClusterError where the scheduler was silent for too long."""
        self._thread.start()
        try:
            yield self
        except (OSError, CommClosedError, CancelledError, TimeoutError) as error:
            if not self._has_lost_scheduler:
                raise
            raise ClusterError(
                f"{self._silent_scheduler()}, and was given up; the same command goes on from what is stored"
            ) from error
        finally:
            self._ended.set()
            # It may wait for an answer of the cluster.
            self._thread.join(2 * _POLL_SECONDS)

    @property
    def _has_lost_scheduler(self) -> bool:
        return self._scheduler[2] > self._patience_seconds

    def _look_out(self) -> None:
        before = time.monotonic()
        while not self._has_lost_scheduler and not self._ended.wait(_POLL_SECONDS):
            now = time.monotonic()
            # More has passed only if this process was stopped too.
            elapsed, before = min(now - before, 2 * _POLL_SECONDS), now
            try:
                obstacle = self._look(elapsed)
            except Exception as error:  # a cluster that is closing does not answer, but the run is alive
                _log.debug("the cluster could not be asked: %r", error)
                continue
            if obstacle != self.obstacle and obstacle:
                _log.warning("%s", obstacle)
            self.obstacle = obstacle

    def _look(self, elapsed: float) -> str:
        try:
            workers = self._ask("identity", n_workers=-1)["workers"]
        except TimeoutError:
            self._scheduler = _silence(None, self._scheduler, elapsed)
            if self._has_lost_scheduler:
                # What waits for its answer wakes up, as if it had ended.
                self._client.loop.add_callback(self._hang_up)
            return self._silent_scheduler() if self._scheduler[2] > _TELL_AFTER_SECONDS else ""
        self._scheduler = _silence(None)
        self._workers = {
            address: _silence(worker["last_seen"], self._workers.get(address), elapsed)
            for address, worker in workers.items()
        }
        silent = {name: since for name, (_, since, seconds) in self._workers.items() if seconds > _TELL_AFTER_SECONDS}
        if silent:
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
            labels = list(dict.fromkeys(_label_of(key) for key in tasks.get(address, ())))
            more = f" and {len(labels) - _MOST_NAMED} more" if len(labels) > _MOST_NAMED else ""
            held = f", and has {', '.join(labels[:_MOST_NAMED])}{more}" if labels else ""
            told.append(f"the worker {address} has said nothing since {since}{held}")
        if len(silences) > _MOST_NAMED:
            told.append(f"and {len(silences) - _MOST_NAMED} more workers have")
        return f"{'; '.join(told)}. Dask gives up whoever stays silent (worker-ttl), and others get the tasks"

    def _silent_scheduler(self) -> str:
        return f"the scheduler at {self._address} has said nothing since {self._scheduler[1]}"

    def _hang_up(self) -> None:
        self._client.rpc.remove(self._address)
        self._client.scheduler_comm.comm.abort()

    def _ask(self, operation: str, **arguments: Any) -> Any:
        """Return what the scheduler answers within some seconds."""
        return self._client.sync(
            getattr(self._client.scheduler, operation), callback_timeout=_POLL_SECONDS, **arguments
        )


def _silence(heard: object, before: _Silence | None = None, elapsed: float = 0.0) -> _Silence:
    """Return the silence of a process after some time; it ends if the process was heard of since."""
    if before is not None and before[0] == heard:
        return heard, before[1], before[2] + elapsed
    return heard, f"{datetime.now(UTC):%H:%M:%S} UTC", 0.0


def _label_of(key: object) -> str:
    """Return what a task works for; see `task_key`."""
    return str(key[1]) if isinstance(key, tuple) and len(key) == 3 else "a task of something else"
