"""Time and memory of nonuniform FFTs, and which of them computes a block within the memory that it may take."""

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from scipy.fft import next_fast_len

from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import MemoryLimitError

Shape = tuple[int, int, int]

# The limits of FINUFFT: below them 2.5 warns, and 2.6 refuses.
FINEST_EPS: dict[ComplexDtype, float] = {"complex128": 1e-14, "complex64": 2e-7}

# Points of one NUFFT: two million take 0.3 GB with strengths and sorting, and make the FFT a small part of the time.
DEFAULT_BATCH = 1 << 21
# The smallest batch holds eight node sets of the largest triangle rule.
_SMALLEST_BATCH = 1 << 12
# The widest kernel of FINUFFT and cuFINUFFT: a grid has at least twice as many cells along each axis.
_WIDEST_KERNEL = 16


@dataclass(frozen=True)
class NufftSpec:
    """A nonuniform FFT in three dimensions.

    Attributes:
        shape: Modes along each axis.
        dtype: Type of strengths and modes.
        oversampling: Ratio of the fine grid to the modes along each axis; None for the fastest one.
        batch: Largest number of points at a time.
    """

    shape: Shape
    eps: float
    dtype: ComplexDtype = "complex128"
    oversampling: float | None = None
    threads: int = 1
    batch: int = DEFAULT_BATCH

    @property
    def size(self) -> int:
        """Number of modes."""
        return math.prod(self.shape)

    @property
    def item_bytes(self) -> int:
        """Size of one mode."""
        return np.dtype(self.dtype).itemsize

    @property
    def real_dtype(self) -> type[np.float32 | np.float64]:
        """Type of the points' coordinates."""
        return np.float32 if self.dtype == "complex64" else np.float64


@dataclass(frozen=True)
class Workload:
    """The points to transform.

    Attributes:
        largest_points: Bound on the number of points, before shared ones are merged.
        fill: Fraction of the lattice's period that the bounding box fills, by volume. At a useful aliasing error it is
            far less than the usual one.
    """

    points: float = math.inf
    largest_points: float = math.inf
    triangles: int = 0
    fill: float = 0.3


@dataclass(frozen=True)
class Costs:
    """Time and memory that a NUFFT library takes: measured, and good enough to choose by.

    Attributes:
        finest_eps: Smallest eps that each oversampling was measured to keep. A coarser grid makes the FFT
            cheaper, but spreading dearer, and amplifies rounding errors.
        point_nanoseconds: Time to make and sort a point.
        spread_nanoseconds: Time to shift and spread a point, without its grid cells.
        spread_cell_nanoseconds: Time for each of the (kernel width)³ grid cells of a point.
        fft_cell_nanoseconds: Time of the FFT for each grid cell.
        point_bytes: Memory for each point of a batch: coordinates, angles, strengths, sorting, temporaries.
        triangle_bytes: Memory for each triangle of the mesh while rules are chosen.
        fixed_bytes: Memory for plans and tables.
        work_grids: Grids that the FFT allocates besides the fine one.
        copies_grid: True if spreading copies the region of the grid that the surface covers.
        largest_grid: Largest number of cells of a fine grid.
    """

    finest_eps: Mapping[ComplexDtype, Mapping[float, float]]
    point_nanoseconds: float
    spread_nanoseconds: float
    spread_cell_nanoseconds: float
    fft_cell_nanoseconds: float
    point_bytes: int
    triangle_bytes: int
    fixed_bytes: int
    work_grids: int
    copies_grid: bool
    largest_grid: int

    def oversamplings(self, spec: NufftSpec) -> tuple[float, ...]:
        """Return the oversamplings that keep the accuracy, the largest first."""
        return tuple(sigma for sigma, finest in self.finest_eps[spec.dtype].items() if spec.eps >= finest)

    def with_oversampling(self, spec: NufftSpec, points: float) -> NufftSpec:
        """Return a specification whose oversampling is set: the fastest for a number of points if it was not."""
        if spec.oversampling is not None:
            return spec

        def nanoseconds(sigma: float) -> float:
            fft = spec.size * sigma**3 * self.fft_cell_nanoseconds
            return points * self.spreading_nanoseconds(sigma, spec.eps) + fft

        return replace(spec, oversampling=min(self.oversamplings(spec), key=nanoseconds))

    def spreading_nanoseconds(self, sigma: float, eps: float) -> float:
        """Return the predicted time to spread a point."""
        width = math.ceil(-math.log(eps) / (math.pi * math.sqrt(1 - 1 / sigma)))
        return self.spread_nanoseconds + self.spread_cell_nanoseconds * width**3

    def grid_cells(self, spec: NufftSpec, workload: Workload) -> int:
        """Return the number of cells of the largest fine grid that may be used."""
        # More points favour more oversampling, never less.
        spec = self.with_oversampling(spec, min(spec.batch, workload.largest_points))
        return math.prod(_grid_length(modes, spec.oversampling or 2.0) for modes in spec.shape)

    def projected_bytes(self, spec: NufftSpec, workload: Workload) -> int:
        """Return an upper estimate of the memory of NUFFTs, without the result and the mesh."""
        grids = 1 + self.work_grids + (workload.fill if self.copies_grid else 0)
        samples = self.grid_cells(spec, workload) * grids + spec.size
        points = min(spec.batch, workload.largest_points) * self.point_bytes
        triangles = workload.triangles * self.triangle_bytes
        return math.ceil(samples * spec.item_bytes + points) + triangles + self.fixed_bytes

    def projected_nanoseconds(self, spec: NufftSpec, shape: Shape, workload: Workload) -> float:
        """Return the predicted time for a block of some shape, whose sub-blocks have the shape of the NUFFTs."""
        sigma = spec.oversampling or max(self.finest_eps[spec.dtype])
        blocks = math.prod(math.ceil(whole / step) for whole, step in zip(shape, spec.shape, strict=True))
        batches = math.ceil(max(workload.points, 1) / spec.batch)
        each_point = self.point_nanoseconds + blocks * self.spreading_nanoseconds(sigma, spec.eps)
        cells = self.grid_cells(spec, workload)
        return workload.points * each_point + batches * blocks * cells * self.fft_cell_nanoseconds


@lru_cache(maxsize=1 << 14)
def _grid_length(modes: int, sigma: float) -> int:
    """Return the cells of the fine grid along an axis: even, with no prime factor above 5, as FINUFFT takes them."""
    least = max(math.ceil(sigma * modes), 2 * _WIDEST_KERNEL)
    return 2 * int(next_fast_len(-(-least // 2), real=True))


CPU_COSTS = Costs(
    finest_eps={
        "complex128": {2.0: 0.0, 1.65: 1e-12, 1.5: 1e-11, 1.25: 1e-7},
        "complex64": {2.0: 0.0, 1.65: 3e-6, 1.5: 2e-5, 1.25: 1e-3},
    },
    point_nanoseconds=150.0,
    spread_nanoseconds=100.0,
    spread_cell_nanoseconds=0.28,
    fft_cell_nanoseconds=27.0,
    point_bytes=140,
    triangle_bytes=100,
    fixed_bytes=8_000_000,
    work_grids=0,
    copies_grid=True,
    largest_grid=10**11,  # FINUFFT's own bound
)

# The times are those of an H100. They decide on nothing but the grid, and every grid keeps eps.
GPU_COSTS = Costs(
    # cuFINUFFT evaluates its kernel by polynomials at these two oversamplings only. Its older kernel was measured
    # with FINUFFT, which has it too: at 1.25 it keeps eps down to 1e-9, and 1e-5 in single precision.
    finest_eps={"complex128": {2.0: 0.0, 1.25: 1e-8}, "complex64": {2.0: 0.0, 1.25: 1e-4}},
    point_nanoseconds=6.0,
    spread_nanoseconds=1.0,
    spread_cell_nanoseconds=0.003,
    fft_cell_nanoseconds=0.07,
    point_bytes=250,
    triangle_bytes=80,
    fixed_bytes=50_000_000,
    work_grids=2,  # cuFFT's work area, and at worst as much for bins of a single cell
    copies_grid=False,
    largest_grid=2**31 - 1,  # cuFINUFFT counts cells in 32 bits and does not check
)


def fastest_spec(whole: NufftSpec, workload: Workload, costs: Costs, allowed_bytes: float) -> NufftSpec:
    """Return the sub-blocks, batches and oversampling that are predicted to be the fastest within the allowed memory.

    That memory is without the result and the mesh. If the whole block fits, nothing is subdivided or prescribed: the
    values are then those of unlimited memory. InputError, with the smallest memory that works, where nothing fits.
    """

    def fits(spec: NufftSpec) -> bool:
        is_allowed = costs.grid_cells(spec, workload) <= costs.largest_grid
        return is_allowed and costs.projected_bytes(spec, workload) <= allowed_bytes

    if fits(whole):
        return whole
    candidates: list[NufftSpec] = []
    least_bytes = math.inf
    halvings = range(max(1, (whole.batch // _SMALLEST_BATCH).bit_length()))
    batches = (whole.batch >> number for number in halvings)
    for batch, sigma in product(batches, costs.oversamplings(whole)):
        shapes = sub_shapes(whole.shape, sigma)
        smaller = [replace(whole, shape=shape, oversampling=sigma, batch=batch) for shape in shapes]
        # Ever smaller sub-blocks take ever less memory: the first that fits is the largest.
        first = bisect_left(smaller, True, key=fits)
        if first < len(smaller):
            candidates.append(smaller[first])
        else:
            least_bytes = min(least_bytes, costs.projected_bytes(smaller[-1], workload))
    if not candidates:
        raise MemoryLimitError(
            f"{allowed_bytes / 1e6:.4g} MB of memory are too little for a block of {' x '.join(map(str, whole.shape))} "
            f"samples: give at least {math.ceil(least_bytes / 1e5) / 10:.4g} MB besides the result and the mesh"
        )
    return min(candidates, key=lambda spec: costs.projected_nanoseconds(spec, whole.shape, workload))


def sub_shapes(shape: Shape, sigma: float) -> Iterator[Shape]:
    """Yield shapes of sub-blocks, from the whole block down to where smaller ones save nothing."""
    lengths = list(shape)
    while True:
        yield lengths[0], lengths[1], lengths[2]
        axis = max(range(3), key=lengths.__getitem__)
        if lengths[axis] * sigma <= 2 * _WIDEST_KERNEL:
            return
        # The fewest parts that are shorter.
        count = math.ceil(shape[axis] / (lengths[axis] - 1))
        lengths[axis] = math.ceil(shape[axis] / count)
