"""A GPU that is none: arrays, allocator and plans as strict as CuPy's and cuFINUFFT's, computed by NumPy and FINUFFT.

What the real ones do was read from CuPy 14.2 and cuFINUFFT 2.5.1: which functions NumPy's protocols
reach, that nothing is converted on the quiet, that device memory is limited, which options a plan
takes, and how its failures look. `test_backends` holds the lists against the real CuPy where it is
installed.
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
from numpy.lib.mixins import NDArrayOperatorsMixin

from sobolev_batch.spectral.backends.backends import GPU_COSTS, Gpu
from sobolev_batch.spectral.backends.cuda import Cuda

# What CuPy answers when NumPy's function of that name is called. `ones` and `full` are not among them:
# with like= NumPy passes on a keyword that CuPy's do not know.
FUNCTIONS = {
    "arange", "ascontiguousarray", "asarray", "bincount", "concatenate", "cumsum", "empty", "flatnonzero", "repeat",
    "stack", "tile", "unique", "zeros",
}  # fmt: skip
# Of its universal functions, those that the package needs. matmul is not among them, since it needs cuBLAS,
# nor is any reduceat, since CuPy's loses digits.
UFUNCS = {
    "absolute", "add", "bitwise_and", "bitwise_or", "cos", "divide", "exp", "left_shift", "maximum", "minimum",
    "multiply", "negative", "not_equal", "right_shift", "rint", "subtract", "tan",
}  # fmt: skip

# The fields of the options structure of cuFINUFFT 2.5.1.
OPTIONS = {
    "upsampfac", "gpu_method", "gpu_sort", "gpu_binsizex", "gpu_binsizey", "gpu_binsizez", "gpu_obinsizex",
    "gpu_obinsizey", "gpu_obinsizez", "gpu_maxsubprobsize", "gpu_kerevalmeth", "gpu_spreadinterponly",
    "gpu_maxbatchsize", "gpu_device_id", "gpu_stream", "modeord", "gpu_np", "debug",
}  # fmt: skip

_SCALARS = (bool, int, float, complex, np.generic)
_MEMORY_ALLOCATION = 2  # of cudaError_t


class OutOfMemoryError(MemoryError):
    """As cupy.cuda.memory.OutOfMemoryError."""


class CUDARuntimeError(RuntimeError):
    """As cupy_backends.cuda.api.runtime.CUDARuntimeError."""

    def __init__(self, status: int) -> None:
        super().__init__(f"cudaError {status}")
        self.status = status


@dataclass(eq=False)
class Device:
    """The device: its memory, what has been asked of it, and what is to go wrong.

    Attributes:
        capacity: bytes of memory.
        used: bytes in use.
        most_used: the largest number of them so far.
        options: of each plan that was asked for.
        failures: what goes wrong: "plan", "setpts" or "execute", and "memory" or "error", in that order.
        last_error: that cuFINUFFT's runtime remembers.
    """

    capacity: float = 1e12
    used: int = 0
    most_used: int = 0
    options: list[dict[str, Any]] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)
    last_error: int = 0
    busy: threading.Lock = field(default_factory=threading.Lock)

    def take(self, size: int) -> None:
        if self.used + size > self.capacity:
            raise OutOfMemoryError(f"Out of memory allocating {size:,} bytes (allocated so far: {self.used:,} bytes).")
        self.used += size
        self.most_used = max(self.most_used, self.used)

    def give(self, size: int) -> None:
        self.used -= size

    def fail(self, where: str) -> None:
        """Fail as cuFINUFFT does, if it is to go wrong here."""
        if not self.failures or self.failures[0][0] != where:
            return
        _, what = self.failures.pop(0)
        self.last_error = _MEMORY_ALLOCATION if what == "memory" else 0
        message = {"plan": "creating plan", "setpts": "setting non-uniform points", "execute": "executing plan"}
        raise RuntimeError(f"Error {message[where]}.")

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Work that no second thread may be at."""
        assert self.busy.acquire(blocking=False), "two threads at one device"
        try:
            time.sleep(1e-3)
            yield
        finally:
            self.busy.release()

    def backend(self) -> Gpu:
        """The backend that computes on this device."""
        return Gpu("gpu", "cufinufft", GPU_COSTS, Cuda(self.cupy, self.cufinufft, self.runtime))

    @property
    def cupy(self) -> Any:
        """The parts of CuPy that are called by name."""
        runtime = SimpleNamespace(
            CUDARuntimeError=CUDARuntimeError,
            memGetInfo=lambda: (self.capacity - self.used, self.capacity),
            getDeviceCount=lambda: 1,
            getDeviceProperties=lambda number: {"name": b"fake", "totalGlobalMem": self.capacity},
        )
        pool = SimpleNamespace(free_bytes=lambda: 0, free_all_blocks=lambda: None)
        cuda = SimpleNamespace(
            runtime=runtime,
            memory=SimpleNamespace(OutOfMemoryError=OutOfMemoryError),
            Device=lambda number: nullcontext(),
            Stream=SimpleNamespace(null=nullcontext()),
        )
        return SimpleNamespace(
            cuda=cuda,
            get_default_memory_pool=lambda: pool,
            asarray=self._asarray,
            asnumpy=lambda array: array.host.copy(),
        )

    def _asarray(self, array: Any) -> Array:
        assert isinstance(array, np.ndarray)
        return Array(self, array.copy())

    @property
    def cufinufft(self) -> Any:
        """The module, as far as it is used."""
        device = self

        class Plan(_Plan):
            def __init__(self, *args: Any, **options: Any) -> None:
                super().__init__(device, *args, **options)

        return SimpleNamespace(Plan=Plan)

    @property
    def runtime(self) -> Any:
        """The CUDA runtime of cuFINUFFT."""
        return SimpleNamespace(cudaGetLastError=self.forget)

    def forget(self) -> int:
        error, self.last_error = self.last_error, 0
        return error


class Array(NDArrayOperatorsMixin):
    """An array of the device, with what CuPy's have of NumPy's."""

    def __init__(self, device: Device, host: Any, owner: Array | None = None) -> None:
        self.device, self.host = device, host
        # A view keeps its base alive, as CuPy's views do.
        self.owner = owner
        self._size = 0
        if owner is None:
            device.take(host.nbytes)
            self._size = host.nbytes

    def __del__(self) -> None:
        self.device.give(self._size)

    def __array__(self, *args: Any, **kwargs: Any) -> None:
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Please use `.get()`")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if ufunc.__name__ not in UFUNCS or method != "__call__":
            raise TypeError(f"not for devices: {ufunc.__name__}.{method}")
        if not kwargs.keys() <= {"out", "casting", "dtype"}:
            raise TypeError(f"Wrong arguments {kwargs}")
        hosts = [self._operand(each) for each in inputs]
        (out,) = kwargs.pop("out", (None,))
        if out is None:
            return Array(self.device, np.asarray(ufunc(*hosts, **kwargs)))
        if not isinstance(out, Array):
            raise TypeError("Output arguments type must be cupy.ndarray")
        assert out.shape == np.broadcast_shapes(*(np.shape(host) for host in hosts)), "Out shape is mismatched"
        ufunc(*hosts, out=out.host, **kwargs)
        return out

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if func.__module__ != "numpy" or func.__name__ not in FUNCTIONS:
            return NotImplemented
        if func.__name__ == "asarray":
            return self.device._asarray(*args, **kwargs)
        made = func(*(self._argument(each) for each in args), **{k: self._argument(v) for k, v in kwargs.items()})
        if isinstance(made, tuple):
            return tuple(Array(self.device, each) for each in made)
        # Whatever comes back is new memory to the device, save what needed no copy.
        same = func.__name__ == "ascontiguousarray" and made is args[0].host
        return args[0] if same else Array(self.device, made)

    def _operand(self, value: Any) -> Any:
        if isinstance(value, Array):
            assert value.device is self.device
            return value.host
        if isinstance(value, _SCALARS):
            return value
        raise TypeError(f"Unsupported type {type(value)}")

    def _argument(self, value: Any) -> Any:
        if isinstance(value, list | tuple) and any(isinstance(each, Array) for each in value):
            if not all(isinstance(each, Array) for each in value):
                raise TypeError("Only cupy arrays can be concatenated")
            return [each.host for each in value]
        if isinstance(value, np.ndarray):
            raise TypeError(f"Unsupported type {type(value)}")
        return value.host if isinstance(value, Array) else value

    def _view(self, host: Any) -> Array:
        return Array(self.device, host, self)

    def _index(self, index: Any) -> tuple[Any, bool]:
        """An index for NumPy, and whether it selects a view."""
        items = index if isinstance(index, tuple) else (index,)
        if any(isinstance(each, np.ndarray) for each in items):
            raise TypeError("an index on the host is uploaded on the quiet")
        view = not any(isinstance(each, Array | list) for each in items)
        hosts = tuple(each.host if isinstance(each, Array) else each for each in items)
        return hosts if isinstance(index, tuple) else hosts[0], view

    def __getitem__(self, index: Any) -> Array:
        place, view = self._index(index)
        found = np.asarray(self.host[place])
        return self._view(found) if view else Array(self.device, found)

    def __setitem__(self, index: Any, value: Any) -> None:
        self.host[self._index(index)[0]] = self._operand(value)

    def __iter__(self) -> Iterator[Array]:
        return (self[number] for number in range(len(self)))

    def __len__(self) -> int:
        return len(self.host)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.host.shape)

    @property
    def ndim(self) -> int:
        return int(self.host.ndim)

    @property
    def size(self) -> int:
        return int(self.host.size)

    @property
    def dtype(self) -> Any:
        return self.host.dtype

    @property
    def flags(self) -> Any:
        return self.host.flags

    @property
    def T(self) -> Array:  # noqa: N802
        return self._view(self.host.T)

    @property
    def real(self) -> Array:
        return self._view(self.host.real)

    @real.setter
    def real(self, value: Any) -> None:
        self.host.real = self._operand(value)

    @property
    def imag(self) -> Array:
        return self._view(self.host.imag)

    @imag.setter
    def imag(self, value: Any) -> None:
        self.host.imag = self._operand(value)

    def reshape(self, *shape: int) -> Array:
        return self._view(self.host.reshape(*shape))

    def ravel(self) -> Array:
        return self._view(self.host.ravel())

    def astype(self, dtype: Any, copy: bool = True) -> Array:
        if not copy and self.dtype == dtype:
            return self
        return Array(self.device, self.host.astype(dtype))

    def sort(self) -> None:
        if not self.host.flags.c_contiguous:
            raise NotImplementedError("Sorting non-contiguous array is not supported.")
        self.host.sort()


class _Plan:
    """A plan as cufinufft.Plan, with FINUFFT's own version of its older kernel."""

    def __init__(
        self,
        device: Device,
        nufft_type: int,
        n_modes: tuple[int, int, int],
        n_trans: int = 1,
        eps: float = 1e-6,
        isign: int | None = None,
        dtype: str = "complex64",
        **options: Any,
    ) -> None:
        self._plan: Any = None
        self._device, self._size = device, 0
        for name in options:
            if name not in OPTIONS:
                raise TypeError(f"Invalid option '{name}'")
        assert (n_trans, len(n_modes)) == (1, 3)
        assert nufft_type in (1, 2)
        assert isign in (-1, 1)
        assert options["gpu_device_id"] == 0
        device.options.append({"eps": eps, "isign": isign, "dtype": dtype, "n_modes": n_modes, **options})
        self._plan = ctypes.c_void_p(None)
        self._dtype = np.dtype(dtype)
        if device.forget():  # an error of an earlier plan passes for its own
            raise RuntimeError("Error creating plan.")
        device.fail("plan")
        sigma = options["upsampfac"]
        if sigma not in (1.25, 2.0) and options["gpu_kerevalmeth"]:
            raise RuntimeError("Error creating plan.")
        cells = int(np.prod([sigma * count for count in n_modes]))
        assert cells < 2**31, "cells are counted in 32 bits"
        # The grid, and the FFT's work area.
        self._take("plan", 2 * cells * self._dtype.itemsize)
        self._made = finufft.Plan(
            nufft_type,
            n_modes,
            eps=eps,
            isign=isign,
            dtype=dtype,
            modeord=options["modeord"],
            upsampfac=sigma,
            nthreads=1,
            spread_kerformula=1,
            showwarn=0,
        )
        self._type, self._n_modes = nufft_type, n_modes
        self._plan = ctypes.c_void_p(1)

    def _take(self, where: str, size: int) -> None:
        try:
            self._device.take(size)
        except OutOfMemoryError:
            self._device.failures.insert(0, (where, "memory"))
            self._device.fail(where)
        self._size += size

    def setpts(self, x: Array, y: Array, z: Array) -> None:
        with self._device.alone():
            self._device.fail("setpts")
            for points in (x, y, z):
                self._check(points, np.float64 if self._dtype == np.complex128 else np.float32)
                assert points.shape == x.shape
            self._references = (x, y, z)
            self._made.setpts(x.host, y.host, z.host)

    def execute(self, data: Array) -> Array:
        with self._device.alone():
            self._device.fail("execute")
            self._check(data, self._dtype)
            assert data.shape == (self._references[0].shape if self._type == 1 else self._n_modes)
            return Array(self._device, self._made.execute(data.host))

    def _check(self, array: Array, dtype: Any) -> None:
        if not isinstance(array, Array):
            raise TypeError("Invalid GPU array implementation.")
        if array.dtype != dtype:
            raise TypeError(f"{array.dtype} was given, but {dtype} was expected.")
        if not array.flags.c_contiguous:
            raise TypeError("does not satisfy the following requirement: C")

    def __del__(self) -> None:
        if self._plan is None:
            return
        if self._plan.value is None:
            raise RuntimeError("Error destroying plan.")
        self._device.give(self._size)
