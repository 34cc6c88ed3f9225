"""Times on a GPU, where there is one: of transforms alone, of batches of meshes, and of exact values."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from statistics import mean, median

import numpy as np

import sobolev_batch as sb
from benchmarks.table import Row, as_seconds, at_most
from benchmarks.timing import Effort, elapsed_seconds, take_turns
from benchmarks.transforms import XI_MAX, fresh, settings_of_the_paper
from sobolev_batch import compiled
from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.norms.tail.remainder import remainder
from sobolev_batch.transform.backends import CPU, Backend, Gpu, gpu_backend
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.fourier import Execution, TransformSettings, transform_block
from sobolev_batch.transform.nufft import transform_points
from sobolev_batch.transform.nufft_costs import NufftSpec, Workload

# Level of the icosphere, intervals per axis, seconds to stay below.
_CASES = ((7, 128, 0.060), (5, 416, 0.150))
_QUICK_CASES = ((3, 32, 0.060),)
# Level, intervals, meshes, threads, whether each mesh was just read, seconds for each mesh to stay below.
_BATCHES = (
    (5, 64, 200, 1, False, 0.005),
    (5, 64, 200, 3, True, None),
    (7, 128, 60, 1, False, 0.015),
    (7, 128, 60, 1, True, None),
    (7, 128, 60, 3, True, None),
)
_QUICK_BATCHES = ((3, 32, 8, 2, True, None),)
_PRECISIONS: tuple[ComplexDtype, ...] = ("complex128", "complex64")
# Passes over the fine grid that a transform cannot do without: it is set to zero, read and written where points are,
# read and written along each axis, and read once more for the modes.
_PASSES = 10
_SAMPLING_SECONDS = 0.02
_CUTOFF = 20.0


def on_a_gpu(effort: Effort) -> Iterator[Row]:
    """Item 9: of meshes whose lengths are known, except in batches, where each mesh was just read."""
    try:
        gpu = gpu_backend()
    except sb.errors.BackendError as error:
        yield Row("9", f"not run: {error}")
        return
    # As in a long study: in the first second of work, meshes are measured without compiled loops.
    compiled.pays(math.inf)
    runtime = gpu.cupy.cuda.runtime
    yield Row("9", f"device: {gpu.description}, driver for CUDA {runtime.driverGetVersion()}")
    bandwidth = _bandwidth(gpu, effort.repeats)
    yield Row("9", "GPU: bytes read and written by a copy in its memory", f"{bandwidth / 1e12:.3g} TB/s")
    for level, intervals, limit in _QUICK_CASES if effort.quick else _CASES:
        for dtype in _PRECISIONS:
            yield from _transforms(gpu, level, intervals, limit, dtype, bandwidth, effort)
    for batch in _QUICK_BATCHES if effort.quick else _BATCHES:
        yield _batch(gpu, *batch)
    for level, count in ((3, 16),) if effort.quick else ((5, 256), (7, 32)):
        yield from _exact_values(gpu, level, count, effort)
    yield _close_points(gpu, 3 if effort.quick else 5, effort)


def _transforms(
    gpu: Gpu, level: int, intervals: int, limit: float, dtype: ComplexDtype, bandwidth: float, effort: Effort
) -> Iterator[Row]:
    mesh, lattice = sb.shapes.icosphere(level), sb.Lattice(XI_MAX, intervals)
    settings = settings_of_the_paper(mesh, lattice, dtype)
    spec = NufftSpec(lattice.half.shape, settings.eps, dtype)

    def to_the_device(given: sb.Mesh) -> None:
        with gpu.work():
            points = settings.kind_for(given, lattice).batches(spec.batch, gpu)
            transform_points(points, lattice, lattice.half, spec, gpu)
            gpu.cupy.cuda.Device().synchronize()

    def to_the_host(given: sb.Mesh) -> None:
        made = transform_block(given, lattice, lattice.half, settings, Execution(gpu))
        if made.backend != gpu.library:
            raise RuntimeError(f"not a time of the GPU: {made.backend}")

    what = f"GPU: T_{level}, M = {intervals}, {dtype}: transform"
    alone, whole = take_turns([to_the_device, to_the_host], lambda: mesh, effort.repeats)
    bound = _PASSES * gpu.costs.grid_cells(spec, Workload()) * spec.item_bytes / bandwidth
    for where, seconds in (("device", alone), ("host", whole)):
        here = f"{what}, until it is on the {where}"
        yield Row("9", here, as_seconds(seconds), as_seconds(limit), seconds / limit, at_most(1.0))
    yield Row("9", f"{what}, against the bound by bandwidth", as_seconds(alone), as_seconds(bound), alone / bound)


def _batch(gpu: Gpu, level: int, intervals: int, count: int, threads: int, just_read: bool, limit: float | None) -> Row:
    sphere, lattice, rng = sb.shapes.icosphere(level), sb.Lattice(XI_MAX, intervals), np.random.default_rng(0)
    settings = TransformSettings()
    scales = 1 + 1e-3 * rng.normal(size=(count, len(sphere.vertices), 1))
    meshes = [sb.Mesh(sphere.vertices * scale, sphere.triangles) for scale in scales]

    def transform(mesh: sb.Mesh) -> str:
        given = fresh(mesh) if just_read else mesh
        return transform_block(given, lattice, lattice.half, settings, Execution(gpu)).backend

    with ThreadPoolExecutor(threads) as pool, _Utilization() as utilization:
        for mesh in meshes[:1] if just_read else meshes:
            transform(mesh)
        seconds = elapsed_seconds(lambda: list(pool.map(transform, meshes))) / count
    state = "just read" if just_read else "with known lengths"
    what = f"GPU: {count} x T_{level}, M = {intervals}, {state}, threads: {threads}: each mesh"
    what += f" ({1 / seconds:.3g} a second, the device computes {utilization.percent:.0f} % of the time)"
    target = None if limit is None else at_most(1)
    other, ratio = ("", None) if limit is None else (as_seconds(limit), seconds / limit)
    return Row("9", what, as_seconds(seconds), other, ratio, target)


def _exact_values(gpu: Gpu, level: int, count: int, effort: Effort) -> Iterator[Row]:
    mesh = sb.shapes.icosphere(level)
    frequencies = 4 * XI_MAX * np.random.default_rng(0).normal(size=(count, 3))

    def on(backend: Backend) -> Callable[[object], object]:
        return lambda given: exact_transform(mesh, frequencies, backend)

    ours, processor = take_turns([on(gpu), on(CPU)], lambda: None, min(effort.repeats, 3))
    what = f"GPU: exact values, T_{level} at {count} frequencies, against one core"
    yield Row("9", what, as_seconds(ours), as_seconds(processor), processor / ours)


def _close_points(gpu: Gpu, level: int, effort: Effort) -> Row:
    sphere, rng = sb.shapes.icosphere(level), np.random.default_rng(0)
    pair = [
        sphere,
        sb.Mesh(sphere.vertices * (1 + 2e-3 * rng.normal(size=(len(sphere.vertices), 1))), sphere.triangles),
    ]

    def on(backend: Backend) -> Callable[[object], object]:
        return lambda given: remainder(pair, [1, -1], _CUTOFF, execution=Execution(backend))

    ours, processor = take_turns([on(gpu), on(CPU)], lambda: None, min(effort.repeats, 5))
    what = f"GPU: close points of two T_{level} beyond |ξ| = {_CUTOFF:g}, against one core"
    return Row("9", what, as_seconds(ours), as_seconds(processor), processor / ours)


def _bandwidth(gpu: Gpu, repeats: int) -> float:
    """Bytes read and written in a second by the median copy of half a gigabyte."""
    cupy = gpu.cupy
    source = cupy.arange(1 << 26, dtype=float)
    target = cupy.empty_like(source)

    def copy() -> None:
        cupy.copyto(target, source)
        cupy.cuda.Device().synchronize()

    copy()
    return 2 * int(source.nbytes) / median(elapsed_seconds(copy) for _ in range(repeats))


class _Utilization:
    """Percent of the time during which the driver saw the device compute, as it says itself."""

    percent = 0.0

    def __enter__(self) -> _Utilization:
        import pynvml

        pynvml.nvmlInit()
        device = pynvml.nvmlDeviceGetHandleByIndex(0)
        self._seen: list[int] = []
        self._stop = threading.Event()

        def watch() -> None:
            while not self._stop.wait(_SAMPLING_SECONDS):
                self._seen.append(pynvml.nvmlDeviceGetUtilizationRates(device).gpu)

        self._watcher = threading.Thread(target=watch)
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._watcher.join()
        self.percent = mean(self._seen or [0])
