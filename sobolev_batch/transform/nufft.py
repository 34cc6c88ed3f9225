"""The primitive of all fields: weighted points transformed onto a block of the lattice; and its adjoint."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Array, ComplexDtype, Complexes, Reals, slices
from sobolev_batch.transform.backends import CPU, Backend, combine, cosine_and_sine
from sobolev_batch.transform.lattice import Block, FrequencyLattice, Lattice
from sobolev_batch.transform.nufft_costs import NufftSpec

# Points at a time whose phases stay in the processor's cache: half the time of all at once.
_CACHED = 1 << 14


@dataclass(frozen=True)
class WeightedPoints:
    """A sum of Dirac masses in arrays of one backend.

    Coordinates are float64 (3, n), one contiguous row per axis, in units of length; weights (n,) in squared units.
    """

    coordinates: Array
    weights: Array

    def part(self, part: slice) -> Self:
        """Return some of the points, which share their memory with these."""
        return type(self)(self.coordinates[:, part], self.weights[part])

    @classmethod
    def concatenated(cls, batches: Sequence[Self]) -> Self:
        """Return the points of several batches as one."""
        if len(batches) == 1:
            return batches[0]
        coordinates, weights = zip(*((points.coordinates, points.weights) for points in batches), strict=True)
        return cls(np.concatenate(coordinates, axis=1), np.concatenate(weights))


def transform_points(
    batches: Iterable[WeightedPoints], lattice: FrequencyLattice, block: Block, spec: NufftSpec, backend: Backend = CPU
) -> tuple[Array, int]:
    """Return Σ_j w_j exp(-2πi ξ·x_j) at the frequencies ξ of a block, by a type-1 nonuniform FFT.

    The values are a complex array (block.shape) of the backend; the number of points comes with them. The sum runs over
    all batches, whose points are in units of length and in arrays of the backend. Points with a |coordinate| of
    ``lattice.half_period`` or more are folded back without an error. The shape of the NUFFT is the block's or that of
    sub-blocks. Its eps is relative to Σ|w_j|, its error a small multiple of that; threads change values by rounding.

    Source: A. Barnett, J. Magland, L. af Klinteberg, "A parallel non-uniform fast Fourier transform library based
    on an exponential of semicircle kernel" (2019), doi:10.1137/18M120885X.
    """
    scale = 2 * np.pi * lattice.spacing
    plan: Any = None
    total: Array | None = None
    count = 0
    for points in batches:
        count += len(points.weights)
        if plan is None:
            plan = backend.plan(backend.costs.with_oversampling(spec, count))
        turned = points.coordinates if lattice.rotation is None else combine(lattice.rotation, points.coordinates)
        angles = scale * turned
        # Whole turns change the strengths of a shifted lattice, and nothing else.
        folded = _folded(angles) if lattice.tolerates_images else angles
        # setpts keeps references, not copies: the angles live until execute has returned.
        plan.setpts(*(np.ascontiguousarray(row, dtype=spec.real_dtype, like=row) for row in folded))
        for sub_block, (x, y, z) in block.tiles(spec.shape):
            first = _first_mode(sub_block, lattice)
            values = plan.execute(_shifted_strengths(points.weights, angles, first, spec.dtype))
            if total is None:
                is_whole = spec.shape == block.shape
                total = values if is_whole else np.zeros(block.shape, dtype=spec.dtype, like=values)
            if total is not values:
                total[x, y, z] += values[: x.stop - x.start, : y.stop - y.start, : z.stop - z.start]
            # Free the memory before the next values and the next batch are made.
            del values
        del points, turned, angles, folded
    if total is None:
        total = backend.upload(np.zeros(block.shape, dtype=spec.dtype))
    return total, count


def _folded(angles: Array) -> Array:
    """Return angles without their whole turns. Each temporary of many points would be fresh memory, which is slow."""
    turns = angles / (2 * np.pi)
    np.rint(turns, out=turns)
    turns *= 2 * np.pi
    return np.subtract(angles, turns, out=turns)


def evaluate_at(coordinates: Reals, coefficients: Complexes, lattice: Lattice, block: Block, spec: NufftSpec) -> Reals:
    """Return Re Σ_ξ c(ξ) exp(+2πi ξ·x_j) over the frequencies ξ of a block, by a type-2 nonuniform FFT.

    For points (3, n) and coefficients (m, *block.shape) of m sums it is float64 (m, n). Sums over several blocks add
    up. Points, NUFFT and source are as for `transform_points`; here eps is relative to Σ|c|.
    """
    count = coordinates.shape[1]
    values = np.zeros((len(coefficients), count))
    spec = CPU.costs.with_oversampling(spec, count)
    plan = CPU.plan(spec, adjoint=True)
    scale = 2 * np.pi * lattice.spacing
    for batch in slices(count, spec.batch):
        angles = scale * coordinates[:, batch]
        ones = np.ones(angles.shape[1])
        plan.setpts(*(np.ascontiguousarray(row, dtype=spec.real_dtype) for row in angles))
        for sub_block, (x, y, z) in block.tiles(spec.shape):
            # The conjugates of these phase shifts move the window of modes to the sub-block.
            shifts = _shifted_strengths(ones, angles, _first_mode(sub_block, lattice), spec.dtype)
            for i, whole in enumerate(coefficients):
                # Sub-blocks at the high ends extend beyond the block.
                modes = np.zeros(spec.shape, dtype=spec.dtype)
                modes[: x.stop - x.start, : y.stop - y.start, : z.stop - z.start] = whole[x, y, z]
                sums = plan.execute(modes)
                values[i, batch] += sums.real * shifts.real + sums.imag * shifts.imag
    return values


def _first_mode(block: Block, lattice: FrequencyLattice) -> Reals:
    """Return the shift (3,), in spacings, of FINUFFT's modes to a block: those of n samples start at -(n // 2)."""
    corner = [start + count // 2 for start, count in zip(block.start, block.shape, strict=True)]
    return np.array(corner, dtype=np.float64) + lattice.shift


def _shifted_strengths(weights: Array, angles: Array, shift: Reals, dtype: ComplexDtype) -> Array:
    """Return strengths whose modes are shifted: a phase factor, at no cost in the FFT."""
    strengths = np.empty(len(weights), dtype=dtype, like=weights)
    if not (axes := np.flatnonzero(shift).tolist()):
        strengths.real = weights
        strengths.imag = 0
        return strengths
    step = _CACHED if isinstance(weights, np.ndarray) else len(weights)
    for part in slices(len(weights), step):
        cosines, sines = cosine_and_sine(combine(shift[axes], angles[axes, part]))
        np.multiply(cosines, weights[part], out=strengths.real[part], casting="same_kind")
        np.multiply(sines, -weights[part], out=strengths.imag[part], casting="same_kind")
    return strengths
