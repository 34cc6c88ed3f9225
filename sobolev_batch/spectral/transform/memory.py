"""Memory of a transform: batches of points and sub-blocks of a block, so that it takes what is allowed."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

from scipy.fft import next_fast_len

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends import Costs, NufftSpec, Shape
from sobolev_batch.spectral.lattice import Block

# Points of one NUFFT: two million take 0.3 GB with their strengths and sorting, and make the FFT a small part of
# the time.
DEFAULT_BATCH = 1 << 21
# The smallest batch holds eight node sets of the largest triangle rule.
_SMALLEST_BATCH = 1 << 12
# The widest kernel of FINUFFT and cuFINUFFT: a grid has at least twice as many cells along each axis.
_WIDEST_KERNEL = 16
# The bounding box of a surface fills this fraction of the lattice's period, if nothing else is known. At a useful
# aliasing error it is far less.
_USUAL_FILL = 0.3


@dataclass(frozen=True)
class Workload:
    """The points to transform.

    Attributes:
        points: Expected number of points.
        largest_points: Bound on the number of points, before shared ones are merged.
        triangles: Number of triangles.
        fill: Fraction of the lattice's period that the bounding box fills, by volume.
    """

    points: float = math.inf
    largest_points: float = math.inf
    triangles: int = 0
    fill: float = _USUAL_FILL


@dataclass(frozen=True)
class Batching:
    """A sequence of equal NUFFTs that computes a transform.

    Attributes:
        spec: Each NUFFT; its shape is the block's, or that of sub-blocks.
        batch: Largest number of points of each.
    """

    spec: NufftSpec
    batch: int = DEFAULT_BATCH

    def grid_cells(self, workload: Workload, costs: Costs) -> int:
        """Return the number of cells of the largest fine grid that may be used."""
        # More points favour more oversampling, never less.
        spec = costs.with_oversampling(self.spec, min(self.batch, workload.largest_points))
        return math.prod(_grid_length(modes, spec.oversampling or 2.0) for modes in spec.shape)

    def projected_bytes(self, workload: Workload, costs: Costs) -> int:
        """Return an upper estimate of the memory, without the result and the mesh."""
        grids = 1 + costs.work_grids + (workload.fill if costs.copies_grid else 0)
        samples = self.grid_cells(workload, costs) * grids + self.spec.size
        points = min(self.batch, workload.largest_points) * costs.point_bytes
        triangles = workload.triangles * costs.triangle_bytes
        return math.ceil(samples * self.spec.item_bytes + points) + triangles + costs.fixed_bytes

    def projected_nanoseconds(self, shape: Shape, workload: Workload, costs: Costs) -> float:
        """Return the predicted time for a block of some shape."""
        sigma = self.spec.oversampling or max(costs.finest_eps[self.spec.dtype])
        blocks = math.prod(math.ceil(whole / step) for whole, step in zip(shape, self.spec.shape, strict=True))
        batches = math.ceil(max(workload.points, 1) / self.batch)
        each_point = costs.point_nanoseconds + blocks * costs.spreading_nanoseconds(sigma, self.spec.eps)
        cells = self.grid_cells(workload, costs)
        return workload.points * each_point + batches * blocks * cells * costs.fft_cell_nanoseconds


def fastest_batching(whole: Batching, workload: Workload, costs: Costs, allowed_bytes: float) -> Batching:
    """Return the batching that is predicted to be the fastest within the allowed memory.

    If the whole block fits, nothing is subdivided or prescribed: the values are then those of unlimited memory.

    Args:
        whole: Batching with the shape of the block and the largest allowed batch.
        workload: Points to transform.
        costs: Costs of the library.
        allowed_bytes: Memory that the transform may take, without the result and the mesh.

    Raises:
        InputError: No batching fits; the message names the smallest memory that works.
    """

    def fits(batching: Batching) -> bool:
        if batching.grid_cells(workload, costs) > costs.largest_grid:
            return False
        return batching.projected_bytes(workload, costs) <= allowed_bytes

    if fits(whole):
        return whole
    shape = whole.spec.shape
    candidates: list[Batching] = []
    least_bytes = math.inf
    batches = [whole.batch]
    while batches[-1] // 2 >= _SMALLEST_BATCH:
        batches.append(batches[-1] // 2)
    for batch, sigma in product(batches, costs.oversamplings(whole.spec)):
        spec = replace(whole.spec, oversampling=sigma)
        smaller = [Batching(replace(spec, shape=sub_shape), batch) for sub_shape in _sub_shapes(shape, sigma)]
        # Ever smaller sub-blocks take ever less memory: the first that fits is the largest.
        first = bisect_left(smaller, True, key=fits)
        if first < len(smaller):
            candidates.append(smaller[first])
        else:
            least_bytes = min(least_bytes, smaller[-1].projected_bytes(workload, costs))
    if not candidates:
        raise InputError(
            f"{allowed_bytes / 1e6:.4g} MB of memory are too little for a block of {' x '.join(map(str, shape))} "
            f"samples: give at least {math.ceil(least_bytes / 1e5) / 10:.4g} MB besides the result and the mesh"
        )
    return min(candidates, key=lambda batching: batching.projected_nanoseconds(shape, workload, costs))


def sub_blocks(block: Block, shape: Shape) -> Iterator[tuple[Block, tuple[slice, slice, slice]]]:
    """Yield the sub-blocks of a block, each with its slices of an array of the block.

    All have the same shape, so that one plan serves them: those at the high ends may extend beyond the block.
    """
    for offsets in product(*(range(0, count, step) for count, step in zip(block.shape, shape, strict=True))):
        i, j, k = (first + offset for first, offset in zip(block.start, offsets, strict=True))
        x, y, z = (
            slice(offset, min(offset + step, count))
            for offset, step, count in zip(offsets, shape, block.shape, strict=True)
        )
        yield Block((i, j, k), shape), (x, y, z)


def _sub_shapes(shape: Shape, sigma: float) -> Iterator[Shape]:
    """Yield shapes of sub-blocks, from the whole block down to where smaller ones save nothing."""
    counts = [1, 1, 1]
    lengths = list(shape)
    while True:
        yield lengths[0], lengths[1], lengths[2]
        axis = max(range(3), key=lengths.__getitem__)
        if lengths[axis] * sigma <= 2 * _WIDEST_KERNEL:
            return
        before = lengths[axis]
        while lengths[axis] == before:
            counts[axis] += 1
            lengths[axis] = math.ceil(shape[axis] / counts[axis])


@lru_cache(maxsize=1 << 14)
def _grid_length(modes: int, sigma: float) -> int:
    """Return the cells of the fine grid along an axis: even, with no prime factor above 5, as FINUFFT takes them."""
    least = max(math.ceil(sigma * modes), 2 * _WIDEST_KERNEL)
    return 2 * int(next_fast_len(-(-least // 2), real=True))
