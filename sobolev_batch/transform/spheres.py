"""Spheres: the Fourier transforms of their area measures, their norms, and the distances of two."""

import math
import warnings
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.special import gamma, kv

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.errors import OrderError
from sobolev_batch.geometry.closed_forms import Sphere

# Terms of a series below this fraction of its sum do not count.
_LEAST_TERM = 1e-17
# The integrand is smooth where this rule is used, over intervals shorter than their distance from its singularity.
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(14)


def sphere_transform(sphere: Sphere, frequencies: Reals) -> Complexes:
    """Return the transform ∫ exp(-2πi ξ·x) dσ(x) of the area measure of a sphere of radius R and centre c.

    For ξ, float64 (..., 3), in cycles per unit length, it is 4πR² sinc(2R|ξ|) exp(-2πi ξ·c) with sinc(t) =
    sin(πt)/(πt), complex128 (...).
    """
    lengths = np.sqrt(np.einsum("...i,...i->...", frequencies, frequencies))
    phases = np.exp(-2j * np.pi * (frequencies @ np.asarray(sphere.center)))
    return np.asarray(sphere.area * np.sinc(2 * sphere.radius * lengths) * phases)


def sphere_inner_product(first: Sphere, second: Sphere, order: float) -> float:
    """Return the inner product of two spheres' area measures in the Sobolev norm of an order s < -1/2.

    It is 4πR₁R₂ times the mean over |t| <= 1 of 2 C(2π(R₁-R₂+dt)) - 2 C(2π(R₁+R₂+dt)), where d is the distance of the
    centres and C(b) = ∫_0^∞ cos(bρ) (1+ρ²)^s dρ is a Matérn function: a closed form for concentric spheres, else an
    integral in one dimension. The relative error is about 1e-13. OrderError where the Bessel functions overflow.
    """
    nu = -order - 0.5
    separation = math.dist(first.center, second.center)
    radii = first.radius, second.radius
    near, far = radii[0] - radii[1], radii[0] + radii[1]

    def integrand(t: float) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            return _matern_difference(nu, abs(near + separation * t), abs(far + separation * t))

    if separation == 0:
        mean = integrand(0.0)
    else:
        # Integrate up to the kink of the Matérn function at zero from both sides.
        edges = [-1.0, *sorted(t for t in (-near / separation, -far / separation) if -1 < t < 1), 1.0]
        mean = 0.5 * sum(_integral(integrand, low, high) for low, high in pairwise(edges))
    value = 8 * math.pi * radii[0] * radii[1] * mean
    if not math.isfinite(value):
        raise OrderError(f"order {order:g} is too low for the closed form of spheres: its Bessel functions overflow")
    return value


def _matern_difference(nu: float, shorter: float, longer: float) -> float:
    """Return C(2π shorter) - C(2π longer), without cancellation if the arguments are close.

    C(b) = √π (b/2)^ν K_ν(b) / Γ(ν+1/2), and d/db [b^ν K_ν(b)] = -b^ν K_{ν-1}(b).
    """
    low, high = 2 * math.pi * shorter, 2 * math.pi * longer
    factor = float(math.sqrt(math.pi) / (np.exp2(nu) * gamma(nu + 0.5)))
    if abs(high - low) < 1 <= min(low, high):
        nodes = (low + high) / 2 + (high - low) / 2 * _NODES
        return float(factor * (high - low) / 2 * (_NODE_WEIGHTS @ (nodes**nu * kv(nu - 1, nodes))))
    if abs(high - low) < 1:
        return factor * _integral(lambda b: b * _matern(nu - 1, b) if b > 0 else 0.0, low, high)
    return float(factor * (_matern(nu, low) - _matern(nu, high)))


def _integral(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.integrate import IntegrationWarning, quad

    with warnings.catch_warnings():
        # The tolerance requires the last digits; quad warns if rounding prevents one of them.
        warnings.simplefilter("ignore", IntegrationWarning)
        return float(quad(function, low, high, epsabs=0, epsrel=1e-13, limit=200)[0])


def _matern(nu: float, b: float) -> float:
    """Return b^ν K_ν(b); at zero its limit 2^(ν-1) Γ(ν)."""
    value = np.power(b, nu) * kv(nu, b) if b > 0 else math.inf
    if math.isfinite(value):
        return float(value)
    # K overflows far below b = ν, where the first terms of its series are all of it (DLMF, 10.31.1).
    series, term, k = 1.0, 1.0, 1
    while k < nu and abs(term) > _LEAST_TERM * series:
        term *= (b / 2) ** 2 / (k * (k - nu))
        series, k = series + term, k + 1
    return float(np.exp2(nu - 1) * gamma(nu) * series)
