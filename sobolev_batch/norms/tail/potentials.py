"""Potentials of triangles and spheres by the kernel that is left beyond a frequency.

With K the inverse transform of (1 - step(|ξ|)) (1 + |ξ|²)^s, where step is `smooth_step`, and M(d) = ∫_d^∞ K(r) r dr =
1/π ∫ (1 - step(r)) (1 + r²)^s cos(2πrd) dr, the divergence theorem in the plane of a triangle turns its potential into
a sum over the three edges,

    ∫ K(|x - y|) dy = Σ ∫ [M(h) - M(√(h² + q²/cos²θ))] dθ,

for x at the height h above the plane, its foot at the distance q from the line of an edge, and θ the angle about the
foot. With q sinh t for the distance along the edge, dθ is dt/cosh t. K and M fall off within a few wavelengths, where
they are cut; twice the reach and twice the nodes tell what that changes.
"""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import beta, betainc

from sobolev_batch import compiled
from sobolev_batch.arrays import Array, Indices, Reals, slices
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.mesh import cross, dot
from sobolev_batch.transform.backends import CPU, Backend, combine, compute_on, sums_at
from sobolev_batch.transform.fourier import ON_CPU, Execution
from sobolev_batch.transform.lattice import smooth_step
from sobolev_batch.transform.rules import symmetric_rule

# Processor time of a pair of a point and a triangle, and of each of its orders, in seconds: on arrays, and compiled,
# with a share of the time that loops take to load.
_ON_ARRAYS, _COMPILED, _START = (1e-6, 4e-7), (5e-7, 5e-8), 0.15
# Distances in wavelengths 1/X between which kernels are tabulated. The smaller one is rounding, or that of coordinates,
# as a part of the largest one: of points on their own face, 3e-16 of it was seen. Beyond the larger one, which depends
# on the order, they are below 1 % of what they are at zero, and between these fractions of it they fade.
_LEAST, _OF_COORDINATES, _FADE = 1e-12, 4e-15, (0.75, 0.999)
_REACHES = (-4.0, -3.0, -2.0, -1.0), (12.0, 10.0, 8.0, 6.0)
# Entries of a table up to the reach, how many times as many are interpolated, and where equal steps begin.
_ENTRIES, _DENSER, _LINEAR_FROM = 1500, 8, 0.3
# Cycles after which a cosine counts as averaged out, and nodes for each octave of frequencies.
_CYCLES, _NODES = 32.0, leggauss(48)
# Degrees of the rules for triangles that are smaller than these fractions of their distance, and of 1/X.
_RULES = (12, 0.6, 1.1), (4, 0.5, 0.5), (2, 0.2, 0.1)
# Panels along an edge are at most as long as this, in t and in wavelengths 1/X, with nodes in each; t ends where all
# that follows is rounding.
_PANEL, _PANEL_WAVES, _PANEL_NODES, _LAST = 2.4, 3.8, leggauss(8), 22.0
# Pairs that are computed at a time on arrays.
_BATCH = 20_000
# Where more than this share of all pairs is close, by a sample of so many points and triangles, a look at each takes a
# tenth of the time of trees; and pairs that are looked at together, whose lists would else take gigabytes.
_OFTEN_CLOSE, _SAMPLE, _PAIRS_AT_ONCE = 0.05, 256, 1 << 22
# With fewer close pairs a GPU takes longer. Pairs that it looks at, and computes, at a time; and nodes of rules, and
# pairs that take integrals over edges, at a time: some 300 MB each.
_FEWEST_FOR_GPU, _PAIRS_ON_DEVICE, _BATCH_ON_DEVICE = 1 << 15, 1 << 23, 1 << 19
_NODES_AT_ONCE, _NEAR_AT_ONCE = 1 << 20, 1 << 16

# Rows and columns: numbers of a point and a triangle for each pair.
Pairs = tuple[Indices, Indices]


def tail_nodes(cutoff: float, order: float) -> Iterator[tuple[float, Reals, Reals]]:
    """Yield, octave by octave from the step on, where it begins, radii r (k,) and weights of (1 - step(r)) (1+r²)^s."""
    low = cutoff / 2
    while True:
        radii = low * (1.5 + 0.5 * _NODES[0])
        yield low, radii, 0.5 * low * _NODES[1] * (1 - smooth_step(radii, cutoff)) * (1 + radii**2) ** order
        low *= 2


@lru_cache(maxsize=4096)
def tail_integral(cutoff: float, order: float) -> float:
    """Return ∫ (1 - step(r)) (1+r²)^s dr over all r, for the smooth step that ends at a cutoff."""
    radii = cutoff * (0.75 + 0.25 * _NODES[0])
    on_step = float(0.25 * cutoff * _NODES[1] @ ((1 - smooth_step(radii, cutoff)) * (1 + radii**2) ** order))
    return on_step + _power_integral(cutoff, order)


def _power_integral(lowest: float, order: float) -> float:
    """Return ∫ (1+r²)^s dr from a radius on, with p = 1/(1+r²) half an incomplete beta integral."""
    exponent = -order - 0.5
    return 0.5 * float(beta(exponent, 0.5) * betainc(exponent, 0.5, 1 / (1 + lowest**2)))


def reach_of(order: float) -> float:
    """Return the distance, in wavelengths 1/X, beyond which the kernel of an order is cut."""
    return float(np.interp(order, *_REACHES))


@dataclass(frozen=True, eq=False)
class Kernels:
    """The kernels of some orders beyond a cutoff, in tables over equal steps of `_scale`.

    Attributes:
        cutoff: |ξ| at which the step ends, in cycles per unit length.
        fineness: 1, or how many times as far the kernels reach, and as many nodes serve.
        least: Distance in wavelengths up to which all are none.
        reach: Distance beyond which all kernels are zero.
        start: Where the tables begin, and the step between their entries.
        totals: M(0), (orders,).
        drops: M(0) - M(d), (n, orders).
        values: K(d), (n, orders).
    """

    cutoff: float
    orders: tuple[float, ...]
    fineness: int
    least: float
    reach: float
    start: float
    step: float
    totals: Reals
    drops: Reals
    values: Reals

    @classmethod
    def of_orders(
        cls, cutoff: float, orders: Sequence[float], fineness: int = 1, largest_coordinate: float = 0.0
    ) -> Self:
        """Return the kernels of some orders, for surfaces with coordinates up to a largest one."""
        # Of a few sizes, so that meshes of a study share their tables.
        least = max(_LEAST, 2.0 ** math.ceil(math.log2(max(_OF_COORDINATES * largest_coordinate * cutoff, _LEAST))))
        start, end = _grid(cutoff, fineness, least)
        tables = zip(*(_tables(cutoff, order, fineness, least) for order in orders), strict=True)
        totals, drops, values = (np.stack(rows, axis=-1) for rows in tables)
        reach, step = fineness * max(map(reach_of, orders)) / cutoff, (end - start) / (len(drops) - 1)
        return cls(cutoff, tuple(orders), fineness, least, reach, start, step, totals, drops, values)

    def looked_up(self, table: Array, squares: Array) -> Array:
        """Return a table's values at each d², (..., orders), by quadratic splines.

        A face has one height above a parallel one. Straight lines would lose second differences, which a distance is
        made of, of moves by less than a step of the table.
        """
        squares = np.minimum(np.maximum(squares, (self.least / self.cutoff) ** 2), self.reach**2)
        places = np.minimum((_scale(np.sqrt(squares), self.cutoff) - self.start) / self.step, len(table) - 1.5001)
        entries = np.where(places > 1, places + 0.5, 1.0).astype(np.int64)  # NaN stays what it is
        offsets, middle = np.maximum(places, 0.0) - entries, table[entries]
        low, high = ((beyond * beyond / 2)[..., None] for beyond in (0.5 - offsets, 0.5 + offsets))
        return middle + low * (table[entries - 1] - middle) + high * (table[entries + 1] - middle)


def _splines(values: Reals) -> Reals:
    """Return the coefficients of the quadratic spline, whose knots are midway between entries, near values (n,)."""
    coefficients = values.copy()
    coefficients[1:-1] -= np.diff(values, 2) / 8
    return coefficients


def _scale(distances: Array, cutoff: float) -> Array:
    """Return where distances lie in the tables: in equal steps of log d at first, of d where kernels oscillate."""
    relative = distances * cutoff / _LINEAR_FROM
    return np.where(relative < 1, np.log(relative), relative - 1)


def _distances(scale: Reals, cutoff: float) -> Reals:
    """Return the distances of places in the tables: the inverse of `_scale`."""
    return np.asarray(np.where(scale < 0, np.exp(np.minimum(scale, 0)), scale + 1) * _LINEAR_FROM / cutoff)


def _grid(cutoff: float, fineness: int, least: float) -> tuple[float, float]:
    """Return where tables begin and end, the same for all orders."""
    ends = _scale(np.array([least, fineness * max(_REACHES[1])]) / cutoff, cutoff).tolist()
    return ends[0], ends[1]


@lru_cache(maxsize=1024)
def _tables(cutoff: float, order: float, fineness: int, least: float) -> tuple[float, Reals, Reals]:
    """Return M(0), the table of M(0) - M(d) and that of K(d) for an order."""
    (start, end), count = _grid(cutoff, fineness, least), fineness * _ENTRIES
    reach, total = fineness * reach_of(order) / cutoff, tail_integral(cutoff, order)
    distances = _distances(np.linspace(start, end, count), cutoff)
    drops = np.zeros(count)
    for low, radii, terms in tail_nodes(cutoff, order):
        near = _CYCLES / distances > low
        if not near.any():
            break
        cycles = np.outer(distances[near], radii)
        fade = smooth_step(cycles, _CYCLES)
        drops[near] += np.einsum("ij,j->i", 1 - fade + 2 * fade * np.sin(np.pi * cycles) ** 2, terms)
        drops[~near] += terms.sum()
    drops, total = (drops + _power_integral(low, order)) / np.pi, total / np.pi
    # Cubic Hermite interpolation makes the tables dense enough for splines between their entries.
    slopes, fractions = np.gradient(drops), np.arange(_DENSER) / _DENSER
    slopes[2:-2] = (8 * (drops[3:-1] - drops[1:-3]) - drops[4:] + drops[:-4]) / 12
    from_start = fractions**2 * (3 - 2 * fractions)
    dense = drops[:-1, None] + np.diff(drops)[:, None] * from_start
    dense += slopes[:-1, None] * fractions * (1 - fractions) ** 2
    dense -= slopes[1:, None] * fractions**2 * (1 - fractions)
    dense = np.append(dense.ravel(), total)
    fine = np.linspace(start, end, len(dense))
    distances = _distances(fine, cutoff)
    # What is left at the reach is cut without a jump, and distances of rounding are none.
    faded = np.clip((distances / reach - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0)
    dense = total + (dense - total) * np.cos(np.pi / 2 * faded) ** 2
    values = np.gradient(dense, fine) / np.minimum(distances, _LINEAR_FROM / cutoff) / distances
    values[-2:] = 0.0
    dense, values = _splines(dense), _splines(values)
    dense[:3] = 0.0
    return total, dense, values


def of_sphere(points: Reals, sphere: Sphere, kernels: Kernels) -> Reals:
    """Return ∫ K(|x - y|) dy over a sphere for points (n, 3), (n, orders)."""
    distances = np.linalg.norm(points - sphere.center, axis=1)
    ends = [kernels.looked_up(kernels.drops, (distances + radius) ** 2) for radius in (sphere.radius, -sphere.radius)]
    # At the centre itself this is 0/0.
    factors = 2 * np.pi * sphere.radius / np.maximum(distances, 1e-4 * sphere.radius)
    return np.asarray(factors[:, None] * (ends[0] - ends[1]))


def seconds_of(pairs: float, orders: int) -> float:
    """Predict the processor time of the potentials of pairs of a point and a triangle, for some orders."""
    # It depends on nothing that the process has done, or choices would.
    on_arrays, loops = (pairs * (cost[0] + cost[1] * orders) for cost in (_ON_ARRAYS, _COMPILED))
    return min(on_arrays, _START + loops)


@dataclass(frozen=True, eq=False)
class SignedTriangles:
    """Triangles of a signed sum of surfaces: corners (m, 3, 3) in units of length, and the sign of each (m,)."""

    corners: Reals
    signs: Reals

    @classmethod
    def with_area(cls, corners: Reals, sign: float, largest_coordinate: float = 0.0) -> Self:
        """Return triangles of one sign, without those that have no area, or are no wider than rounding."""
        sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        doubled, lengths = np.linalg.norm(np.cross(*sides), axis=1), np.linalg.norm(sides, axis=2).sum(axis=0)
        corners = corners[doubled > _OF_COORDINATES * largest_coordinate * lengths]
        return cls(corners, np.full(len(corners), float(sign)))

    @cached_property
    def balls(self) -> tuple[Reals, Reals]:
        """See `centers_and_radii`."""
        return centers_and_radii(self.corners)


def add_of_triangles(
    potentials: Reals, points: Reals, triangles: SignedTriangles, kernels: Kernels, execution: Execution = ON_CPU
) -> int:
    """Add the integrals of K(|x - y|) over triangles, times their signs, to potentials (n, orders) at points (n, 3).

    Return the number of pairs of a point and a triangle that are close enough to count.
    """
    centers, radii = triangles.balls
    # The share of pairs that are close, by a sample.
    some, which = slice(None, None, len(points) // _SAMPLE + 1), slice(None, None, len(centers) // _SAMPLE + 1)
    are_close = _are_close(points[some], centers[which], (kernels.reach + radii)[which])
    share = float(are_close.mean()) if len(centers) else 0.0
    is_worth = share * len(points) * len(centers) >= _FEWEST_FOR_GPU

    def added(backend: Backend) -> tuple[Reals | None, int]:
        return (None, 0) if backend is CPU else _on_device(points, triangles, kernels, backend)

    found, count = compute_on(execution.backend if is_worth else CPU, added)
    if found is not None:
        potentials += found
        return count
    for rows, columns in _close_pairs(points, centers, radii, kernels.reach, share):
        count += len(rows)
        if compiled.pays(len(rows) * (_ON_ARRAYS[0] + _ON_ARRAYS[1] * len(kernels.totals))):
            add_compiled(potentials, points, triangles, (rows, columns), kernels, execution.threads)
            continue
        for part in slices(len(rows), _BATCH):
            row, column = rows[part], columns[part]
            of_pairs = of_triangles(points[row], triangles.corners[column], kernels)
            np.add.at(potentials, row, triangles.signs[column, None] * of_pairs)
    return count


def _on_device(points: Reals, triangles: SignedTriangles, kernels: Kernels, backend: Backend) -> tuple[Reals, int]:
    """Return the integrals of K(|x - y|) over triangles for points (n, 3), (n, orders), and the number of pairs.

    A GPU looks at each pair in less time than it takes to upload what trees find.
    """
    centers, radii = triangles.balls
    given = points, triangles.corners, triangles.signs, centers, kernels.reach + radii
    points, corners, signs, centers, farthest = map(backend.upload, given)
    tables = {name: backend.upload(getattr(kernels, name)) for name in ("totals", "drops", "values")}
    kernels, count = replace(kernels, **tables), 0
    totals = np.zeros((len(kernels.orders), len(points)), like=points)
    for some in slices(len(points), max(1, _PAIRS_ON_DEVICE // len(centers))):
        here = points[some]
        rows, columns = np.nonzero(_are_close(here, centers, farthest))
        count += len(rows)
        for part in slices(len(rows), _BATCH_ON_DEVICE):
            row, column = rows[part], columns[part]
            found = of_triangles(here[row], corners[column], kernels) * signs[column][:, None]
            for order, total in enumerate(totals):
                total[some] += sums_at(row, found[:, order], len(here))
    return np.ascontiguousarray(backend.download(totals).T), count


def add_compiled(
    potentials: Reals, points: Reals, triangles: SignedTriangles, pairs: Pairs, kernels: Kernels, threads: int
) -> None:
    """Do the same for pairs of rows and columns, by the compiled loop."""
    from sobolev_batch.compiled.edges import add_potentials

    rules = [symmetric_rule(degree) for degree, _, _ in _RULES]
    limits = np.array([[farthest, largest] for _, farthest, largest in _RULES]) / kernels.fineness
    nodes = np.concatenate([np.column_stack([rule.barycentric, rule.weights]) for rule in rules])
    ends = np.cumsum([0, *(len(rule.weights) for rule in rules)])
    grid = kernels.cutoff, kernels.reach, kernels.start, kernels.step
    tables = *grid, kernels.totals, kernels.drops, kernels.values, kernels.least, _LINEAR_FROM
    longest = _PANEL / kernels.fineness, _PANEL_WAVES / kernels.fineness / kernels.cutoff
    panels, faces = (*longest, _LAST, np.stack(_PANEL_NODES)), (triangles.corners, triangles.signs)

    def sums_of(rows: Indices, columns: Indices) -> Reals:
        sums = np.zeros_like(potentials)
        add_potentials(sums, points, *faces, rows, columns, tables, panels, limits, nodes, ends)
        return sums

    with ThreadPoolExecutor(threads) as pool:
        for sums in pool.map(sums_of, *(np.array_split(side, threads) for side in pairs)):
            potentials += sums


def of_triangles(points: Array, corners: Array, kernels: Kernels) -> Array:
    """Return ∫ K(|x - y|) dy over a triangle for each pair of a point (n, 3) and a triangle (n, 3, 3), (n, orders).

    All arrays are of one backend, that of the kernels.
    """
    # Axes, corners, pairs.
    rows = np.ascontiguousarray((corners - points[:, None]).T, like=points)
    a, b, c = rows[:, 0], rows[:, 1], rows[:, 2]
    normals, center = np.stack(cross(b - a, c - a)), (a + b + c) / 3
    doubled, distances = np.sqrt(dot(normals, normals)), np.sqrt(dot(center, center))
    arms = [corner - center for corner in (a, b, c)]
    squares = [dot(arm, arm) for arm in arms]
    radii, fineness = np.sqrt(np.maximum(np.maximum(squares[0], squares[1]), squares[2])), kernels.fineness
    degrees = np.zeros(len(points), dtype=np.int64, like=points)
    for degree, farthest, largest in _RULES:
        is_far = (radii < farthest / fineness * distances) & (radii * kernels.cutoff < largest / fineness)
        degrees = np.where(is_far, degree, degrees)
    values = np.empty((len(points), len(kernels.orders)), like=points)
    for degree, _, _ in _RULES:
        rule = symmetric_rule(degree)
        chosen = np.flatnonzero(degrees == degree)
        for part in slices(len(chosen), _NODES_AT_ONCE // rule.node_count):
            here = chosen[part]
            nodes = combine(rule.barycentric, np.ascontiguousarray(rows[:, :, here], like=points))
            at_nodes = kernels.looked_up(kernels.values, dot(nodes, nodes)).reshape(rule.node_count, -1)
            values[here] = (doubled[here] / 2)[:, None] * combine(rule.weights, at_nodes).reshape(len(here), -1)
    chosen = np.flatnonzero(degrees == 0)
    for near in (chosen[part] for part in slices(len(chosen), _NEAR_AT_ONCE)):
        values[near] = _over_edges(rows[:, :, near], normals[:, near] / doubled[near], kernels)
    return values


def _over_edges(corners: Array, normals: Array, kernels: Kernels) -> Array:
    """Return the potential at the origin of triangles (3, 3, n) with unit normals (3, n), by edges, (n, orders)."""
    # Axes, edges, pairs.
    ends = np.roll(corners, -1, axis=1)
    along = ends - corners
    normals = _square_on_longest(normals, along)
    along /= np.sqrt(dot(along, along))
    first, last = dot(corners, along), dot(ends, along)
    offsets = dot(normals[:, None], cross(corners, along))
    heights = np.repeat(dot(normals, corners[:, 0])[None], 3, axis=0)
    # From the foot on the line of an edge to both ends, or between the two where they are on one side of it.
    one_side, first, last = first * last > 0, np.abs(first), np.abs(last)
    near = np.where(one_side, np.minimum(first, last), 0.0)
    begins = np.concatenate([near, 0 * near])
    far = np.concatenate([np.where(one_side, np.maximum(first, last), last), np.where(one_side, 0.0, first)])
    offsets, heights = np.concatenate([offsets, offsets]), np.concatenate([heights, heights])
    spans = (rows.ravel() for rows in (offsets, heights, begins, far))
    return _of_span(*spans, kernels=kernels).reshape(6, corners.shape[2], -1).sum(axis=0)


def _square_on_longest(normals: Array, edges: Array) -> Array:
    """Return unit normals (3, n) at right angles to the longest of three edges (3, 3, n).

    Those of slivers are not, by rounding, so that their far points would seem to lie above their plane.
    """
    squares = dot(edges, edges)
    best, square = edges[:, 0], squares[0]
    for number in (1, 2):
        is_longer = squares[number] > square
        best, square = np.where(is_longer, edges[:, number], best), np.where(is_longer, squares[number], square)
    return normals - dot(normals, best) / square * best


def _of_span(offsets: Array, heights: Array, near: Array, far: Array, *, kernels: Kernels) -> Array:
    """Return ∫ [M(h) - M(√(h² + q²/cos²θ))] dθ between two distances from the foot on an edge's line, (n, orders)."""
    reach, squares = kernels.reach, heights * heights
    q = np.maximum(np.abs(offsets), kernels.least * reach)
    # Beyond the reach the integrand is constant.
    farthest = np.sqrt(np.maximum(reach**2 - squares - q * q, 0.0))
    begin, end = np.minimum(near, farthest), np.minimum(far, farthest)
    level = kernels.looked_up(kernels.drops, squares)
    outside = np.arctan2(far, q) - np.arctan2(end, q) - np.arctan2(near, q) + np.arctan2(begin, q)
    result = outside[:, None] * (kernels.totals - level)
    longest = _PANEL_WAVES / kernels.fineness / kernels.cutoff
    begun, last = (np.minimum(np.arcsinh(length / q), _LAST) for length in (begin, end))
    active = np.flatnonzero(last > begun)
    while len(active):
        low, here = begun[active], q[active]
        # Far along an edge the distance grows like exp t.
        steps = np.log(1 + longest / (here * np.cosh(low)))
        high = np.minimum(last[active], low + np.minimum(_PANEL / kernels.fineness, steps))
        # Nodes, pairs.
        nodes, weights = (np.asarray(row, like=q)[:, None] for row in _PANEL_NODES)
        widening = np.cosh((low + high) / 2 + (high - low) / 2 * nodes)
        along = here * widening
        terms = kernels.looked_up(kernels.drops, squares[active] + along * along) - level[active]
        result[active] += ((weights / 2 * (high - low) / widening)[..., None] * terms).sum(axis=0)
        begun[active] = high
        active = active[np.flatnonzero(high < last[active])]
    return np.sign(offsets)[:, None] * result


def centers_and_radii(corners: Reals) -> tuple[Reals, Reals]:
    """Return the centroids (n, 3) of triangles, and the distance of the farthest corner (n,)."""
    centers = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    return centers, np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)


def _are_close(points: Array, centers: Array, farthest: Array) -> Array:
    def squared_offsets(axis: int) -> Array:
        offsets = points[:, axis, None] - centers[:, axis]
        # In place, as below: these are the largest arrays of all.
        offsets *= offsets
        return offsets

    squares = squared_offsets(0)
    for axis in (1, 2):
        squares += squared_offsets(axis)
    return squares < farthest * farthest


def _close_pairs(points: Reals, centers: Reals, radii: Reals, reach: float, share: float) -> Iterator[Pairs]:
    """Yield rows and columns of pairs of a point and a triangle that may be closer than a reach."""
    from scipy.spatial import KDTree

    if share > _OFTEN_CLOSE:
        for some in slices(len(points), max(1, _PAIRS_AT_ONCE // len(centers))):
            rows, columns = np.nonzero(_are_close(points[some], centers, reach + radii))
            yield rows + some.start, columns
        return
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
