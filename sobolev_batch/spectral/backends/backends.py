"""Where transforms are computed: on the processor by FINUFFT, or on a GPU by cuFINUFFT."""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol

import finufft
import numpy as np

from sobolev_batch.errors import BackendError, InputError
from sobolev_batch.spectral.backends import cuda
from sobolev_batch.spectral.backends.arrays import Array
from sobolev_batch.spectral.backends.costs import Costs, Shape
from sobolev_batch.spectral.dtypes import ComplexDtype

_log = logging.getLogger(__name__)

CPU_COSTS = Costs(
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

# Times are rough: nothing but the choice of a grid follows from them, and both grids keep eps.
GPU_COSTS = Costs(
    # cuFINUFFT evaluates its kernel by polynomials for these two only. Its older kernel was measured
    # with FINUFFT, which has it too: at 1.25 it keeps eps down to 1e-9, and 1e-5 in single precision.
    finest={"complex128": {2.0: 0.0, 1.25: 1e-8}, "complex64": {2.0: 0.0, 1.25: 1e-4}},
    making=1.0,
    point=1.0,
    spread_cell=0.02,
    grid_cell=0.1,
    point_bytes=250,
    triangle_bytes=60,
    fixed_bytes=50_000_000,
    work_grids=2,  # cuFFT's work area, and at worst as much for bins of a single cell
    scattered=False,
    most_cells=2**31 - 1,  # cuFINUFFT counts cells in 32 bits and does not check
)

# A plan is not for two threads, and two transforms at once would each find half of the memory.
_DEVICE = threading.RLock()


class NufftPlan(Protocol):
    """A plan in three dimensions, as finufft and cufinufft make it: of type 1 where nothing else is said."""

    def setpts(self, x: Array, y: Array, z: Array) -> None:
        """Set the angles of the points; references are kept, not copies."""

    def execute(self, data: Array) -> Array:
        """Transform the strengths of the points; of type 2, the coefficients of the modes."""


@dataclass(frozen=True, eq=False)
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
        """An array of this backend, on the host; waits until it is computed."""

    @abstractmethod
    def plan(self, shape: Shape, *, eps: float, dtype: ComplexDtype, oversampling: float, threads: int) -> NufftPlan:
        """A type-1 plan with the sign -1, whose modes of an axis of n samples start at -(n // 2)."""


class _Cpu(Backend):
    def upload(self, array: Array) -> Array:
        return array

    def download(self, array: Array) -> Array:
        return array

    def plan(self, shape: Shape, *, eps: float, dtype: ComplexDtype, oversampling: float, threads: int) -> NufftPlan:
        return _finufft_plan(1, -1, shape, eps=eps, dtype=dtype, oversampling=oversampling, threads=threads)

    def __reduce__(self) -> str:
        return "CPU"


@dataclass(frozen=True, eq=False)
class Gpu(Backend):
    """The first of the devices that CUDA shows; `gpu_backend` makes it.

    Attributes:
        libraries: that it calls.
    """

    libraries: cuda.Cuda

    @property
    def description(self) -> str:
        """The device's name and memory."""
        runtime = self.libraries.cupy.cuda.runtime
        properties = runtime.getDeviceProperties(0)
        return f"{properties['name'].decode()}, {properties['totalGlobalMem'] / 1e9:.3g} GB"

    @property
    def free_bytes(self) -> int:
        """Device memory that a transform may take, that of arrays no longer in use included."""
        cupy = self.libraries.cupy
        return int(cupy.cuda.runtime.memGetInfo()[0] + cupy.get_default_memory_pool().free_bytes())

    @contextmanager
    def work(self) -> Iterator[None]:
        """While device work goes on: one thread at a time, on the first device and its default stream."""
        cupy = self.libraries.cupy
        with _DEVICE, cupy.cuda.Device(0), cupy.cuda.Stream.null:
            yield

    def make_room(self, needed: float) -> None:
        """Where fewer bytes are free, give back what CuPy keeps of freed memory: cuFINUFFT allocates beside it."""
        cupy = self.libraries.cupy
        if cupy.cuda.runtime.memGetInfo()[0] < needed:
            cupy.get_default_memory_pool().free_all_blocks()

    def upload(self, array: Array) -> Array:
        """A copy in device memory."""
        return self.libraries.cupy.asarray(array)

    def download(self, array: Array) -> Array:
        """A copy on the host, once everything before it is computed."""
        return self.libraries.cupy.asnumpy(array)

    def plan(self, shape: Shape, *, eps: float, dtype: ComplexDtype, oversampling: float, threads: int) -> NufftPlan:
        """A plan of cuFINUFFT with every option that it has a choice in.

        Raises:
            RuntimeError: cuFINUFFT could not make it; it does not say why.
        """
        # Defaults differ from FINUFFT's and between versions: dtype is complex64, upsampfac its own choice.
        made: NufftPlan = self.libraries.plan(
            1,
            shape,
            n_trans=1,
            eps=eps,
            isign=-1,
            dtype=dtype,
            modeord=0,
            upsampfac=oversampling,
            gpu_method=0,  # shared memory where the kernel's width leaves room for it, else global memory
            gpu_sort=1,
            gpu_kerevalmeth=1,
            gpu_maxsubprobsize=1024,
            gpu_maxbatchsize=1,
            gpu_spreadinterponly=0,
            gpu_device_id=0,
            gpu_stream=0,
            debug=0,
        )
        return made

    def __reduce__(self) -> tuple[object, ...]:
        return gpu_backend, ()


CPU: Backend = _Cpu("cpu", "finufft", CPU_COSTS)


def evaluation_plan(shape: Shape, *, eps: float, dtype: ComplexDtype, oversampling: float, threads: int) -> NufftPlan:
    """A type-2 plan on the processor with the sign +1, whose modes of an axis of n samples start at -(n // 2)."""
    return _finufft_plan(2, 1, shape, eps=eps, dtype=dtype, oversampling=oversampling, threads=threads)


def _finufft_plan(
    kind: int, sign: int, shape: Shape, *, eps: float, dtype: ComplexDtype, oversampling: float, threads: int
) -> NufftPlan:
    # Its warnings speak of thread counts and of tolerances, which are checked before they get here.
    made: NufftPlan = finufft.Plan(
        kind,
        shape,
        eps=eps,
        isign=sign,
        dtype=dtype,
        modeord=0,
        nthreads=threads,
        upsampfac=oversampling,
        showwarn=0,
    )
    return made


@cache
def gpu_backend() -> Gpu:
    """The GPU, after it has passed a trial.

    Nothing of CUDA is loaded before this is called. With several GPUs, one process each with its own
    CUDA_VISIBLE_DEVICES is the way to use them all.

    Raises:
        BackendError: there is none that can be used; the message says why, and what to do.
    """
    backend = Gpu("gpu", "cufinufft", GPU_COSTS, cuda.load())
    try_out(backend)
    return backend


def backend_named(name: str) -> Backend:
    """The backend that is meant by "cpu", "gpu" or "auto": a GPU if there is one that can be used.

    Raises:
        BackendError: "gpu", and there is none.
        InputError: another name.
    """
    if name == "gpu":
        return gpu_backend()
    if name == "auto":
        try:
            return gpu_backend()
        except BackendError as error:
            _log.info("computing on the processor: %s", error)
    elif name != "cpu":
        raise InputError(f"backend must be 'cpu', 'gpu' or 'auto', found {name!r}")
    return CPU


def try_out(backend: Gpu) -> None:
    """Transform one point at the origin, which compiles a kernel and calls every library.

    Raises:
        BackendError: it fails, or the values are wrong.
    """
    try:
        with backend.work():
            plan = backend.plan((4, 6, 8), eps=1e-9, dtype="complex128", oversampling=2.0, threads=1)
            origin = backend.upload(np.zeros(1))
            plan.setpts(origin, origin, origin)
            values = backend.download(plan.execute(np.exp(1j * origin)))
    except Exception as error:  # CUDA's errors have no common base
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BackendError(f"the GPU fails a trial transform: {reason}; is its driver up to date?") from error
    if not np.allclose(values, 1.0, rtol=0.0, atol=1e-8):
        raise BackendError(f"the GPU computes wrong values: {values.flat[0]} instead of 1")
