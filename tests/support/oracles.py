"""Transforms of spheroids and tori as integrals of Bessel functions; norms as sums over the whole cube."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import quad
from scipy.special import j0

from sobolev_batch import Lattice


def torus_value(R: float, r: float, across: float, along: float) -> float:
    """Return the transform of a torus at a frequency with components across and along its axis."""

    def ring(v: float) -> float:
        radius = R + r * math.cos(v)
        length = 2 * math.pi * radius * float(j0(2 * math.pi * across * radius))
        return r * length * math.cos(2 * math.pi * along * r * math.sin(v))

    return 2 * integral(ring, 0.0, math.pi)


def spheroid_value(a: float, c: float, across: float, along: float) -> float:
    """Return the transform of an ellipsoid with semi-axes (a, a, c), likewise."""

    def ring(theta: float) -> float:
        sine, cosine = math.sin(theta), math.cos(theta)
        width = a * sine * math.hypot(a * cosine, c * sine)
        length = 2 * math.pi * width * float(j0(2 * math.pi * across * a * sine))
        return length * math.cos(2 * math.pi * along * c * cosine)

    return 2 * integral(ring, 0.0, math.pi / 2)


def integral(function: Callable[[float], float], low: float, high: float) -> float:
    """Integrate a function to 1e-14 of its values."""
    edges = [low + (high - low) * k / 12 for k in range(13)]
    return math.fsum(quad(function, start, stop, epsabs=1e-15, epsrel=1e-13)[0] for start, stop in pairwise(edges))


def on_whole_cube(values: np.ndarray, lattice: Lattice, order: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a field with its conjugate half, and the weights of the trapezoidal rule times (1 + |ξ|²)^s."""
    whole = np.concatenate([np.conj(values[::-1, ::-1, :0:-1]), values], axis=2)
    axis = lattice.axes[0]
    ends = np.where(np.abs(axis) == lattice.xi_max, 0.5, 1.0) * lattice.spacing
    squares = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    return whole, ends[:, None, None] * ends[:, None] * ends * (1 + squares) ** order


def full_lattice_norm(values: np.ndarray, lattice: Lattice, order: float) -> float:
    whole, weights = on_whole_cube(values, lattice, order)
    return float(np.sqrt(np.sum(weights * np.abs(whole) ** 2)))
