"""GPU libraries, loaded on demand: CuPy, cuFINUFFT, and the CUDA libraries that both need."""

from __future__ import annotations

import ctypes
import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from sobolev_batch.errors import BackendError

INSTALL = "pip install 'sobolev-batch[gpu]'"

# cuFINUFFT is linked against the first two, and CuPy compiles with the third. cuFINUFFT's wheel neither declares them
# nor finds them where pip puts them: they must be in the process before it is imported.
_LIBRARIES = {"cudart": "the CUDA runtime", "cufft": "cuFFT", "nvrtc": "the CUDA compiler NVRTC"}
# Values of cudaError_t.
_OUT_OF_MEMORY, _INSUFFICIENT_DRIVER, _NO_DEVICE = 2, 35, 100


@dataclass(frozen=True, eq=False)
class Cuda:
    """The loaded libraries.

    Attributes:
        cupy: Module.
        cufinufft: Module.
        runtime: CUDA runtime of cuFINUFFT; CuPy has one of its own.
    """

    cupy: Any
    cufinufft: Any
    runtime: Any

    def last_error(self) -> int:
        """Return the last error of cuFINUFFT's runtime, and reset it."""
        return int(self.runtime.cudaGetLastError())

    def is_out_of_memory(self, error: BaseException) -> bool:
        """Return True if device memory was too little, which cuFINUFFT itself does not report."""
        if isinstance(error, self.cupy.cuda.memory.OutOfMemoryError):
            return True
        return _OUT_OF_MEMORY in (getattr(error, "status", None), self.last_error())

    def plan(self, *args: Any, **options: Any) -> Any:
        """Return a plan of cuFINUFFT."""
        # A plan takes an error that an earlier one left behind for its own.
        self.last_error()
        return _plan_class(self.cufinufft)(*args, **options)


def load() -> Cuda:
    """Load all libraries and look for a device.

    Raises:
        BackendError: A library, the driver or the device is missing; the message says what to do.
    """
    pathfinder = _module("cuda.pathfinder", "cuda-pathfinder")
    runtime: Any = None
    for name, title in _LIBRARIES.items():
        try:
            library = pathfinder.load_nvidia_dynamic_lib(name)
        except RuntimeError as error:  # pathfinder's errors derive from it
            raise BackendError(f"no GPU: {title} ({name}) is not installed or cannot be loaded: {INSTALL}") from error
        runtime = runtime or ctypes.CDLL(library.abs_path)
    cupy = _module("cupy", "CuPy")
    cufinufft = _module("cufinufft", "cuFINUFFT")
    _require_device(cupy)
    return Cuda(cupy, cufinufft, runtime)


def _module(name: str, title: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise BackendError(f"no GPU: {title} is not installed: {INSTALL}") from error
    except ImportError as error:
        reason = " ".join(str(error).split())
        raise BackendError(f"no GPU: {title} is installed but cannot be imported ({reason}): {INSTALL}") from error


def _require_device(cupy: Any) -> None:
    runtime = cupy.cuda.runtime
    try:
        count = runtime.getDeviceCount()
    except runtime.CUDARuntimeError as error:
        if error.status == _NO_DEVICE:
            count = 0
        elif error.status == _INSUFFICIENT_DRIVER and runtime.driverGetVersion() == 0:
            raise BackendError("no GPU: the NVIDIA driver is not installed on this machine") from error
        elif error.status == _INSUFFICIENT_DRIVER:
            raise BackendError("no GPU: the NVIDIA driver is too old for CUDA 12: update it to 525 or newer") from error
        else:
            raise BackendError(f"no GPU: CUDA says {error}") from error
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
