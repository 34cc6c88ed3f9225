"""Processes that are killed all through a run: workers, and the process that drives it."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable

import psutil


class Havoc:
    """Kills worker processes of this process's cluster, and a driver, at requests to the storage that a seed chooses.

    It counts requests rather than seconds, so that the kills are spread over the work, however long that
    takes; and it strikes while a request is under way. One worker is left each time: a run on a cluster
    that has none does not begin.

    Args:
        seed: Seed of the choice among requests and workers.
        requests: Numbers of the requests among which the kills come.
        kills, driver_kills: Number of kills of workers and of drivers.
        workers: Function that returns the ids of the cluster's worker processes, whether they are alive or not.
        known: Function that returns how many of them its scheduler knows.

    Attributes:
        workers, drivers: Numbers of workers and drivers that were killed.
    """

    def __init__(
        self,
        seed: int,
        requests: range,
        kills: int,
        driver_kills: int,
        workers: Callable[[], list[int]],
        known: Callable[[], int],
    ) -> None:
        self.workers = self.drivers = 0
        self._random = random.Random(seed)
        chosen = self._random.sample(requests, kills + driver_kills)
        self._workers_due, self._drivers_due = deque(sorted(chosen[:kills])), deque(sorted(chosen[kills:]))
        self._pids, self._known = workers, known
        self._driver: subprocess.Popen[str] | None = None
        self._requests = 0
        self._lock = threading.Lock()

    def drive(self, driver: subprocess.Popen[str]) -> None:
        """Name the process that drives the run from now on."""
        with self._lock:
            self._driver = driver

    def on_request(self) -> None:
        """Kill whoever is due."""
        with self._lock:
            self._requests += 1
            # Who is not there yet is killed with a later request.
            if self._is_due(self._drivers_due) and self._driver is not None and self._driver.poll() is None:
                self._driver.kill()
                self._driver = None
                self.drivers += 1
                self._drivers_due.popleft()
            if self._is_due(self._workers_due):
                pids = sorted(self._pids())
                if self._known() == len(pids) and all(map(_is_alive, pids)):
                    os.kill(self._random.choice(pids), signal.SIGKILL)
                    self.workers += 1
                    self._workers_due.popleft()

    def _is_due(self, plan: deque[int]) -> bool:
        return bool(plan) and plan[0] <= self._requests


def _is_alive(pid: int) -> bool:
    return pid > 0 and psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
