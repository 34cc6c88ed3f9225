"""Bounds on norms and products of surfaces that no field is needed for: by areas, moves of faces, and the gap between.

Their kernel, the inverse transform of (1 + |ξ|²)^s, is Matérn's.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import beta, gamma, gammaln, kve, zeta

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.surface import Surface

# Fraction of the accuracy that the product of two surfaces far apart may take.
APART_FRACTION = 0.01
# The order below which points have a norm.
_OF_POINTS = -1.5
# What folds may add to the norm of faces that move by a rounding.
_FOLDS = 3.0
# Edge of the cubes that bound norms from below, in units of length: the kernel hardly falls within one.
_EDGE = 0.25


def area_bounds(area: float, order: float, layers: float = 1.0) -> list[tuple[float, float]]:
    """Return bounds on the squared norm beyond a frequency, as factors and powers: factor / frequency^power.

    The energy on |ξ| = r is on average twice the area, times the layers of each surface in one place, and twice that
    where two surfaces reinforce each other. If surfaces repeat, it comes in pulses at the odd multiples of a frequency;
    the first may lie just beyond. Besides, no value of the transform is larger than the area.
    """
    power = -2 * order - 3
    bounds = [(4 * layers * area * (1 - 4**order) * float(zeta(-2 * order)), -2 * order - 1)]
    if power > 0:
        bounds.append((4 * np.pi * area**2 / power, power))
    return bounds


def modulus_bound(area: float, orders: Reals, highest: float) -> Reals:
    """Return what no squared norm beyond a frequency exceeds (orders,), by the area; infinite from order -3/2 on."""
    powers = -2 * orders - 3
    with np.errstate(divide="ignore", over="ignore"):
        return np.where(powers > 0, 4 * np.pi * area**2 * highest**-powers / np.maximum(powers, 0.0), np.inf)


def norm_of_moves(areas: Reals, distances: Reals, orders: Sequence[float]) -> Reals:
    """Return what no norm changes by (orders,) if flat faces of some areas move by distances out of their planes.

    Norms of different planes add.
    """
    return np.array([np.sqrt(areas * _square_of_moves(distances, -order)).sum() for order in orders])


def norm_of_rounding(area: float, distance: float, missing: float, orders: Sequence[float], norms: Reals) -> Reals:
    """Return what norms (orders,) are not likely to change by if each of many faces moves by a small distance at most.

    On the way a test function changes by no more than the distance times its slope, and by the trace theorem a surface
    has little more of the squares of both than a plane has. So all faces count as one that is flat, and as several
    where their norm is that of several close layers, which may move alike. Shifts and growth of spheres, boxes and
    plates took up to 1.1 of that at orders from -4 to -1, and of stacks of plates up to 1.5; the factor 3 is for folds.
    Area that is missing counts as points. Above order -3/2, where points have no norm, moves are far more, and are
    those of short waves, in which layers do not move alike.
    """
    powers = -np.array(orders)
    moved = np.array([_FOLDS * (area * _square_of_moves(np.array([distance]), a)[0]) ** 0.5 for a in powers])
    layers = np.where(powers <= -_OF_POINTS, 1.0, norms**2 / (area * beta(0.5, powers - 0.5)))
    at_zero = np.array([_kernel(order, np.zeros(1))[0] if order < _OF_POINTS else 0.0 for order in orders])
    return np.asarray(moved * np.sqrt(np.maximum(layers, 1.0)) + missing * np.sqrt(at_zero))


def _square_of_moves(distances: Reals, a: float) -> Reals:
    """Return the square of a norm of order -a (n,), for each unit of area of a flat face that moves out of its plane.

    By Parseval's identity along a plane, it is at most ∫ (1 + z²)^s 4 sin²(πzd) dz. There sin² x is at most x^2p for
    all p from 0 to 1, and at high orders (1 + z²)^s at most |z|^2s.
    """
    p = np.linspace(0, 1, 41)
    p = p[p < a - 0.5]
    squares = (4 * (np.pi * distances[:, None]) ** (2 * p) * beta(p + 0.5, a - 0.5 - p)).min(axis=1)
    if a < 1.5:
        powers = 2 * np.pi * (2 * np.pi * distances) ** (2 * a - 1) / (gamma(2 * a) * -np.cos(np.pi * a))
        squares = np.minimum(squares, powers)
    return np.where(distances > 0, squares, 0.0)


def bessel_logs(nu: float, distances: Reals) -> Reals:
    """Return the logarithms of b^ν K_ν(b) at b = 2π distance (n,): the powers overflow at low orders, and so does K."""
    # Beyond the upper bound K is zero, and its routine gives up.
    arguments = np.clip(2 * np.pi * distances, 1e-6, 1e6)
    with np.errstate(over="ignore"):
        return np.asarray(nu * np.log(arguments) + np.log(kve(nu, arguments)) - arguments)


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
    sides = np.stack([high - low, other_high - other_low])
    cubes = math.sqrt(np.prod(np.maximum(np.ceil(sides / _EDGE), 1.0)))
    at_gap, within = np.array([_kernel(order, np.array([gap, math.sqrt(3) * _EDGE])) for order in orders]).T
    return a.area * b.area * at_gap if np.all(at_gap * cubes <= 2 * APART_FRACTION * rtol * within) else None


def _kernel(order: float, distances: Reals) -> Reals:
    """Return the Matérn kernel of an order at distances > 0 (n,): the inverse transform of (1 + |ξ|²)^order."""
    power = -order - 1.5
    factor = -order * math.log(np.pi) - gammaln(-order)
    logs = math.log(2) + factor - power * math.log(2 * np.pi) + bessel_logs(power, distances)
    at_zero = gammaln(power) + factor - power * math.log(np.pi) if power > 0 else math.inf
    return np.asarray(np.exp(np.minimum(logs, at_zero)))
