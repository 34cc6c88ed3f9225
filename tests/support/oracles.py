"""Transforms of ellipsoids and tori as integrals over one variable of Bessel functions and elliptic integrals."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import quad
from scipy.special import ellipe, j0

from sobolev_batch import Lattice


def torus_value(R: float, r: float, across: float, along: float) -> float:
    """The transform at a frequency with these parts across and along the axis: the angle around it is closed."""

    def ring(v: float) -> float:
        radius = R + r * math.cos(v)
        return (
            r
            * radius
            * 2
            * math.pi
            * float(j0(2 * math.pi * across * radius))
            * math.cos(2 * math.pi * along * r * math.sin(v))
        )

    return 2 * integral(ring, 0.0, math.pi)


def spheroid_value(a: float, c: float, across: float, along: float) -> float:
    """The transform of an ellipsoid with semi-axes (a, a, c), likewise."""

    def ring(theta: float) -> float:
        sine, cosine = math.sin(theta), math.cos(theta)
        width = a * sine * math.hypot(a * cosine, c * sine)
        return (
            width
            * 2
            * math.pi
            * float(j0(2 * math.pi * across * a * sine))
            * math.cos(2 * math.pi * along * c * cosine)
        )

    return 2 * integral(ring, 0.0, math.pi / 2)


def ellipsoid_value_along_c(a: float, b: float, c: float, along: float) -> float:
    """The transform of an ellipsoid on the axis of c: each section's part is an elliptic integral."""

    def section(t: float) -> float:
        first = c**2 * (1 - t * t) * b**2 + (a * b * t) ** 2
        second = c**2 * (1 - t * t) * a**2 + (a * b * t) ** 2
        return 4 * math.sqrt(first) * float(ellipe(1 - second / first)) * math.cos(2 * math.pi * along * c * t)

    return 2 * integral(section, 0.0, 1.0)


def integral(function: Callable[[float], float], low: float, high: float) -> float:
    """To 1e-14 of the values of the function."""
    pieces = 12
    edges = [low + (high - low) * k / pieces for k in range(pieces + 1)]
    parts = [quad(function, edges[k], edges[k + 1], epsabs=1e-15, epsrel=1e-13)[0] for k in range(pieces)]
    return math.fsum(parts)


def full_lattice_norm(values: np.ndarray, lattice: Lattice, order: float) -> float:
    """The trapezoidal rule spelt out on the whole cube, conjugate half and all."""
    mirrored = np.conj(values[::-1, ::-1, :0:-1])
    whole = np.concatenate([mirrored, values], axis=2)
    axis = lattice.axes[0]
    ends = np.where(np.abs(axis) == lattice.xi_max, 0.5, 1.0)
    weights = ends[:, None, None] * ends[:, None] * ends * lattice.spacing**3
    squares = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    return float(np.sqrt(np.sum(weights * (1 + squares) ** order * np.abs(whole) ** 2)))
