"""Clients of the clusters that studies run on: processes or threads of this machine, or any Dask scheduler.

Who reaches a scheduler can run programs on its machines, so its address has to be private.
"""

import asyncio
import os
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from ipaddress import IPv6Address, ip_address
from multiprocessing import current_process, resource_tracker
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed import Client, LocalCluster, Security
from distributed.comm import connect
from distributed.comm.addressing import get_address_host_port, parse_address

from sobolev_batch.batch.cluster import workers as workers_module
from sobolev_batch.errors import ClusterError, InputError, one_line
from sobolev_batch.machine import available_cores, machine_memory, require_machine_memory
from sobolev_batch.parameters import byte_count, format_bytes, is_whole_number

# In less, a worker with all its libraries has no memory left for any transform.
_LEAST_BYTES = 700_000_000
# Hardly any machine has more cores.
_MOST_WORKERS = 1024
# Dask has workers hand freed memory back at once, and the arrays of a task come and go: taking fresh memory
# for each took a third of the time of tables. What glibc may keep is bounded.
_KEPT_BYTES = 64 << 20
_LARGEST_KEPT_BYTES = 32 << 20
# After a worker has died, Dask looks once whether it is back, and gives it up for ever if it is just then
# being started again, as after a second death. Nannies start workers for as long as they live themselves.
_LOST_WORKER_SECONDS = 10**7


@contextmanager
def local_client(workers: int | None = None, memory: float | str | None = None) -> Iterator[Client]:
    """Give a client of a new cluster of single-threaded worker processes, reachable from this machine only.

    Its scheduler and workers demand certificates made for it, since other users reach loopback too. By default there is
    a worker for each core, and they share the memory equally; InputError where there is too little.
    """
    count = workers or available_cores()
    # Dask's own default knows no limit of an inner control group.
    limit = machine_memory()[0] // count if memory is None else memory_limit(memory, count)
    # Loopback is spelt out for the dashboard too: its own default is every interface.
    with (
        _shielded_from_interrupts() as unshield,
        _pointing_to_the_guard(),
        dask.config.set(
            {
                # A task whose worker died twice is set aside, and tried with nothing beside it.
                "distributed.scheduler.allowed-failures": 1,
                "distributed.worker.memory.pause": 0.9,
                # Sampling the stack of every worker a hundred times a second takes from the tasks.
                "distributed.worker.profile.enabled": False,
                # So does looking fifty times a second whether the loop of events answers, for as long as a run takes.
                "distributed.admin.tick.interval": "500ms",
                "distributed.worker.preload": [*dask.config.get("distributed.worker.preload"), workers_module.__name__],
                "distributed.deploy.lost-worker-timeout": _LOST_WORKER_SECONDS,
                "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
                "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": _LARGEST_KEPT_BYTES,
            }
        ),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=limit,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            security=Security.temporary(),
        ) as cluster,
        Client(cluster) as client,
        _ending_at_once(cluster),
    ):
        unshield()
        yield client


@contextmanager
def _pointing_to_the_guard() -> Iterator[None]:
    """Say what a script lacks whose workers run it once more: Dask ends with the failure of a process alone."""
    if getattr(current_process(), "_inheriting", False):
        # This is such a worker, while it starts. Its parent tells.
        raise SystemExit(1)
    try:
        yield
    except RuntimeError as error:
        if "Nanny failed to start" not in str(error):
            raise
        raise ClusterError(
            "no worker process could start; a script needs 'if __name__ == \"__main__\":' around its main part"
        ) from None


@contextmanager
def _ending_at_once(cluster: LocalCluster) -> Iterator[None]:
    """Kill the workers of a cluster when this process is asked to end.

    A worker in the midst of a transform does not answer when it is asked to close, and would be waited for.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        for nanny in cluster.workers.values():
            nanny.auto_restart = False
            if nanny.pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)
        raise


@contextmanager
def _shielded_from_interrupts() -> Iterator[Callable[[], object]]:
    """Keep Ctrl-C from processes that are started from now on, until the yielded function is called.

    A terminal sends it to all processes at once. The driver ends, and its cluster with it; workers would only print
    where they were. What the signal mask of a thread blocks is blocked in everything that it starts.
    """
    # It starts with the first process otherwise, and unblocks the signal in the thread that does that.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    restore = partial(signal.pthread_sigmask, signal.SIG_SETMASK, before)
    try:
        yield restore
    finally:
        restore()


@contextmanager
def thread_client(workers: int | None = None) -> Iterator[Client]:
    """Give a client of a new cluster of threads of this process, for a store that no other process can see."""
    # The protocol opens no port, but web pages of scheduler and worker would be open to all interfaces, and linked.
    link, count = "http://127.0.0.1:{port}/status", workers or available_cores()
    pages = dict.fromkeys(("dashboard_address", "worker_dashboard_address"), "127.0.0.1:0")
    with (
        dask.config.set({"distributed.worker.profile.enabled": False, "distributed.dashboard.link": link}),
        LocalCluster(n_workers=1, threads_per_worker=count, processes=False, protocol="inproc://", **pages) as cluster,
        Client(cluster) as client,
    ):
        yield client


def check_cluster(client: Client | None, workers: object, memory: object = None) -> None:
    """Refuse by an InputError a client that is of no use, processes to start beside it, and a wrong number of them."""
    if workers is not None and (not is_whole_number(workers) or not 1 <= workers <= _MOST_WORKERS):
        raise InputError(f"workers must be a whole number from 1 to {_MOST_WORKERS:,}, found {workers!r}")
    if client is not None:
        require_blocking(client)
        if workers is not None or memory is not None:
            raise InputError(
                "workers and memory are for processes that are started here, and those of a client have their own; "
                "leave them out, or the client"
            )


def require_blocking(client: Client) -> None:
    """Refuse by an InputError what is no client, and an asynchronous one, whose answers would have to be awaited."""
    if not isinstance(client, Client):
        raise InputError(f"client must be a dask.distributed.Client, found {client!r}; give Client(address)")
    if client.asynchronous:
        raise InputError(
            "the client is asynchronous, and studies wait for its answers; give a Client without asynchronous=True, "
            "which works in notebooks too, and call it in a thread of its own where an event loop must go on"
        )


def memory_limit(memory: float | str, workers: int) -> int:
    """Return the memory of each worker in bytes; refuse too little for one, or more than there is for all."""
    if (limit := byte_count(memory)) < _LEAST_BYTES:
        raise InputError(f"the memory of a worker must be at least {format_bytes(_LEAST_BYTES)}, found {memory!r}")
    require_machine_memory(limit, "the memory of a worker")
    require_machine_memory(workers * limit, f"the memory of {workers} workers", "for each, or take fewer")
    return limit


@contextmanager
def remote_client(address: str, trust_network: bool = False) -> Iterator[Client]:
    """Give a client of the scheduler at an address, for which it waits as long as Dask is set up to connect.

    The network has to be trusted where scheduler or workers are neither encrypted nor on loopback: whoever reaches
    their ports can run programs there and read the meshes. InputError where it is not, or the address is malformed;
    ClusterError where nothing answers there, or Dask's configuration does not fit.
    """
    require_private(address, "the scheduler", trust_network)
    seconds = parse_timedelta(dask.config.get("distributed.comm.timeouts.connect"))
    check_connection(address, seconds)
    try:
        client = Client(address, timeout=seconds)
    except (OSError, ValueError) as error:
        raise _unreachable(address, seconds, error) from error
    with client:
        if not (workers := client.scheduler_info(n_workers=-1)["workers"]):
            raise ClusterError(f"the scheduler at {address} has no workers; start some with: dask worker {address}")
        # An address on loopback may be one end of a tunnel.
        for worker in workers:
            require_private(worker, "a worker", trust_network)
        yield client


def require_private(name: str, who: str, trust_network: bool = False) -> None:
    """Check that nobody else reaches an address: it demands certificates, or is on loopback."""
    scheme, _ = parse_address(name)
    if scheme == "inproc":
        return
    try:
        host, port = get_address_host_port(name)
        if not host or not 0 < port < 65536:
            raise ValueError("it has no host, or a port out of range")
    except ValueError as error:
        raise InputError(f"{name!r} is not the address of a scheduler ({error}); one is tls://host:8786") from error
    if trust_network or scheme in ("tls", "wss"):
        return
    try:
        infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise ClusterError(f"no Dask scheduler answers at {name!r}: there is no host {host!r}") from error
    if beyond := [str(place[0]) for *_, place in infos if not _is_loopback(str(place[0]))]:
        raise InputError(
            f"{who} at {name} is neither encrypted nor on loopback ({beyond[0]}): everybody who reaches it "
            "could run programs on these machines and read the meshes. Use tls:// (docs/clusters.md), or "
            "--trust-network (in Python trust_network=True) where nobody else is on that network"
        )


def check_connection(address: str, seconds: float) -> None:
    """Shake hands with the scheduler at an address: Dask's client waits for ever for what listens and is none."""
    try:
        arguments = Security().get_connection_args("client")
        # In a thread: a notebook has a loop of its own running in this one.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(asyncio.run, _shake_hands(address, seconds, arguments)).result()
    except (OSError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        raise _unreachable(address, seconds, error) from error


async def _shake_hands(address: str, seconds: float, arguments: dict[str, Any]) -> None:
    # The handshake that follows on the connection has no limit of its own.
    async with asyncio.timeout(seconds + 1):
        comm = await connect(address, timeout=seconds, **arguments)
        await comm.close()


def _unreachable(address: str, seconds: float, error: BaseException) -> ClusterError:
    when = f" within {seconds:g} s" if isinstance(error, OSError) else ""
    causes = [one_line(cause) for cause in (error, error.__cause__) if cause is not None and str(cause)]
    return ClusterError(
        f"no Dask scheduler answers at {address!r}{when} "
        f"({'; '.join(causes) or 'something listens and says nothing'}); start one with: dask scheduler. One with "
        "certificates has an address tls://..., and its DASK_CONFIG is needed here (docs/clusters.md)"
    )


def _is_loopback(host: str) -> bool:
    address = ip_address(host)
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return (mapped or address).is_loopback
