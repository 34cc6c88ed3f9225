"""The witness function: where two surfaces differ, as the norm sees it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends.backends import CPU
from sobolev_batch.spectral.backends.costs import NufftSpec
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.metrics.inputs import BLOCK_SAMPLES, Operand, pair_of, read_blocks, triples_of
from sobolev_batch.spectral.shells import Orders, check_orders, shell_weights
from sobolev_batch.spectral.transform.memory import Batching, Workload, fastest_batching
from sobolev_batch.spectral.transform.nufft import evaluate_at
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import require_points_inside

# Of a given memory, what blocks of fields may take; the rest is for the NUFFT.
_SHARE_OF_BLOCKS = 0.25
# Samples of a block besides their coefficients: two fields, their difference, its weights and its shells.
_SAMPLE_BYTES = 72


def witness(
    a: Operand,
    b: Operand,
    order: Orders,
    points: ArrayLike,
    *,
    lattice: Lattice | None = None,
    eps: float | None = None,
    dtype: ComplexDtype = "complex128",
    threads: int | None = None,
    memory: float | None = None,
) -> xr.DataArray:
    """The witness function of two surfaces at points: positive where a has area that b lacks.

    It is w(x) = ∫ (1 + |ξ|²)^s (a^ - b^)(ξ) exp(+2πi ξ·x) dξ, by the trapezoidal rule over the lattice
    as in norms: the difference of the area measures, smoothed by the norm's kernel. Its integral
    against that difference is the squared distance, ∫ w d(a - b) = ||a - b||_s².

    Args:
        a: a field from `fourier_transform` or a store, or a surface.
        b: a field on the same lattice, or a surface.
        order: one order s < -1/2, or several.
        points: x, real (n, 3), in the fields' unit of length: such as ``mesh.vertices`` of a mesh that
            the similarity of its study has been applied to.
        lattice: where surfaces are to be transformed; a field brings its own.
        eps: accuracy of the NUFFT, relative to the sum of the moduli of all terms; the error reached is
            a small multiple of it. Default 1e-9, or 1e-6 in single precision.
        dtype: "complex128" or "complex64": of the arithmetic, whatever the fields'.
        threads: of the NUFFT; default one per core.
        memory: bytes that this may take besides points, result and fields held in memory; default as
            many as are fastest.

    Returns:
        `witness` over (order, point), or (point,) of a single order: float64, or float32 with complex64.
        In 1 / unit length. NaN everywhere if a field has NaN anywhere.

    Raises:
        OrderError: an order that is not below -1/2.
        LatticeError: fields on different lattices, or points beyond the half period 1/(2h).
        InputError: points that are not finite or not (n, 3); a mesh, and no lattice from anywhere;
            settings out of range; too little memory.

    Source: A. Gretton et al., "A kernel two-sample test" (2012), JMLR 13, section 2.3.
    """
    orders = check_orders(order)
    settings = TransformSettings(eps, dtype)
    coordinates = _coordinates(points)
    first, second = pair_of(a, b, lattice, orders)
    known = Lattice.of(first)
    require_points_inside(coordinates, known)
    evaluation = Evaluation(coordinates, known, shell_weights(known, orders), settings, threads, memory)
    values = np.zeros((len(orders), coordinates.shape[1]))
    # FINUFFT refuses to evaluate nothing.
    for block, (of_a, of_b) in read_blocks(known, first, second, largest=evaluation.largest) if values.size else ():
        values += evaluation.of_block(block, of_a - of_b)
    return _labelled(values.astype(np.float32 if dtype == "complex64" else np.float64), order)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Evaluates witness functions at points, one block of the difference of two fields after the other.

    Attributes:
        coordinates: of the points, float64 (3, n), contiguous, n > 0, within the half period.
        lattice: of the fields.
        weights: of its shells, (orders, lattice.shell_count).
        settings: accuracy and precision of the NUFFT.
        threads: of the NUFFT; one per core by default.
        memory: bytes that a block may take, besides points, result and the fields themselves.
    """

    coordinates: NDArray[np.float64]
    lattice: Lattice
    weights: NDArray[np.float64]
    settings: TransformSettings
    threads: int | None = None
    memory: float | None = None

    @property
    def largest(self) -> int:
        """Samples that a block should have at most."""
        if self.memory is None:
            return BLOCK_SAMPLES
        each = _SAMPLE_BYTES + len(self.weights) * np.dtype(self.settings.dtype).itemsize
        return max(1, min(BLOCK_SAMPLES, int(_SHARE_OF_BLOCKS * self.memory / each)))

    def of_block(self, block: Block, difference: NDArray[np.complexfloating]) -> NDArray[np.float64]:
        """What a block adds to the witness functions, (orders, n)."""
        dtype = self.settings.dtype
        weighted = difference * self.lattice.trapezoid_weights(block)
        shells = self.lattice.shells(block)
        coefficients = np.empty((len(self.weights), *block.shape), dtype=dtype)
        for row, weight in zip(coefficients, self.weights, strict=True):
            np.multiply(weighted, weight[shells], out=row, casting="same_kind")
        threads = self.threads or os.cpu_count() or 1
        batching = Batching(NufftSpec(block.shape, self.settings.eps, dtype, threads=threads))
        if self.memory is not None:
            count = self.coordinates.shape[1]
            allowed_bytes = (1 - _SHARE_OF_BLOCKS) * self.memory
            batching = fastest_batching(batching, Workload(count, count, fill=1.0), CPU.costs, allowed_bytes)
        return evaluate_at(self.coordinates, coefficients, self.lattice, block, batching)


def _coordinates(points: ArrayLike) -> NDArray[np.float64]:
    """Points (n, 3) as one contiguous row per axis (3, n).

    Raises:
        InputError: they are not real, finite or of that shape.
    """
    found = triples_of(points, "points")
    bad = int(np.count_nonzero(~np.isfinite(found).all(axis=1)))
    if bad:
        raise InputError(f"{bad} of {len(found)} points have NaN or infinite coordinates")
    return np.ascontiguousarray(found.T)


def _labelled(values: NDArray[np.floating], order: Orders) -> xr.DataArray:
    orders = np.asarray(order, dtype=np.float64)
    dimensions = ("order",) * orders.ndim
    return xr.DataArray(
        values.reshape(*orders.shape, values.shape[1]),
        dims=(*dimensions, "point"),
        coords={"order": (dimensions, orders)},
        name="witness",
        attrs={"description": "positive where the first surface has area that the second lacks"},
    )
