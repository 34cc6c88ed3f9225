"""The largest distance of one mesh's points from another mesh, between two bounds that come as near as requested.

The distance from one triangle is a convex function, so over a piece of a triangle it is largest at a corner. With the
triangles t of the other mesh B, some piece has

    largest distance from B <= min over t of max over the corners of the distance from t,

and the distance of each of its points from B is a lower bound. A piece whose upper bound exceeds the best lower bound
by too much is cut. Both bounds hold wherever it is cut, so the cut decides about speed alone. It runs along the plane
at right angles to the best t, through the side beyond which the worst corner lies. The part on the side of t then has
its closest points in t, and its bound is the distance itself. Where points of a piece are equally far from two
triangles, along a line, both bound it together: each of them the part that is closer to it.

Where the question is only whether it exceeds a length, triangles of B may answer for one that they cover (`cover`).

Where both meshes cut one plane into long thin triangles, pieces are as many as these cross each other. What takes many
is begun again without the parts of planes that both meshes cover (see `overlap`).

Sources: M. Guthe, P. Borodin, R. Klein, "Fast and accurate Hausdorff distance calculation between meshes" (2005);
M. Tang, M. Lee, Y. J. Kim, "Interactive Hausdorff distance computation for general polygonal models" (2009),
doi:10.1145/1531326.1531380; L. Sacht, A. Jacobson, "Cascading upper bounds for triangle soup Pompeiu-Hausdorff
distance" (2024). The cut along planes is ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.cover import cover_distances
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh, dot
from sobolev_batch.geometry.overlap import ROUNDING, rests_of
from sobolev_batch.geometry.surface import is_finite_number

# Gap between both bounds, as a fraction of the distance.
DEFAULT_GAP = 0.01
# Bounds are not closer than rounding permits: units in the last place of the largest coordinate.
_BOUND_ROUNDING = 32 * np.finfo(float).eps
# Fraction of the largest coordinate below which a deviation is rounding.
_PLACE_ROUNDING = 1e-14
# Lengths that people write down are met up to this fraction.
_EQUAL = 1e-9
# Pieces that are cut at a time, in some 2 kB each; and pieces after which bounds stay apart.
_BATCH, _MOST_PIECES = 1 << 15, 100_000_000
# Pieces of all triangles together, and of each, that take longer than to cut planes against each other.
_MANY, _MANY_OF_EACH = 1 << 17, 2
# A plane that cuts off less of the sides than these fractions leaves slivers, and the piece is cut in two.
_LEAST_CUT, _LEAST_SHORTER_CUT, _LARGEST_CUT = 0.05, 0.003, 0.97
# For so many pieces, with the farthest centers, the closest triangle to the worst corner, and covers, are searched.
_FEW = 300


@dataclass(frozen=True)
class Deviation:
    """The largest distance of a mesh's points from another mesh: between `lower` and `upper`, in the meshes' unit.

    Attributes:
        lower: Distance of the point at `place`.
        upper: No point is farther away.
        place: Point (3,) of the mesh whose distance is `lower`.

    >>> import sobolev_batch as sb
    >>> sb.largest_deviation(sb.shapes.icosphere(0), sb.shapes.icosphere(1)).forward.upper < 0.3
    True
    """

    lower: float
    upper: float
    place: tuple[float, float, float]

    def is_within(self, length: float) -> bool | None:
        """Tell whether the largest distance is at most a length; None where the bounds or rounding leave it open."""
        if self.upper <= length * (1 + _EQUAL):
            return True
        return False if self.lower > length * (1 + _EQUAL) + self.rounding else None

    @property
    def rounding(self) -> float:
        """A length for which coordinates have no digits there."""
        return _PLACE_ROUNDING * max(*map(abs, self.place), self.lower)


@dataclass(frozen=True)
class Deviations:
    """Largest distances of two meshes from each other, each way and both (the Hausdorff distance).

    Attributes:
        forward: The largest distance of the first mesh's points from the second mesh.
        backward: That of the second mesh's points from the first mesh.

    >>> import sobolev_batch as sb
    >>> square = sb.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> found = sb.largest_deviation(square, sb.Mesh(square.vertices + [0.25, 0, 0], square.triangles))
    >>> found.both.lower, found.both.upper
    (0.25, 0.25)
    """

    forward: Deviation
    backward: Deviation

    @property
    def both(self) -> Deviation:
        """The larger of both, with the place where it is larger."""
        farther = max(self.forward, self.backward, key=lambda way: way.lower)
        return Deviation(farther.lower, max(self.forward.upper, self.backward.upper), farther.place)


def largest_deviation(a: MeshLike, b: MeshLike, *, gap: float = DEFAULT_GAP, within: float | None = None) -> Deviations:
    """Bound the largest distance of two meshes from each other, from each point to the closest one: no sample.

    Args:
        a: First mesh, or what `as_mesh` makes one of.
        b: Second mesh, in the same unit of length, or what `as_mesh` makes one of.
        gap: Largest gap between lower and upper bound, as a fraction of the distance, or what single precision may have
            moved vertices by, where that is more; below rounding there is none.
        within: A length for the question whether the largest distance exceeds it. Bounds then stay as far apart as the
            answer permits, which is faster where it is clear.

    Returns:
        Bounds each way and both, in the unit of the meshes. They hold up to rounding, 7e-15 of the largest coordinate,
        whatever the meshes look like. Where a hundred million pieces do not close the gap, it stays wider.

    Raises:
        InputError: ``gap`` or ``within`` is no positive number; or see `as_mesh`.

    >>> import sobolev_batch as sb
    >>> ball = sb.shapes.icosphere(4)
    >>> found = sb.largest_deviation(ball, sb.shapes.icosphere(2))
    >>> found.both.upper <= 1.01 * found.both.lower, found.both.is_within(0.1)
    (True, True)
    """
    for name, value in (("gap", gap), ("within", gap if within is None else within)):
        if not (is_finite_number(value) and value > 0):
            raise InputError(f"{name} must be a positive number, found {value!r}")
    meshes = each(as_mesh, {"a": a, "b": b})
    ways = (meshes, meshes[::-1])
    return Deviations(*(directed_deviation(mesh, Triangles(other), gap, within) for mesh, other in ways))


@dataclass
class _Bounds:
    """Both bounds while they close, in units of a scale.

    Attributes:
        rounding: Distances that differ by less do not differ.
        gap: Gap that is permitted, as a fraction of the lower bound.
        least_gap: Gap that is permitted however small that bound is: what files may have rounded.
        within: Length whose question is to be answered; None without a question.
        lower: Largest distance of a point so far, that of `place`.
        upper: Largest upper bound of the pieces that are not looked at any more.
        count: Number of pieces that were looked at.
    """

    rounding: float
    gap: float
    least_gap: float
    within: float | None
    lower: float = -1.0
    place: Reals = field(default_factory=lambda: np.zeros(3))
    upper: float = 0.0
    count: int = 0

    @property
    def enough(self) -> float:
        """Upper bound of a piece below which it need not be cut."""
        if self.within is not None:
            return max(self.within, self.rounding + self.lower)
        return self.rounding + self.lower + max(self.gap * self.lower, self.least_gap)

    def see(self, points: Reals, distances: Reals) -> None:
        """Take the distances (n,) of points (3, n) as lower bounds."""
        farthest = int(distances.argmax())
        if distances[farthest] > self.lower:
            self.lower, self.place = float(distances[farthest]), points[:, farthest].copy()


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Parts of triangles: corners (3 corners, 3 coordinates, n), and triangles (k, n) that may be close to each.

    Covers of these parts, or of what they were cut from, may have been searched: where none was, there hardly is one.
    """

    corners: Reals
    close: Indices
    is_searched: bool = False

    def batches(self) -> Iterator[Self]:
        for group in slices(self.corners.shape[2], _BATCH):
            yield replace(self, corners=self.corners[..., group], close=self.close[:, group])


def directed_deviation(
    mesh: Mesh, other: Triangles, gap: float = DEFAULT_GAP, within: float | None = None
) -> Deviation:
    """Bound the largest distance of a mesh's points from triangles; see `largest_deviation`."""
    if within is not None and (moved := _moved(mesh, other, within)) is not None:
        return moved
    scale, reach = other.scale, max(other.scale, float(np.abs(mesh.vertices).max()))
    of_files = max(mesh.rounding, other.mesh.rounding)
    length = None if within is None else within / scale
    bounds = _Bounds(_BOUND_ROUNDING * reach / scale, gap, of_files / scale, length)
    cutting, many = _cut_all(mesh, other, bounds), _MANY + _MANY_OF_EACH * len(mesh.triangles)
    # The pieces are cut as this goes on.
    if any(bounds.count > many for _ in cutting):
        rests = rests_of(mesh, other.mesh, max(ROUNDING, of_files / reach))
        rest = rests.meshes[0]
        if rest is not mesh:
            # Both were moved onto common planes, and the bound grows by both moves.
            bounds.upper = max(bounds.upper, bounds.rounding + 2 * float(rests.distances.max()) / scale)
            cutting = iter(()) if rest is None else _cut_all(rest, other, bounds)
        for _ in cutting:
            pass
    x, y, z = (scale * bounds.place).tolist()
    return Deviation(scale * bounds.lower, scale * max(bounds.lower, bounds.upper), (x, y, z))


def _moved(mesh: Mesh, other: Triangles, within: float) -> Deviation | None:
    """Bound it by the largest move of a vertex, without a search; None for other triangles, and for longer moves."""
    if len(mesh.vertices) != len(other.mesh.vertices) or not np.array_equal(mesh.triangles, other.mesh.triangles):
        return None
    used = mesh.used_vertices
    moves = ((mesh.vertices[used] - other.mesh.vertices[used]) / other.scale).T
    squares = dot(moves, moves)
    upper, farthest = other.scale * math.sqrt(squares.max()), mesh.vertices[used[squares.argmax()]]
    # Lengths below rounding are left to the search, as for other meshes.
    if upper + _BOUND_ROUNDING * other.scale > within:
        return None
    every = np.arange(len(mesh.triangles))
    points = np.broadcast_to(farthest[:, None] / other.scale, (3, len(every)))
    lower = other.scale * math.sqrt(other.squares(points, every).min())
    x, y, z = farthest.tolist()
    return Deviation(lower, max(lower, upper), (x, y, z))


def _cut_all(mesh: Mesh, other: Triangles, bounds: _Bounds) -> Iterator[None]:
    """Cut triangles until both bounds are as close as they may be; pause after each batch."""
    scale, used = other.scale, mesh.used_vertices
    vertices, closest = mesh.vertices.T / scale, np.zeros(len(mesh.vertices), dtype=np.int64)
    distances = np.zeros(len(closest))
    distances[used], closest[used] = other.closest(mesh.vertices[used])
    distances /= scale
    bounds.see(vertices[:, used], distances[used])
    # The farthest come first: with a high lower bound, fewer of the others are cut. Those of a batch are in the order
    # of the mesh, in which searches are twice as fast.
    order = np.argsort(-distances[mesh.triangles].max(axis=1), kind="stable")
    for batch in slices(len(order), _BATCH):
        corners = mesh.triangles[np.sort(order[batch])].T
        pending = [_Pieces(np.stack([vertices[:, corner] for corner in corners]), closest[corners])]
        while pending:
            # The last ones are cut to their end before the others, so that few are in memory.
            parts = _cut(pending.pop(), other, bounds)
            pending += [] if parts is None else parts.batches()
            yield


def _cut(pieces: _Pieces, other: Triangles, bounds: _Bounds) -> _Pieces | None:
    """Bound the distances of pieces, and cut those whose bound is too large; None where there are none."""
    corners, count = pieces.corners, pieces.corners.shape[2]
    bounds.count += count
    # For each piece the smallest upper bound, its triangle, and the squared distances of the corners from that.
    upper, best, squares = np.full(count, np.inf), np.full(count, -1), np.zeros((3, count))
    left = np.arange(count)

    def look(tried: Indices) -> Indices:
        is_new = tried != best[left]
        looked, tried = left[is_new], tried[is_new]
        found = np.stack([other.squares(corner[:, looked], tried) for corner in corners])
        largest = found.max(axis=0)
        better = largest < upper[looked]
        improved = looked[better]
        upper[improved], best[improved], squares[:, improved] = largest[better], tried[better], found[:, better]
        return left[upper[left] > bounds.enough**2]

    for tried in pieces.close:
        left = look(tried[left])
    if len(left):
        centers = corners[..., left].mean(axis=0)
        distances, closest = other.closest(other.scale * centers.T)
        bounds.see(centers, distances / other.scale)
        depths, near = np.zeros(count), np.zeros(count, dtype=np.int64)
        depths[left], near[left] = distances, closest
        left = look(closest)
    # No piece need be cut any more, whatever its bound.
    if bounds.count > _MOST_PIECES or (bounds.within is not None and bounds.lower > bounds.within + bounds.rounding):
        left = left[:0]
    is_searched = pieces.is_searched
    if bounds.within is not None and not is_searched and len(left) >= _FEW:
        covers = cover_distances(corners[..., left], other, near[left], bounds.enough)
        upper[left] = np.minimum(upper[left], covers**2)
        left, is_searched = left[covers > bounds.enough], True
    bounds.upper = max(bounds.upper, math.sqrt(np.delete(upper, left).max(initial=0.0)))
    if not len(left):
        return None
    farthest = (-depths[left]).argsort()[:_FEW]
    parts = _parts(corners[..., left], best[left], np.sqrt(squares[:, left]), farthest, other, bounds)
    return replace(parts, is_searched=is_searched)


def _parts(
    corners: Reals, best: Indices, distances: Reals, farthest: Indices, other: Triangles, bounds: _Bounds
) -> _Pieces:
    """Cut pieces, of corners at distances (3, n): along the plane through a side of the best triangle, or in two.

    Those that two triangles bound together are left out.
    """
    pieces, worst = np.arange(len(best)), distances.argmax(axis=0)
    # How far each corner lies beyond each side, in lengths of the direction outward.
    starts, outward = (np.stack([each[:, best] for each in sides]) for sides in (other.corners, other.outward))
    lengths = np.sqrt(np.einsum("kin,kin->kn", outward, outward))
    beyond = np.einsum("kin,kin->kn", corners[worst, :, pieces].T - starts, outward)
    side = (beyond / np.where(lengths > 0, lengths, np.inf)).argmax(axis=0)
    start, outward = starts[side, :, pieces].T, outward[side, :, pieces].T
    heights = np.einsum("kin,in->kn", corners - start, outward)
    # Corners that a plane was cut to are in it: another cut there would never end.
    heights[np.abs(heights) <= bounds.rounding * lengths[side, pieces]] = 0.0
    turned, shares = _crossings(heights)
    a, b, c = (corners[corner, :, pieces].T for corner in turned)
    shorter, longer = shares.min(axis=0), shares.max(axis=0)
    fair = (longer > _LEAST_CUT) & (shorter > _LEAST_SHORTER_CUT) & (shorter < _LARGEST_CUT)
    # Near the plane of the best triangle, the part that is cut away from slivers needs no further look.
    thin = np.max([other.squared_heights(corner, best) for corner in corners], axis=0) <= bounds.enough**2
    thin &= heights.min(axis=0) < 0
    is_beyond = heights > 0
    is_cut = is_beyond.any(axis=0) & ~is_beyond.all(axis=0) & (fair | thin)
    parts = [*_beside_plane(a[:, is_cut], b[:, is_cut], c[:, is_cut], shares[:, is_cut])]
    # Beyond a side, the triangle across it is likely to be the closest one; of the farthest pieces a search tells.
    halved, likely, second = np.flatnonzero(~is_cut), other.across[side, best], best.copy()
    searched = np.union1d(halved, farthest)
    points = corners[worst[searched], :, searched]
    depths, second[searched] = other.closest(other.scale * points)
    bounds.see(points.T, depths / other.scale)
    likely[farthest] = second[farthest]
    of_pairs = _bounds_of_pairs(corners[..., halved], distances[:, halved], best[halved], second[halved], other, bounds)
    is_done = of_pairs <= bounds.enough
    bounds.upper, halved = max(bounds.upper, of_pairs[is_done].max(initial=0.0)), halved[~is_done]
    parts += _halves(corners[..., halved])
    near, far = np.stack([best, best]), np.stack([likely, best])
    is_lone = is_beyond[turned[0], pieces]
    alone, beside = np.where(is_lone, far, near)[:, is_cut], np.where(is_lone, near, far)[:, is_cut]
    return _Pieces(np.concatenate(parts, axis=2), np.concatenate([alone] + [beside] * 2 + [far[:, halved]] * 2, axis=1))


def _crossings(values: Reals) -> tuple[Indices, Reals]:
    """Return where values of the corners (3, n) of pieces change their sign, as if they were linear.

    Returns:
        The order of corners (3, n), of which the first lies alone on its side, and the shares (2, n) of the sides from
        it at which they are zero; of no meaning where all corners lie on one side.
    """
    is_beyond = values > 0
    lone = np.where(is_beyond.sum(axis=0) == 1, is_beyond.argmax(axis=0), (~is_beyond).argmax(axis=0))
    turned = (lone + np.arange(3)[:, None]) % 3
    own, *others = np.take_along_axis(values, turned, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return turned, np.stack([own / (own - value) for value in others])


def _bounds_of_pairs(
    corners: Reals, distances: Reals, first: Indices, second: Indices, other: Triangles, bounds: _Bounds
) -> Reals:
    """Return upper bounds (n,) by two triangles for each piece, the first of them at distances (3, n) from its corners.

    A line through the piece leaves each of them a part. Any line gives a bound, and a good one has the same distance
    from both: from their planes, or from corners and parallel sides, where squares have a linear difference. It is
    infinite where there is no such line.
    """
    pieces, worst = np.arange(len(first)), distances.argmax(axis=0)
    seconds = np.sqrt([other.squares(corner, second) for corner in corners])
    is_above, differences = np.ones(len(first), dtype=bool), np.zeros_like(distances)
    for sign, triangles, values in ((1, first, distances), (-1, second, seconds)):
        heights = np.sqrt([other.squared_heights(corner, triangles) for corner in corners])
        is_above &= values[worst, pieces] <= heights[worst, pieces] + bounds.rounding
        differences += sign * heights
    differences = np.where(is_above, differences, distances**2 - seconds**2)
    is_beyond = differences > 0
    is_divided = is_beyond.any(axis=0) & ~is_beyond.all(axis=0)
    largest = np.where(is_divided, np.where(is_beyond, seconds, distances).max(axis=0), np.inf)
    tried = np.flatnonzero(largest <= bounds.enough)
    turned, shares = _crossings(differences[:, tried])
    a, *ends = (corners[corner, :, tried].T for corner in turned)
    for end, share in zip(ends, shares, strict=True):
        point = a + share * (end - a)
        squares = np.maximum(other.squares(point, first[tried]), other.squares(point, second[tried]))
        largest[tried] = np.maximum(largest[tried], np.sqrt(squares))
    return largest


def _beside_plane(a: Reals, b: Reals, c: Reals, shares: Reals) -> list[Reals]:
    """Return triangles cut at shares (2, n) of the sides from a: the part at a, and the other one as two."""
    along_b, along_c = a + shares[0] * (b - a), a + shares[1] * (c - a)
    # The shorter diagonal leaves fewer slivers.
    is_longer = dot(along_b - c, along_b - c) > dot(along_c - b, along_c - b)
    b, c, along_b, along_c = np.where(is_longer, (c, b, along_c, along_b), (b, c, along_b, along_c))
    return [np.stack(part) for part in ((a, along_b, along_c), (along_b, b, c), (along_b, c, along_c))]


def _halves(corners: Reals) -> list[Reals]:
    """Return triangles (3, 3, n) cut at the middles of their longest sides: thin ones become less so."""
    lengths = np.stack([dot(side, side) for side in np.roll(corners, -1, axis=0) - corners])
    first, which = lengths.argmax(axis=0), np.arange(corners.shape[2])
    a, b, c = (corners[(first + k) % 3, :, which].T for k in range(3))
    middle = (a + b) / 2
    return [np.stack(part) for part in ((a, middle, c), (middle, b, c))]
