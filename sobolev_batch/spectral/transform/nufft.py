"""The one primitive: transform weighted points onto a block of the lattice; and its adjoint."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends.arrays import Array, combine
from sobolev_batch.spectral.backends.backends import CPU, Backend, NufftPlan, evaluation_plan
from sobolev_batch.spectral.backends.costs import Shape, fastest_oversampling
from sobolev_batch.spectral.backends.phases import cosine_and_sine
from sobolev_batch.spectral.dtypes import ComplexDtype, Complexes
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.quadrature.meshes import WeightedPoints
from sobolev_batch.spectral.transform.memory import Division, parts


def transform_points(
    batches: Iterable[WeightedPoints],
    lattice: Lattice,
    block: Block,
    *,
    eps: float,
    dtype: ComplexDtype = "complex128",
    threads: int = 1,
    backend: Backend = CPU,
    shape: Shape | None = None,
    oversampling: float | None = None,
) -> tuple[Array, int]:
    """Σ_j w_j exp(-2πi ξ·x_j) at the frequencies ξ of a block, by a type-1 nonuniform FFT.

    Args:
        batches: the points, in units of length; all |coordinates| below ``lattice.half_period``
            (not checked here: points beyond it fold silently). Batches are added up.
        lattice: where ξ lies.
        block: which part of it to compute; memory and time are those of the block alone.
        eps: accuracy relative to Σ|w_j|; the error reached is a small multiple of it.
        dtype: of the arithmetic and the result.
        threads: of FINUFFT. The result changes with it by rounding.
        backend: where to compute; the points are arrays of it, and so is the result.
        shape: of the parts that the block is computed in; the whole at once by default.
        oversampling: of the fine grid; the fastest for the first batch by default.

    Returns:
        complex array (block.shape); the number of points.

    Sources: A. Barnett, J. Magland, L. af Klinteberg, "A parallel non-uniform fast Fourier transform
    library based on an exponential of semicircle kernel" (2019), doi:10.1137/18M120885X.
    """
    real = np.float32 if dtype == "complex64" else np.float64
    whole = shape is None or shape == block.shape
    scale = 2 * np.pi * lattice.spacing
    plan: NufftPlan | None = None
    total: Array | None = None
    count = 0
    for points in batches:
        count += len(points.weights)
        if plan is None:
            sigma = oversampling or fastest_oversampling(count, block.size, eps, dtype, backend.costs)
            plan = backend.plan(shape or block.shape, eps=eps, dtype=dtype, oversampling=sigma, threads=threads)
        angles = scale * points.coordinates
        # setpts keeps references, not copies: `angles` lives until execute has returned.
        plan.setpts(*(np.ascontiguousarray(row, dtype=real, like=row) for row in angles))
        for part, (x, y, z) in parts(block, shape):
            values = plan.execute(_turned(points.weights, angles, part, dtype))
            if total is None and whole:
                total = values
            elif total is None:
                total = np.zeros(block.shape, dtype=dtype, like=values)
                total[x, y, z] = values[: x.stop - x.start, : y.stop - y.start, : z.stop - z.start]
            else:
                total[x, y, z] += values[: x.stop - x.start, : y.stop - y.start, : z.stop - z.start]
            # The next values and the next batch are made before these names are bound again.
            del values
        del points, angles
    if total is None:
        total = backend.upload(np.zeros(block.shape, dtype=dtype))
    return total, count


def evaluate_at(
    coordinates: NDArray[np.float64],
    coefficients: Complexes,
    lattice: Lattice,
    block: Block,
    *,
    eps: float,
    dtype: ComplexDtype = "complex128",
    threads: int = 1,
    division: Division,
) -> NDArray[np.float64]:
    """Re Σ_ξ c(ξ) exp(+2πi ξ·x_j) over the frequencies ξ of a block, by a type-2 nonuniform FFT.

    Args:
        coordinates: (3, n), the points x_j in units of length; all |coordinates| below
            ``lattice.half_period`` (not checked here: points beyond it fold silently).
        coefficients: c, complex (m, *block.shape): m sums over the same frequencies.
        lattice: where ξ lies.
        block: which part of it; what several blocks give adds up.
        eps: accuracy relative to Σ|c|; the error reached is a small multiple of it.
        dtype: of the arithmetic.
        threads: of FINUFFT. The result changes with it by rounding.
        division: points evaluated at a time, and parts of the block: see `Division`.

    Returns:
        float64 (m, n).

    Source: see `transform_points`.
    """
    real = np.float32 if dtype == "complex64" else np.float64
    count = coordinates.shape[1]
    values = np.zeros((len(coefficients), count))
    sigma = division.oversampling or fastest_oversampling(count, block.size, eps, dtype, CPU.costs)
    shape = division.shape or block.shape
    plan = evaluation_plan(shape, eps=eps, dtype=dtype, oversampling=sigma, threads=threads)
    scale = 2 * np.pi * lattice.spacing
    for first in range(0, count, division.batch):
        here = slice(first, min(first + division.batch, count))
        angles = scale * coordinates[:, here]
        ones = np.ones(angles.shape[1])
        plan.setpts(*(np.ascontiguousarray(row, dtype=real) for row in angles))
        for part, (x, y, z) in parts(block, division.shape):
            # Conjugates of the phases that move the window of modes to the part.
            turns = _turned(ones, angles, part, dtype)
            for i, whole in enumerate(coefficients):
                # Parts at the high ends reach beyond the block.
                modes = np.zeros(shape, dtype=dtype)
                modes[: x.stop - x.start, : y.stop - y.start, : z.stop - z.start] = whole[x, y, z]
                found = plan.execute(modes)
                values[i, here] += found.real * turns.real + found.imag * turns.imag
    return values


def _turned(weights: Array, angles: Array, block: Block, dtype: ComplexDtype) -> Array:
    """The strengths whose modes are those of a block.

    FINUFFT's modes of an axis of n samples start at -(n // 2). Turning the strengths by the difference
    to the block's own start moves that window anywhere, at no cost in the FFT.
    """
    shift = np.array([start + count // 2 for start, count in zip(block.start, block.shape, strict=True)])
    strengths = np.empty(len(weights), dtype=dtype, like=weights)
    turned = np.flatnonzero(shift)
    if turned.size:
        phases = combine(shift[turned].astype(np.float64), angles[turned.tolist()])
        cosines, sines = cosine_and_sine(phases)
        np.multiply(cosines, weights, out=strengths.real, casting="same_kind")
        np.multiply(sines, -weights, out=strengths.imag, casting="same_kind")
    else:
        strengths.real = weights
        strengths.imag = 0
    return strengths
