"""The backends that compute transforms, FINUFFT on the processor and cuFINUFFT on a GPU: their arrays and plans.

Arrays on the processor are NumPy's, arrays on a GPU are CuPy's. NumPy's functions dispatch on their arguments,
or on ``like=`` where they create an array, so the same expressions run on both. The exceptions are here.
"""

import ctypes
import importlib
import logging
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache
from types import ModuleType
from typing import Any, ClassVar, Literal, Self, TypeVar

import finufft
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Array, Reals
from sobolev_batch.errors import BackendError, one_line
from sobolev_batch.parameters import check_choice
from sobolev_batch.transform.nufft_costs import CPU_COSTS, FINEST_EPS, GPU_COSTS, Costs, NufftSpec

Result = TypeVar("Result")

# What a study may ask for; "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]
INSTALL = "pip install 'sobolev-batch[gpu]'"
# cuFINUFFT is linked against the first two, and CuPy compiles with the third. cuFINUFFT's wheel neither declares them
# nor finds them where pip puts them: they must be in the process before it is imported.
_LIBRARIES = {"cudart": "the CUDA runtime", "cufft": "cuFFT", "nvrtc": "the CUDA compiler NVRTC"}
# Values of cudaError_t.
_OUT_OF_MEMORY, _INSUFFICIENT_DRIVER, _NO_DEVICE = 2, 35, 100
# Methods of cuFINUFFT. Each block of threads gathers its cells of the grid in shared memory: on an H100, 3 to 15 times
# as fast as what the library chooses by itself, which is shared memory or, for want of it, global memory.
_OUTPUT_DRIVEN, _AUTOMATIC = 3, 0
# Its further options: the defaults differ from FINUFFT's and between versions.
_GPU_OPTIONS = {"n_trans": 1, "gpu_sort": 1, "gpu_kerevalmeth": 1, "gpu_maxsubprobsize": 1024, "gpu_maxbatchsize": 1}
_GPU_OPTIONS |= {"gpu_spreadinterponly": 0, "gpu_device_id": 0, "gpu_stream": 0, "debug": 0}
# Of the device's memory, for the plans that are kept while it is idle, and their number at most.
_KEPT_FRACTION, _KEPT_PLANS = 0.25, 4
_LARGE_BYTES, _PAGE_BYTES, _TOUCHING_THREADS = 1 << 25, 1 << 12, 4
# Sums among which the additions of a device are spread where there are few.
_LANES = 1 << 14
# Two threads cannot share a plan, and each of two transforms would find half of the memory.
_DEVICE = threading.RLock()

_log = logging.getLogger(__name__)


def combine(coefficients: Reals, rows: Array, out: Array | None = None) -> Array:
    """Return the matrix product of few coefficients (..., k), on the host, with rows (k, n) or (a, k, n) of a backend.

    NumPy's own product leaves threads of the BLAS that spin for some 25 ms, in which those of FINUFFT wait for them.
    CuPy's needs cuBLAS, which takes more memory than everything else together.
    """
    if isinstance(rows, np.ndarray):
        return np.einsum("...k,kn->...n" if rows.ndim == 2 else "qk,akn->aqn", coefficients, rows, out=out)
    factors = np.asarray(coefficients, like=rows)[..., None]
    each = [rows[:, index, None] if rows.ndim > 2 else rows[index] for index in range(rows.shape[-2])]
    total = factors[..., 0, :] * each[0]
    for index in range(1, len(each)):
        total += factors[..., index, :] * each[index]
    if out is None:
        return total
    out[...] = total
    return out


def sums_at(places: Array, values: Array, length: int) -> Array:
    """Return the sums (length,) of the float64 values (n,) at each place.

    CuPy's bincount first asks whether a place is negative, and the first such question compiles for seven seconds.
    """
    if isinstance(values, np.ndarray):
        return np.bincount(places, weights=values, minlength=length)
    # Threads that add to the same number wait for each other.
    lanes = max(1, _LANES // length)
    sums = np.zeros(length * lanes, like=values)
    np.add.at(sums, places if lanes == 1 else places * lanes + np.arange(len(values), like=values) % lanes, values)
    return sums if lanes == 1 else sums.reshape(length, lanes).sum(axis=1)


def sums_of_runs(values: Array, starts: Array) -> Array:
    """Return the sum of each run of values (n,), given the index at which each run starts; the first is zero.

    CuPy's reduceat takes differences of a cumulative sum, which loses digits where the sum is large.
    """
    if isinstance(values, np.ndarray):
        return np.add.reduceat(values, starts)
    firsts = np.zeros(len(values), dtype=np.int64, like=values)
    firsts[starts] = 1
    return sums_at(np.cumsum(firsts) - 1, values, len(starts))


def cosine_and_sine(angles: Array) -> tuple[Array, Array]:
    """Return cosine and sine of angles in radians, to two or three rounding errors of 1.

    Both come from the tangent of half the angle: NumPy vectorises the tangent of doubles, but neither
    cosine nor sine, which each take seven times as long.
    """
    tangents = np.tan(0.5 * angles)
    squares = tangents * tangents
    inverses = 1 / (1 + squares)
    return (1 - squares) * inverses, 2 * tangents * inverses


class Backend:
    """The processor with FINUFFT; a `Gpu` is another one."""

    name: ClassVar[Literal["cpu", "gpu"]] = "cpu"
    library: ClassVar[Literal["finufft", "cufinufft"]] = "finufft"
    costs: ClassVar[Costs] = CPU_COSTS

    def work(self) -> AbstractContextManager[None]:
        """Reserve the backend for one thread, for as long as it uses plans and arrays."""
        return nullcontext()

    def upload(self, array: Array) -> Array:
        """Return an array of the host as an array of this backend."""
        return array

    def download(self, array: Array) -> Array:
        """Return an array of this backend as an array of the host, once it is computed."""
        return array

    def plan(self, spec: NufftSpec, *, adjoint: bool = False) -> Any:
        """Return a plan of the library: its `setpts` takes angles, its `execute` the strengths of the points.

        It is of type 1 with the sign -1; the adjoint is of type 2 with the sign +1 and takes the coefficients of the
        modes. The modes of an axis of n samples start at -(n // 2). A plan keeps references to angles, not copies. The
        oversampling must be set. cuFINUFFT raises RuntimeError without a reason.
        """
        # FINUFFT warns of thread counts and of tolerances, which are checked before.
        options = _common_options(spec, adjoint)
        return finufft.Plan(2 if adjoint else 1, spec.shape, **options, nthreads=spec.threads, showwarn=0)

    def __reduce__(self) -> str | tuple[object, ...]:
        return "CPU"


def _common_options(spec: NufftSpec, adjoint: bool) -> dict[str, Any]:
    sign = 1 if adjoint else -1
    return {"eps": spec.eps, "dtype": spec.dtype, "upsampfac": spec.oversampling, "isign": sign, "modeord": 0}


CPU = Backend()


@dataclass(frozen=True, eq=False)
class Gpu(Backend):
    """The first device that CUDA shows; `gpu_backend` returns it. CuPy has a CUDA runtime of its own."""

    name: ClassVar[Literal["cpu", "gpu"]] = "gpu"
    library: ClassVar[Literal["finufft", "cufinufft"]] = "cufinufft"
    costs: ClassVar[Costs] = GPU_COSTS

    cupy: Any
    cufinufft: Any
    runtime: Any
    # The last plans with the memory that they take, by what they are for: the next surface of a study needs the same.
    _kept: dict[object, tuple[Any, int]] = field(default_factory=dict, init=False, repr=False)
    _own: threading.local = field(default_factory=threading.local, init=False, repr=False)

    @classmethod
    def load(cls) -> Self:
        """Load all libraries and look for a device; BackendError, with what to do, where one is missing."""
        pathfinder = _module("cuda.pathfinder", "cuda-pathfinder")
        runtime: Any = None
        for name, title in _LIBRARIES.items():
            try:
                library = pathfinder.load_nvidia_dynamic_lib(name)
            except RuntimeError as error:  # pathfinder's errors derive from it
                raise BackendError(
                    f"no GPU: {title} ({name}) is not installed or cannot be loaded: {INSTALL}"
                ) from error
            runtime = runtime or ctypes.CDLL(library.abs_path)
        cupy = _module("cupy", "CuPy")
        cufinufft = _module("cufinufft", "cuFINUFFT")
        _require_device(cupy)
        return cls(cupy, cufinufft, runtime)

    @property
    def description(self) -> str:
        """Name and memory of the device."""
        properties = self.cupy.cuda.runtime.getDeviceProperties(0)
        return f"{properties['name'].decode()}, {properties['totalGlobalMem'] / 1e9:.3g} GB"

    @property
    def free_bytes(self) -> int:
        """Device memory that a transform may take, including what is kept of freed arrays and of the last plan."""
        kept = self.cupy.get_default_memory_pool().free_bytes() + sum(size for _, size in self._kept.values())
        return int(self.cupy.cuda.runtime.memGetInfo()[0] + kept)

    @contextmanager
    def work(self) -> Iterator[None]:
        """Reserve the device for one thread, and select it with its default stream."""
        with _DEVICE, self.cupy.cuda.Device(0), self.cupy.cuda.Stream.null:
            yield

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Select a stream of this thread, which does not wait for what others compute; it is done in the end."""
        if not hasattr(self._own, "stream"):
            self._own.stream = self.cupy.cuda.Stream(non_blocking=True)
        with self.cupy.cuda.Device(0), self._own.stream as stream:
            yield
            stream.synchronize()

    def release_memory(self, projected_bytes: float) -> None:
        """Give back what is kept if less is free: cuFINUFFT allocates outside of CuPy's pool."""
        if self.cupy.cuda.runtime.memGetInfo()[0] < projected_bytes:
            self._kept.clear()
            self.cupy.get_default_memory_pool().free_all_blocks()

    def is_out_of_memory(self, error: BaseException) -> bool:
        """Return True if device memory was too little, which cuFINUFFT itself does not report."""
        if isinstance(error, MemoryError):  # CuPy's own is one
            return True
        return _OUT_OF_MEMORY in (getattr(error, "status", None), self.runtime.cudaGetLastError())

    def upload(self, array: Array) -> Array:
        """Return a copy in device memory."""
        return self.cupy.asarray(array)

    def download(self, array: Array) -> Array:
        """Return a copy on the host, once everything before it is computed."""
        host = np.empty(array.shape, array.dtype)
        _touch_pages(host)
        return self.cupy.asnumpy(array, out=host)

    def plan(self, spec: NufftSpec, *, adjoint: bool = False) -> Any:
        """Return a plan of cuFINUFFT with all of its options set, the last one where that will do; see `Backend.plan`.

        On a small lattice it takes longer to make one than to execute it.
        """
        # The accuracies of the meshes of a study differ a little.
        spec = replace(spec, eps=max(10.0 ** math.floor(math.log10(spec.eps)), FINEST_EPS[spec.dtype]))
        purpose = adjoint, spec.shape, spec.eps, spec.dtype, spec.oversampling
        if purpose in self._kept:
            return self._kept[purpose][0]
        while len(self._kept) >= _KEPT_PLANS:
            self._kept.pop(next(iter(self._kept)))
        memory = self.cupy.cuda.runtime.memGetInfo
        before, _ = memory()
        try:
            made = self._new_plan(spec, adjoint, _AUTOMATIC if adjoint else _OUTPUT_DRIVEN)
        except RuntimeError as error:
            if self.is_out_of_memory(error):
                raise MemoryError(one_line(error)) from error
            # On some devices a wide kernel finds too little shared memory.
            made = self._new_plan(spec, adjoint, _AUTOMATIC)
        left, most = memory()
        taken = before - left
        if sum(size for _, size in self._kept.values()) + taken < _KEPT_FRACTION * most:
            self._kept[purpose] = made, taken
        return made

    def _new_plan(self, spec: NufftSpec, adjoint: bool, method: int) -> Any:
        # A plan takes an error that an earlier one left behind for its own: asking for it resets it.
        self.runtime.cudaGetLastError()
        options = {**_common_options(spec, adjoint), **_GPU_OPTIONS, "gpu_method": method}
        return _plan_class(self.cufinufft)(2 if adjoint else 1, spec.shape, **options)

    def __reduce__(self) -> tuple[object, ...]:
        return gpu_backend, ()


def _touch_pages(array: NDArray[Any]) -> None:
    """Have threads write to each page of new memory, which the operating system provides only then.

    A copy would wait for one page after the other: on an H100, 170 ms instead of 80 for 580 MB.
    """
    if array.nbytes < _LARGE_BYTES:
        return
    parts = np.array_split(array.reshape(-1).view(np.uint8), _TOUCHING_THREADS)
    with ThreadPoolExecutor(_TOUCHING_THREADS) as pool:
        for part in parts:
            pool.submit(part[::_PAGE_BYTES].fill, 0)


def _module(name: str, title: str) -> ModuleType:
    try:
        return importlib.import_module(name)  # noqa: TID251 -- of libraries that this module names
    except ImportError as error:
        is_missing = isinstance(error, ModuleNotFoundError)
        found = "not installed" if is_missing else f"installed but cannot be imported ({one_line(error)})"
        raise BackendError(f"no GPU: {title} is {found}: {INSTALL}") from error


def _require_device(cupy: Any) -> None:
    runtime, count = cupy.cuda.runtime, 0
    try:
        count = runtime.getDeviceCount()
    except runtime.CUDARuntimeError as error:
        if error.status != _NO_DEVICE:
            reason = f"CUDA says {error}"
            if error.status == _INSUFFICIENT_DRIVER and runtime.driverGetVersion():
                reason = "the NVIDIA driver is too old for CUDA 12: update it to 525 or newer"
            elif error.status == _INSUFFICIENT_DRIVER:
                reason = "the NVIDIA driver is not installed on this machine"
            raise BackendError(f"no GPU: {reason}") from error
    if not count:
        raise BackendError("no GPU: the NVIDIA driver sees no device; is CUDA_VISIBLE_DEVICES set to hide it?")


def _plan_class(cufinufft: Any) -> Any:
    class Plan(cufinufft.Plan):  # type: ignore[misc]
        """A plan whose destructor does nothing if the constructor failed; cuFINUFFT's would print a traceback."""

        def __del__(self) -> None:
            handle = getattr(self, "_plan", None)
            if handle is not None and getattr(handle, "value", handle) is not None:
                super().__del__()

    return Plan


def compute_on(backend: Backend, compute: Callable[[Backend], Result], *, alone: bool = True) -> Result:
    """Return what a function computes on a backend. The processor steps in for a GPU that fails, with a warning.

    What makes no plan and takes little memory need not be alone on a GPU.
    """
    if isinstance(backend, Gpu):
        try:
            with backend.work() if alone else backend.beside():
                return compute(backend)
        except Exception as error:  # CUDA's errors have no common base
            _log.warning("the GPU fails: %s; the processor computes it instead", one_line(error)[:200])
            backend.release_memory(math.inf)
    return compute(CPU)


@cache
def gpu_backend() -> Gpu:
    """Return the GPU, once it has passed a trial; BackendError, with what to do, where none is usable.

    Nothing of CUDA is loaded before this. For several GPUs, start a process each, with its own CUDA_VISIBLE_DEVICES.
    """
    backend = Gpu.load()
    try_out(backend)
    return backend


def backend_named(name: str) -> Backend:
    """Return the backend for "cpu", "gpu" (or BackendError), or "auto": a usable GPU, else the processor."""
    check_choice("backend", name, ("cpu", "gpu", "auto"))
    if name == "gpu":
        return gpu_backend()
    if name == "auto":
        try:
            return gpu_backend()
        except BackendError as error:
            _log.info("computing on the processor: %s", error)
    return CPU


def try_out(backend: Gpu) -> None:
    """Transform one point at the origin, which calls every library; BackendError where that fails."""
    try:
        with backend.work():
            plan = backend.plan(NufftSpec((4, 6, 8), 1e-9, oversampling=2.0))
            origin = backend.upload(np.zeros(1))
            plan.setpts(origin, origin, origin)
            values = backend.download(plan.execute(np.exp(1j * origin)))
    except Exception as error:  # CUDA's errors have no common base
        raise BackendError(f"the GPU fails a trial transform: {one_line(error)}; is its driver up to date?") from error
    if not np.allclose(values, 1.0, rtol=0.0, atol=1e-8):
        raise BackendError(f"the GPU computes wrong values: {values.flat[0]} instead of 1")
