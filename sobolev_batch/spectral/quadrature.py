"""Triangle meshes as weighted points: rules and that of each triangle, its points, and the error to be expected."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.backends import Array, Backend, combine, sums_at, sums_of_runs
from sobolev_batch.spectral.exact import second_difference
from sobolev_batch.spectral.lattice import FrequencyLattice
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Indices, Reals

HIGHEST_DEGREE = 50
# Below this, rounding hides the error of a rule.
FINEST_TOLERANCE = 1e-15
# Sizes 2π|ξ|ρ of triangles (radians) at which the largest and the typical errors of rules are tabulated.
_SIZES, _SIZES_ON_AVERAGE = np.geomspace(1e-4, 200.0, 160), np.geomspace(1e-3, 200.0, 64)
_TABULATED = Path(__file__).with_name("rules.npz")


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
    in two and higher dimensions" (2010), doi:10.1016/j.camwa.2009.10.027.
    """
    found = tabulated()
    end = int(found["sizes"][:degree].sum())
    own = slice(end - int(found["sizes"][degree - 1]), end)
    return TriangleRule(degree, found["nodes"][own], found["weights"][own])


@cache
def gauss_rule(points: int = 8) -> TriangleRule:
    """Return the product of two Gauss-Legendre rules on the triangle: points² nodes, 64 in K. Koga's paper."""
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
    for rule, row in zip(candidate_rules(), tabulated()["largest"], strict=True):
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
    stored, row = tabulated(), candidate_rules().index(rule)
    return _SIZES_ON_AVERAGE, stored["even"][row], stored["odd"][row]


@cache
def candidate_rules() -> tuple[TriangleRule, ...]:
    """Return the 52 rules from which each tolerance takes its own: corners, midpoints, and the symmetric ones."""
    symmetric = [symmetric_rule(degree) for degree in range(1, HIGHEST_DEGREE + 1)]
    return (corner_rule(), symmetric[0], midpoint_rule(), *symmetric[1:])


@cache
def tabulated() -> dict[str, Reals]:
    """Return the symmetric rules and what was measured of each candidate, float64.

    The "nodes" (n, 3) and "weights" (n,) of all degrees follow each other; "sizes" (50,) has the number of each. The
    errors "largest" (52, 160), "even" and "odd" (52, 64) depend on the rules alone, and measuring takes a second of
    each process, so the package carries them. `python -m sobolev_batch.spectral.quadrature` measures them anew.
    """
    with np.load(_TABULATED, allow_pickle=False) as stored:  # noqa: TID251
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


_Corners = tuple[Array, Array, Array]
# Vertices (n, 3), triangles (m, 3) and areas (m,) of a mesh, as arrays of a backend.
FaceArrays = tuple[Array, Array, Array]

# Triangles at a time: keeps the temporaries with a mid-sized rule near 50 MB.
_TRIANGLES = 1 << 17
# An edge and its triangle are sorted as one integer, which takes twice the bits of a vertex and those of a triangle.
_BITS = 63


@dataclass(frozen=True)
class WeightedPoints:
    """A sum of Dirac masses in arrays of one backend.

    Coordinates are float64 (3, n), one contiguous row per axis, in units of length; weights (n,) in squared units.
    """

    coordinates: Array
    weights: Array

    @staticmethod
    def concatenated(batches: Sequence[WeightedPoints]) -> WeightedPoints:
        """Return the points of several batches as one."""
        if len(batches) == 1:
            return batches[0]
        return WeightedPoints(
            np.concatenate([points.coordinates for points in batches], axis=1),
            np.concatenate([points.weights for points in batches]),
        )


def fixed_rule(quadrature: str | int) -> TriangleRule | None:
    """Return the rule that a method prescribes for all triangles, or None if the rule depends on their size.

    The method "auto" gives every triangle the cheapest rule that keeps the tolerance at all frequencies of the lattice,
    and splits triangles that are too large for any rule. An integer from 1 to 50 is the degree of one symmetric rule
    with interior nodes for all triangles. "gauss8" is the 64-point product rule of K. Koga's paper. Any other method is
    an InputError. Parametrised surfaces ignore the method.
    """
    if quadrature == "auto":
        return None
    if quadrature == "gauss8":
        return gauss_rule(8)
    if isinstance(quadrature, int) and not isinstance(quadrature, bool) and 1 <= quadrature <= HIGHEST_DEGREE:
        return symmetric_rule(quadrature)
    raise InputError(
        f"quadrature must be 'auto', 'gauss8' or a degree from 1 to {HIGHEST_DEGREE}, found {quadrature!r}"
    )


@dataclass(frozen=True, eq=False)
class RuleUse:
    """Triangles of a mesh that share a rule, each to be split into 4^splits similar ones.

    Attributes:
        members: uint32 (k,), the triangles.
        path: Quarter of the quarter ... of each triangle that is meant; empty for the whole triangle.
    """

    rule: TriangleRule
    splits: int
    members: NDArray[np.uint32]
    path: tuple[int, ...] = ()

    @property
    def largest_points(self) -> int:
        """Number of points, before shared ones are merged."""
        return len(self.members) * self.rule.size << 2 * self.splits

    @property
    def expected_points(self) -> float:
        """Number of points of a closed mesh, after shared ones are merged."""
        return self.largest_points / (1 if self.splits else self.rule.sharing)

    def split(self, largest: int) -> Iterator[RuleUse]:
        """Yield parts of at most ``largest`` points, or of one triangle without splits."""
        points_each = self.rule.size << 2 * self.splits
        if points_each > largest and self.splits:
            for quarter in range(4):
                yield from RuleUse(self.rule, self.splits - 1, self.members, (*self.path, quarter)).split(largest)
            return
        count = largest // points_each
        step = max(1, count if self.rule.sharing > 1 else min(_TRIANGLES, count))
        for first in range(0, len(self.members), step):
            yield RuleUse(self.rule, self.splits, self.members[first : first + step], self.path)

    def points(self, mesh: FaceArrays, backend: Backend) -> WeightedPoints:
        """Return the points, on the backend of the mesh's arrays."""
        vertices, all_triangles, all_areas = mesh
        members = backend.upload(self.members.astype(np.int64))
        if not (self.splits or self.path):
            if self.rule is corner_rule():
                return WeightedPoints(*merged_corners(mesh, members))
            if self.rule is midpoint_rule():
                return WeightedPoints(*merged_midpoints(mesh, members))
        triangles = all_triangles[members]
        a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
        areas = all_areas[members] / 4 ** len(self.path)
        for quarter in self.path:
            a, b, c = _quarters((a, b, c))[quarter]
        for _ in range(self.splits):
            a, b, c = (np.concatenate(quarters) for quarters in zip(*_quarters((a, b, c)), strict=True))
            areas = np.tile(areas / 4, 4)
        rule = self.rule
        coordinates = np.empty((3, rule.size, len(areas)), like=areas)
        for axis in range(3):
            combine(rule.barycentric, np.stack([a[:, axis], b[:, axis], c[:, axis]]), out=coordinates[axis])
        weights = np.asarray(rule.weights, like=areas)[:, None] * areas
        return WeightedPoints(coordinates.reshape(3, -1), weights.ravel())


def assign_rules(
    mesh: Mesh, highest_frequency: float, eps: float, quadrature: str | int = "auto", tolerance: float | None = None
) -> tuple[RuleUse, ...]:
    """Return the rules of all triangles up to a frequency: the prescribed one, or those that keep an error.

    That is eps, of the whole mesh relative to its area, or a tolerance of each triangle relative to its own.
    """
    fixed = fixed_rule(quadrature)
    if fixed is not None:
        return (RuleUse(fixed, 0, np.arange(len(mesh.triangles), dtype=np.uint32)),)
    rules, ranges = rule_ranges(_tolerance_for(mesh, highest_frequency, eps) if tolerance is None else tolerance)
    sizes = mesh.centroid_radii
    # Meshes have tens of millions of triangles: temporaries are small, and four bytes for each are kept.
    keys = np.empty(len(sizes), dtype=np.uint16)
    for first in range(0, len(sizes), _TRIANGLES):
        batch = slice(first, first + _TRIANGLES)
        splits, choice = choose_rules(2 * np.pi * highest_frequency * sizes[batch], ranges)
        keys[batch] = splits * len(rules) + choice
    return tuple(
        RuleUse(rules[key % len(rules)], key // len(rules), np.flatnonzero(keys == key).astype(np.uint32))
        for key in np.flatnonzero(np.bincount(keys)).tolist()
    )


def choose_rules(sizes: Reals, ranges: Reals) -> tuple[Indices, Indices]:
    """Return how often to halve edges, and the index of the rule then, by sizes 2π|ξ|ρ (n,); see `rule_ranges`."""
    splits = np.zeros(sizes.shape, dtype=np.int64)
    large = sizes > ranges[-1]
    if large.any():
        splits[large] = np.ceil(np.log2(sizes[large] / ranges[-1]))
        sizes = np.ldexp(sizes, -splits)
    # Rounding of the logarithm may leave a size just beyond the last range.
    return splits, np.minimum(np.searchsorted(ranges, sizes), len(ranges) - 1)


def _quarters(corners: _Corners) -> tuple[_Corners, _Corners, _Corners, _Corners]:
    """Return the four similar triangles that edge midpoints split each triangle into."""
    a, b, c = corners
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)


def merged_corners(mesh: FaceArrays, members: Array) -> tuple[Array, Array]:
    """Return the corners of some triangles (3, n), each with a third of the areas that meet there (n,)."""
    vertices, triangles, areas = mesh
    thirds = np.repeat(areas[members] / 3, 3)
    weights = sums_at(triangles[members].ravel(), thirds, len(vertices))
    corners = np.flatnonzero(weights)
    return np.ascontiguousarray(vertices[corners].T, like=weights), weights[corners]


def merged_midpoints(mesh: FaceArrays, members: Array) -> tuple[Array, Array]:
    """Return the edge midpoints of some triangles (3, n), each with a third of the areas that meet there (n,)."""
    vertices, triangles, areas = mesh
    triangles = triangles[members]
    triangle_bits = len(triangles).bit_length()
    if 2 * len(vertices).bit_length() + triangle_bits > _BITS:
        used, triangles = np.unique(triangles, return_inverse=True)
        vertices, triangles = vertices[used], triangles.reshape(-1, 3)
    bits = len(vertices).bit_length()
    numbers = np.arange(len(triangles), like=triangles)
    edges = np.empty((3, len(triangles)), dtype=np.int64, like=triangles)
    for row, (i, j) in zip(edges, ((0, 1), (1, 2), (2, 0)), strict=True):
        first, second = triangles[:, i], triangles[:, j]
        np.left_shift(np.minimum(first, second), bits, out=row)
        row |= np.maximum(first, second)
        row <<= triangle_bits
        row |= numbers
    ordered = edges.ravel()
    ordered.sort()
    thirds = (areas[members] / 3)[ordered & ((1 << triangle_bits) - 1)]
    ordered >>= triangle_bits
    is_first = np.empty(len(ordered), dtype=bool, like=ordered)
    is_first[:1] = True
    np.not_equal(ordered[1:], ordered[:-1], out=is_first[1:])
    starts = np.flatnonzero(is_first)
    weights = sums_of_runs(thirds, starts)
    ends = ordered[starts]
    coordinates = np.empty((3, len(starts)), like=thirds)
    low, high = ends >> bits, ends & ((1 << bits) - 1)
    for axis in range(3):
        column = np.ascontiguousarray(vertices[:, axis], like=vertices)
        np.multiply(column[low] + column[high], 0.5, out=coordinates[axis])
    return coordinates, weights


# Fraction of the odd errors that was seen to remain between neighbouring triangles.
_ODD_REMAINDER = 0.2
_BINS = 48
_RADII = 32
_LOOSEST_TOLERANCE = 0.1
_STEPS_PER_DECADE = 4
# The typical error of a frequency for a largest one, and the phases (radians) at which triangles may repeat.
_TYPICAL_OF_LARGEST, _RESONANCE = 0.3, 2.0
# Products of three coordinates, and in how many orders each comes.
_CUBES = Counter(tuple(sorted(axes)) for axes in product(range(3), repeat=3))


def loosest_tolerance(mesh: Mesh, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
    """Return the largest tolerance of triangle rules whose error is predicted to have at most some norms (orders,).

    On fine meshes the prediction was measured to be one to ten times the true error, on coarse ones down to a fifth.
    """
    classes = size_classes(mesh)
    return _loosest(
        FINEST_TOLERANCE,
        lambda tolerance: bool(np.all(quadrature_error(classes, lattice, orders, tolerance) <= norms)),
    )


def _tolerance_for(mesh: Mesh, highest_frequency: float, eps: float) -> float:
    """Return the largest tolerance of triangle rules with a predicted error of eps · area at most up to a frequency.

    It is eps at least. The errors of triangles that are small beside the wavelength cancel: of icospheres, scans,
    plates and random triangles the largest one was measured to be at most 1.1 eps, of a hundred equal ones 1.9, and of
    small pieces of a plate in rows, whose distance is a wavelength, 3.7.
    """
    classes = size_classes(mesh)
    radii, unpaired = highest_frequency * (np.arange(_RADII) + 1) / _RADII, _unpaired(mesh)
    allowed = _TYPICAL_OF_LARGEST * eps * float(classes[2].sum())

    def suffices(tolerance: float) -> bool:
        energies = _error_energies(classes, highest_frequency, radii, tolerance, _RESONANCE, unpaired)
        return bool(np.sqrt(energies.max()) <= allowed)

    return _loosest(eps, suffices)


def _loosest(finest: float, suffices: Callable[[float], bool]) -> float:
    """Return the largest tolerance that suffices, in steps from the finest one, which is taken where none does."""
    decades = max(0.0, math.log10(_LOOSEST_TOLERANCE / finest))
    tolerances = (finest * 10 ** np.linspace(decades, 0, round(decades * _STEPS_PER_DECADE) + 1)).tolist()
    return float(tolerances[bisect_left(tolerances[:-1], True, key=suffices)])


def size_classes(mesh: Mesh) -> Reals:
    """Return the triangles of a mesh in classes of similar size, (4, classes).

    The rows are the least and the greatest centroid radius of each class, in units of length, and the sums of the
    areas and of the squared areas in it.
    """
    radii, areas = mesh.centroid_radii, mesh.areas
    largest = float(radii.max())
    smallest = max(float(radii.min()), 1e-6 * largest)
    count = max(1, min(_BINS, math.ceil(8 * math.log(largest / smallest))))
    edges = np.geomspace(smallest, largest, count + 1)
    classes = np.clip(np.searchsorted(edges, radii) - 1, 0, count - 1)
    return np.stack(
        [edges[:-1], edges[1:], *(np.bincount(classes, values, count) for values in (areas, areas * areas))]
    )


def quadrature_error(classes: Reals, lattice: FrequencyLattice, orders: Sequence[float], tolerance: float) -> Reals:
    """Predict the norm of the quadrature's part of a field's error (orders,), from the `size_classes` of a mesh."""
    radii = _radii(lattice)
    energies = _error_energies(classes, lattice.highest_frequency, radii, tolerance)
    return np.asarray(np.sqrt(_radial_integrals(energies, radii, orders)))


def _error_energies(
    classes: Reals,
    highest_frequency: float,
    radii: Reals,
    tolerance: float,
    resonance: float = math.inf,
    unpaired: float = 0.0,
) -> Reals:
    """Predict the squared error of a mesh's points at frequencies |ξ| (n,), from its `size_classes`.

    The even parts of the triangles' errors add up like the surface's transform itself, whose energy on |ξ| = r is
    area² near zero and area / (2π r²) on average far out. The odd parts add up like random numbers, but for a fraction
    of triangles that are unpaired. Triangles that are larger than a phase may repeat with the wavelength: there both
    parts add up.
    """
    smallest, largest, areas, squares = classes
    rules, ranges = rule_ranges(tolerance)
    # The rule for the smallest of a class, applied to the largest of it: never less than the truth.
    splits, choice = choose_rules(2 * np.pi * highest_frequency * smallest, ranges)
    phases = 2 * np.pi * radii[:, None] * (largest / 2.0**splits)
    even, odd = np.empty_like(phases), np.empty_like(phases)
    for rule in np.unique(choice):
        members = choice == rule
        even[:, members], odd[:, members] = _interpolated_errors(rules[rule], phases[:, members])
    coherence = np.minimum(1.0, 1 / (2 * np.pi * radii**2 * areas.sum()))
    repeats = phases > resonance
    energies = (np.where(repeats, 0, even) @ areas) ** 2 * coherence + (np.where(repeats, even + odd, 0) @ areas) ** 2
    energies += (unpaired * odd @ areas) ** 2
    energies += (even**2 + (_ODD_REMAINDER * odd) ** 2) @ (squares / 4.0**splits)
    return np.asarray(energies)


def _unpaired(mesh: Mesh) -> float:
    """Return the fraction of odd errors that adds up: 0 where each triangle has an opposite one, 1 where all are alike.

    The leading odd error is that of third moments about the centroid.
    """
    totals, amount = np.zeros(len(_CUBES)), 0.0
    for first in range(0, len(mesh.triangles), _TRIANGLES):
        corners = mesh.vertices[mesh.triangles[first : first + _TRIANGLES]]
        x = np.ascontiguousarray(np.moveaxis(corners - corners.mean(axis=1, keepdims=True), 0, 2))
        areas = mesh.areas[first : first + _TRIANGLES]
        squares = np.zeros(len(areas))
        for number, ((i, j, k), orders) in enumerate(_CUBES.items()):
            moments = np.einsum("cn,cn,cn->n", x[:, i], x[:, j], x[:, k])
            totals[number] += math.sqrt(orders) * np.sum(areas * moments)
            squares += orders * moments * moments
        amount += float(np.sum(areas * np.sqrt(squares)))
    return float(np.linalg.norm(totals)) / amount if amount else 0.0


def _interpolated_errors(rule: TriangleRule, phases: Reals) -> tuple[Reals, Reals]:
    """Return the typical even and odd errors of a rule at some phases."""
    sizes, even, odd = typical_errors(rule)
    logs, grid = np.log(np.maximum(phases, sizes[0])), np.log(sizes)
    first, second = (np.exp(np.interp(logs, grid, np.log(errors + 1e-17))) for errors in (even, odd))
    return first, second


def _radii(lattice: FrequencyLattice) -> Reals:
    low, high = lattice.radial_range
    radii: Reals = low + (np.arange(_RADII) + 0.5) / _RADII * (high - low)
    return radii


def weight_masses(lattice: FrequencyLattice, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+|ξ|²)^s over the range of a lattice (orders,)."""
    return _radial_integrals(np.ones(_RADII), _radii(lattice), orders)


def _radial_integrals(energy: Reals, radii: Reals, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+r²)^s energy(r) 4πr² dr by the midpoint rule (orders,)."""
    step = radii[1] - radii[0]
    return np.array([np.sum((1 + radii**2) ** order * energy * 4 * np.pi * radii**2) * step for order in orders])


if __name__ == "__main__":
    _largest = [measure_largest_errors(rule) for rule in candidate_rules()]
    _even, _odd = zip(*(measure_typical_errors(rule) for rule in candidate_rules()), strict=True)
    _rules = {name: tabulated()[name] for name in ("sizes", "nodes", "weights")}
    np.savez_compressed(_TABULATED, allow_pickle=False, largest=_largest, even=_even, odd=_odd, **_rules)
