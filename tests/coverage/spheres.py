"""Distances of spheres, by a radial integral of their transforms: no Bessel functions, lattices or fields.

||σ_1 - σ_2||_s² = ∫_0^∞ 4πρ² (1+ρ²)^s [(m_1 - m_2)² + 2 m_1 m_2 (1 - sinc 2ρd)] dρ,   m_i = 4πR_i² sinc 2R_iρ,

with d the distance of the centres. Up to a large ρ, Gauss rules on short panels take it. What lies beyond is a constant
part and sines and cosines over powers of ρ, which QUADPACK integrates period by period.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import IntegrationWarning, quad
from scipy.special import beta, betainc

from sobolev_batch import Sphere

Reals = NDArray[np.float64]

# Where the panels end, their width, and nodes of the two rules on each.
_REACH, _PANEL, _NODES = 1024, 0.125, (14, 18)
# Absolute accuracy asked of each oscillating integral.
_ACCURACY = 1e-13
# Rounding of the two terms of the integrand, relative to the area squared.
_ROUNDING = 1e-15


def squared_distances(first: Sphere, second: Sphere, orders: Sequence[float]) -> tuple[Reals, Reals]:
    """Return the squared distances (orders,) of two spheres, and their uncertainties."""
    coarse, fine = (_within_reach(first, second, orders, count) for count in _NODES)
    tails, slacks = np.array([_beyond_reach(first, second, order) for order in orders]).T
    rounding = _ROUNDING * (first.area + second.area) ** 2 * fine / np.maximum(fine, 1e-3)
    return fine + tails, np.abs(fine - coarse) + slacks + rounding


def _within_reach(first: Sphere, second: Sphere, orders: Sequence[float], count: int) -> Reals:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    starts = np.arange(0, _REACH, _PANEL)
    rho = (starts[:, None] + _PANEL * (nodes + 1) / 2).ravel()
    masses = [sphere.area * np.sinc(2 * sphere.radius * rho) for sphere in (first, second)]
    apart = 2 * masses[0] * masses[1] * _one_minus_sinc(2 * rho * math.dist(first.center, second.center))
    energies = 4 * np.pi * rho**2 * ((masses[0] - masses[1]) ** 2 + apart)
    energies *= np.tile(weights * _PANEL / 2, len(starts))
    return np.array([energies @ (1 + rho**2) ** order for order in orders])


def _one_minus_sinc(x: Reals) -> Reals:
    squared = (np.pi * x) ** 2
    series = squared / 6 * (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72)))
    return np.where(squared < 0.01, series, 1 - np.sinc(x))


def _beyond_reach(first: Sphere, second: Sphere, order: float) -> tuple[float, float]:
    """Return the rest of the integral and its uncertainty.

    4πρ² m_i m_j is 16π R_i R_j sin(2πR_iρ) sin(2πR_jρ), a sum of waves.
    """
    radii = first.radius, second.radius
    separation = math.dist(first.center, second.center)
    total, slack = 0.0, 0.0

    def add(factor: float, frequency: float, sine: bool) -> None:
        nonlocal total, slack
        value, error = _wave(order, 2 * np.pi * frequency, sine)
        total += factor * value
        slack += abs(factor) * error

    for radius in radii:
        add(8 * np.pi * radius**2, 0.0, sine=False)
        add(-8 * np.pi * radius**2, 2 * radius, sine=False)
    scale = -16 * np.pi * radii[0] * radii[1]
    for sign, partner in product((1, -1), (-1, 1)):
        beat = radii[0] + partner * radii[1]
        if separation == 0:
            add(-partner * scale / 2, abs(beat), sine=False)
        else:
            add(-partner * scale / (4 * np.pi * separation), separation + sign * beat, sine=True)
    return total, slack


def _wave(order: float, rate: float, sine: bool) -> tuple[float, float]:
    """Return ∫ (1+ρ²)^s cos(rate ρ) dρ, or that of sin(rate ρ)/ρ, beyond the reach, and its uncertainty."""
    if rate == 0:
        return (0.0, 0.0) if sine else (_constant(order), 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IntegrationWarning)
        value, error = quad(
            lambda rho: (1 + rho**2) ** order / (rho if sine else 1.0),
            _REACH,
            np.inf,
            weight="sin" if sine else "cos",
            wvar=abs(rate),
            epsabs=_ACCURACY,
            limlst=200,
        )[:2]
    return math.copysign(1.0, rate) * value if sine else value, error


def _constant(order: float) -> float:
    """Return ∫ (1+ρ²)^s dρ beyond the reach, by t = 1/(1+ρ²)."""
    power = -order - 0.5
    return float(0.5 * beta(power, 0.5) * betainc(power, 0.5, 1 / (1 + _REACH**2)))
