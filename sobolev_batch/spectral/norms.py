"""Sobolev norms, inner products and distances of fields, for any list of orders at once.

The weight (1 + |ξ|²)^s depends on the shell |k|² of a lattice point only. A field is therefore
reduced to one number per shell first, whatever the orders; a norm of any order is then a short
weighted sum of those. Fields are read block by block, so they need not fit into memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError, LatticeError, OrderError
from sobolev_batch.spectral.lattice import AXES, Block, Lattice
from sobolev_batch.spectral.spheres import sphere_distance, sphere_inner_product, sphere_norm
from sobolev_batch.spectral.transform import Transform, fourier_transform
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Surface
from sobolev_batch.surfaces.sphere import Sphere

Reals = NDArray[np.float64]
Complexes = NDArray[np.complexfloating[Any, Any]]
Orders = float | Sequence[float]

# Samples of a field held at a time when it is read from elsewhere: 64 MB of complex128.
_BLOCK_SAMPLES = 1 << 22


def norm(a: Surface | xr.DataArray, order: Orders, *, lattice: Lattice | None = None) -> xr.Dataset:
    """The Sobolev norm ||a||_s of a surface's area measure.

    Args:
        a: a field from `fourier_transform` or a store, or a surface. A sphere without a lattice is
            answered in closed form.
        order: one order s < -1/2, or several.
        lattice: where a surface is to be transformed; a field brings its own.

    Returns:
        A dataset with `norm` over `order`.

    Raises:
        OrderError: an order that is not below -1/2.
        InputError: a mesh without a lattice.
    """
    orders = check_orders(order)
    if isinstance(a, Sphere) and lattice is None:
        return _dataset("norm", order, [sphere_norm(a, s) for s in orders])
    field = _field(a, lattice)
    return _dataset("norm", order, np.sqrt(_products(field, field, Lattice.of(field), orders)))


def inner_product(
    a: Surface | xr.DataArray, b: Surface | xr.DataArray, order: Orders, *, lattice: Lattice | None = None
) -> xr.Dataset:
    """The Sobolev inner product <a, b>_s, with the arguments of `distance`; real, since measures are."""
    orders = check_orders(order)
    if isinstance(a, Sphere) and isinstance(b, Sphere) and lattice is None:
        return _dataset("inner_product", order, [sphere_inner_product(a, b, s) for s in orders])
    first, second = _pair(a, b, lattice)
    return _dataset("inner_product", order, _products(first, second, Lattice.of(first), orders))


def distance(
    a: Surface | xr.DataArray, b: Surface | xr.DataArray, order: Orders, *, lattice: Lattice | None = None
) -> xr.Dataset:
    """The Sobolev distance ||a - b||_s of two surfaces' area measures.

    Args:
        a: a field, or a surface. Two spheres without a lattice are answered in closed form.
        b: a field on the same lattice, or a surface.
        order: one order s < -1/2, or several.
        lattice: where surfaces are to be transformed; a field brings its own.

    Returns:
        A dataset with `distance` over `order`.

    Raises:
        OrderError: an order that is not below -1/2.
        LatticeError: fields on different lattices, or a surface that does not fit into the lattice.
        InputError: a mesh, and no lattice from anywhere.
    """
    orders = check_orders(order)
    if isinstance(a, Sphere) and isinstance(b, Sphere) and lattice is None:
        return _dataset("distance", order, [sphere_distance(a, b, s) for s in orders])
    first, second = _pair(a, b, lattice)
    return _dataset("distance", order, np.sqrt(_squared_distances(first, second, Lattice.of(first), orders)))


def check_orders(order: Orders) -> tuple[float, ...]:
    """The orders as a tuple of floats.

    Raises:
        OrderError: none at all, or one that is not finite and below -1/2.
    """
    orders = tuple(float(s) for s in np.atleast_1d(np.asarray(order, dtype=np.float64)))
    if not orders:
        raise OrderError("at least one order is needed")
    for s in orders:
        if not (np.isfinite(s) and s < -0.5):
            raise OrderError(f"the norm of a surface is finite only for orders below -1/2, found {s:g}")
    return orders


def shell_sums(
    values: NDArray[np.complexfloating], others: NDArray[np.complexfloating] | None, lattice: Lattice, block: Block
) -> Reals:
    """Trapezoidal sums of Re(a conj b) over each shell of one block of the half lattice.

    Args:
        values: a, complex (block.shape).
        others: b, likewise; None stands for a itself.
        lattice: where the values lie.
        block: which part of it they are.

    Returns:
        float64 (lattice.shell_count,): indexed by |k|². The sums of all blocks add up to those of
        the whole lattice, conjugate half included. NaN anywhere makes its shells NaN.
    """
    if others is None:
        products = values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2
    else:
        products = values.real.astype(np.float64) * others.real + values.imag.astype(np.float64) * others.imag
    products *= lattice.trapezoid_weights(block)
    shells = lattice.shells(block).ravel()
    sums: Reals = np.bincount(shells, weights=products.ravel(), minlength=lattice.shell_count).astype(np.float64)
    return sums


def shell_weights(lattice: Lattice, orders: Sequence[float]) -> Reals:
    """(1 + h²|k|²)^s for each order and each shell, float64 (orders, lattice.shell_count)."""
    squares = 1 + lattice.spacing**2 * np.arange(lattice.shell_count, dtype=np.float64)
    return np.stack([squares**s for s in orders])


def _products(a: xr.DataArray, b: xr.DataArray, lattice: Lattice, orders: Sequence[float]) -> Reals:
    sums = np.zeros(lattice.shell_count)
    for block in lattice.split(_BLOCK_SAMPLES):
        values = _read(a, lattice, block)
        sums += shell_sums(values, None if b is a else _read(b, lattice, block), lattice, block)
    return shell_weights(lattice, orders) @ sums


def _squared_distances(a: xr.DataArray, b: xr.DataArray, lattice: Lattice, orders: Sequence[float]) -> Reals:
    sums = np.zeros(lattice.shell_count)
    for block in lattice.split(_BLOCK_SAMPLES):
        sums += shell_sums(_read(a, lattice, block) - _read(b, lattice, block), None, lattice, block)
    return shell_weights(lattice, orders) @ sums


def _read(field: xr.DataArray, lattice: Lattice, block: Block) -> Complexes:
    places = dict(zip(AXES, lattice.place(block), strict=True))
    return np.asarray(field.isel(places).transpose(*AXES).values)


def _pair(
    a: Surface | xr.DataArray, b: Surface | xr.DataArray, lattice: Lattice | None
) -> tuple[xr.DataArray, xr.DataArray]:
    """Both as fields; a surface beside a field is transformed on the field's lattice."""
    known = [Lattice.of(x) for x in (a, b) if isinstance(x, xr.DataArray)]
    if lattice is not None:
        known.append(lattice)
    for other in known[1:]:
        if other.M != known[0].M or not np.isclose(other.xi_max, known[0].xi_max, rtol=1e-12, atol=0):
            raise LatticeError(f"fields on different lattices cannot be compared: {known[0]} and {other}")
    common = known[0] if known else None
    return _field(a, common), _field(b, common)


def _field(a: Surface | xr.DataArray, lattice: Lattice | None) -> xr.DataArray:
    if isinstance(a, xr.DataArray):
        if set(a.dims) != set(AXES):
            raise LatticeError(
                f"a field must have the dimensions {', '.join(AXES)} and no others, found {a.dims}: select one mesh"
            )
        return a
    if not isinstance(a, Mesh | Sphere):
        raise InputError(f"expected a Mesh, a Sphere or a Fourier field, found {type(a).__name__}")
    if lattice is None:
        raise InputError("a mesh needs a lattice to be compared on: pass lattice=Lattice(xi_max=..., M=...)")
    return fourier_transform(a, lattice, Transform().accuracy)


def _dataset(name: str, order: Orders, values: Sequence[float] | Reals) -> xr.Dataset:
    """Values over the dimension `order`; a single number asked for comes back without dimensions."""
    orders = np.asarray(order, dtype=np.float64)
    result = np.asarray(values, dtype=np.float64).reshape(orders.shape)
    return xr.Dataset({name: (("order",) * orders.ndim, result)}, coords={"order": (("order",) * orders.ndim, orders)})
