"""The Fourier transform of a surface on a block of the lattice, by a closed form or by a NUFFT: settings, memory, time.

The prediction of errors is good enough to choose settings by; the probe measures the error afterwards.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self, get_args

import numpy as np

from sobolev_batch.arrays import Array, ComplexDtype, Complexes, Reals
from sobolev_batch.errors import InputError, LatticeError, one_line
from sobolev_batch.geometry.subdivision import icosphere
from sobolev_batch.geometry.surface import Similarity, Surface, is_finite_number
from sobolev_batch.machine import available_cores
from sobolev_batch.parameters import check_choice, is_whole_number
from sobolev_batch.transform.backends import CPU, Backend, Gpu
from sobolev_batch.transform.kinds import SurfaceKind, kind_of
from sobolev_batch.transform.lattice import LARGEST_M, Block, FrequencyLattice, Lattice
from sobolev_batch.transform.nufft import transform_points
from sobolev_batch.transform.nufft_costs import DEFAULT_BATCH, FINEST_EPS, Costs, NufftSpec, Workload, fastest_spec
from sobolev_batch.transform.rule_errors import weight_masses
from sobolev_batch.transform.rules import fixed_rule

DEFAULT_EPS: dict[ComplexDtype, float] = {"complex128": 1e-9, "complex64": 1e-6}
COARSEST_EPS = 0.1
# OpenMP crashes with very many.
_MOST_THREADS = 1024
# Fraction of a field's error that is left to the NUFFT.
_NUFFT_FRACTION = 0.4
# The rms error of a field of many points at one frequency over eps · area: measured 0.003 to 0.006.
_NUFFT_ERROR = 0.005
# The same of single precision over the area, however small its eps; measured 1e-7 at most.
_SINGLE_ROUNDING = 3e-7
# Samples of a closed form at a time: temporaries of the whole block would take several times its size.
_SAMPLES = 1 << 18
# The fraction of a GPU's free memory that a transform plans with, and the number of attempts, each with half of it.
_DEVICE_FRACTION, _ATTEMPTS = 0.9, 4
_OUT_OF_MEMORY = "out of memory"
# Triangles of a mesh differ in size, which their rules follow; those of this sphere stand for them.
_STAND_IN_LEVEL = 2
# A sphere, transformed in a fraction of a second, mostly spreading its points.
_TRIAL_LEVEL, _TRIAL_LATTICE = 5, Lattice(5.0, 64)
_NANO = 1e-9
# Raise it whenever the numbers for a given surface and settings change, or the surface that is read from a file: stored
# fields of another version are then computed again instead of being compared with new ones.
NUMERICS_VERSION = 18

_log = logging.getLogger(__name__)


@dataclass(frozen=True, init=False)
class TransformSettings:
    """Accuracy, dtype and quadrature of fields; InputError where one is unknown or out of reach for the dtype.

    Attributes:
        eps: Accuracy of a field relative to the surface's area; default 1e-9 in complex128, 1e-6 in complex64.
        dtype: "complex128" or "complex64".
        quadrature: Rules for triangles: see `fixed_rule`.
        tolerance: Largest error of the rule on any one triangle, relative to its area, or of the nodes of a
            parametrised surface, relative to the whole area; by default what eps needs.
        stored: Dtype that values are rounded to once they are computed; by default that of the computation.
    """

    eps: float
    dtype: ComplexDtype
    quadrature: str | int
    tolerance: float | None
    stored: ComplexDtype

    def __init__(
        self,
        eps: float | None = None,
        dtype: ComplexDtype = "complex128",
        quadrature: str | int = "auto",
        tolerance: float | None = None,
        stored: ComplexDtype | None = None,
    ) -> None:
        check_choice("dtype", dtype, get_args(ComplexDtype))
        eps = DEFAULT_EPS[dtype] if eps is None else eps
        if not is_finite_number(eps) or not FINEST_EPS[dtype] <= eps <= COARSEST_EPS:
            ends = f"{FINEST_EPS[dtype]:g} and {COARSEST_EPS:g}"
            raise InputError(f"eps must lie between {ends} in {dtype}, found {eps!r}")
        fixed_rule(quadrature)
        vars(self).update(
            eps=float(eps), dtype=dtype, quadrature=quadrature, tolerance=tolerance, stored=stored or dtype
        )

    def kind_for(self, surface: Surface, lattice: FrequencyLattice) -> SurfaceKind:
        """Return a surface with quadrature points for a lattice."""
        return kind_of(surface, lattice.highest_frequency, self.eps, self.quadrature, self.tolerance)


def thread_count(threads: int | None) -> int:
    """Return a number of threads, by default one per core; InputError where it is not from 1 to 1,024."""
    if threads is None:
        return available_cores()
    if not is_whole_number(threads) or not 1 <= threads <= _MOST_THREADS:
        raise InputError(f"threads must be a whole number from 1 to {_MOST_THREADS:,}, found {threads!r}")
    return int(threads)


@dataclass(frozen=True)
class Execution:
    """The means to compute a transform; values depend on them by a small multiple of eps at most.

    Attributes:
        backend: Backend to compute on. The processor steps in for a GPU that fails.
        allowed_bytes: Memory that a transform may take on the processor, without the mesh and the result; None
            for no limit. On a GPU the limit is its free memory. See `fastest_spec`.
        batch: Largest number of points of one NUFFT.
    """

    backend: Backend = CPU
    threads: int = 1
    allowed_bytes: float | None = None
    batch: int = DEFAULT_BATCH


ON_CPU = Execution()


@dataclass(frozen=True)
class ErrorTarget:
    """Largest permitted norms ||computed - exact||_s of a field's own error, one for each order s."""

    orders: tuple[float, ...]
    norms: tuple[float, ...]

    def tightened(self, factor: float) -> Self:
        """Return a target that is smaller by a factor."""
        return replace(self, norms=tuple(norm / factor for norm in self.norms))


def cheapest_dtype(surfaces: Sequence[Surface], lattice: FrequencyLattice, target: ErrorTarget) -> ComplexDtype:
    """Return the dtype in which the field of each surface meets a target: single precision loses 1e-7 of the area."""
    rounding = _SINGLE_ROUNDING * max(surface.area for surface in surfaces)
    errors = rounding * np.sqrt(weight_masses(lattice, target.orders))
    return "complex64" if np.all(errors <= _NUFFT_FRACTION * np.array(target.norms)) else "complex128"


def choose_settings(
    surface: Surface, lattice: FrequencyLattice, target: ErrorTarget, settings: TransformSettings
) -> TransformSettings:
    """Return the cheapest eps and tolerance that are predicted to meet a target, or the finest possible ones."""
    kind = kind_of(surface)
    if kind.is_closed_form:
        return settings
    norms, masses = np.array(target.norms), weight_masses(lattice, target.orders)
    tolerance = kind.loosest_tolerance(lattice, target.orders, (1 - _NUFFT_FRACTION) * norms)
    # The largest eps with which the NUFFT of that many points keeps to its fraction.
    spread = _NUFFT_ERROR + 1 / math.sqrt(kind.fewest_points)
    eps = float(np.min(_NUFFT_FRACTION * norms / (surface.area * spread * np.sqrt(masses))))
    return replace(settings, eps=min(max(eps, FINEST_EPS[settings.dtype]), COARSEST_EPS), tolerance=tolerance)


def settings_on(
    lattice: FrequencyLattice, surface: Surface, settings: TransformSettings | ErrorTarget
) -> TransformSettings:
    """Return settings as they are, or the cheapest ones with which a surface meets a target on a lattice."""
    if isinstance(settings, TransformSettings):
        return settings
    if kind_of(surface).is_closed_form:
        return TransformSettings()
    cheapest = TransformSettings(dtype=cheapest_dtype([surface], lattice, settings))
    return choose_settings(surface, lattice, settings, cheapest)


@dataclass(frozen=True, eq=False)
class Transformed:
    """A block of a field: its values, the number of quadrature points, and the library or "closed form".

    The library comes with the reason if another one failed before.
    """

    values: Complexes
    points: int
    backend: str


def transform_block(
    surface: Surface,
    lattice: FrequencyLattice,
    block: Block,
    settings: TransformSettings,
    execution: Execution = ON_CPU,
    kind: SurfaceKind | None = None,
) -> Transformed:
    """Return the transform of a surface on one block of the lattice.

    Several blocks take one choice of rules with the kind of the surface for the same settings. LatticeError where the
    surface extends beyond the lattice's half period, InputError where the allowed memory is too little, or the
    quadrature of a parametrised surface does not converge.
    """
    exact = kind_of(surface)
    if isinstance(lattice, Lattice):
        require_inside(surface, lattice)
    if exact.is_closed_form:
        values: Complexes = np.empty(block.shape, dtype=settings.stored)
        for part in block.split(_SAMPLES):
            values[part.place_in(block)] = exact.exact_values(lattice.points(part)).reshape(part.shape)
        return Transformed(values, 0, "closed form")
    kind = kind or settings.kind_for(surface, lattice)
    whole = NufftSpec(block.shape, settings.eps, settings.dtype, threads=execution.threads, batch=execution.batch)
    low, high = surface.extent.box
    fill = min(1.0, float(np.prod((high - low) / (2 * lattice.half_period))))

    kind.choose_points(execution.backend)
    points = kind.expected_points if isinstance(execution.backend, Gpu) else math.inf

    def fitting(costs: Costs, allowed_bytes: float) -> tuple[NufftSpec, int]:
        workload = Workload(points, triangles=kind.triangles, fill=fill)
        if costs.projected_bytes(whole, workload) > allowed_bytes:
            # Only now do the points need counting.
            workload = replace(workload, points=kind.expected_points, largest_points=kind.largest_points)
        spec = fastest_spec(whole, workload, costs, allowed_bytes)
        return spec, costs.projected_bytes(spec, workload)

    def compute(backend: Backend, spec: NufftSpec) -> tuple[Array, int]:
        values, points = transform_points(kind.batches(spec.batch, backend), lattice, block, spec, backend)
        return values.astype(settings.stored, copy=False), points

    # Before the GPU is tried: the memory must be enough for the processor that may have to step in.
    spec = whole if execution.allowed_bytes is None else fitting(CPU.costs, execution.allowed_bytes)[0]
    if not isinstance(execution.backend, Gpu):
        return Transformed(*compute(CPU, spec), CPU.library)
    gpu = execution.backend
    try:
        with gpu.work():
            computed, count = _on_gpu(gpu, block.size * whole.item_bytes, fitting, compute)
        # Other threads have the device meanwhile.
        return Transformed(gpu.download(computed), count, gpu.library)
    except InputError:  # nothing is small enough
        failure = _OUT_OF_MEMORY
    except Exception as error:
        failure = one_line(error)[:200]
    _log.warning("%s: %s; the processor computes it instead", gpu.library, failure)
    return Transformed(*compute(CPU, spec), f"{CPU.library} after {gpu.library}: {failure}")


def _on_gpu(
    gpu: Gpu,
    result_bytes: int,
    fitting: Callable[[Costs, float], tuple[NufftSpec, int]],
    compute: Callable[[Backend, NufftSpec], tuple[Array, int]],
) -> tuple[Array, int]:
    """Compute on a GPU, and try again with half the memory where it is too little after all; at last InputError."""
    allowed_bytes = _DEVICE_FRACTION * gpu.free_bytes - result_bytes
    for _ in range(_ATTEMPTS):
        spec, projected = fitting(gpu.costs, allowed_bytes)
        gpu.release_memory(projected)
        try:
            return compute(gpu, spec)
        except Exception as error:
            # cuFINUFFT says of a failure only where it happened, and nothing if cuFFT ran out of memory.
            unexplained = type(error) is RuntimeError and projected > allowed_bytes / 2
            if not (gpu.is_out_of_memory(error) or unexplained):
                raise
        allowed_bytes = min(allowed_bytes, projected) / 2
        _log.warning("%s: %s; trying again with %.3g MB", gpu.library, _OUT_OF_MEMORY, allowed_bytes / 1e6)
        gpu.release_memory(math.inf)
    raise InputError(_OUT_OF_MEMORY)


def projected_bytes(block: Block, settings: TransformSettings, *, triangles: int = 0) -> int:
    """Return an upper estimate of the peak memory of `transform_block`, with its result and without the mesh."""
    whole = NufftSpec(block.shape, settings.eps, settings.dtype)
    return block.size * whole.item_bytes + CPU.costs.projected_bytes(whole, Workload(triangles=triangles))


def require_inside(surface: Surface, lattice: Lattice) -> None:
    """Check that a surface lies within the lattice's period, and would not be folded back."""
    kind = "mesh" if kind_of(surface).triangles else "surface"
    require_points_inside(np.stack(surface.extent.box), lattice, f"the {kind} reaches")


def require_points_inside(coordinates: Reals, lattice: Lattice, subject: str = "the points reach") -> None:
    """Check that coordinates lie within the lattice's period; LatticeError otherwise."""
    reach = float(np.abs(coordinates).max(initial=0.0))
    if not reach < lattice.half_period:
        intervals = 2 * math.floor(2 * lattice.xi_max * reach) + 2
        raise LatticeError(
            f"{subject} to |coordinate| = {reach:.6g}, but the lattice (xi_max {lattice.xi_max:g}, "
            f"M {lattice.M}) holds only |coordinate| < 1/(2h) = {lattice.half_period:.6g}; "
            f"take {f'M >= {intervals}, ' if intervals <= LARGEST_M else ''}a smaller xi_max, or scale down"
        )


def field_seconds(triangles: int, area: float, lattice: Lattice, settings: TransformSettings) -> float:
    """Return the predicted processor time of the field of a mesh; of a closed form with zero triangles."""
    spec = NufftSpec(lattice.half.shape, settings.eps, settings.dtype)
    workload = Workload(points=expected_points(triangles, area, lattice, settings), triangles=triangles)
    return _NANO * CPU.costs.projected_nanoseconds(spec, spec.shape, workload)


@lru_cache(maxsize=4)
def slowness(backend: Backend = CPU) -> float:
    """Return how many times as long as predicted a field takes on this machine, in processor time of one thread.

    The time of a GPU is that of the whole computation.
    """
    mesh, settings = icosphere(_TRIAL_LEVEL), TransformSettings()
    clock = time.thread_time if backend is CPU else time.perf_counter
    predicted = field_seconds(len(mesh.triangles), mesh.area, _TRIAL_LATTICE, settings)
    times = []
    # The first time includes what is loaded and tabulated once.
    for _ in range(2):
        started = clock()
        transform_block(mesh, _TRIAL_LATTICE, _TRIAL_LATTICE.half, settings, Execution(backend))
        times.append(clock() - started)
    return min(times) / predicted


def expected_points(triangles: int, area: float, lattice: Lattice, settings: TransformSettings) -> float:
    """Return the number of quadrature points of a mesh, as if all its triangles were alike; see `field_seconds`."""
    if not triangles:
        return 0.0
    # Of many sizes a few stand for all.
    return triangles * _points_of_triangle(float(f"{area / triangles:.1e}"), lattice, settings)


@lru_cache(maxsize=1 << 10)
def _points_of_triangle(area: float, lattice: Lattice, settings: TransformSettings) -> float:
    sphere = icosphere(_STAND_IN_LEVEL)
    count = len(sphere.triangles)
    alike = Similarity(math.sqrt(area * count / sphere.area)).apply(sphere)
    return settings.kind_for(alike, lattice).expected_points / count
