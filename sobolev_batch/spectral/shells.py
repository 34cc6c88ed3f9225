"""Sums over the shells |k|² of a lattice, to which every weight (1 + |ξ|²)^s reduces a field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import OrderError
from sobolev_batch.spectral.lattice import Block, Lattice

Reals = NDArray[np.float64]
Complexes = NDArray[np.complexfloating[Any, Any]]
Orders = float | Sequence[float]

_LOWEST_ORDER = -100.0
# Samples weighed at a time.
_BLOCK_SAMPLES = 1 << 20


def check_orders(order: Orders) -> tuple[float, ...]:
    """The orders as a tuple of floats.

    Raises:
        OrderError: none at all, or one that is not between -100 and -1/2.
    """
    orders = tuple(float(s) for s in np.atleast_1d(np.asarray(order, dtype=np.float64)))
    if not orders:
        raise OrderError("at least one order is needed")
    for s in orders:
        if not (np.isfinite(s) and s < -0.5):
            raise OrderError(f"the norm of a surface is finite only for orders below -1/2, found {s:g}")
        if s < _LOWEST_ORDER:
            raise OrderError(f"orders go down to {_LOWEST_ORDER:g}, where weights leave double precision, found {s:g}")
    return orders


def shell_sums(
    values: NDArray[np.complexfloating], others: NDArray[np.complexfloating] | None, lattice: Lattice, block: Block
) -> Reals:
    """Trapezoidal sums of Re(a conj b) over each shell of one block of the half lattice.

    Args:
        values: a, complex (..., *block.shape).
        others: b, likewise; None stands for a itself.
        lattice: where the values lie.
        block: which part of it they are.

    Returns:
        float64 (..., lattice.shell_count): indexed by |k|². The sums of all blocks add up to those of
        the whole lattice, conjugate half included. NaN anywhere makes its shells NaN.
    """
    # The type that counting needs, and the weights, once for all fields.
    shells = lattice.shells(block).ravel().astype(np.intp)
    weights = lattice.trapezoid_weights(block)
    sums = np.empty((*values.shape[:-3], lattice.shell_count))
    for i in np.ndindex(sums.shape[:-1]):
        a = values[i]
        b = a if others is None else others[i]
        products = a.real.astype(np.float64) * b.real
        products += a.imag.astype(np.float64) * b.imag
        products *= weights
        sums[i] = np.bincount(shells, weights=products.ravel(), minlength=lattice.shell_count)
    return sums


def shell_weights(lattice: Lattice, orders: Sequence[float]) -> Reals:
    """(1 + h²|k|²)^s for each order and each shell, float64 (orders, lattice.shell_count)."""
    squares = 1 + lattice.spacing**2 * np.arange(lattice.shell_count, dtype=np.float64)
    return np.stack([squares**s for s in orders])


def shell_volumes(lattice: Lattice) -> Reals:
    """The trapezoidal weights of each shell together, float64 (lattice.shell_count,): what a field of ones sums to."""
    volumes = np.zeros(lattice.shell_count)
    for block in lattice.split(_BLOCK_SAMPLES):
        weights = lattice.trapezoid_weights(block).ravel()
        volumes += np.bincount(lattice.shells(block).ravel(), weights=weights, minlength=lattice.shell_count)
    return volumes
