"""Quadrature rules on the triangle, and their errors on plane waves: which rule does for a triangle of some size."""

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import permutations
from pathlib import Path

import numpy as np

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import InputError

HIGHEST_DEGREE = 50
# Below this, rounding hides the error of a rule.
FINEST_TOLERANCE = 1e-15
# Sizes 2π|ξ|ρ of triangles (radians) at which the largest and the typical errors of rules are tabulated.
SIZES, SIZES_ON_AVERAGE = np.geomspace(1e-4, 200.0, 160), np.geomspace(1e-3, 200.0, 64)
TABULATED = Path(__file__).with_name("rules.npz")
# Gauss nodes along or across a long triangle.
GAUSS_NODES = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 96, 128, 192, 256)
# Two coordinates of a node, and the weight of all nodes that symmetry makes from it, for rules whose nodes neighbouring
# triangles share. They solve the equations for the means of the symmetric polynomials, to all digits.
_SHARING = {
    1: ((1.0, 0.0, 1.0),),
    2: ((0.5, 0.5, 1.0),),
    4: (
        (1.0, 0.0, 0.0616204060378000892),
        (0.5, 0.5, 0.185926496604801428),
        (0.188580484696445039, 0.188580484696445039, 0.752453097357398483),
    ),
    5: ((1.0, 0.0, 1 / 30), (0.5, 0.5, 0.213333333333333333), (1 / 3, 1 / 3, 81 / 320), (1 / 7, 1 / 7, 2401 / 4800)),
    6: (
        (1.0, 0.0, 0.0213910779216134461),
        (0.307745941625991646, 0.0, 0.177416497060831764),
        (0.118613686396592868, 0.118613686396592868, 0.305653959080855442),
        (0.425340125989747152, 0.425340125989747152, 0.495538465936699348),
    ),
}


@dataclass(frozen=True, eq=False)
class TriangleRule:
    """A quadrature rule on the triangle, whose nodes on the boundary are symmetric.

    Attributes:
        degree: Total degree up to which polynomials are integrated exactly.
        barycentric: Barycentric coordinates of the nodes (n, 3); rows sum to 1.
        weights: Positive weights (n,), to be multiplied by the area; they sum to 1.
    """

    degree: int
    barycentric: Reals
    weights: Reals

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return len(self.weights)

    @cached_property
    def corner_weight(self) -> float:
        """Weight of each corner, which six triangles of a closed mesh share; 0 where corners are no nodes."""
        return float(self.weights[self.barycentric[:, 0] == 1].sum())

    @cached_property
    def edge_nodes(self) -> tuple[Reals, Reals]:
        """Coordinates (k, 2) of the nodes on an edge, which two triangles share, by its two ends, and weights (k,)."""
        here = (self.barycentric[:, 2] == 0) & (self.barycentric[:, :2] > 0).all(axis=1)
        return self.barycentric[here, :2], self.weights[here]

    @cached_property
    def inner_nodes(self) -> tuple[Reals, Reals]:
        """Barycentric coordinates (k, 3) of the other nodes, and their weights (k,)."""
        here = (self.barycentric > 0).all(axis=1)
        return self.barycentric[here], self.weights[here]

    @property
    def cost(self) -> float:
        """Points for each triangle of a large closed mesh, once shared nodes are merged."""
        return 0.5 * bool(self.corner_weight) + 1.5 * len(self.edge_nodes[1]) + len(self.inner_nodes[1])

    @property
    def shares(self) -> bool:
        """True if neighbouring triangles share nodes."""
        return self.cost < self.node_count


@cache
def sharing_rule(degree: int) -> TriangleRule:
    """Return the rule of degree 1, 2, 4, 5 or 6 with corners, nodes on edges, or both, which neighbours share.

    A triangle of a large closed mesh takes 0.5, 1.5, 5, 6 and 9.5 points; rules with interior nodes alone take 1, 3, 6,
    7 and 12. Source of the second: P. C. Hammer, A. H. Stroud, "Numerical integration over simplexes" (1956). The last
    three were found by Newton's method.
    """
    nodes, weights = [], []
    for first, second, weight in _SHARING[degree]:
        # The centroid's third coordinate differs from the others by rounding.
        third = first if first == 1 / 3 else 1 - first - second
        orbit = sorted(set(permutations((first, second, third))))
        nodes += orbit
        weights += [weight / len(orbit)] * len(orbit)
    return TriangleRule(degree, np.array(nodes), np.array(weights))


@cache
def symmetric_rule(degree: int) -> TriangleRule:
    """Return the fully symmetric rule of a degree from 1 to 50, with positive weights and interior nodes.

    Source: H. Xiao, Z. Gimbutas, "A numerical algorithm for the construction of efficient quadrature rules
    in two and higher dimensions" (2010), doi:10.1016/j.camwa.2009.10.027.
    """
    found = tabulated()
    end = int(found["sizes"][:degree].sum())
    own = slice(end - int(found["sizes"][degree - 1]), end)
    return TriangleRule(degree, found["nodes"][own], found["weights"][own])


@cache
def gauss_rule(along: int = 8, across: int = 8, corner: int = 1) -> TriangleRule:
    """Return the product of two Gauss-Legendre rules, towards a corner and across: 64 nodes in K. Koga's paper."""
    (nodes, weights), (others, of_others) = map(np.polynomial.legendre.leggauss, (along, across))
    u, v = np.meshgrid((1 + nodes) / 2, (1 + others) / 2, indexing="ij")
    products = np.outer(weights, of_others) / 4 * 2 * (1 - u)
    first, second = u.ravel(), ((1 - u) * v).ravel()
    barycentric = np.roll(np.stack([first, second, 1 - first - second], axis=1), corner, axis=1)
    return TriangleRule(2 * min(along, across) - 2, barycentric, products.ravel())


def fixed_rule(quadrature: str | int) -> TriangleRule | None:
    """Return the rule that a method prescribes for all triangles, or None if the rule depends on their size.

    The method "auto" gives every triangle the cheapest rule that keeps the tolerance at all frequencies of the lattice,
    and splits triangles that are too large for any rule. An integer from 1 to 50 is the degree of one symmetric rule
    with interior nodes for all triangles. "gauss8" is the 64-point product rule of K. Koga's paper. Any other method is
    an InputError. Parametrised surfaces ignore the method.
    """
    if isinstance(quadrature, str) and quadrature in ("auto", "gauss8"):
        return None if quadrature == "auto" else gauss_rule()
    if isinstance(quadrature, int) and not isinstance(quadrature, bool) and 1 <= quadrature <= HIGHEST_DEGREE:
        return symmetric_rule(quadrature)
    raise InputError(f"quadrature must be auto, gauss8 or a degree from 1 to {HIGHEST_DEGREE}, found {quadrature!r}")


@cache
def gauss_errors() -> tuple[Reals, Reals]:
    """Return phases (radians, n), and the errors (2, counts, n) up to them along and across, with `GAUSS_NODES` each.

    The phase along is 2π|ξ| times the longest side, and that across times the shortest one, opposite the corner. The
    error of a product, relative to the area, is at most the sum of two: that of the nodes along on (1 - u) exp(iau),
    and that of those across on exp(ibv), for all smaller phases a and b.
    """
    phases, sums = np.geomspace(0.02, 1000.0, 260), []
    rules = [np.polynomial.legendre.leggauss(count) for count in GAUSS_NODES]
    # The last one on both halves is exact.
    most, of_most = rules[-1]
    for nodes, weights in (*rules, (np.concatenate([most - 1, most + 1]) / 2, np.tile(of_most / 2, 2))):
        waves = np.exp(0.5j * np.outer(phases, nodes))
        sums.append([waves @ (weights / 2 * (1 - nodes) ** power) for power in (1, 0)])
    errors = np.abs(np.array(sums[:-1]) - np.array(sums[-1]))
    return phases, np.maximum.accumulate(np.moveaxis(errors, 1, 0), axis=2)


@lru_cache(maxsize=64)
def rule_ranges(tolerance: float, shared: bool = True) -> tuple[tuple[TriangleRule, ...], Reals]:
    """Return the rules of increasing cost that are worth using at a tolerance, and the range of each.

    The tolerance is the largest error on one triangle, relative to its area. The range is the largest 2π|ξ|ρ (radians;
    ρ is the distance from a triangle's centroid to its farthest corner) up to which a rule keeps it for every shape and
    direction. Rules that reach no farther than a cheaper one are left out, as are shared nodes where there are none.
    """
    tolerance = max(tolerance, FINEST_TOLERANCE)
    rules: list[TriangleRule] = []
    ranges: list[float] = []
    for rule, row in zip(candidate_rules(), tabulated()["largest"], strict=True):
        if rule.shares and not shared:
            continue
        beyond = np.flatnonzero(row > tolerance)
        last = beyond[0] - 1 if beyond.size else len(SIZES) - 1
        limit = float(SIZES[last]) if last >= 0 else 0.0
        while rules and rules[-1].cost >= rule.cost and ranges[-1] <= limit:
            rules.pop()
            ranges.pop()
        if not ranges or limit > ranges[-1]:
            rules.append(rule)
            ranges.append(limit)
    return tuple(rules), np.array(ranges)


def typical_errors(rule: TriangleRule, sizes: Reals) -> tuple[Reals, Reals]:
    """Return the rms errors of a candidate on one triangle of each size 2π|ξ|ρ (radians) over all directions of ξ.

    The even part (real, seen from the centroid) adds up over neighbouring triangles. The odd part changes sign between
    neighbours that point opposite ways, and mostly cancels. Both are relative to the area, and each is the larger one
    of the equilateral and the flat triangle.
    """
    stored, row = tabulated(), candidate_rules().index(rule)
    logs, grid = np.log(np.maximum(sizes, SIZES_ON_AVERAGE[0])), np.log(SIZES_ON_AVERAGE)
    even, odd = (np.exp(np.interp(logs, grid, np.log(stored[part][row] + 1e-17))) for part in ("even", "odd"))
    return even, odd


@cache
def candidate_rules() -> tuple[TriangleRule, ...]:
    """Return the 55 rules from which each tolerance takes its own, by increasing cost."""
    sharing = [sharing_rule(degree) for degree in _SHARING]
    symmetric = [symmetric_rule(degree) for degree in range(1, HIGHEST_DEGREE + 1)]
    return tuple(sorted((*sharing, *symmetric), key=lambda rule: rule.cost))


@cache
def tabulated() -> dict[str, Reals]:
    """Return the symmetric rules and what was measured of each candidate, float64.

    The "nodes" (n, 3) and "weights" (n,) of all degrees follow each other; "sizes" (50,) has the number of each. The
    errors "largest" (55, 160), "even" and "odd" (55, 64) take `python -m benchmarks.rule_errors` a second to measure.
    """
    with np.load(TABULATED, allow_pickle=False) as stored:  # noqa: TID251
        return {name: stored[name] for name in stored.files}


def choose_gauss(along: Reals, across: Reals, tolerance: float) -> tuple[Reals, Indices, Indices, Indices]:
    """Return the points of the cheapest product rules for phases along and across triangles (n,), see `gauss_errors`.

    With them come how often edges are halved, and the places of both numbers in `GAUSS_NODES`.
    """
    phases, errors = gauss_errors()
    # Each may have half of the tolerance. More nodes do at least as well, whatever rounding hides.
    within = (errors <= max(tolerance, FINEST_TOLERANCE) / 2).sum(axis=2)
    limits, nodes = np.maximum.accumulate(np.append(0.0, phases)[within], axis=1), np.array(GAUSS_NODES)
    splits = np.maximum(np.ceil(np.log2(along / max(limits[:, -1].min(), phases[0]))), 0).astype(np.int64)
    first, second = (
        np.minimum(np.searchsorted(ranges, np.ldexp(own, -splits)), len(nodes) - 1)
        for ranges, own in zip(limits, (along, across), strict=True)
    )
    return nodes[first] * nodes[second] * 4.0**splits, splits, first, second


def choose_rules(sizes: Reals, ranges: Reals) -> tuple[Indices, Indices]:
    """Return how often to halve edges, and the index of the rule then, by sizes 2π|ξ|ρ (n,); see `rule_ranges`."""
    splits = np.zeros(sizes.shape, dtype=np.int64)
    large = sizes > ranges[-1]
    if large.any():
        splits[large] = np.ceil(np.log2(sizes[large] / ranges[-1]))
        sizes = np.ldexp(sizes, -splits)
    # Rounding of the logarithm may leave a size just beyond the last range.
    return splits, np.minimum(np.searchsorted(ranges, sizes), len(ranges) - 1)
