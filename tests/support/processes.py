"""Schedulers and workers, started as users start them."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import TypeVar

import psutil
from dask import config as dask_config
from distributed import Client

T = TypeVar("T")

SCHEDULER = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
# Limit of every wait for another process, for a machine that does much else: nothing is to depend on it.
PATIENCE_SECONDS = 200
_POLL_SECONDS = 0.02
# A worker's own HTTP server listens on every interface unless told otherwise, --no-dashboard or not.
WORKER = ["--host", "127.0.0.1", "--nthreads", "1", "--dashboard-address", "127.0.0.1:0", "--no-nanny"]


def wait_until(condition: Callable[[], T]) -> T:
    """Return the first true value of a condition, which other processes make true."""
    started = time.monotonic()
    while not (value := condition()):
        assert time.monotonic() - started < PATIENCE_SECONDS, "it did not come true"
        time.sleep(_POLL_SECONDS)
    return value


def dask(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "dask", *arguments], stderr=subprocess.PIPE, text=True)


def stop(process: subprocess.Popen[str]) -> None:
    """End a process, by force if need be: one that was stopped hears nothing, and a worker may wait for a lost peer."""
    with suppress(psutil.NoSuchProcess):
        is_stopped = psutil.Process(process.pid).status() == psutil.STATUS_STOPPED
        (process.kill if is_stopped else process.terminate)()
    try:
        process.communicate(timeout=PATIENCE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listening(*pids: int) -> set[tuple[str, int]]:
    """Return the addresses at which processes, and all that they started, take connections."""
    everyone = [psutil.Process(pid) for pid in pids]
    everyone += [child for process in everyone for child in process.children(recursive=True)]
    return {
        (connection.laddr.ip, connection.laddr.port)
        for process in everyone
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }


def scheduler_address(scheduler: subprocess.Popen[str]) -> str:
    assert scheduler.stderr is not None
    return next(match[0] for line in scheduler.stderr if (match := re.search(r"(?:tcp|tls)://127\.0\.0\.1:\d+", line)))


def with_certificates(client: Client) -> AbstractContextManager[None]:
    """Let commands of this process reach the cluster of a client that has certificates."""
    security = client.security
    files = {"ca-file": security.tls_ca_file, "client.cert": security.tls_client_cert}
    files["client.key"] = security.tls_client_key
    of_client: AbstractContextManager[None] = dask_config.set(
        {f"distributed.comm.tls.{name}": content for name, content in files.items()}
    )
    return of_client


@contextmanager
def tcp_cluster(*workers: list[str]) -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """Give the address of a scheduler, and its process before those of workers with further options; all end."""
    processes = [dask(*SCHEDULER)]
    try:
        address = scheduler_address(processes[0])
        processes += [dask("worker", address, *WORKER, *options) for options in workers]
        if workers:
            with Client(address) as client:
                client.wait_for_workers(len(workers), timeout=PATIENCE_SECONDS)
        yield address, processes
    finally:
        for process in reversed(processes):
            stop(process)
