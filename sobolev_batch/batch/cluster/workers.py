"""The workers of a cluster: how many tasks they run at once, in how much memory, with which backend."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from sobolev_batch.batch.study.schema import Backends
from sobolev_batch.errors import ClusterError, InputError
from sobolev_batch.machine import MachineMemory
from sobolev_batch.parameters import format_bytes
from sobolev_batch.spectral.adaptive.tolerance import Accuracy

# Dask resources that tasks claim of a worker.
MEMORY = "sobolev-batch-memory"
GPU = "sobolev-batch-gpu"

# Dask pauses a worker near its memory limit and ends it at the limit; an idle process with its libraries takes
# the constant.
_ALLOWED_FRACTION, _IDLE_BYTES = 0.85, 300e6
_MOST_NAMED = 4


@dataclass(frozen=True)
class WorkerInfo:
    """One worker.

    Attributes:
        address: Address of the worker.
        threads: Number of tasks that it runs at once.
        allowed_bytes: Memory that all its tasks together may take.
        backend: "cpu" or "gpu".
        note: Name of the GPU, or the reason why the worker computes on the CPU.
        declares_gpu: True where the worker was started with a resource GPU.
    """

    address: str
    threads: int
    allowed_bytes: float
    backend: str
    note: str
    declares_gpu: bool = False


def allowed_bytes(limit: float | None) -> float:
    """Return the memory that tasks of a worker may take together.

    Args:
        limit: Memory limit of the worker; without one, the machine's memory, which no limit can exceed.
    """
    total = MachineMemory.detect().total_bytes
    return _ALLOWED_FRACTION * min(limit or total, total) - _IDLE_BYTES


@dataclass(frozen=True)
class Workers:
    """All workers of a cluster at the time when a study begins."""

    members: tuple[WorkerInfo, ...]

    @classmethod
    def of_this_machine(cls, count: int) -> Workers:
        """Return the workers of a cluster that a run without a scheduler would start here."""
        allowed = allowed_bytes(MachineMemory.detect().total_bytes / count)
        return cls((WorkerInfo("this machine", 1, allowed, "cpu", ""),) * count)

    @property
    def threads(self) -> int:
        """Number of tasks that run at once."""
        return sum(member.threads for member in self.members)

    @cached_property
    def allowed_bytes_per_task(self) -> float:
        """Memory that every task may take while all threads of every worker are busy."""
        return min(member.allowed_bytes / member.threads for member in self.members)

    @cached_property
    def largest_allowed_bytes(self) -> float:
        """Memory that a task may take alone on the worker with the most."""
        return max(member.allowed_bytes for member in self.members)

    def require_memory(self, projected_bytes: float) -> None:
        """Check that a task fits into a worker.

        Raises:
            ClusterError: No worker has the memory.
        """
        if projected_bytes > self.largest_allowed_bytes:
            raise ClusterError(
                f"it takes about {format_bytes(projected_bytes)} in one task, and no worker has more than "
                f"{format_bytes(self.largest_allowed_bytes)} for tasks (of its limit it keeps 15 % and 0.3 GB for "
                "itself); start workers with more memory"
            )

    def require_accuracy(self, accuracy: Accuracy | None) -> None:
        """Check that the workers have the memory that a study allows for a transform.

        Raises:
            InputError: The largest worker has less, in all.
        """
        largest = max(self.members, key=lambda member: member.allowed_bytes)
        limit = (largest.allowed_bytes + _IDLE_BYTES) / _ALLOWED_FRACTION
        if accuracy is not None and accuracy.asks_for_memory and accuracy.allowed_bytes > limit:
            raise InputError(
                f"[accuracy]: memory of {format_bytes(accuracy.allowed_bytes)} is more than any worker has: "
                f"{format_bytes(limit)} on {largest.address}; ask for less, or start workers with more"
            )

    def with_backend(self, backend: Backends) -> Workers:
        """Return the workers that can serve a study with this backend.

        Raises:
            ClusterError: The study asks for a GPU, and no worker has one.
        """
        if backend != "gpu":
            return self
        members = tuple(member for member in self.members if member.backend == "gpu")
        if not members:
            reasons = "; ".join(
                f"{member.address}{' (declares a GPU)' if member.declares_gpu else ''}: {member.note}"
                for member in self.members[:_MOST_NAMED]
            )
            raise ClusterError(
                f"the study asks for backend 'gpu', and none of the {len(self.members)} workers can compute on one. "
                f"{reasons}{'; ...' if len(self.members) > _MOST_NAMED else ''}. "
                "Start a worker on a machine with an NVIDIA GPU and the extra gpu, or ask for backend 'auto'"
            )
        return Workers(members)
