"""Where transforms are computed: on the processor by FINUFFT."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import finufft

from sobolev_batch.errors import BackendError
from sobolev_batch.spectral.division import Costs, Shape
from sobolev_batch.spectral.precision import Precision

# Arrays are NumPy's here and CuPy's on a GPU, which has no types.
Array = Any

_CPU_COSTS = Costs(
    finest={
        "complex128": {2.0: 0.0, 1.75: 1e-12, 1.5: 1e-11, 1.25: 1e-7},
        "complex64": {2.0: 0.0, 1.75: 3e-6, 1.5: 2e-5, 1.25: 1e-3},
    },
    making=150.0,
    point=100.0,
    spread_cell=0.28,
    grid_cell=27.0,
    point_bytes=140,
    triangle_bytes=100,
    fixed_bytes=8_000_000,
    work_grids=0,
    scattered=True,
    most_cells=10**11,  # FINUFFT's own bound
)


class Plan(Protocol):
    """A type-1 plan in three dimensions, as finufft and cufinufft make it."""

    def setpts(self, x: Array, y: Array, z: Array) -> None:
        """Set the angles of the points; references are kept, not copies."""

    def execute(self, data: Array, out: Array | None = None) -> Array:
        """Transform the strengths of the points."""


@dataclass(frozen=True)
class Backend(ABC):
    """Where transforms are computed.

    Attributes:
        name: "cpu" or "gpu".
        library: that computes the nonuniform FFT.
        costs: of that library.
    """

    name: Literal["cpu", "gpu"]
    library: Literal["finufft", "cufinufft"]
    costs: Costs

    @abstractmethod
    def upload(self, array: Array) -> Array:
        """An array of the host, where this backend computes."""

    @abstractmethod
    def download(self, array: Array) -> Array:
        """An array of this backend, on the host."""

    @abstractmethod
    def plan(self, shape: Shape, *, eps: float, precision: Precision, oversampling: float, threads: int) -> Plan:
        """A type-1 plan with the sign -1, whose modes of an axis of n samples start at -(n // 2)."""


@dataclass(frozen=True)
class _Cpu(Backend):
    def upload(self, array: Array) -> Array:
        return array

    def download(self, array: Array) -> Array:
        return array

    def plan(self, shape: Shape, *, eps: float, precision: Precision, oversampling: float, threads: int) -> Plan:
        # Its warnings speak of thread counts and of tolerances, which are checked before they get here.
        made: Plan = finufft.Plan(
            1,
            shape,
            eps=eps,
            isign=-1,
            dtype=precision,
            modeord=0,
            nthreads=threads,
            upsampfac=oversampling,
            showwarn=0,
        )
        return made


CPU: Backend = _Cpu("cpu", "finufft", _CPU_COSTS)


def gpu_backend() -> Backend:
    """The GPU that this process sees.

    Raises:
        BackendError: there is none.
    """
    raise BackendError("transforms on a GPU are not built yet")
