"""Triangle meshes as weighted points: the rule of each triangle, and its points."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Array, Reals, slices
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.backends import CPU, Backend, combine, sums_at, sums_of_runs
from sobolev_batch.transform.faces import FaceArrays
from sobolev_batch.transform.nufft import WeightedPoints
from sobolev_batch.transform.rule_errors import shares_vertices, tolerance_for
from sobolev_batch.transform.rules import (
    GAUSS_NODES,
    TriangleRule,
    choose_gauss,
    choose_rules,
    fixed_rule,
    gauss_rule,
    rule_ranges,
)

_Corners = tuple[Array, Array, Array]

# Triangles at a time: keeps the temporaries with a mid-sized rule near 50 MB.
_TRIANGLES = 1 << 17
# Area of an equilateral triangle over the squared distance of its corners from the centroid. A triangle is long where
# that is this many times its area, and has rules of its own where it would take more points than some; these have a
# part of the tolerance.
EQUILATERAL, _LONG, _DEAR, _OF_TOLERANCE = 0.75 * math.sqrt(3), 2.0, 12.0, 0.1
# An edge and its triangle are sorted as one integer, which takes twice the bits of a vertex and those of a triangle.
_BITS = 63


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
        return len(self.members) * self.rule.node_count << 2 * self.splits

    @property
    def expected_points(self) -> float:
        """Number of points of a closed mesh, after shared ones are merged."""
        return len(self.members) * (self.rule.node_count << 2 * self.splits if self.splits else self.rule.cost)

    def split(self, most: int) -> Iterator[Self]:
        """Yield parts whose expected points are at most a number, or of one triangle without splits."""
        points_each = self.expected_points / len(self.members)
        if points_each > most and self.splits:
            for quarter in range(4):
                yield from replace(self, splits=self.splits - 1, path=(*self.path, quarter)).split(most)
            return
        count = int(most / points_each)
        step = max(1, count if self.rule.shares else min(_TRIANGLES, count))
        for part in slices(len(self.members), step):
            yield replace(self, members=self.members[part])

    def points(self, mesh: FaceArrays) -> WeightedPoints:
        """Return the points, on the backend of the faces of the whole mesh."""
        faces = mesh.part(self.members.astype(np.int64)) if len(self.members) < len(mesh) else mesh
        if not (self.splits or self.path):
            return _merged_points(faces, self.rule)
        corners, areas = (faces.at(0), faces.at(1), faces.at(2)), faces.areas / 4 ** len(self.path)
        for quarter in self.path:
            corners = quarters(corners)[quarter]
        for _ in range(self.splits):
            a, b, c = (np.concatenate(parts, axis=1) for parts in zip(*quarters(corners), strict=True))
            corners, areas = (a, b, c), np.tile(areas / 4, 4)
        coordinates = np.empty((3, self.rule.node_count * len(areas)), like=areas)
        combine(self.rule.barycentric, np.stack(corners, axis=1), out=coordinates.reshape(3, self.rule.node_count, -1))
        return WeightedPoints(coordinates, _products(self.rule.weights, areas))


def assign_rules(
    mesh: Mesh,
    highest_frequency: float,
    eps: float,
    quadrature: str | int = "auto",
    tolerance: float | None = None,
    faces: FaceArrays | None = None,
    backend: Backend = CPU,
) -> tuple[RuleUse, ...]:
    """Return the rules of all triangles up to a frequency: the prescribed one, or those that keep an error.

    That is eps, of the mesh relative to its area, or a tolerance of each triangle to its own. A GPU and its faces help.
    """
    if (fixed := fixed_rule(quadrature)) is not None:
        return (RuleUse(fixed, 0, np.arange(len(mesh.triangles), dtype=np.uint32)),)
    # What is predicted of a tolerance is measured of rules for all triangles: errors of others are to be no part of it.
    of_long = eps if tolerance is None else _OF_TOLERANCE * tolerance
    if tolerance is None:
        tolerance = tolerance_for(mesh, highest_frequency, eps, faces or FaceArrays.of_mesh(mesh), backend)
    rules, ranges = rule_ranges(tolerance, shares_vertices(mesh))
    sizes, wave_number, costs = mesh.centroid_radii, 2 * np.pi * highest_frequency, [rule.cost for rule in rules]
    # Behind the rules for all triangles come the products for long ones.
    products, count = (3, len(GAUSS_NODES), len(GAUSS_NODES)), len(rules) + 3 * len(GAUSS_NODES) ** 2
    keys = np.empty(len(sizes), dtype=np.uint16)
    # Meshes have tens of millions of triangles: temporaries are small, and four bytes for each are kept.
    for part in slices(len(sizes), _TRIANGLES):
        splits, choice = choose_rules(wave_number * sizes[part], ranges)
        keys[part] = splits * count + choice
        points = np.array(costs)[choice] * 4.0**splits
        long = np.flatnonzero((points > _DEAR) & (EQUILATERAL * sizes[part] ** 2 > _LONG * mesh.areas[part]))
        if not long.size:
            continue
        corners = mesh.vertices[mesh.triangles[part][long]]
        # The side opposite each corner.
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
        along, across = wave_number * sides.max(axis=1), wave_number * sides.min(axis=1)
        fewer, splits, *nodes = choose_gauss(along, across, of_long)
        pays = fewer < points[long]
        numbers = np.ravel_multi_index((sides.argmin(axis=1), *nodes), products) + splits * count + len(rules)
        keys[part.start + long[pays]] = numbers[pays]

    def rule_of(number: int) -> TriangleRule:
        if number < len(rules):
            return rules[number]
        corner, along, across = np.unravel_index(number - len(rules), products)
        return gauss_rule(GAUSS_NODES[along], GAUSS_NODES[across], int(corner))

    return tuple(
        RuleUse(rule_of(key % count), key // count, np.flatnonzero(keys == key).astype(np.uint32))
        for key in np.flatnonzero(np.bincount(keys)).tolist()
    )


def quarters(corners: _Corners) -> tuple[_Corners, _Corners, _Corners, _Corners]:
    """Return the four similar triangles that edge midpoints split each triangle into."""
    a, b, c = corners
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return (a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)


def _merged_points(faces: FaceArrays, rule: TriangleRule) -> WeightedPoints:
    """Return the points of some triangles; a node that neighbours share has the weights of all of them."""
    (on_edges, of_edges), (inside, of_inside) = rule.edge_nodes, rule.inner_nodes
    columns, areas = faces.columns, faces.areas
    ends, count = np.ascontiguousarray(faces.corners, like=areas), columns.shape[1]
    sums = sums_at(ends.ravel(), np.tile(areas, 3), count) if rule.corner_weight else areas[:0]
    corners = np.flatnonzero(sums)
    edges, edge_sums = merged_edges(ends, areas, count) if len(of_edges) else (corners, sums)
    parts = [
        (np.ones((1, 1)), np.array([rule.corner_weight]), corners[None], sums[corners]),
        (on_edges, of_edges, edges, edge_sums),
        (inside, of_inside, ends, areas),
    ]
    weights = [_products(node_weights, part_areas) for _, node_weights, _, part_areas in parts]
    limits = np.cumsum([0, *map(len, weights)]).tolist()
    coordinates = np.empty((3, limits[-1]), like=areas)
    for first, last, (nodes, _, indices, _) in zip(limits, limits[1:], parts, strict=False):
        if last > first:
            # All axes at once on a device, where each call takes time.
            for axes in (slice(axis, axis + 1) for axis in range(3)) if faces.backend is CPU else [slice(3)]:
                block = coordinates[axes, first:last].reshape(-1, len(nodes), len(indices[0]))
                combine(nodes, np.take(columns[axes], indices, axis=1), out=block)
    return WeightedPoints(coordinates, np.concatenate(weights))


def _products(weights: Reals, areas: Array) -> Array:
    """Return the products of all weights (k,) of a rule with the areas (n,), weight by weight (k · n,)."""
    return (np.asarray(weights, like=areas)[:, None] * areas).ravel()


def merged_edges(corners: Array, areas: Array, vertex_count: int) -> tuple[Array, Array]:
    """Return both vertices of the edges (2, n) of triangles with some corners (3, m), and the sums of their areas."""
    nexts = (corners[1], corners[2], corners[0])
    if isinstance(areas, np.ndarray):
        from scipy.sparse import coo_array

        # SciPy sorts by counting; a GPU sorts faster than it counts.
        places = np.minimum(corners, nexts).ravel(), np.maximum(corners, nexts).ravel()
        merged = coo_array((np.tile(areas, 3), places), shape=(vertex_count, vertex_count)).tocsr()
        return np.stack(merged.tocoo().coords).astype(np.int64), merged.data
    triangle_bits = len(areas).bit_length()
    used = None
    if 2 * vertex_count.bit_length() + triangle_bits > _BITS:
        used, corners = np.unique(corners, return_inverse=True)
        vertex_count, corners = len(used), corners.reshape(3, -1)
    bits = vertex_count.bit_length()
    numbers = np.arange(len(areas), like=corners)
    edges = np.empty((3, len(areas)), dtype=np.int64, like=corners)
    for row, first, second in zip(edges, corners, nexts, strict=True):
        np.left_shift(np.minimum(first, second), bits, out=row)
        row |= np.maximum(first, second)
        row <<= triangle_bits
        row |= numbers
    ordered = edges.ravel()
    ordered.sort()
    sums = areas[ordered & ((1 << triangle_bits) - 1)]
    ordered >>= triangle_bits
    is_first = np.empty(len(ordered), dtype=bool, like=ordered)
    is_first[:1] = True
    np.not_equal(ordered[1:], ordered[:-1], out=is_first[1:])
    starts = np.flatnonzero(is_first)
    firsts = ordered[starts]
    ends = np.stack([firsts >> bits, firsts & ((1 << bits) - 1)])
    return ends if used is None else used[ends], sums_of_runs(sums, starts)
