"""The GPU libraries, loaded on demand: CuPy, cuFINUFFT, and the CUDA libraries that both need."""

from __future__ import annotations

import ctypes
import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from sobolev_batch.errors import BackendError

INSTALL = "pip install 'sobolev-batch[gpu]'"

# What cuFINUFFT is linked against, and what CuPy compiles with. cuFINUFFT's wheel neither declares them
# nor finds them where pip puts them: they must be in the process before it is imported.
_LIBRARIES = {"cudart": "the CUDA runtime", "cufft": "cuFFT", "nvrtc": "the CUDA compiler NVRTC"}
# Of cudaError_t.
_OUT_OF_MEMORY, _INSUFFICIENT_DRIVER, _NO_DEVICE = 2, 35, 100


@dataclass(frozen=True, eq=False)
class Cuda:
    """The libraries, once loaded.

    Attributes:
        cupy: the module.
        cufinufft: the module.
        runtime: the CUDA runtime of cuFINUFFT; CuPy has one of its own.
    """

    cupy: Any
    cufinufft: Any
    runtime: Any

    def last_error(self) -> int:
        """The error that cuFINUFFT's runtime remembers, which is forgotten by asking."""
        return int(self.runtime.cudaGetLastError())

    def is_out_of_memory(self, error: BaseException) -> bool:
        """Whether device memory was too little; cuFINUFFT itself does not say what went wrong."""
        if isinstance(error, self.cupy.cuda.memory.OutOfMemoryError):
            return True
        return _OUT_OF_MEMORY in (getattr(error, "status", None), self.last_error())

    def plan(self, *args: Any, **options: Any) -> Any:
        """A plan of cuFINUFFT."""
        # It takes an error that an earlier plan left behind for its own.
        self.last_error()
        return _plan_class(self.cufinufft)(*args, **options)


def load() -> Cuda:
    """Load everything and look for a device.

    Raises:
        BackendError: something is missing; the message says what, and what to do.
    """
    pathfinder = _module("cuda.pathfinder", "cuda-pathfinder")
    runtime: Any = None
    for name, what in _LIBRARIES.items():
        try:
            found = pathfinder.load_nvidia_dynamic_lib(name)
        except RuntimeError as error:  # pathfinder's errors derive from it
            raise BackendError(f"no GPU: {what} ({name}) is not installed or cannot be loaded: {INSTALL}") from error
        runtime = runtime or ctypes.CDLL(found.abs_path)
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
        """A plan that is not destroyed where it could not be made: that would print a traceback."""

        def __del__(self) -> None:
            handle = getattr(self, "_plan", None)
            if handle is not None and getattr(handle, "value", handle) is not None:
                super().__del__()

    return Plan
