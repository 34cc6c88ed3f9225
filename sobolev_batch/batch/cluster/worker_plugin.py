"""The backend and memory of each worker: found once when it starts, declared, and used by all its tasks."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from typing import Any

from distributed import Client, Worker, WorkerPlugin, get_worker
from distributed.core import Status

from sobolev_batch.batch.cluster.gpus import GpuLock, visible_devices
from sobolev_batch.batch.cluster.versions import require_same_versions
from sobolev_batch.batch.cluster.workers import GPU, MEMORY, WorkerInfo, Workers, allowed_bytes
from sobolev_batch.errors import BackendError, ClusterError
from sobolev_batch.spectral.backends.backends import CPU, Backend, gpu_backend
from sobolev_batch.spectral.transform.transform import slowness

_log = logging.getLogger(__name__)

_NAME = "sobolev-batch"
_SETUP_SECONDS = 0.05


class BackendPlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Plugin that finds a worker's backend when it starts, and declares its memory and its GPU to the scheduler.

    A worker takes at most one GPU, and only one that no other worker of its host has.

    Attributes:
        backend: Backend that the worker's tasks compute with.
        note: Name of the GPU, or the reason why there is none.
        allowed_bytes: Memory for all its tasks together.
    """

    idempotent = True

    def __init__(self) -> None:
        self.backend: Backend = CPU
        self.note = ""
        self.allowed_bytes = 0.0
        self._lock: GpuLock | None = None
        self._ready: asyncio.Event | None = None

    def __reduce__(self) -> tuple[type[BackendPlugin], tuple[()]]:
        # It travels to workers before it has found anything.
        return BackendPlugin, ()

    async def setup(self, worker: Worker) -> None:
        """Find the backend; in a thread, since loading CUDA takes seconds."""
        self._ready = asyncio.Event()
        self.allowed_bytes = allowed_bytes(worker.memory_manager.memory_limit)
        await asyncio.to_thread(self._find_backend)
        has_gpu = self.backend.name == "gpu"
        if _declares_gpu(worker) and not has_gpu:
            _log.warning("%s declares a GPU but computes on its CPU: %s", worker.address, self.note)
        await worker.set_resources(**{MEMORY: self.allowed_bytes}, **({GPU: 1} if has_gpu else {}))
        if worker.status == Status.running:
            # The scheduler looks for tasks that wait for resources only when a worker begins to run.
            worker.status = Status.paused
            worker.status = Status.running
        self._ready.set()

    async def describe(self, worker: Worker) -> WorkerInfo:
        """Return what the worker offers, once that is known."""
        while self._ready is None:
            await asyncio.sleep(_SETUP_SECONDS)
        await self._ready.wait()
        threads, backend = worker.state.nthreads, self.backend.name
        return WorkerInfo(worker.address, threads, self.allowed_bytes, backend, self.note, _declares_gpu(worker))

    def teardown(self, worker: Worker) -> None:
        """Release the GPU."""
        if self._lock is not None:
            self._lock.release()

    def _find_backend(self) -> None:
        lock = None
        try:
            devices = visible_devices()
            lock = GpuLock.acquire(devices)
            if lock is None:
                raise BackendError(f"no GPU left: other workers have all of the {len(devices)} that it may use")
            backend = gpu_backend()
            self.backend, self.note, self._lock = backend, backend.description, lock
        except BackendError as error:
            self.note = str(error)
            if lock is not None:
                lock.release()


def prepare_workers(client: Client, libraries: Iterable[str] = ()) -> Workers:
    """Install the plugin on the workers of a cluster, also on those that join later, and return what they offer.

    Args:
        client: Client of the cluster.
        libraries: Names of distributions that the study takes besides what this package requires.

    Raises:
        ClusterError: The cluster has no workers, or their versions differ from those here.
    """
    require_same_versions(client, libraries)
    client.register_plugin(BackendPlugin(), name=_NAME)
    answers = client.run(_describe, on_error="return")
    # A worker that is just leaving, or joining, does not count.
    members = tuple(answers[address] for address in sorted(answers) if isinstance(answers[address], WorkerInfo))
    if not members:
        raise ClusterError("the cluster has no workers; start some with: dask worker ADDRESS")
    return Workers(members)


def worker_slowness(client: Client, address: str) -> float:
    """Return how many times as long as predicted a transform takes on a worker; see `slowness`."""
    return float(client.run(_slowness, workers=[address])[address])


def worker_backend(choice: str) -> Backend:
    """Return the backend of the worker that runs this task; the CPU where the study chose that."""
    if choice == "cpu":
        return CPU
    try:
        plugins: dict[str, Any] = get_worker().plugins
    except ValueError:  # called outside a cluster
        return CPU
    return plugins[_NAME].backend if _NAME in plugins else CPU


async def _describe(dask_worker: Worker) -> WorkerInfo | None:
    plugin = dask_worker.plugins.get(_NAME)
    return None if plugin is None else await plugin.describe(dask_worker)


async def _slowness(dask_worker: Worker) -> float:
    # In a thread, or the worker would not answer meanwhile.
    return await asyncio.to_thread(slowness, dask_worker.plugins[_NAME].backend)


def _declares_gpu(worker: Worker) -> bool:
    return any(name.upper() == "GPU" for name in worker.state.total_resources)
