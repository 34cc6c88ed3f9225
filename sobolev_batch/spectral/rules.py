"""Quadrature rules on triangles, and how far each of them reaches at a given accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import modepy
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.triangles import second_difference

Reals = NDArray[np.float64]

HIGHEST_DEGREE = 50
# Below this the rules' own rounding hides what is left of their error.
FINEST_TOLERANCE = 1e-15


@dataclass(frozen=True, eq=False)
class TriangleRule:
    """A quadrature rule on the triangle.

    Attributes:
        degree: polynomials up to this total degree are integrated exactly.
        barycentric: (n, 3) barycentric coordinates of the nodes, rows sum to 1.
        weights: (n,) positive weights, their sum is 1: multiply by the area.
    """

    degree: int
    barycentric: Reals
    weights: Reals

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.weights)


@cache
def symmetric_rule(degree: int) -> TriangleRule:
    """The fully symmetric rule of a degree from 1 to 50 with positive weights and interior nodes.

    H. Xiao, Z. Gimbutas, "A numerical algorithm for the construction of efficient quadrature rules
    in two and higher dimensions" (2010), doi:10.1016/j.camwa.2009.10.027; tables from modepy.
    """
    rule = modepy.XiaoGimbutasSimplexQuadrature(degree, 2)
    second, third = (1 + np.asarray(rule.nodes, dtype=np.float64)) / 2
    weights = np.asarray(rule.weights, dtype=np.float64)
    return TriangleRule(degree, np.stack([1 - second - third, second, third], axis=1), weights / weights.sum())


@cache
def gauss_rule(points: int = 8) -> TriangleRule:
    """The product of two Gauss-Legendre rules, collapsed onto the triangle: points² nodes.

    With 8 points it is the rule of K. Koga's paper: 64 nodes whatever the triangle's size.
    """
    nodes, weights = np.polynomial.legendre.leggauss(points)
    u, v = np.meshgrid((1 + nodes) / 2, (1 + nodes) / 2, indexing="ij")
    products = np.outer(weights, weights) / 4 * 2 * (1 - u)
    second, third = u.ravel(), ((1 - u) * v).ravel()
    return TriangleRule(2 * points - 2, np.stack([1 - second - third, second, third], axis=1), products.ravel())


@lru_cache(maxsize=64)
def reaches(tolerance: float) -> tuple[tuple[TriangleRule, ...], Reals]:
    """The rules worth using at a tolerance, by size, and how large a triangle each may get.

    Args:
        tolerance: largest error on one triangle, relative to its area, at every frequency.

    Returns:
        rules of increasing size, and for each the largest 2π|ξ|ρ (radians; ρ the distance from a
        triangle's centroid to its farthest corner) up to which it keeps the tolerance for every
        shape of triangle and direction of ξ. Rules that a smaller one outreaches are left out.
    """
    tolerance = max(tolerance, FINEST_TOLERANCE)
    sizes, errors = _error_table()
    rules: list[TriangleRule] = []
    kept: list[float] = []
    for degree in range(1, HIGHEST_DEGREE + 1):
        within = np.flatnonzero(errors[degree - 1] > tolerance)
        reach = sizes[within[0] - 1] if within.size and within[0] > 0 else (0.0 if within.size else sizes[-1])
        rule = symmetric_rule(degree)
        while rules and rules[-1].size >= rule.size and kept[-1] <= reach:
            rules.pop()
            kept.pop()
        if not kept or reach > kept[-1]:
            rules.append(rule)
            kept.append(float(reach))
    return tuple(rules), np.array(kept)


@lru_cache(maxsize=1)
def _error_table() -> tuple[Reals, Reals]:
    """Sizes 2π|ξ|ρ (S,) and the largest relative error of each degree on triangles of that size (50, S).

    On a plane wave a rule sees nothing of the triangle but the phases at its three corners. Measured
    from the centroid they sum to zero, and the largest is at most 2π|ξ|ρ: a hexagon, of which
    symmetry leaves one twelfth to sample.
    """
    sizes = np.geomspace(1e-4, 200.0, 160)
    fractions = np.linspace(0.5, 1.0, 5)
    largest = np.repeat(sizes, len(fractions))
    second = -largest * np.tile(fractions, len(sizes))
    phases = np.stack([largest, second, -largest - second])
    e = np.exp(1j * phases)
    exact = 2 * second_difference(
        (e[0], e[1], e[2]), phases[1] - phases[0], phases[2] - phases[0], phases[2] - phases[1]
    )
    errors = np.empty((HIGHEST_DEGREE, len(sizes)))
    for degree in range(1, HIGHEST_DEGREE + 1):
        rule = symmetric_rule(degree)
        found = rule.weights @ np.exp(1j * (rule.barycentric @ phases))
        errors[degree - 1] = np.abs(found - exact).reshape(len(sizes), -1).max(axis=1)
    return sizes, errors
