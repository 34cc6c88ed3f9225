"""Specification of a NUFFT, and the time and memory that each library takes for it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sobolev_batch.spectral.dtypes import ComplexDtype

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class NufftSpec:
    """A nonuniform FFT in three dimensions.

    Attributes:
        shape: Modes along each axis.
        eps: Relative accuracy.
        dtype: Type of strengths and modes.
        oversampling: Ratio of the fine grid to the modes along each axis; None for the fastest one.
        threads: Threads on the processor.
    """

    shape: Shape
    eps: float
    dtype: ComplexDtype = "complex128"
    oversampling: float | None = None
    threads: int = 1

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


CPU_COSTS = Costs(
    finest_eps={
        "complex128": {2.0: 0.0, 1.75: 1e-12, 1.5: 1e-11, 1.25: 1e-7},
        "complex64": {2.0: 0.0, 1.75: 3e-6, 1.5: 2e-5, 1.25: 1e-3},
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

# The times are rough: they decide on nothing but the grid, and every grid keeps eps.
GPU_COSTS = Costs(
    # cuFINUFFT evaluates its kernel by polynomials at these two oversamplings only. Its older kernel was measured
    # with FINUFFT, which has it too: at 1.25 it keeps eps down to 1e-9, and 1e-5 in single precision.
    finest_eps={"complex128": {2.0: 0.0, 1.25: 1e-8}, "complex64": {2.0: 0.0, 1.25: 1e-4}},
    point_nanoseconds=1.0,
    spread_nanoseconds=1.0,
    spread_cell_nanoseconds=0.02,
    fft_cell_nanoseconds=0.1,
    point_bytes=250,
    triangle_bytes=60,
    fixed_bytes=50_000_000,
    work_grids=2,  # cuFFT's work area, and at worst as much for bins of a single cell
    copies_grid=False,
    largest_grid=2**31 - 1,  # cuFINUFFT counts cells in 32 bits and does not check
)
