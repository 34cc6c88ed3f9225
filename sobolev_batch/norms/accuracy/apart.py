"""Surfaces so far apart that neither feels the other: their squared distance is the sum of both squared norms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import gammaln, kve

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.surface import Extent, Surface

# Fraction of the accuracy that the product of both surfaces may take.
APART_FRACTION = 0.01
# Edge of the cubes that bound norms from below, in units of length: the kernel hardly falls within one.
_EDGE = 0.25
# At this distance the kernel is zero in floating point.
_VANISHED = 1e4


def product_apart(surfaces: Sequence[Surface], orders: Sequence[float], rtol: float) -> Reals | None:
    """Return what the inner product of two surfaces does not exceed (orders,), or None if that is not next to nothing.

    The kernel is positive and falls, so that no product exceeds both areas times the kernel at the gap between the
    boxes. And no squared norm is below that of an even distribution over cubes of the box, area² / cubes times the
    kernel at their diagonal. So the areas cancel in the ratio, which is to be far below the rtol.
    """
    if len(surfaces) == 1:
        return None
    a, b = surfaces
    (low, high), (other_low, other_high) = a.extent.box, b.extent.box
    gap = float(np.linalg.norm(np.maximum(np.maximum(low - other_high, other_low - high), 0.0)))
    if gap <= _EDGE:
        return None
    cubes = math.sqrt(_cubes(a.extent) * _cubes(b.extent))
    at_gap = np.array([kernel(order, gap) for order in orders])
    within = np.array([kernel(order, math.sqrt(3) * _EDGE) for order in orders])
    return a.area * b.area * at_gap if np.all(at_gap * cubes <= 2 * APART_FRACTION * rtol * within) else None


def _cubes(extent: Extent) -> float:
    """Return the number of cubes that hold a box."""
    low, high = extent.box
    return float(np.prod(np.maximum(np.ceil((high - low) / _EDGE), 1.0)))


def kernel(order: float, distance: float) -> float:
    """Return the Matérn kernel of an order at a distance > 0: the inverse transform of (1 + |ξ|²)^order.

    >>> bool(abs(kernel(-2.0, 0.5) / (np.pi**2 * np.exp(-np.pi)) - 1) < 1e-12)
    True
    """
    power = -order - 1.5
    argument = 2 * np.pi * min(distance, _VANISHED)
    # In logarithms, as powers and Bessel functions overflow at low orders, where the value at zero is nearly met.
    factor = -order * math.log(np.pi) - gammaln(-order)
    with np.errstate(over="ignore", divide="ignore"):
        bessel = np.log(kve(abs(power), argument)) - argument
        value = math.log(2) + factor + power * math.log(argument / (2 * np.pi)) + bessel
    at_zero = gammaln(power) + factor - power * math.log(np.pi) if power > 0 else math.inf
    return math.exp(min(float(value), float(at_zero)))
