"""What each worker computes with: found out once when it starts, reported, and used by all its tasks."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from typing import Any

from distributed import Client, Worker, WorkerPlugin, get_worker
from distributed.core import Status

from sobolev_batch.batch.cluster.gpus import Claim, claim_device, visible_devices
from sobolev_batch.batch.cluster.versions import guarded, require_same_versions
from sobolev_batch.batch.cluster.workers import GPU, MEMORY, WorkerInfo, Workers, spare_bytes
from sobolev_batch.errors import BackendError, ClusterError
from sobolev_batch.spectral.backends.backends import CPU, Backend, gpu_backend

_log = logging.getLogger(__name__)

_NAME = "sobolev-batch"
_GUARD = "sobolev-batch-versions"
_SETUP_SECONDS = 0.05


class Equipment(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Finds a worker's backend when it starts, and declares its memory and its GPU to the scheduler.

    A worker takes at most one GPU, and only one that no other worker of its host has.

    Attributes:
        backend: what the worker's tasks compute with.
        note: the GPU's name, or why there is none.
        spare_bytes: of memory, for all its tasks together.
    """

    idempotent = True

    def __init__(self) -> None:
        self.backend: Backend = CPU
        self.note = ""
        self.spare_bytes = 0.0
        self._claim: Claim | None = None
        self._ready: asyncio.Event | None = None

    def __reduce__(self) -> tuple[type[Equipment], tuple[()]]:
        # It travels to workers before it has found anything.
        return Equipment, ()

    async def setup(self, worker: Worker) -> None:
        """Find out what is there; in a thread, since loading CUDA takes seconds."""
        self._ready = asyncio.Event()
        self.spare_bytes = spare_bytes(worker.memory_manager.memory_limit)
        await asyncio.to_thread(self._find_backend)
        declared = [name for name in worker.state.total_resources if name.upper() == "GPU"]
        if declared and self.backend.name != "gpu":
            _log.warning("%s declares a GPU but computes on its CPU: %s", worker.address, self.note)
        resources = {MEMORY: self.spare_bytes} | ({GPU: 1} if self.backend.name == "gpu" else {})
        await worker.set_resources(**resources)
        if worker.status == Status.running:
            # The scheduler looks for tasks that wait for resources only when a worker begins to run.
            worker.status = Status.paused
            worker.status = Status.running
        self._ready.set()

    async def found(self) -> tuple[float, str, str]:
        """Spare memory, backend and note, once they are known."""
        while self._ready is None:
            await asyncio.sleep(_SETUP_SECONDS)
        await self._ready.wait()
        return self.spare_bytes, self.backend.name, self.note

    def teardown(self, worker: Worker) -> None:
        """Let go of the GPU."""
        if self._claim is not None:
            self._claim.release()

    def _find_backend(self) -> None:
        claim = None
        try:
            devices = visible_devices()
            claim = claim_device(devices)
            if claim is None:
                raise BackendError(f"no GPU left: other workers have all of the {len(devices)} that it may use")
            backend = gpu_backend()
            self.backend, self.note, self._claim = backend, backend.description, claim
        except BackendError as error:
            self.note = str(error)
            if claim is not None:
                claim.release()


def enlist(client: Client, needed: Iterable[str] = ()) -> Workers:
    """Equip the workers of a cluster, those that join later too, and tell what they offer.

    Args:
        client: of the cluster.
        needed: names of distributions that the study takes besides what this package requires.

    Raises:
        ClusterError: there are no workers, or versions there and here differ.
    """
    require_same_versions(client, needed)
    client.register_plugin(guarded(Equipment(), _NAME), name=_GUARD)
    answers = client.run(_describe, on_error="return")
    # One that is just leaving, or joining, counts as not there.
    found = {address: parts for address, parts in answers.items() if isinstance(parts, tuple)}
    if not found:
        raise ClusterError("the cluster has no workers; start some with: dask worker ADDRESS")
    return Workers(tuple(WorkerInfo(address, *parts) for address, parts in sorted(found.items())))


def worry_about(client: Client, backend: str) -> str:
    """What a study is waiting for that its cluster does not have any more; empty while it has."""
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    if not workers:
        return "no worker is left; waiting for one to start"
    if backend == "gpu" and not any(worker["resources"].get(GPU) for worker in workers):
        return "no worker with a GPU is left, and the study asks for one; waiting for one to start"
    return ""


async def _describe(dask_worker: Worker) -> tuple[int, float, str, str, bool] | None:
    equipment = dask_worker.plugins.get(_NAME)
    if equipment is None:
        return None
    declares = any(name.upper() == "GPU" for name in dask_worker.state.total_resources)
    return dask_worker.state.nthreads, *await equipment.found(), declares


def backend_of(wanted: str) -> Backend:
    """The backend of the worker that this task runs on; the CPU where a study wants that."""
    if wanted == "cpu":
        return CPU
    try:
        plugins: dict[str, Any] = get_worker().plugins
    except ValueError:  # called outside a cluster
        return CPU
    return plugins[_NAME].backend if _NAME in plugins else CPU
