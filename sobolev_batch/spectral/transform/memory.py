"""How a transform is divided so that it fits into memory: batches of points, parts of the block, oversampling."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

from scipy.fft import next_fast_len

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends.costs import Costs, Shape, fastest_oversampling, spreading_nanoseconds
from sobolev_batch.spectral.dtypes import ComplexDtype, item_bytes
from sobolev_batch.spectral.lattice import Block

# A batch holds a few pieces of triangles, and a piece at least eight times the largest rule.
SMALLEST_BATCH = 1 << 12
# Widest kernel of FINUFFT and cuFINUFFT: a grid has at least twice as many cells along each axis.
_WIDEST_KERNEL = 16
# The share of the lattice's period that a surface's bounding box fills, where it is not known. At an
# aliasing error worth having it is far less.
_USUAL_FILL = 0.3


@dataclass(frozen=True)
class Load:
    """What is to be transformed.

    Attributes:
        points: expected number.
        most_points: bound on it before shared ones are merged.
        triangles: number.
        fill: the share of the lattice's period that the bounding box takes, by volume.
    """

    points: float
    most_points: float = math.inf
    triangles: int = 0
    fill: float = _USUAL_FILL


@dataclass(frozen=True)
class Division:
    """How a transform is divided.

    Attributes:
        batch: points of one NUFFT.
        shape: samples along each axis of the parts that a block is computed in; None for the whole.
        oversampling: of the fine grid; None for the fastest.
    """

    batch: int
    shape: Shape | None = None
    oversampling: float | None = None


def parts(block: Block, shape: Shape | None) -> Iterator[tuple[Block, tuple[slice, slice, slice]]]:
    """The parts of a block, each with its place in an array of the block.

    All have the same shape, so that one plan serves them: those at the high ends may reach beyond the block.
    """
    shape = shape or block.shape
    for offsets in product(*(range(0, count, step) for count, step in zip(block.shape, shape, strict=True))):
        i, j, k = (first + offset for first, offset in zip(block.start, offsets, strict=True))
        x, y, z = (
            slice(offset, min(offset + step, count))
            for offset, step, count in zip(offsets, shape, block.shape, strict=True)
        )
        yield Block((i, j, k), shape), (x, y, z)


def transform_bytes(shape: Shape, eps: float, dtype: ComplexDtype, load: Load, division: Division, costs: Costs) -> int:
    """Upper estimate of what transforming to a block of some shape takes, besides its result and the mesh.

    Args:
        shape: of the block.
        eps: accuracy.
        dtype: of the field.
        load: what is transformed.
        division: how.
        costs: of the library.
    """
    part = division.shape or shape
    grids = 1 + costs.work_grids + (load.fill if costs.scattered else 0)
    samples = _cells(shape, eps, dtype, load, division, costs) * grids + math.prod(part)
    points = min(division.batch, load.most_points) * costs.point_bytes
    triangles = load.triangles * costs.triangle_bytes
    return math.ceil(samples * item_bytes(dtype) + points) + triangles + costs.fixed_bytes


def divide(
    shape: Shape, eps: float, dtype: ComplexDtype, load: Load, costs: Costs, *, memory: float, batch: int
) -> Division:
    """The division that fits into memory and is predicted to be the fastest.

    Where the whole fits, nothing is divided and nothing prescribed: results are then those that unlimited
    memory leads to.

    Args:
        shape: of the block.
        eps: accuracy.
        dtype: of the field.
        load: what is to be transformed.
        costs: of the library.
        memory: what may be taken besides the result and the mesh, in bytes.
        batch: the largest number of points of one NUFFT.

    Raises:
        InputError: no division fits; the message names the smallest memory that works.
    """

    def taken(division: Division) -> int:
        return transform_bytes(shape, eps, dtype, load, division, costs)

    def fits(division: Division) -> bool:
        cells = _cells(shape, eps, dtype, load, division, costs)
        return taken(division) <= memory and cells <= costs.most_cells

    undivided = Division(batch)
    if fits(undivided):
        return undivided
    batches = [batch]
    while batches[-1] // 2 >= SMALLEST_BATCH:
        batches.append(batches[-1] // 2)
    found: list[tuple[float, Division]] = []
    least = math.inf
    for points in batches:
        for sigma in costs.oversamplings(eps, dtype):
            for part in _shapes(shape, sigma):
                division = Division(points, part, sigma)
                if fits(division):
                    found.append((_nanoseconds(shape, eps, dtype, load, division, costs), division))
                    break
            else:
                least = min(least, taken(division))
    if not found:
        raise InputError(
            f"{memory / 1e6:.4g} MB of memory are too little for a block of {' x '.join(map(str, shape))} samples: "
            f"give at least {math.ceil(least / 1e5) / 10:.4g} MB besides the result and the mesh"
        )
    return min(found, key=lambda candidate: candidate[0])[1]


def _shapes(shape: Shape, sigma: float) -> Iterator[Shape]:
    """Shapes of parts, from the whole block down to where smaller ones save nothing."""
    counts = [1, 1, 1]
    now = list(shape)
    while True:
        yield now[0], now[1], now[2]
        axis = max(range(3), key=now.__getitem__)
        if now[axis] * sigma <= 2 * _WIDEST_KERNEL:
            return
        before = now[axis]
        while now[axis] == before:
            counts[axis] += 1
            now[axis] = math.ceil(shape[axis] / counts[axis])


@lru_cache(maxsize=1 << 14)
def _axis(samples: int, sigma: float) -> int:
    """Cells of the fine grid along an axis: even, with no prime factor above 5, as FINUFFT takes them."""
    least = max(math.ceil(sigma * samples), 2 * _WIDEST_KERNEL)
    return 2 * int(next_fast_len(-(-least // 2), real=True))


def _cells(shape: Shape, eps: float, dtype: ComplexDtype, load: Load, division: Division, costs: Costs) -> int:
    """Cells of the largest fine grid that a division can lead to."""
    sigma = division.oversampling
    if sigma is None:
        # More points ask for more oversampling, never for less.
        points = min(division.batch, load.most_points)
        sigma = fastest_oversampling(points, math.prod(shape), eps, dtype, costs)
    return math.prod(_axis(samples, sigma) for samples in division.shape or shape)


def _nanoseconds(shape: Shape, eps: float, dtype: ComplexDtype, load: Load, division: Division, costs: Costs) -> float:
    """Predicted time of a division with a shape and an oversampling, in nanoseconds."""
    part, sigma = division.shape or shape, division.oversampling or max(costs.finest[dtype])
    count = math.prod(math.ceil(whole / step) for whole, step in zip(shape, part, strict=True))
    rounds = math.ceil(max(load.points, 1) / division.batch)
    each = costs.making + count * spreading_nanoseconds(sigma, eps, costs)
    cells = _cells(shape, eps, dtype, load, division, costs)
    return load.points * each + rounds * count * cells * costs.grid_cell
