"""The workers of a cluster: the memory and the backend of each, found once when it starts and used by all its tasks.

A worker with a GPU has it for itself on its host.

Before a study begins, all processes must have the same versions and see the same store.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from threading import Lock as ThreadLock

from distributed import Client, Worker, WorkerPlugin, get_worker
from distributed.core import Status
from distributed.versions import get_versions

from sobolev_batch.errors import BackendError, ClusterError, InputError, StoreError
from sobolev_batch.machine import machine_memory
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.parameters import format_bytes
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock
from sobolev_batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.transform.backends import CPU, INSTALL, Backend, Backends, gpu_backend
from sobolev_batch.transform.fourier import NUMERICS_VERSION, slowness
from sobolev_batch.visible import make_messages_visible

_log = logging.getLogger(__name__)

# Dask resources that tasks claim of a worker.
MEMORY = "sobolev-batch-memory"
GPU = "sobolev-batch-gpu"

# Dask pauses a worker near its memory limit and ends it there; an idle process with its libraries takes the constant.
_ALLOWED_FRACTION, _IDLE_BYTES = 0.85, 300e6
_MOST_NAMED = 4
_NAME = "sobolev-batch"
# Plugin and topic of workers that have other versions.
_KEPT_OUT = "sobolev-batch-kept-out"
_SETUP_SECONDS = 0.05

_VISIBLE = "CUDA_VISIBLE_DEVICES"
# The device of this process and its lock. There is one at most, as CUDA settles on those that it sees at its start.
_own: dict[str, socket.socket] = {}
_locking = ThreadLock()

_OF_DASK = ("dask", "distributed")
_OF_NUMBERS = ("cloudpickle", "sobolev-batch", "numpy", "scipy", "finufft", "zarr", "xarray")
# Not every study needs these. Processes that have them must have the same.
_OF_EXTRAS = ("fast-simplification", "pyacvd", "vtk")


@dataclass(frozen=True)
class WorkerInfo:
    """One worker; the note is the name of its GPU, or the reason why it computes on the CPU."""

    address: str
    threads: int
    allowed_bytes: float
    backend: str
    note: str


def allowed_bytes(limit: float | None) -> float:
    """Return the memory that tasks of a worker may take together, by its limit; without one, by the machine's."""
    total = machine_memory()[0]
    return _ALLOWED_FRACTION * min(limit or total, total) - _IDLE_BYTES


@dataclass(frozen=True)
class Workers:
    """All workers of a cluster at the time when a study begins."""

    members: tuple[WorkerInfo, ...]

    @classmethod
    def of_this_machine(cls, count: int) -> Workers:
        """Return the workers of a cluster that a run without a scheduler would start here."""
        return cls((WorkerInfo("this machine", 1, allowed_bytes(machine_memory()[0] / count), "cpu", ""),) * count)

    @property
    def threads(self) -> int:
        """Number of tasks that run at once."""
        return sum(member.threads for member in self.members)

    @property
    def smallest(self) -> Workers:
        """The worker with the least memory for a task, with one thread: what any of them can do by itself."""
        return Workers((WorkerInfo("any worker", 1, self.allowed_bytes_per_task, "cpu", ""),))

    @cached_property
    def allowed_bytes_per_task(self) -> float:
        """Memory that every task may take while all threads of every worker are busy."""
        return min(member.allowed_bytes / member.threads for member in self.members)

    @cached_property
    def largest_allowed_bytes(self) -> float:
        """Memory that a task may take alone on the worker with the most."""
        return max(member.allowed_bytes for member in self.members)

    def require_memory(self, projected_bytes: float) -> None:
        """Check that a task fits into a worker."""
        if projected_bytes > self.largest_allowed_bytes:
            raise ClusterError(
                f"it takes about {format_bytes(projected_bytes)} in one task, and no worker has more than "
                f"{format_bytes(self.largest_allowed_bytes)} for tasks (of its limit it keeps 15 % and 0.3 GB for "
                "itself); start workers with more memory"
            )

    def require_accuracy(self, accuracy: Accuracy | None) -> None:
        """Check that the workers have the memory that a study allows for a transform."""
        largest = max(self.members, key=lambda member: member.allowed_bytes)
        limit = (largest.allowed_bytes + _IDLE_BYTES) / _ALLOWED_FRACTION
        if accuracy is not None and accuracy.asks_for_memory and accuracy.allowed_bytes > limit:
            raise InputError(
                f"[accuracy]: memory of {format_bytes(accuracy.allowed_bytes)} is more than any worker has: "
                f"{format_bytes(limit)} on {largest.address}; ask for less, or start workers with more"
            )

    def with_backend(self, backend: Backends) -> Workers:
        """Return the workers that can serve a study with this backend."""
        if backend != "gpu":
            return self
        if not (members := tuple(member for member in self.members if member.backend == "gpu")):
            reasons = "; ".join(f"{member.address}: {member.note}" for member in self.members[:_MOST_NAMED])
            raise ClusterError(
                f"the study requests backend 'gpu', and none of the {len(self.members)} workers can compute on one. "
                f"{reasons}{'; ...' if len(self.members) > _MOST_NAMED else ''}. "
                "Start a worker on a machine with an NVIDIA GPU and the extra gpu, or ask for backend 'auto'"
            )
        return Workers(members)


class BackendPlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Plugin that finds a worker's backend when it starts, and declares its memory and its GPU to the scheduler.

    A worker takes at most one GPU, and only one that no other worker of its host has.
    """

    idempotent = True
    # It travels to workers before it has found any of these.
    backend: Backend = CPU
    info: WorkerInfo | None = None
    _device: str | None = None

    async def setup(self, worker: Worker) -> None:
        """Find the backend; in a thread, since loading CUDA takes seconds."""
        allowed = allowed_bytes(worker.memory_manager.memory_limit)
        note = await asyncio.to_thread(self._find_backend, worker)
        name = self.backend.name
        await worker.set_resources(**{MEMORY: allowed}, **({GPU: 1} if name == "gpu" else {}))
        if worker.status == Status.running:
            # The scheduler looks for tasks that wait for resources only when a worker begins to run.
            worker.status = Status.paused
            worker.status = Status.running
        self.info = WorkerInfo(worker.address, worker.state.nthreads, allowed, name, note)

    def teardown(self, worker: Worker) -> None:
        """Release the GPU."""
        if self._device is not None:
            release_gpu(self._device)
            self._device = None

    def _find_backend(self, worker: Worker) -> str:
        """Find the backend, and return the name of its GPU, or why there is none."""
        try:
            devices = visible_devices()
            self._device = lock_gpu(devices)
            if self._device is None:
                raise BackendError(f"no GPU left: other workers have all of the {len(devices)} that it may use")
            self.backend = gpu_backend()
        except BackendError as error:
            self.teardown(worker)
            return str(error)
        return self.backend.description


class VersionPlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Plugin that keeps a worker out that joins later with other versions than those of the study.

    A worker sets its plugins up before it hears of any task. One without this package fails to, and ends.
    """

    def __init__(self, required: Sequence[str], ours: Mapping[str, str]) -> None:
        self.required, self.ours = tuple(required), dict(ours)

    async def setup(self, worker: Worker) -> None:
        """Compare the versions; where they differ, say so, take no task, and leave."""
        found = _packages(get_versions([*self.required[1:], *_OF_EXTRAS])) | _checkout()
        if not (differing := _differing(found, self.ours, self.required)):
            return
        listed = ", ".join(f"{name} {version or 'is missing'}" for name, version in differing.items())
        expected = ", ".join(f"{name} {self.ours[name]}" for name in differing)
        reason = (
            f"the worker {worker.address} is kept out, since results would mix what other versions compute: it has "
            f"{listed}; the study that began on its cluster has {expected}. Install the same, or start the scheduler "
            "again for another study"
        )
        _log.error(reason)
        worker.log_event(_KEPT_OUT, reason)
        # From now on it neither begins a task nor is given one.
        worker.status = Status.closing_gracefully
        worker.loop.add_callback(worker.scheduler.retire_workers, workers=[worker.address], close_workers=True)


def prepare_workers(client: Client, libraries: Iterable[str] = ()) -> Workers:
    """Install the plugins on the workers of a cluster, also on those that join later, and return what they offer."""
    await_a_worker(client)
    client.subscribe_topic(_KEPT_OUT, lambda event: _log.warning("%s", event[1]))
    client.register_plugin(VersionPlugin(*require_same_versions(client, libraries)), name=_KEPT_OUT)
    client.register_plugin(BackendPlugin(), name=_NAME)
    while True:
        answers = client.run(_describe, on_error="return")
        # A worker that is just leaving, or joining, does not count.
        if members := tuple(answers[one] for one in sorted(answers) if isinstance(answers[one], WorkerInfo)):
            return Workers(members)
        if answers.keys() & client.scheduler_info(n_workers=-1)["workers"].keys():
            raise ClusterError("the cluster has no workers; start some with: dask worker ADDRESS")
        # An adaptive cluster has retired those that it had.
        await_a_worker(client)


def await_a_worker(client: Client) -> None:
    """Wait until a cluster has a worker, which an adaptive one starts for a task that waits."""
    if not client.scheduler_info(n_workers=-1)["workers"]:
        _log.warning("the cluster at %s has no worker yet; waiting for one to start", client.scheduler.address)
        client.submit(abs, 0, pure=False).result()


def worker_slowness(client: Client, address: str) -> float:
    """Return how many times as long as predicted a transform takes on a worker; see `slowness`."""
    return float(client.run(_slowness, workers=[address])[address])


def this_worker() -> Worker | None:
    """Return the worker that runs this task; None outside a cluster."""
    with suppress(ValueError):
        return get_worker()
    return None


def worker_backend(choice: str) -> Backend:
    """Return the backend of the worker that runs this task; the CPU where the study chose that."""
    worker = None if choice == "cpu" else this_worker()
    return CPU if worker is None else worker.plugins.get(_NAME, BackendPlugin).backend


async def _describe(dask_worker: Worker) -> WorkerInfo | None:
    """Return what a worker offers, once that is known; None where it is just leaving or joining."""
    plugin = dask_worker.plugins.get(_NAME)
    while plugin is not None and plugin.info is None:
        await asyncio.sleep(_SETUP_SECONDS)
    info: WorkerInfo | None = plugin and plugin.info
    return info


async def _slowness(dask_worker: Worker) -> float:
    # In a thread, or the worker would not answer meanwhile.
    return await asyncio.to_thread(slowness, dask_worker.plugins[_NAME].backend)


def require_same_versions(client: Client, libraries: Iterable[str] = ()) -> tuple[tuple[str, ...], dict[str, str]]:
    """Check that the scheduler and all workers have installed what this process has; return the names and versions."""
    required = ("python", *_OF_DASK, *_OF_NUMBERS, *libraries, *_checkout())
    # Dask answers this itself: code of ours would not run where the package is missing.
    answers = client.get_versions(packages=[*required[1:], *_OF_EXTRAS])
    # One checkout may follow another without a new version.
    checkouts = client.run(_checkout, on_error="return")
    ours = _packages(answers["client"]) | _checkout()
    processes = {f"scheduler {client.scheduler.address}": _differing(_packages(answers["scheduler"]), ours, _OF_DASK)}
    for address, answer in answers["workers"].items():
        if answer:  # a worker that is just leaving answers nothing
            checkout = checkouts.get(address)
            found = _packages(answer) | (checkout if isinstance(checkout, dict) else _checkout())
            processes[f"worker {address}"] = _differing(found, ours, required)
    differing = defaultdict(list)
    for process in sorted(processes):
        for name, version in processes[process].items():
            differing[name, version].append(process)
    if differing:
        differences = (
            f"{name} {version or 'is missing'} at the {who[0]}{f' and {len(who) - 1} more' if who[1:] else ''}, "
            f"{f'{ours[name]} here' if ours[name] else 'there is none here'}"
            for (name, version), who in differing.items()
        )
        raise ClusterError(
            f"versions differ, and results would mix what they compute: {'; '.join(differences)}. "
            "Install the same ones everywhere and start those processes again"
        )
    return required, ours


def _differing(found: Mapping[str, str], ours: Mapping[str, str], required: Iterable[str]) -> dict[str, str]:
    """Return what a process has in another version than this one, or lacks; extras count where both have them."""
    names = (*required, *(name for name in _OF_EXTRAS if ours[name] and found.get(name)))
    return {name: found[name] for name in names if found[name] != ours[name]}


def _packages(answer: Mapping[str, Mapping[str, str | None]]) -> dict[str, str]:
    versions = {name: version or "" for name, version in answer["packages"].items()}
    return {**versions, "python": ".".join(versions["python"].split(".")[:2])}


def _checkout() -> dict[str, str]:
    return {"numerics of sobolev-batch": str(NUMERICS_VERSION), "schema of sobolev-batch": str(SCHEMA_VERSION)}


def lock_gpu(devices: Sequence[str]) -> str | None:
    """Lock the first device that no other process of this host has, and make it the only visible one.

    The device belongs to this process until it ends or releases it. The lock is a socket bound to a name that Linux
    keeps in memory: it is exclusive, needs no permissions, leaves no file, and ends with the process however that ends.
    Containers share it if they share the host's network; a file is no better, since their temporary folders are theirs.

    Return None where all are locked or this process has one already.
    """
    with _locking:
        for device in () if _own else devices:
            name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                name.bind(f"\0sobolev-batch/{device}")
            except OSError:
                name.close()
                continue
            _own[device] = name
            os.environ[_VISIBLE] = device
            return device
    return None


def release_gpu(device: str) -> None:
    """Let another process have a device that this process has locked."""
    _own.pop(device).close()


def visible_devices() -> tuple[str, ...]:
    """Return the UUIDs of the GPUs that this process may use: those of CUDA_VISIBLE_DEVICES, or all of the host.

    CUDA itself is not started: it would settle on its devices for good.
    """
    try:
        import pynvml
    except ImportError as error:
        raise BackendError(f"no GPU: nvidia-ml-py, which lists them, is not installed: {INSTALL}") from error
    try:
        pynvml.nvmlInit()
        count = pynvml.nvmlDeviceGetCount()
        uuids = [str(pynvml.nvmlDeviceGetUUID(pynvml.nvmlDeviceGetHandleByIndex(i))) for i in range(count)]
    except pynvml.NVMLError_LibraryNotFound as error:
        raise BackendError("no GPU: the NVIDIA driver is not installed on this machine") from error
    except pynvml.NVMLError as error:
        raise BackendError(f"no GPU: the NVIDIA driver says: {error}") from error
    visible = os.environ.get(_VISIBLE)
    devices = tuple(uuids) if visible is None else chosen_devices(visible, uuids)
    if not devices:
        reason = f"CUDA_VISIBLE_DEVICES={visible} hides all {count}" if count else "the NVIDIA driver sees none"
        raise BackendError(f"no GPU: {reason}")
    return devices


def chosen_devices(visible: str, uuids: Sequence[str]) -> tuple[str, ...]:
    """Return the devices that a value of CUDA_VISIBLE_DEVICES names, up to the first entry that is no device."""
    known = {**{str(number): uuid for number, uuid in enumerate(uuids)}, **{uuid: uuid for uuid in uuids}}
    entries = map(str.strip, visible.split(","))
    named = (known.get(entry, entry if entry.startswith("MIG-") else "") for entry in entries)
    return tuple(dict.fromkeys(takewhile(bool, named)))


def require_store_access(client: Client, location: Location, lock: Lock) -> None:
    """Check that all workers see the store that this process has locked.

    Drivers and credentials differ between processes: a store that this process reaches, a worker may not. And a
    folder of the same name may be another folder on another machine.

    Raises:
        StoreError: A worker does not see it; the message names the worker.
    """
    await_a_worker(client)
    for worker, problem in client.run(_problem, location, lock, on_error="return").items():
        if isinstance(problem, BaseException):
            # A worker that has just gone says nothing about the store; tasks will tell.
            _log.warning("the worker %s does not say whether it reaches %s: %s", worker, location, problem)
        elif problem and location.is_in_memory:
            raise StoreError(
                f"{location}: what is written there stays in the memory of one process, and the worker {worker} is "
                "another one; name a folder or an s3:// URL, or leave out the client"
            )
        elif problem:
            raise StoreError(f"the worker {worker} cannot use the store: {problem}")


def _problem(location: Location, lock: Lock) -> str:
    """Return why the process that runs this does not see the store; empty if it does."""
    try:
        return "" if lock.is_held(location) else f"{location} is another place there; name one that all machines share"
    except StoreError as error:
        return str(error)


def dask_setup(worker: Worker) -> None:
    """Make messages of this worker visible, and leave out Dask's: the driver reports what went wrong.

    Dask calls this in each worker of a local cluster when it starts. Its messages go to the terminal of the driver.
    """
    make_messages_visible()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
