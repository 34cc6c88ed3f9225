"""The squared distance of a mesh from a sphere over a lattice, and its exact derivative, by plain sums."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi, roots_legendre

Reals = NDArray[np.float64]

_STEP = 1e-40
# Nodes along each side of a product rule on the triangle.
_COUNT = 12


class PlainSums:
    """Σ (1 + |ξ|²)^s |mesh^ - sphere^|² over the whole cube of frequencies of a lattice.

    Args:
        radius: Radius of the sphere.
        center: Its centre.
        highest: xi_max of the lattice.
        intervals: M of the lattice.
        orders: Orders s.
    """

    def __init__(self, radius: float, center: Reals, highest: float, intervals: int, orders: Sequence[float]) -> None:
        indices = np.array(list(product(range(-intervals // 2, intervals // 2 + 1), repeat=3)), dtype=np.float64)
        step = 2 * highest / intervals
        self.frequencies = step * indices
        lengths = np.linalg.norm(self.frequencies, axis=1)
        at_ends = np.sum(np.abs(indices) == intervals // 2, axis=1)
        self.weights = step**3 * 0.5**at_ends * (1 + lengths**2) ** np.array(orders)[:, None]
        size, phases = 4 * np.pi * radius**2 * np.sinc(2 * radius * lengths), 2 * np.pi * self.frequencies @ center
        self.sphere = size * np.cos(phases), -size * np.sin(phases)
        u, of_u = roots_legendre(_COUNT)
        v, of_v = roots_jacobi(_COUNT, 1.0, 0.0)
        self.first = ((1 + v)[:, None] / 2 * np.ones(_COUNT)).ravel()
        self.second = ((1 - v)[:, None] / 2 * (1 + u) / 2).ravel()
        self.shares = (of_v[:, None] * of_u / 4).ravel()

    def value_and_derivative(self, vertices: Reals, triangles: NDArray[np.int64]) -> tuple[Reals, Reals]:
        """Return the sum for each order and its derivative (orders, n, 3), by imaginary steps: exact to rounding."""
        parts = [self._triangle(corners) for corners in vertices[triangles]]
        cosines = sum(cosine for cosine, _ in parts) - self.sphere[0]
        sines = sum(sine for _, sine in parts) - self.sphere[1]
        found = np.zeros((len(self.weights), *vertices.shape))
        for triangle in triangles:
            for corner, axis in product(range(3), range(3)):
                moved = vertices[triangle].astype(complex)
                moved[corner, axis] += 1j * _STEP
                cosine, sine = (part.imag / _STEP for part in self._triangle(moved))
                found[:, triangle[corner], axis] += 2 * self.weights @ (cosines * cosine + sines * sine)
        return self.weights @ (cosines**2 + sines**2), found

    def _triangle(self, corners: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Real and imaginary part of a triangle's transform, as analytic functions of its corners."""
        a, b, c = corners
        normal = np.cross(b - a, c - a)
        area = np.sqrt(np.sum(normal * normal)) / 2
        nodes = a + self.first[:, None] * (b - a) + self.second[:, None] * (c - a)
        angles = 2 * np.pi * self.frequencies @ nodes.T
        return np.cos(angles) @ self.shares * area, -np.sin(angles) @ self.shares * area
