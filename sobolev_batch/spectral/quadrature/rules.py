"""Quadrature rules on triangles, and the range of triangle sizes in which each keeps a tolerance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import modepy
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.exact import second_difference
from sobolev_batch.surfaces.shapes.surface import Reals

HIGHEST_DEGREE = 50
# Below this, rounding hides the error of a rule.
FINEST_TOLERANCE = 1e-15
# Sizes 2π|ξ|ρ of triangles (radians) at which the largest and the typical errors of rules are tabulated.
_SIZES, _SIZES_ON_AVERAGE = np.geomspace(1e-4, 200.0, 160), np.geomspace(1e-3, 200.0, 64)
_MEASURED = Path(__file__).with_name("rule_errors.npz")


@dataclass(frozen=True, eq=False)
class TriangleRule:
    """A quadrature rule on the triangle.

    Attributes:
        degree: Total degree up to which polynomials are integrated exactly.
        barycentric: Barycentric coordinates of the nodes (n, 3); rows sum to 1.
        weights: Positive weights (n,), to be multiplied by the area; they sum to 1.
        sharing: Number of triangles of a closed mesh that share a node: 6 for corners, 2 for edges.
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
        """Points for each triangle of a large closed mesh, once shared nodes are merged."""
        return self.size / self.sharing


@cache
def corner_rule() -> TriangleRule:
    """Return the rule of degree 1 whose nodes are the corners: half a point for each triangle."""
    return TriangleRule(1, np.eye(3), np.full(3, 1 / 3), sharing=6)


@cache
def midpoint_rule() -> TriangleRule:
    """Return the rule of degree 2 whose nodes are the edge midpoints: one and a half points for each triangle.

    Source: P. C. Hammer, A. H. Stroud, "Numerical integration over simplexes" (1956).
    """
    return TriangleRule(2, np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]), np.full(3, 1 / 3), sharing=2)


@cache
def symmetric_rule(degree: int) -> TriangleRule:
    """Return the fully symmetric rule of a degree from 1 to 50, with positive weights and interior nodes.

    Source: H. Xiao, Z. Gimbutas, "A numerical algorithm for the construction of efficient quadrature rules
    in two and higher dimensions" (2010), doi:10.1016/j.camwa.2009.10.027; tables from modepy.
    """
    rule = modepy.XiaoGimbutasSimplexQuadrature(degree, 2)
    second, third = (1 + np.asarray(rule.nodes, dtype=np.float64)) / 2
    weights = np.asarray(rule.weights, dtype=np.float64)
    return TriangleRule(degree, np.stack([1 - second - third, second, third], axis=1), weights / weights.sum())


@cache
def gauss_rule(points: int = 8) -> TriangleRule:
    """Return the product of two Gauss-Legendre rules, collapsed onto the triangle: points² nodes.

    With 8 points it is the rule of K. Koga's paper: 64 nodes for every triangle.
    """
    nodes, weights = np.polynomial.legendre.leggauss(points)
    u, v = np.meshgrid((1 + nodes) / 2, (1 + nodes) / 2, indexing="ij")
    products = np.outer(weights, weights) / 4 * 2 * (1 - u)
    second, third = u.ravel(), ((1 - u) * v).ravel()
    return TriangleRule(2 * points - 2, np.stack([1 - second - third, second, third], axis=1), products.ravel())


@lru_cache(maxsize=64)
def rule_ranges(tolerance: float) -> tuple[tuple[TriangleRule, ...], Reals]:
    """Return the rules of increasing cost that are worth using at a tolerance, and the range of each.

    The tolerance is the largest error on one triangle, relative to its area, at every frequency. The range is the
    largest 2π|ξ|ρ (radians; ρ is the distance from a triangle's centroid to its farthest corner) up to which a rule
    keeps it for every shape of triangle and direction of ξ. Rules with a smaller range than a cheaper one are left out.
    """
    tolerance = max(tolerance, FINEST_TOLERANCE)
    rules: list[TriangleRule] = []
    ranges: list[float] = []
    for rule, row in zip(candidate_rules(), measured_errors()["largest"], strict=True):
        beyond = np.flatnonzero(row > tolerance)
        last = beyond[0] - 1 if beyond.size else len(_SIZES) - 1
        limit = float(_SIZES[last]) if last >= 0 else 0.0
        while rules and rules[-1].cost >= rule.cost and ranges[-1] <= limit:
            rules.pop()
            ranges.pop()
        if not ranges or limit > ranges[-1]:
            rules.append(rule)
            ranges.append(limit)
    return tuple(rules), np.array(ranges)


def typical_errors(rule: TriangleRule) -> tuple[Reals, Reals, Reals]:
    """Return sizes 2π|ξ|ρ (radians), and the rms errors of a candidate on one triangle there over all directions of ξ.

    The even part (real, seen from the centroid) adds up over neighbouring triangles. The odd part changes sign between
    neighbours that point opposite ways, and mostly cancels. Both are relative to the area, and each is the larger one
    of the equilateral and the flat triangle.
    """
    stored, row = measured_errors(), candidate_rules().index(rule)
    return _SIZES_ON_AVERAGE, stored["even"][row], stored["odd"][row]


@cache
def candidate_rules() -> tuple[TriangleRule, ...]:
    """Return the 52 rules from which each tolerance takes its own: corners, midpoints, and the symmetric ones."""
    symmetric = [symmetric_rule(degree) for degree in range(1, HIGHEST_DEGREE + 1)]
    return (corner_rule(), symmetric[0], midpoint_rule(), *symmetric[1:])


@cache
def measured_errors() -> dict[str, Reals]:
    """Return what was measured of each candidate: "largest" (52, 160), "even" and "odd" (52, 64), float64.

    They depend on the rules alone, and measuring takes a second of each process, so the package carries them.
    `python -m sobolev_batch.spectral.quadrature.rules` writes them anew.
    """
    with np.load(_MEASURED, allow_pickle=False) as stored:  # noqa: TID251
        return {name: stored[name] for name in stored.files}


def measure_largest_errors(rule: TriangleRule) -> Reals:
    """Return the largest relative error of a rule on triangles of each size (160,).

    On a plane wave the error of a rule depends only on the phases at the triangle's three corners. Measured from the
    centroid they sum to zero, and the largest is at most 2π|ξ|ρ: a hexagon; symmetry leaves one twelfth of it to
    sample.
    """
    fractions = np.linspace(0.5, 1.0, 5)
    largest = np.repeat(_SIZES, len(fractions))
    second = -largest * np.tile(fractions, len(_SIZES))
    errors = np.abs(_rule_errors(rule, np.stack([largest, second, -largest - second])))
    return np.asarray(errors.reshape(len(_SIZES), -1).max(axis=1))


def measure_typical_errors(rule: TriangleRule) -> tuple[Reals, Reals]:
    """Return the even and the odd part of a rule's error at each size (64,): see `typical_errors`."""
    sizes = _SIZES_ON_AVERAGE
    cosines, weights = np.polynomial.legendre.leggauss(4)
    sines = np.sqrt(1 - ((1 + cosines) / 2) ** 2)
    angles = (np.arange(4) + 0.5) * np.pi / 24
    equilateral = np.cos(angles + 2 * np.pi / 3 * np.arange(3)[:, None])
    flat = np.outer([1.0, -0.5, -0.5], np.cos((np.arange(4) + 0.5) * np.pi / 8))
    even, odd = [], []
    for shape in (equilateral, flat):
        phases = (sizes[:, None, None] * sines[:, None]) * shape[:, None, None, :]
        difference = _rule_errors(rule, phases.reshape(3, -1)).reshape(len(sizes), len(sines), -1)
        even.append(np.sqrt(weights / 2 @ np.mean(difference.real**2, axis=2).T))
        odd.append(np.sqrt(weights / 2 @ np.mean(difference.imag**2, axis=2).T))
    return np.maximum(*even), np.maximum(*odd)


def _rule_errors(rule: TriangleRule, phases: Reals) -> NDArray[np.complex128]:
    """Return the error (n,) of a rule on exp(i phase), relative to the area, from the phases at the corners (3, n)."""
    exact = 2 * second_difference(phases[1] - phases[0], phases[2] - phases[0])
    return np.asarray(rule.weights @ np.exp(1j * (rule.barycentric @ phases)) - exact)


if __name__ == "__main__":
    _largest = [measure_largest_errors(rule) for rule in candidate_rules()]
    _even, _odd = zip(*(measure_typical_errors(rule) for rule in candidate_rules()), strict=True)
    np.savez_compressed(_MEASURED, largest=_largest, even=_even, odd=_odd)
