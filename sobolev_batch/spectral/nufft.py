"""The one primitive: transform weighted points onto a block of the lattice."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Literal

import finufft
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.phases import cosine_and_sine
from sobolev_batch.spectral.quadrature import WeightedPoints

Precision = Literal["complex128", "complex64"]
Complexes = NDArray[np.complexfloating[Any, Any]]

# Oversamplings of the fine grid, and the smallest eps that each was measured to keep: the coarser the
# grid, the cheaper the FFT, the dearer the spreading of a point, and the more a rounding error grows.
_FINEST: dict[Precision, dict[float, float]] = {
    "complex128": {2.0: 0.0, 1.75: 1e-12, 1.5: 1e-11, 1.25: 1e-7},
    "complex64": {2.0: 0.0, 1.75: 3e-6, 1.5: 2e-5, 1.25: 1e-3},
}
LARGEST_OVERSAMPLING = 2.0
# Measured times: of a point, of one of its (kernel width)³ grid cells, of an FFT's grid cell.
_POINT, _SPREAD_CELL, _GRID_CELL = 100.0, 0.28, 27.0


def oversampling(points: int, block: Block, eps: float, precision: Precision) -> float:
    """The oversampling of the fine grid with which so many points are transformed fastest."""

    def time(sigma: float) -> float:
        width = math.ceil(-math.log(eps) / (math.pi * math.sqrt(1 - 1 / sigma)))
        return points * (_POINT + _SPREAD_CELL * width**3) + block.size * sigma**3 * _GRID_CELL

    return min((sigma for sigma, finest in _FINEST[precision].items() if eps >= finest), key=time)


def transform_points(
    batches: Iterable[WeightedPoints],
    lattice: Lattice,
    block: Block,
    *,
    eps: float,
    precision: Precision = "complex128",
    threads: int = 1,
) -> Complexes:
    """Σ_j w_j exp(-2πi ξ·x_j) at the frequencies ξ of a block, by a type-1 nonuniform FFT.

    Args:
        batches: the points, in units of length; all |coordinates| below ``lattice.half_period``
            (not checked here: points beyond it fold silently). Batches are added up.
        lattice: where ξ lies.
        block: which part of it to compute; memory and time are those of the block alone.
        eps: accuracy relative to Σ|w_j|; the error reached is a small multiple of it.
        precision: of the arithmetic and the result.
        threads: of FINUFFT. The result changes with it by rounding.

    Returns:
        complex array (block.shape).

    Sources: A. Barnett, J. Magland, L. af Klinteberg, "A parallel non-uniform fast Fourier transform
    library based on an exponential of semicircle kernel" (2019), doi:10.1137/18M120885X.
    """
    real = np.float32 if precision == "complex64" else np.float64
    # FINUFFT's modes of an axis of n samples start at -(n // 2). Turning the strengths by the
    # difference to the block's own start moves that window anywhere, at no cost in the FFT.
    shift = np.array([start + count // 2 for start, count in zip(block.start, block.shape, strict=True)])
    scale = 2 * np.pi * lattice.spacing
    plan: finufft.Plan | None = None
    total: Complexes | None = None
    for points in batches:
        if plan is None:
            # Its warnings speak of thread counts and of tolerances, which are checked before they get here.
            plan = finufft.Plan(
                1,
                block.shape,
                eps=eps,
                isign=-1,
                dtype=precision,
                modeord=0,
                nthreads=threads,
                upsampfac=oversampling(len(points.weights), block, eps, precision),
                showwarn=0,
            )
        angles = scale * points.coordinates
        strengths = np.empty(len(points.weights), dtype=precision)
        turned = np.flatnonzero(shift)
        if turned.size:
            phase = shift[turned].astype(np.float64) @ angles[turned]
            cosines, sines = cosine_and_sine(phase)
            np.multiply(cosines, points.weights, out=strengths.real, casting="same_kind")
            np.multiply(sines, -points.weights, out=strengths.imag, casting="same_kind")
        else:
            strengths.real = points.weights
            strengths.imag = 0
        # setpts keeps references, not copies: `angles` lives until execute has returned.
        plan.setpts(*(np.ascontiguousarray(row, dtype=real) for row in angles))
        values = plan.execute(strengths)
        if total is None:
            total = values
        else:
            total += values
    if total is None:
        return np.zeros(block.shape, dtype=precision)
    return total
