"""A GPU that is none: arrays, allocator and plans as strict as CuPy's and cuFINUFFT's, computed by NumPy and FINUFFT.

What the real ones do was read from CuPy 14.2 and cuFINUFFT 2.5.1; `test_backends` holds the lists against the real
ones where they are installed.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import finufft
import numpy as np
import pytest
from numpy.lib.mixins import NDArrayOperatorsMixin

from sobolev_batch.errors import BackendError
from sobolev_batch.transform.backends import Gpu, gpu_backend

# What CuPy answers when NumPy's function of that name is called. `ones` and `full` are not among them:
# with like= NumPy passes on a keyword that CuPy's do not know.
FUNCTIONS = {
    "arange", "ascontiguousarray", "asarray", "bincount", "concatenate", "cumsum", "empty", "empty_like", "flatnonzero",
    "nonzero", "ones_like", "repeat", "roll", "searchsorted", "sinc", "stack", "take", "tile", "unique", "where",
    "zeros", "zeros_like",
}  # fmt: skip
# Of its universal functions, those that the package needs. matmul is not among them, since it needs cuBLAS,
# nor is any reduceat, since CuPy's loses digits.
UFUNCS = {
    "absolute", "add", "arcsinh", "arctan2", "bitwise_and", "bitwise_or", "cos", "cosh", "divide", "equal", "exp",
    "floor", "greater", "greater_equal", "invert", "left_shift", "less", "log", "maximum", "minimum", "multiply",
    "negative", "not_equal", "remainder", "right_shift", "rint", "sign", "sin", "sqrt", "subtract", "tan",
}  # fmt: skip
# The fields of the options structure of cuFINUFFT 2.5.1.
OPTIONS = {
    "upsampfac", "gpu_method", "gpu_sort", "gpu_binsizex", "gpu_binsizey", "gpu_binsizez", "gpu_obinsizex",
    "gpu_obinsizey", "gpu_obinsizez", "gpu_maxsubprobsize", "gpu_kerevalmeth", "gpu_spreadinterponly",
    "gpu_maxbatchsize", "gpu_device_id", "gpu_stream", "modeord", "gpu_np", "debug",
}  # fmt: skip

# Whose defaults are others than FINUFFT's, or name a device and a stream that may not be the current ones.
_REQUIRED = {"gpu_method", "gpu_sort", "gpu_device_id", "gpu_stream"}

_MEMORY_ALLOCATION = 2  # of cudaError_t
_MESSAGES = {"plan": "creating plan", "setpts": "setting non-uniform points", "execute": "executing plan"}


class OutOfMemoryError(MemoryError):
    """As cupy.cuda.memory.OutOfMemoryError."""


class CUDARuntimeError(RuntimeError):
    """As cupy_backends.cuda.api.runtime.CUDARuntimeError."""

    def __init__(self, status: int) -> None:
        super().__init__(f"cudaError {status}")
        self.status = status


class _Stream:
    null: Any = nullcontext()

    def __init__(self, non_blocking: bool) -> None:
        assert non_blocking, "it would wait for the others"

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def synchronize(self) -> None:
        pass


@dataclass(eq=False)
class Device:
    """The device: its bytes of memory, the options of each plan, and what is to go wrong.

    Failures happen where they stand: "plan", "setpts" or "execute", and "memory" or "error", in that order.
    """

    capacity: float = 1e12
    used: int = 0
    most_used: int = 0
    options: list[dict[str, Any]] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)
    last_error: int = 0
    busy: threading.Lock = field(default_factory=threading.Lock)

    def take(self, size: int) -> int:
        if self.used + size > self.capacity:
            raise OutOfMemoryError(f"Out of memory allocating {size:,} bytes (allocated so far: {self.used:,} bytes).")
        self.used += size
        self.most_used = max(self.most_used, self.used)
        return size

    def fail(self, where: str, what: str = "") -> None:
        """Fail as cuFINUFFT does, which does not say why, if it is to go wrong here."""
        if not what and self.failures and self.failures[0][0] == where:
            what = self.failures.pop(0)[1]
        if what:
            self.last_error = _MEMORY_ALLOCATION if what == "memory" else 0
            raise RuntimeError(f"Error {_MESSAGES[where]}.")

    def forget(self) -> int:
        error, self.last_error = self.last_error, 0
        return error

    @contextmanager
    def call(self, where: str) -> Iterator[None]:
        """Work that no second thread may be at."""
        assert self.busy.acquire(blocking=False), "two threads at one device"
        try:
            time.sleep(1e-3)
            self.fail(where)
            yield
        finally:
            self.busy.release()

    def upload(self, array: Any) -> Array:
        assert isinstance(array, np.ndarray)
        return Array(self, array.copy())

    def backend(self) -> Gpu:
        """The backend that computes on this device."""
        cuda = SimpleNamespace(
            runtime=SimpleNamespace(
                memGetInfo=lambda: (self.capacity - self.used, self.capacity),
                getDeviceProperties=lambda number: {"name": b"fake", "totalGlobalMem": self.capacity},
            ),
            memory=SimpleNamespace(OutOfMemoryError=OutOfMemoryError),
            Device=lambda number: nullcontext(),
            Stream=_Stream,
        )
        pool = SimpleNamespace(free_bytes=lambda: 0, free_all_blocks=lambda: None)
        calls = {"asarray": self.upload, "asnumpy": _copied}
        cupy = SimpleNamespace(cuda=cuda, get_default_memory_pool=lambda: pool, **calls)
        plan = SimpleNamespace(Plan=type("Plan", (_Plan,), {"device": self}))
        return Gpu(cupy, plan, SimpleNamespace(cudaGetLastError=self.forget))


def device_of(name: str) -> Gpu:
    """Return a "fake" GPU, or the "gpu" of this machine; the test is left out where there is none."""
    try:
        return Device().backend() if name == "fake" else gpu_backend()
    except BackendError as error:
        pytest.skip(str(error))


def _copied(array: Array, out: Any) -> Any:
    out[...] = array.host
    return out


def _attribute(name: str) -> Any:
    return property(lambda self: getattr(self.host, name))


def _part(name: str) -> Any:
    def assign(array: Array, value: Any) -> None:
        setattr(array.host, name, _operand(value))

    return property(lambda self: Array(self.device, getattr(self.host, name), self), assign)


class Array(NDArrayOperatorsMixin):
    """An array of the device, with what CuPy's have of NumPy's; a view keeps its owner alive."""

    shape, ndim, size, dtype, flags = map(_attribute, ("shape", "ndim", "size", "dtype", "flags"))
    T, real, imag = map(_part, ("T", "real", "imag"))
    _size = 0

    def __init__(self, device: Device, host: Any, owner: Array | None = None) -> None:
        self.device, self.host, self.owner = device, np.asarray(host), owner
        self._size = 0 if owner is not None else device.take(self.host.nbytes)

    def __del__(self) -> None:
        self.device.used -= self._size

    def __array__(self, *args: Any, **kwargs: Any) -> None:
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Please use `.get()`")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if (ufunc.__name__, method) == ("add", "at"):
            return ufunc.at(*map(_operand, inputs))
        if ufunc.__name__ not in UFUNCS or method != "__call__" or not kwargs.keys() <= {"out", "casting", "dtype"}:
            raise TypeError(f"not for devices: {ufunc.__name__}.{method} with {kwargs.keys()}")
        (out,) = kwargs.pop("out", (None,))
        if not isinstance(out, Array | None):
            raise TypeError("Output arguments type must be cupy.ndarray")
        made = ufunc(*map(_operand, inputs), out=None if out is None else out.host, **kwargs)
        return Array(self.device, made) if out is None else out

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func.__module__ != "numpy" or func.__name__ not in FUNCTIONS:
            return NotImplemented
        if func.__name__ == "asarray":
            return self.device.upload(*args, **kwargs)
        made = func(*map(_argument, args), **{name: _argument(value) for name, value in kwargs.items()})
        if isinstance(made, tuple):
            return tuple(Array(self.device, part) for part in made)
        # Whatever comes back is new memory to the device, save what needed no copy.
        return args[0] if args and made is getattr(args[0], "host", None) else Array(self.device, made)

    def __getitem__(self, index: Any) -> Array:
        # Indices on the device, and lists, select copies.
        items = index if isinstance(index, tuple) else (index,)
        is_copy = any(isinstance(part, Array | list) for part in items)
        return Array(self.device, self.host[_index(index)], None if is_copy else self)

    def __setitem__(self, index: Any, value: Any) -> None:
        self.host[_index(index)] = _operand(value)

    def __len__(self) -> int:
        return len(self.host)

    def reshape(self, *shape: int) -> Array:
        return Array(self.device, self.host.reshape(*shape), self)

    def ravel(self) -> Array:
        return self.reshape(-1)

    def astype(self, dtype: Any, copy: bool = True) -> Array:
        return self if not copy and self.dtype == dtype else Array(self.device, self.host.astype(dtype))

    def sum(self, axis: int) -> Array:
        return Array(self.device, self.host.sum(axis=axis))

    def max(self) -> Array:
        return Array(self.device, self.host.max())

    def __float__(self) -> float:
        return float(self.host)

    def sort(self) -> None:
        if not self.host.flags.c_contiguous:
            raise NotImplementedError("Sorting non-contiguous array is not supported.")
        self.host.sort()


def _operand(value: Any) -> Any:
    """Return the host's side of an operand; arrays of the host are none."""
    if not isinstance(value, Array | bool | int | float | complex | np.generic):
        raise TypeError(f"Unsupported type {type(value)}")
    return value.host if isinstance(value, Array) else value


def _argument(value: Any) -> Any:
    """Return the host's side of an argument: an array of the device, a sequence of such arrays, or a setting."""
    if isinstance(value, list | tuple) and any(isinstance(part, Array) for part in value):
        return [_operand(part) for part in value]
    return _operand(value) if isinstance(value, Array | np.ndarray) else value


def _index(index: Any) -> Any:
    """Return an index for NumPy. CuPy would upload an array of the host on the quiet."""
    return tuple(map(_argument, index)) if isinstance(index, tuple) else _argument(index)


class _Plan:
    """A plan as cufinufft.Plan, with FINUFFT's own version of its older kernel."""

    device: Device

    def __init__(self, nufft_type: int, n_modes: tuple[int, int, int], **options: Any) -> None:
        self._plan, self._size, self._dtype = None, 0, np.dtype(options["dtype"])
        assert _REQUIRED <= options.keys() <= OPTIONS | {"n_trans", "eps", "isign", "dtype"}, options
        self.device.options.append({"n_modes": n_modes, **options})
        self._plan, sigma = ctypes.c_void_p(None), options["upsampfac"]
        # An error of an earlier plan passes for its own.
        if self.device.forget() or (sigma not in (1.25, 2.0) and options["gpu_kerevalmeth"]):
            self.device.fail("plan", "error")
        self.device.fail("plan")
        cells = int(np.prod([sigma * count for count in n_modes]))
        assert cells < 2**31, "cells are counted in 32 bits"
        try:
            # The grid, and the FFT's work area.
            self._size = self.device.take(2 * cells * self._dtype.itemsize)
        except OutOfMemoryError:
            self.device.fail("plan", "memory")
        same = {name: options[name] for name in ("eps", "isign", "dtype", "modeord", "upsampfac")}
        self._made = finufft.Plan(nufft_type, n_modes, **same, nthreads=1, spread_kerformula=1, showwarn=0)
        self._plan = ctypes.c_void_p(1)

    def setpts(self, *points: Array) -> None:
        with self.device.call("setpts"):
            self._references = points
            self._made.setpts(*(self._checked(row, self._dtype.type(0).real.dtype) for row in points))

    def execute(self, data: Array) -> Array:
        with self.device.call("execute"):
            return Array(self.device, self._made.execute(self._checked(data, self._dtype)))

    def _checked(self, array: Array, dtype: Any) -> Any:
        if not isinstance(array, Array) or array.dtype != dtype or not array.flags.c_contiguous:
            raise TypeError(f"a contiguous array of {dtype} on the device was expected.")
        return array.host

    def __del__(self) -> None:
        if self._plan is not None and self._plan.value is None:
            raise RuntimeError("Error destroying plan.")
        self.device.used -= self._size
