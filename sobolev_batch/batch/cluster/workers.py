"""The workers of a cluster: how many tasks they take at once, in how much memory, with which backend."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import psutil

from sobolev_batch.batch.study.schema import Backends
from sobolev_batch.errors import ClusterError

# Names of what tasks ask of a worker, in Dask's words its resources.
MEMORY = "sobolev-batch-memory"
GPU = "sobolev-batch-gpu"


@dataclass(frozen=True)
class WorkerInfo:
    """One worker.

    Attributes:
        address: where it is.
        threads: tasks that it runs at once.
        spare_bytes: memory for all its tasks together.
        backend: "cpu" or "gpu".
        note: the GPU's name, or why it computes on the CPU.
        declares_gpu: whether it was started with a resource GPU.
    """

    address: str
    threads: int
    spare_bytes: float
    backend: str
    note: str
    declares_gpu: bool = False


# Of a worker's memory limit, what tasks may take together: Dask pauses a worker near its limit and
# ends it at it, and an idle process with its libraries takes the constant part.
_USABLE, _IDLE_BYTES = 0.85, 300e6


def spare_bytes(limit: float | None) -> float:
    """What tasks of a worker with a memory limit may take together; without one, the machine's memory is the limit."""
    return _USABLE * (limit or psutil.virtual_memory().total) - _IDLE_BYTES


@dataclass(frozen=True)
class Workers:
    """All workers of a cluster at the time when a study begins."""

    members: tuple[WorkerInfo, ...]

    @classmethod
    def of_this_machine(cls, count: int) -> Workers:
        """The workers of a cluster that a run without a scheduler would start here."""
        spare = spare_bytes(psutil.virtual_memory().total / count)
        return cls(tuple(WorkerInfo("this machine", 1, spare, "cpu", "") for _ in range(count)))

    @property
    def threads(self) -> int:
        """Tasks that run at once."""
        return sum(member.threads for member in self.members)

    @cached_property
    def share_bytes(self) -> float:
        """Memory that every task can have while all threads of every worker are busy."""
        return min(member.spare_bytes / member.threads for member in self.members)

    @cached_property
    def largest_bytes(self) -> float:
        """Memory that the best equipped worker has for a task alone."""
        return max(member.spare_bytes for member in self.members)

    def with_backend(self, wanted: Backends) -> Workers:
        """The workers that can serve a study with this backend.

        Raises:
            ClusterError: a GPU is asked for, and none of them has one.
        """
        if wanted != "gpu":
            return self
        equipped = tuple(member for member in self.members if member.backend == "gpu")
        if not equipped:
            reasons = "; ".join(
                f"{member.address}{' (declares a GPU)' if member.declares_gpu else ''}: {member.note}"
                for member in self.members[:4]
            )
            raise ClusterError(
                f"the study asks for backend 'gpu', and none of the {len(self.members)} workers can compute on one. "
                f"{reasons}{'; ...' if len(self.members) > 4 else ''}. "
                "Start a worker on a machine with an NVIDIA GPU and the extra gpu, or ask for backend 'auto'"
            )
        return Workers(equipped)
