"""Quadrature rules on triangles, and how far each of them reaches at a given accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import modepy
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.exact.triangles import second_difference

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
        sharing: triangles of a closed mesh that have each node in common: 6 for corners, 2 for edges.
    """

    degree: int
    barycentric: Reals
    weights: Reals
    sharing: int = 1

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.weights)

    @property
    def cost(self) -> float:
        """Points a triangle of a large closed mesh, where shared nodes are merged."""
        return self.size / self.sharing


@cache
def corner_rule() -> TriangleRule:
    """The rule of degree 1 whose nodes are the corners: half a point a triangle."""
    return TriangleRule(1, np.eye(3), np.full(3, 1 / 3), sharing=6)


@cache
def midpoint_rule() -> TriangleRule:
    """The rule of degree 2 whose nodes are the edge midpoints: one and a half points a triangle.

    Source: P. C. Hammer, A. H. Stroud, "Numerical integration over simplexes" (1956).
    """
    return TriangleRule(2, np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]), np.full(3, 1 / 3), sharing=2)


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
    """The rules worth using at a tolerance, by cost, and how large a triangle each may get.

    Args:
        tolerance: largest error on one triangle, relative to its area, at every frequency.

    Returns:
        rules of increasing cost, and for each the largest 2π|ξ|ρ (radians; ρ the distance from a
        triangle's centroid to its farthest corner) up to which it keeps the tolerance for every
        shape of triangle and direction of ξ. Rules that a cheaper one outreaches are left out.
    """
    tolerance = max(tolerance, FINEST_TOLERANCE)
    sizes, errors = _error_table()
    rules: list[TriangleRule] = []
    kept: list[float] = []
    for rule, row in zip(_candidates(), errors, strict=True):
        beyond = np.flatnonzero(row > tolerance)
        reach = sizes[beyond[0] - 1] if beyond.size and beyond[0] > 0 else (0.0 if beyond.size else sizes[-1])
        while rules and rules[-1].cost >= rule.cost and kept[-1] <= reach:
            rules.pop()
            kept.pop()
        if not kept or reach > kept[-1]:
            rules.append(rule)
            kept.append(float(reach))
    return tuple(rules), np.array(kept)


@lru_cache(maxsize=128)
def typical_errors(rule: TriangleRule) -> tuple[Reals, Reals, Reals]:
    """Root mean square of a rule's error on one triangle over all directions of ξ.

    Returns:
        sizes 2π|ξ|ρ (radians), and at each the error relative to the area, split into its even part
        (real, seen from the centroid), which neighbouring triangles add up, and its odd part, which
        changes sign between neighbours that point opposite ways and mostly cancels. Taken over the
        equilateral triangle and the flat one, whichever is worse.
    """
    sizes = np.geomspace(1e-3, 200.0, 64)
    cosines, chances = np.polynomial.legendre.leggauss(4)
    sines = np.sqrt(1 - ((1 + cosines) / 2) ** 2)
    turns = (np.arange(4) + 0.5) * np.pi / 24
    equilateral = np.cos(turns + 2 * np.pi / 3 * np.arange(3)[:, None])
    flat = np.outer([1.0, -0.5, -0.5], np.cos((np.arange(4) + 0.5) * np.pi / 8))
    even, odd = [], []
    for shape in (equilateral, flat):
        phases = (sizes[:, None, None] * sines[:, None]) * shape[:, None, None, :]
        difference = _rule_errors(rule, phases.reshape(3, -1)).reshape(len(sizes), len(sines), -1)
        mean = chances / 2 @ np.mean(difference.real**2, axis=2).T, chances / 2 @ np.mean(difference.imag**2, axis=2).T
        even.append(np.sqrt(mean[0]))
        odd.append(np.sqrt(mean[1]))
    return sizes, np.maximum(*even), np.maximum(*odd)


@cache
def _candidates() -> tuple[TriangleRule, ...]:
    symmetric = [symmetric_rule(degree) for degree in range(1, HIGHEST_DEGREE + 1)]
    return (corner_rule(), symmetric[0], midpoint_rule(), *symmetric[1:])


@lru_cache(maxsize=1)
def _error_table() -> tuple[Reals, Reals]:
    """Sizes 2π|ξ|ρ (S,) and the largest relative error of each candidate on triangles of that size (52, S).

    On a plane wave a rule sees nothing of the triangle but the phases at its three corners. Measured
    from the centroid they sum to zero, and the largest is at most 2π|ξ|ρ: a hexagon, of which
    symmetry leaves one twelfth to sample.
    """
    sizes = np.geomspace(1e-4, 200.0, 160)
    fractions = np.linspace(0.5, 1.0, 5)
    largest = np.repeat(sizes, len(fractions))
    second = -largest * np.tile(fractions, len(sizes))
    phases = np.stack([largest, second, -largest - second])
    errors = [np.abs(_rule_errors(rule, phases)).reshape(len(sizes), -1).max(axis=1) for rule in _candidates()]
    return sizes, np.stack(errors)


def _rule_errors(rule: TriangleRule, phases: Reals) -> NDArray[np.complex128]:
    """Error of a rule on exp(i phase), given at the three corners (3, n), relative to the area (n,)."""
    exact = 2 * second_difference(phases[1] - phases[0], phases[2] - phases[0])
    return np.asarray(rule.weights @ np.exp(1j * (rule.barycentric @ phases)) - exact)
