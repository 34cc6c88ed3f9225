"""Sums over the shells |k|² of a lattice, to which every weight (1 + |ξ|²)^s reduces a field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from sobolev_batch.errors import InputError, OrderError
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.surfaces.shapes.surface import Reals

Complexes = NDArray[np.complexfloating[Any, Any]]
Orders = float | Sequence[float]

_LOWEST_ORDER = -100.0
# The smooth step falls from one to zero between this fraction of the cutoff and the cutoff.
STEP_START = 0.5
# At the ends of the fall it is off by erfc(3)/2 = 1e-5, on both sides of the cut: a partition by steps stays one.
_STEEPNESS = 3.0


@dataclass(frozen=True)
class SobolevWeights:
    """Weights (1 + |ξ|²)^s of one or several orders on a lattice.

    Attributes:
        lattice: Lattice of ξ, in cycles per unit length.
        cutoff: Radius |ξ| at which a `smooth_step` ends that the weights are multiplied by; None for none.
    """

    lattice: Lattice
    orders: tuple[float, ...]
    cutoff: float | None = None

    @cached_property
    def per_shell(self) -> Reals:
        """Weight of each shell |k|² for each order, float64 (orders, lattice.shell_count)."""
        squares = self.lattice.spacing**2 * np.arange(self.lattice.shell_count, dtype=np.float64)
        step = 1.0 if self.cutoff is None else smooth_step(np.sqrt(squares), self.cutoff)
        return np.stack([(1 + squares) ** s * step for s in self.orders])

    def __getstate__(self) -> dict[str, Any]:
        # Tasks carry these weights: it is cheaper to compute them again than to send them.
        return {"lattice": self.lattice, "orders": self.orders, "cutoff": self.cutoff}


def smooth_step(radii: Reals, cutoff: float) -> Reals:
    """Return a smooth function of |ξ| that is 1 up to half the cutoff and 0 from the cutoff on.

    Where a sharp cut would spoil it, the trapezoidal rule stays spectrally accurate.
    """
    middle, width = (1 + STEP_START) / 2, (1 - STEP_START) / 2
    fractions = np.asarray(radii, dtype=np.float64) / cutoff
    steps = 0.5 * erfc(_STEEPNESS * (fractions - middle) / width)
    return np.where(fractions <= STEP_START, 1.0, np.where(fractions >= 1, 0.0, steps))


def check_orders(order: Orders) -> tuple[float, ...]:
    """Return one or several orders as floats; OrderError where one is not between -100 and -1/2, or none is given."""
    try:
        given = np.atleast_1d(np.asarray(order))
    except ValueError:
        given = np.empty((0, 0))
    if given.dtype.kind not in "iuf" or given.ndim > 1:
        raise OrderError(f"an order is a number, such as -2.0, or a list of numbers; found {order!r}")
    orders = tuple(float(s) for s in given)
    if not orders:
        raise OrderError("at least one order is needed")
    for s in orders:
        if not (np.isfinite(s) and s < -0.5):
            raise OrderError(f"the norm of a surface is finite only for orders below -1/2, found {s:g}")
        if s < _LOWEST_ORDER:
            raise OrderError(f"orders go down to {_LOWEST_ORDER:g}, where weights leave double precision, found {s:g}")
    return orders


def single_order(order: float) -> float:
    """Return one order as a float, as `check_orders` does; several are an InputError."""
    orders = check_orders(order)
    if len(orders) > 1:
        raise InputError(f"one order is needed, found {len(orders)}")
    return orders[0]


def shell_sums(
    values: NDArray[np.complexfloating], others: NDArray[np.complexfloating] | None, lattice: Lattice, block: Block
) -> Reals:
    """Sum Re(a conj b) by the trapezoidal rule over each shell of one block of the half lattice.

    The fields a and b, or a itself for None, are complex (..., *block.shape). The sums are float64 (...,
    lattice.shell_count), indexed by |k|². Those of all blocks add up to those of the whole lattice, conjugate half
    included. A NaN makes the sum of its shell NaN.
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


@lru_cache(maxsize=16)
def shell_volumes(lattice: Lattice) -> Reals:
    """Return the sum of the trapezoidal weights of each shell, float64 (lattice.shell_count,)."""
    x, y, z = lattice.axis_weights(lattice.half)
    squares = lattice.half.indices(0) ** 2
    plane = np.bincount((squares[:, None] + squares).ravel(), weights=np.outer(x, y).ravel())
    volumes = np.zeros(lattice.shell_count)
    for k, weight in enumerate(z):
        volumes[k * k : k * k + len(plane)] += weight * plane
    return volumes
