"""Witness functions: where two surfaces differ, as seen by the norm."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.machine import available
from sobolev_batch.spectral.backends import CPU, ComplexDtype, NufftSpec
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.metrics.datasets import KERNEL, LENGTH, described, lattice_attributes, order_axis
from sobolev_batch.spectral.metrics.inputs import BLOCK_SAMPLES, OperandLike, pair_of, point_array, read_blocks
from sobolev_batch.spectral.shells import Orders, Reals, SobolevWeights, check_orders
from sobolev_batch.spectral.transform.memory import Batching, Workload, fastest_batching
from sobolev_batch.spectral.transform.nufft import evaluate_at
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings, thread_count
from sobolev_batch.spectral.transform.transform import require_points_inside

# Fraction of a given memory for blocks of fields; the rest is for the NUFFT.
_BLOCK_FRACTION = 0.25
# Samples of a block besides their coefficients: two fields, their difference, its weights and its shells.
_SAMPLE_BYTES = 72


def witness(
    a: OperandLike,
    b: OperandLike,
    order: Orders,
    points: ArrayLike,
    *,
    lattice: Lattice | None = None,
    eps: float | None = None,
    dtype: ComplexDtype = "complex128",
    threads: int | None = None,
    memory: float | str | None = None,
) -> xr.DataArray:
    """Return the witness function of two surfaces at points: positive where a has area that b lacks.

    It is w(x) = ∫ (1 + |ξ|²)^s (a^ - b^)(ξ) exp(+2πi ξ·x) dξ, by the trapezoidal rule over the lattice
    as in norms: the difference of the area measures, smoothed by the norm's kernel. Its integral
    against that difference is the squared distance, ∫ w d(a - b) = ||a - b||_s².

    Args:
        a: Field from `fourier_transform` or a store, or a surface.
        b: Field on the same lattice, or a surface.
        order: One order s < -1/2, or several.
        points: Points x, real (n, 3), in the fields' unit of length. For example ``mesh.vertices`` of a mesh
            after the similarity of its study.
        lattice: Lattice to transform surfaces on. A field brings its own.
        eps: Accuracy of the NUFFT, relative to the sum of the moduli of all terms. The error is a small
            multiple of it. Default 1e-9, or 1e-6 in single precision.
        dtype: "complex128" or "complex64", the dtype of the arithmetic, whatever that of the fields.
        threads: Threads of the NUFFT; default one per core.
        memory: Memory for the computation besides points, result and fields in memory, in bytes or as a text
            such as "4GB". Default as much as is fastest.

    Returns:
        `witness` over (order, point), or (point,) for a single order, with the coordinates `order` and `x`,
        `y`, `z` of the points: float64, or float32 with complex64, in 1 / unit length. NaN everywhere if a
        field has NaN anywhere. The attribute `shortest_wavelength` is 1/xi_max, in units of length: what is shorter is
        not in the function. At orders above -3 that may be much of the distance.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: The fields lie on different lattices, or points lie beyond the half period 1/(2h).
        InputError: Points are not finite or not (n, 3); a surface comes without a lattice; settings are out
            of range; the memory is too little.

    Source: A. Gretton et al., "A kernel two-sample test" (2012), JMLR 13, section 2.3.

    >>> from sobolev_batch import Lattice, Sphere, witness
    >>> w = witness(Sphere(), Sphere(0.9), -4.0, [[1, 0, 0], [0, 0, 0]], lattice=Lattice(3.0, 32))
    >>> (w > 0).values.tolist()
    [True, False]
    """
    orders = check_orders(order)
    settings = TransformSettings(eps, dtype)
    allowed_bytes = None if memory is None else available(memory)
    coordinates = _coordinates(points)
    first, second = pair_of(a, b, lattice, orders)
    lattice = Lattice.from_field(first)
    require_points_inside(coordinates, lattice)
    weights = SobolevWeights(lattice, orders)
    execution = Execution(threads=thread_count(threads), allowed_bytes=allowed_bytes)
    largest = BLOCK_SAMPLES
    if allowed_bytes is not None:
        sample_bytes = _SAMPLE_BYTES + len(orders) * np.dtype(dtype).itemsize
        largest = max(1, min(BLOCK_SAMPLES, int(_BLOCK_FRACTION * allowed_bytes / sample_bytes)))
    values = np.zeros((len(orders), coordinates.shape[1]))
    # FINUFFT refuses to evaluate nothing.
    for block, (of_a, of_b) in read_blocks(lattice, first, second, largest=largest) if values.size else ():
        values += _block_values(coordinates, weights, block, of_a - of_b, settings, execution)
    dims, labels, _ = axis = order_axis(order)
    values = values.astype(np.float32 if dtype == "complex64" else np.float64)
    places = {name: ("point", row, described(name, LENGTH)) for name, row in zip("xyz", coordinates, strict=True)}
    return xr.DataArray(
        values.reshape(*labels.shape, coordinates.shape[1]),
        dims=(*dims, "point"),
        coords={"order": axis, **places},
        name="witness",
        attrs={
            **described("witness function", "1 / unit length"),
            "description": "positive where the first surface has area that the second lacks",
            "kernel": KERNEL,
            **lattice_attributes(lattice, first, second),
            "shortest_wavelength": 1 / lattice.xi_max,
        },
    )


def _block_values(
    coordinates: Reals,
    weights: SobolevWeights,
    block: Block,
    difference: NDArray[np.complexfloating],
    settings: TransformSettings,
    execution: Execution,
) -> Reals:
    """Return the contribution of a block of the difference of two fields to the witness functions, (orders, n)."""
    lattice = weights.lattice
    weighted = difference * lattice.trapezoid_weights(block)
    shells = lattice.shells(block)
    coefficients = np.empty((len(weights.orders), *block.shape), dtype=settings.dtype)
    for row, weight in zip(coefficients, weights.per_shell, strict=True):
        np.multiply(weighted, weight[shells], out=row, casting="same_kind")
    batching = Batching(NufftSpec(block.shape, settings.eps, settings.dtype, threads=execution.threads))
    if execution.allowed_bytes is not None:
        count = coordinates.shape[1]
        allowed_bytes = (1 - _BLOCK_FRACTION) * execution.allowed_bytes
        batching = fastest_batching(batching, Workload(count, count, fill=1.0), CPU.costs, allowed_bytes)
    return evaluate_at(coordinates, coefficients, lattice, block, batching)


def _coordinates(points: ArrayLike) -> Reals:
    """Return points (n, 3) as one contiguous row per axis (3, n).

    Raises:
        InputError: The points are not real, finite or of that shape.
    """
    array = point_array(points, "points")
    bad = int(np.count_nonzero(~np.isfinite(array).all(axis=1)))
    if bad:
        raise InputError(f"{bad} of {len(array)} points have NaN or infinite coordinates")
    return np.ascontiguousarray(array.T)
