"""What lies beyond a frequency, from pairs of close points: the part of a squared norm that no sample shows.

Beyond a cutoff X the squared norm of a signed area measure m is

    ∫ (1 - step(|ξ|)) (1 + |ξ|²)^s |m^(ξ)|² dξ = ∬ K(|x - y|) dm(x) dm(y),

where step is `smooth_step` and K falls off within a few wavelengths 1/X. So only close points matter; periods, layers
and parts that coincide count for what they are. The points x are random; the integral over y is computed triangle by
triangle. With M(d) = ∫_d^∞ K(r) r dr = 1/π ∫ (1 - step(r)) (1 + r²)^s cos(2πrd) dr, the divergence theorem in the plane
of a triangle turns it into a sum over the three edges,

    ∫ K(|x - y|) dy = Σ ∫ [M(h) - M(√(h² + q²/cos²θ))] dθ,

for x at the height h above the plane, its foot at the distance q from the line of an edge, and θ the angle about the
foot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import beta, betainc, stdtrit

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.kinds import resolution_of
from sobolev_batch.spectral.lattice import smooth_step
from sobolev_batch.spectral.rules import symmetric_rule
from sobolev_batch.surfaces.shapes.closed_forms import Sphere
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Interval, Smooth
from sobolev_batch.surfaces.shapes.surface import Indices, Reals, Surface

# Random points of the first estimate; pairs of a point and a triangle that it may take, and the fewest points.
USUAL_POINTS, _FEWEST_POINTS, _USUAL_PAIRS = 256, 40, 150_000
# Predicted processor time of a pair, and of each of its orders, in seconds.
_PAIR_SECONDS, _ORDER_SECONDS = 3e-7, 2e-7
# Distances in wavelengths 1/X between which kernels are tabulated. The smaller one is rounding. Beyond the larger one,
# which depends on the order, they are below 1 % of what they are at zero. What lies beyond a cutoff at lower orders
# than this is bounded by that at this one.
_LEAST, LOWEST_ORDER = 1e-12, -4.0
_REACHES = (-4.0, -3.0, -2.0, -1.0), (12.0, 10.0, 8.0, 6.0)
# Entries of a table, how many times as many are interpolated, and the distance in wavelengths where they begin to be in
# equal steps.
_ENTRIES, _DENSER, _LINEAR_FROM = 1500, 8, 0.3
# Cycles after which a cosine and a sinc count as averaged out, and nodes for each octave of frequencies.
_CYCLES, _SINC_CYCLES, _NODES = 32.0, 8.0, leggauss(48)
# Degrees of the rules for triangles that are smaller than these fractions of their distance, and of 1/X.
_RULES = (12, 0.6, 1.1), (4, 0.5, 0.5), (2, 0.2, 0.1)
# Nodes along an edge: near the foot of the point, and farther out.
_NEAR, _OUTWARDS = leggauss(4), leggauss(10)
# Pairs that are computed at a time, and triangles whose corners are held.
_BATCH, _HELD = 20_000, 1 << 18
# Cells along each parameter that a smooth surface is replaced by: the most, and how many for a node of its transform.
_MOST_CELLS, _CELLS_PER_NODE, _TRIANGULATION_TOLERANCE = 320, 4, 1e-4
# Orders between which the mean energy beyond a frequency is interpolated.
_USUAL_ORDERS = (-0.55, -0.7, -1.0, -1.5, -2.0, -2.5, -3.0)
_CONFIDENCE = 0.99


@dataclass(frozen=True)
class Remainder:
    """The part of a squared norm beyond a cutoff, as mean energies: the energy is ∫_{|ξ|=r} |m^(ξ)|² dS.

    Attributes:
        cutoff: |ξ| at which the `smooth_step` ends beyond which the part lies, in cycles per unit length.
        orders: Orders s in descending order.
        energies: Mean of the energy beyond the cutoff, weighted by (1 - step(r)) (1 + r²)^s, for each order.
        errors: How far off these may be at 99 %.
        pairs: Number of pairs of a point and a triangle.
    """

    cutoff: float
    orders: tuple[float, ...]
    energies: tuple[float, ...]
    errors: tuple[float, ...]
    points: int = 0
    pairs: int = 0

    @classmethod
    def between(cls, lowest: float, highest: float, cutoff: float) -> Self:
        """Return a part whose mean energy lies between bounds."""
        return cls(cutoff, (-1.0,), ((lowest + highest) / 2,), (abs(highest - lowest) / 2,))

    def at(self, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the part of the squared norm (orders,), and how far off it may be; energies are interpolated."""
        values, errors = np.zeros(len(orders)), np.zeros(len(orders))
        for number, order in enumerate(orders):
            # Every weight of a lower order is at most this factor times that of the lowest one.
            known = max(order, LOWEST_ORDER)
            factor = (1 + (self.cutoff / 2) ** 2) ** (order - known) * tail_integral(self.cutoff, known)
            values[number] = factor * np.interp(-known, -np.array(self.orders), self.energies)
            errors[number] = factor * np.interp(-known, -np.array(self.orders), self.errors)
            if order < known:
                errors[number] += values[number] / 2
                values[number] /= 2
        return values, errors

    def seconds(self, points: int) -> float:
        """Predict the processor time of an estimate from another number of points."""
        pairs = self.pairs * points / max(self.points, 1)
        return pairs * (_PAIR_SECONDS + _ORDER_SECONDS * len(self.orders))


def remainder(
    surfaces: Sequence[Surface],
    signs: Sequence[int],
    cutoff: float,
    orders: Sequence[float] = (),
    points: int | None = None,
    seed: int = 0,
) -> Remainder:
    """Estimate what lies beyond a cutoff in the norm of a signed sum of surfaces, in units of length.

    The cutoff is the |ξ| at which the `smooth_step` ends, in cycles per unit length. By default there are enough orders
    to interpolate between, and as many random points as take about a second, at most 256.
    """
    known = tuple(sorted({max(order, LOWEST_ORDER) for order in orders or _USUAL_ORDERS}, reverse=True))
    reach = float(np.interp(known[-1], *_REACHES)) / cutoff
    kernels, rng = [_kernel(cutoff, order, reach) for order in known], np.random.default_rng(seed)
    meshes, spheres = _as_meshes(surfaces, signs, cutoff)
    count = points or _affordable_points(meshes, reach, rng)
    places, own = _random_points(meshes, spheres, count, rng)
    potentials, pairs = np.zeros((count, len(known))), 0
    for corners, sign in _chunks(meshes):
        for rows, columns in _close_pairs(places, corners, reach):
            pairs += len(rows)
            for start in range(0, len(rows), _BATCH):
                part = slice(start, start + _BATCH)
                np.add.at(
                    potentials, rows[part], sign * _potentials(places[rows[part]], corners[columns[part]], kernels)
                )
    for sphere, sign in spheres:
        potentials += sign * _of_sphere(places, sphere, kernels)
    area = sum(mesh.area for mesh, _ in meshes) + sum(sphere.area for sphere, _ in spheres)
    terms = area * own[:, None] * potentials
    means = terms.mean(axis=0)
    # A single point may stand for others like it that were not met.
    variances = terms.var(axis=0, ddof=1) / count + (np.abs(terms - means).max(axis=0) / count) ** 2
    errors = np.sqrt(variances) * stdtrit(count - 1, (1 + _CONFIDENCE) / 2)
    scales = np.array([tail_integral(cutoff, order) for order in known])
    return Remainder(cutoff, known, tuple((means / scales).tolist()), tuple((errors / scales).tolist()), count, pairs)


@lru_cache(maxsize=4096)
def tail_integral(cutoff: float, order: float) -> float:
    """Return ∫ (1 - step(r)) (1+r²)^s dr over all r, for the smooth step that ends at a cutoff."""
    radii = cutoff * (0.75 + 0.25 * _NODES[0])
    on_step = float(0.25 * cutoff * _NODES[1] @ ((1 - smooth_step(radii, cutoff)) * (1 + radii**2) ** order))
    return on_step + _power_integral(cutoff, order)


def mean_sinc(cutoff: float, order: float, length: float) -> float:
    """Return the mean of sinc(2 r length) beyond a cutoff, weighted by (1 - step(r)) (1+r²)^s: 1 for a short length."""
    integral, low = 0.0, cutoff / 2
    # Farther out it averages to nothing.
    while low * length < _SINC_CYCLES:
        radii, weights = low * (1.5 + 0.5 * _NODES[0]), 0.5 * low * _NODES[1]
        terms = weights * (1 - smooth_step(radii, cutoff)) * (1 + radii**2) ** order
        integral += float(terms @ np.sinc(2 * radii * length))
        low *= 2
    return integral / tail_integral(cutoff, order)


def _power_integral(lowest: float, order: float) -> float:
    """Return ∫ (1+r²)^s dr from a radius on."""
    # With p = 1/(1+r²) it is half an incomplete beta integral.
    exponent = -order - 0.5
    return 0.5 * float(beta(exponent, 0.5) * betainc(exponent, 0.5, 1 / (1 + lowest**2)))


@dataclass(frozen=True, eq=False)
class _Kernel:
    """The kernel K of an order beyond a cutoff, up to a reach, in tables over equal steps of `_scale` from a start on.

    The total is M(0); drops are M(0) - M(d) and values K(d), (n,) each.
    """

    cutoff: float
    reach: float
    start: float
    step: float
    total: float
    drops: Reals
    values: Reals


def _scale(distances: Reals, cutoff: float) -> Reals:
    """Return where distances lie in the tables: in equal steps of log d at first, of d where kernels oscillate."""
    return np.asarray(np.log(distances) + cutoff / _LINEAR_FROM * distances)


@lru_cache(maxsize=1024)
def _kernel(cutoff: float, order: float, reach: float) -> _Kernel:
    start, end = _scale(np.array([_LEAST / cutoff, reach]), cutoff).tolist()
    scale, many = np.linspace(start, end, _ENTRIES), np.geomspace(_LEAST / cutoff, reach, 20 * _ENTRIES)
    distances, total = np.interp(scale, _scale(many, cutoff), many), tail_integral(cutoff, order)
    drops, low = np.zeros(_ENTRIES), cutoff / 2
    while np.any(near := _CYCLES / distances > low):
        radii, weights = low * (1.5 + 0.5 * _NODES[0]), 0.5 * low * _NODES[1]
        terms = weights * (1 - smooth_step(radii, cutoff)) * (1 + radii**2) ** order
        cycles = np.outer(distances[near], radii)
        fade = smooth_step(cycles, _CYCLES)
        drops[near] += np.einsum("ij,j->i", 1 - fade + 2 * fade * np.sin(np.pi * cycles) ** 2, terms)
        drops[~near] += terms.sum()
        low *= 2
    drops, total = (drops + _power_integral(low, order)) / np.pi, total / np.pi
    # Denser tables by cubic Hermite interpolation, so that straight lines between their entries will do.
    slopes, fractions = np.gradient(drops), np.arange(_DENSER) / _DENSER
    from_start = fractions**2 * (3 - 2 * fractions)
    dense = drops[:-1, None] + np.diff(drops)[:, None] * from_start
    dense += slopes[:-1, None] * fractions * (1 - fractions) ** 2
    dense -= slopes[1:, None] * fractions**2 * (1 - fractions)
    # The kernel ends where the tables do, and distances of rounding are none.
    dense = np.append(dense.ravel(), total)
    dense[0] = 0.0
    fine = np.linspace(start, end, len(dense))
    distances = np.interp(fine, scale, distances)
    values = np.gradient(dense, fine) * (1 / distances + cutoff / _LINEAR_FROM) / distances
    values[-2:] = 0.0
    return _Kernel(cutoff, reach, start, float(fine[1] - fine[0]), total, dense, values)


def _looked_up(name: str, squares: Reals, kernels: Sequence[_Kernel]) -> Reals:
    """Return a table's value at each d², (..., kernels)."""
    cutoff, start, step = kernels[0].cutoff, kernels[0].start, kernels[0].step
    distances = np.sqrt(np.clip(squares, (_LEAST / cutoff) ** 2, kernels[0].reach ** 2))
    places = np.minimum((_scale(distances, cutoff) - start) / step, len(kernels[0].drops) - 1.0001)
    entries = np.maximum(places, 0.0).astype(np.int64)
    fractions = places - entries
    tables = (getattr(kernel, name) for kernel in kernels)
    return np.stack([table[entries] + fractions * (table[entries + 1] - table[entries]) for table in tables], -1)


def _as_meshes(
    surfaces: Sequence[Surface], signs: Sequence[int], cutoff: float
) -> tuple[list[tuple[Mesh, int]], list[tuple[Sphere, int]]]:
    meshes: list[tuple[Mesh, int]] = []
    spheres: list[tuple[Sphere, int]] = []
    for surface, sign in zip(surfaces, signs, strict=True):
        if isinstance(surface, Sphere):
            spheres.append((surface, sign))
        elif isinstance(surface, Smooth):
            meshes.append((_triangulated(surface, cutoff), sign))
        elif isinstance(surface, Mesh):
            meshes.append((surface, sign))
    return meshes, spheres


def _triangulated(surface: Smooth, cutoff: float) -> Mesh:
    """Return a mesh of a smooth surface that is fine beside it and beside the wavelength at a cutoff."""
    try:
        counts, _ = resolution_of(surface, cutoff, _TRIANGULATION_TOLERANCE)
    except InputError:
        counts = (_MOST_CELLS, _MOST_CELLS)
    cells = (min(_CELLS_PER_NODE * count, _MOST_CELLS) for count in counts)
    u, v = (_grid(interval, count) for interval, count in zip(surface.intervals, cells, strict=True))
    vertices = surface.positions(*np.meshgrid(u, v, indexing="ij")).reshape(3, -1).T
    first = (np.arange(len(u) - 1)[:, None] * len(v) + np.arange(len(v) - 1)).ravel()
    across, both = first + len(v), first + len(v) + 1
    triangles = np.concatenate([np.stack([first, across, both], 1), np.stack([first, both, first + 1], 1)])
    return Mesh.from_checked(np.ascontiguousarray(vertices), triangles)


def _grid(interval: Interval, cells: int) -> Reals:
    """Return ends of cells along a parameter, denser at the ends of one that is not periodic: there may be a pole."""
    fractions = np.linspace(0, 1, cells + 1)
    if not interval.periodic:
        fractions = (1 - np.cos(np.pi * fractions)) / 2
    return np.asarray(interval.low + interval.length * fractions)


def _chunks(meshes: Sequence[tuple[Mesh, int]]) -> Iterator[tuple[Reals, int]]:
    """Yield the corners (n, 3, 3) of triangles with an area, and the sign of their mesh."""
    for mesh, sign in meshes:
        for start in range(0, len(mesh.triangles), _HELD):
            corners = mesh.vertices[mesh.triangles[start : start + _HELD]]
            yield corners[_doubled_normals(corners)[1] > 0], sign


def _squares(vectors: Reals) -> Reals:
    """Return the squared lengths of vectors (..., 3)."""
    return np.asarray(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)


def _doubled_normals(corners: Reals) -> tuple[Reals, Reals]:
    """Return normals (n, 3) of triangles and their lengths (n,), twice the areas."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals, np.sqrt(_squares(normals))


def _centers(corners: Reals) -> tuple[Reals, Reals]:
    """Return the centroids (n, 3) of triangles, and the distance of the farthest corner (n,)."""
    centers = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    return centers, np.sqrt(_squares(corners - centers[:, None]).max(axis=1))


def _close_pairs(points: Reals, corners: Reals, reach: float) -> Iterator[tuple[Indices, Indices]]:
    """Yield rows and columns of pairs of a point and a triangle that may be closer than a reach."""
    from scipy.spatial import KDTree

    centers, radii = _centers(corners)
    # Triangles of like size at a time.
    sizes = np.maximum(np.ceil(np.log2(radii / reach)), -2.0)
    tree = KDTree(points)
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes == size)
        farthest = reach * (1 + 2.0**size)
        found = tree.sparse_distance_matrix(KDTree(centers[members]), farthest, output_type="ndarray")
        columns = members[found["j"]]
        near = found["v"] < reach + radii[columns]
        yield found["i"][near], columns[near]


def _affordable_points(meshes: Sequence[tuple[Mesh, int]], reach: float, rng: np.random.Generator) -> int:
    """Return the number of points whose pairs take about a second."""
    if not meshes:
        return USUAL_POINTS
    places, _ = _random_points(meshes, [], _FEWEST_POINTS, rng)
    pairs = 0
    for corners, _ in _chunks(meshes):
        centers, radii = _centers(corners)
        # A few triangles stand for all of them.
        step = max(1, len(centers) // 2000)
        offsets = np.linalg.norm(places[:, None] - centers[::step], axis=2)
        pairs += step * int(np.count_nonzero(offsets < reach + radii[::step]))
    return int(np.clip(_USUAL_PAIRS * _FEWEST_POINTS // max(pairs, 1), _FEWEST_POINTS, USUAL_POINTS))


def _random_points(
    meshes: Sequence[tuple[Mesh, int]], spheres: Sequence[tuple[Sphere, int]], count: int, rng: np.random.Generator
) -> tuple[Reals, Reals]:
    """Draw points (count, 3) on all surfaces, evenly by area, and return the signs of their surfaces (count,)."""
    areas = [np.asarray(mesh.areas) for mesh, _ in meshes] + [np.array([sphere.area]) for sphere, _ in spheres]
    ends = np.cumsum([0, *map(len, areas)])
    levels = np.cumsum(np.concatenate(areas))
    chosen = np.searchsorted(levels, (np.arange(count) + rng.random(count)) / count * levels[-1])
    chosen = np.minimum(chosen, len(levels) - 1)
    signs = np.repeat([float(sign) for _, sign in (*meshes, *spheres)], np.diff(ends))[chosen]
    first, second = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = np.empty((count, 3))
    surfaces: list[Mesh | Sphere] = [*(mesh for mesh, _ in meshes), *(sphere for sphere, _ in spheres)]
    for number, surface in enumerate(surfaces):
        here = (chosen >= ends[number]) & (chosen < ends[number + 1])
        if isinstance(surface, Sphere):
            points[here] = surface.center + surface.radius * directions[here]
            continue
        a, b, c = np.moveaxis(surface.vertices[surface.triangles[chosen[here] - ends[number]]], 1, 0)
        r, t = first[here], second[here]
        points[here] = (1 - r) * a + r * (1 - t) * b + r * t * c
    return points, signs


def _of_sphere(points: Reals, sphere: Sphere, kernels: Sequence[_Kernel]) -> Reals:
    """Return ∫ K(|x - y|) dy over a sphere for points (n, 3), (n, kernels)."""
    distances = np.linalg.norm(points - sphere.center, axis=1)
    ends = [_looked_up("drops", (distances + radius) ** 2, kernels) for radius in (sphere.radius, -sphere.radius)]
    # At the centre itself this is 0/0.
    factors = 2 * np.pi * sphere.radius / np.maximum(distances, 1e-4 * sphere.radius)
    return np.asarray(factors[:, None] * (ends[0] - ends[1]))


def _potentials(points: Reals, corners: Reals, kernels: Sequence[_Kernel]) -> Reals:
    """Return ∫ K(|x - y|) dy over a triangle for each pair of a point and a triangle, (n, kernels)."""
    corners = corners - points[:, None]
    normals, doubled = _doubled_normals(corners)
    centers, radii = _centers(corners)
    farness, sizes = radii / np.sqrt(_squares(centers)), radii * kernels[0].cutoff
    degrees = np.zeros(len(points), dtype=np.int64)
    for degree, farthest, largest in _RULES:
        degrees[(farness < farthest) & (sizes < largest)] = degree
    values, near = np.empty((len(points), len(kernels))), degrees == 0
    for degree, _, _ in _RULES:
        here, rule = degrees == degree, symmetric_rule(degree)
        at_nodes = _looked_up("values", _squares(rule.barycentric @ corners[here]), kernels)
        values[here] = doubled[here, None] / 2 * (rule.weights @ at_nodes)
    values[near] = _over_edges(corners[near], normals[near] / doubled[near, None], kernels)
    return values


def _over_edges(corners: Reals, normals: Reals, kernels: Sequence[_Kernel]) -> Reals:
    """Return the potential at the origin of triangles (n, 3, 3) with these unit normals, by edges, (n, kernels)."""
    ends = np.roll(corners, -1, axis=1)
    along = ends - corners
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    first, last = np.einsum("ijk,ijk->ij", corners, along), np.einsum("ijk,ijk->ij", ends, along)
    offsets = np.einsum("ik,ijk->ij", normals, np.cross(corners, along))
    heights = np.repeat(np.einsum("ij,ij->i", normals, corners[:, 0])[:, None], 3, axis=1)
    parts = _to_end(offsets, heights, last, kernels) - _to_end(offsets, heights, first, kernels)
    return np.asarray(parts.sum(axis=1))


def _to_end(offsets: Reals, heights: Reals, ends: Reals, kernels: Sequence[_Kernel]) -> Reals:
    """Return ∫ [M(h) - M(√(h² + q²/cos²θ))] dθ from the foot on an edge's line to one end, (..., kernels)."""
    reach, squares = kernels[0].reach, heights**2
    q = np.maximum(np.abs(offsets), 1e-12 * reach)
    # Beyond the reach the integrand is constant.
    lengths = np.minimum(np.abs(ends), np.sqrt(np.maximum(reach**2 - squares - q**2, 0.0)))
    level, total = _looked_up("drops", squares, kernels), np.array([kernel.total for kernel in kernels])
    inner = np.minimum(lengths, q)
    angles = np.arctan2(inner, q)
    result = (np.arctan2(np.abs(ends), q) - np.arctan2(lengths, q))[..., None] * (total - level)
    for node, weight in zip(*_NEAR, strict=True):
        distances = squares + (q / np.cos(angles * (node + 1) / 2)) ** 2
        result += (weight / 2 * angles)[..., None] * (_looked_up("drops", distances, kernels) - level)
    spans = np.log(lengths / np.where(inner > 0, inner, 1.0), where=inner > 0, out=np.zeros_like(q))
    for node, weight in zip(*_OUTWARDS, strict=True):
        lateral = inner * np.exp(spans * (node + 1) / 2)
        widths = weight / 2 * spans * q * lateral / (q**2 + lateral**2)
        distances = squares + q**2 + lateral**2
        result += widths[..., None] * (_looked_up("drops", distances, kernels) - level)
    return np.asarray((np.sign(offsets) * np.sign(ends))[..., None] * result)
