"""What each of two meshes has that the other lacks: triangles that both have are left out, and flat faces are cut.

Faces are cut against each other plane by plane. Triangles lie in one plane where all their corners are within a
tolerance of it. There each mesh is a set of polygons, one for each layer where it lies on itself; orientation does not
matter, as area measures have none. A plane stays as it is where GEOS (https://libgeos.org) refuses it, where areas do
not balance, where the meshes hardly cover each other, and where cutting would multiply the number of triangles by more
than it divides the area, as between combs.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.errors import GEOSException

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Extent, Surface

# Rounding, relative to the largest coordinate.
ROUNDING = 2.0**-47
# The grid of polygons, and the least height of triangles that are left, beside the rounding.
_GRID, _LEAST_HEIGHT = 0.25, 2.0
# How far off areas may be, relative to them, and the least fraction of them that is worth taking out.
_BALANCE, _LEAST_FRACTION = 1e-12, 0.05
_MOST_LAYERS = 16
# Triangles in a plane from which on it takes less time to look first whether they share whole edges.
_MANY = 64
# Triangles that are measured at a time, and the most pairs of a small one and a plane, which may be tilted so far.
_BATCH, _MOST_PAIRS, _LEAST_COSINE = 1 << 14, 1 << 23, 1 - 2e-8
# A direction without pattern, to whose side normals are turned, and a projection of normals and offsets.
_SIDE, _PROJECTION = np.array([0.4127, 0.7391, 0.5323]), np.array([0.4862, -0.3817, 0.6254, 0.4775])
# Dimensions of polygons.
_FLAT = 2

_Objects = NDArray[np.object_]


@dataclass(frozen=True, eq=False)
class Rests:
    """Parts of each of two meshes that the other lacks, as area measures.

    Attributes:
        meshes: The rests; None where nothing is left, the meshes themselves where nothing is taken out.
        areas: Twice the area of both meshes in each plane that was cut, times its layers (planes,).
        distances: Largest distance that it was moved by, onto the plane (planes,); zero where that is rounding.
    """

    meshes: tuple[Mesh | None, Mesh | None]
    areas: Reals
    distances: Reals


def rests_of(first: Mesh, second: Mesh, tolerance: float = ROUNDING) -> Rests:
    """Return what two meshes do not have in common; planes are equal to a tolerance beside the largest coordinate."""
    low, high = Extent.union([first.extent, second.extent]).box
    center, size = low + (high - low) / 2, 2.0 ** np.ceil(np.log2((high - low).max()))
    reach = max(np.abs(low).max(), np.abs(high).max()) / size
    sides = [_Side.of(mesh, center, size) for mesh in (first, second)]
    planes, of = _shared_planes(sides, tolerance * reach)
    cuts = _cut(sides, of, planes, ROUNDING * reach)
    if sum(cut.removed for cut in cuts) < _LEAST_FRACTION * sum(side.areas.sum() for side in sides):
        return Rests((first, second), np.zeros(0), np.zeros(0))
    accepted = np.concatenate([cut.planes for cut in cuts])
    one, other = (
        side.rest(np.isin(plane, accepted), np.concatenate([cut.rests[number] for cut in cuts]), ROUNDING * reach)
        for number, (side, plane) in enumerate(zip(sides, of, strict=True))
    )
    areas, distances = (np.concatenate([getattr(cut, name) for cut in cuts]) for name in ("areas", "distances"))
    return Rests((one, other), areas * size**2, distances * size)


@dataclass(frozen=True, eq=False)
class _Side:
    """One mesh, moved to a centre and divided by a size: planes (m, 4), least heights and areas of triangles (m,)."""

    mesh: Mesh
    center: Reals
    size: float
    planes: Reals
    heights: Reals
    areas: Reals

    @classmethod
    def of(cls, mesh: Mesh, center: Reals, size: float) -> Self:
        count = len(mesh.triangles)
        side = cls(mesh, center, size, np.zeros((count, 4)), np.zeros(count), np.zeros(count))
        for part in slices(count, _BATCH):
            corners = side.corners(part)
            normals, side.areas[part], side.heights[part] = _measured(corners)
            side.planes[part, :3] = normals * np.where(normals @ _SIDE < 0, -1, 1)[:, None]
            side.planes[part, 3] = np.einsum("ij,ij->i", side.planes[part, :3], corners[:, 0])
        return side

    def corners(self, selection: slice | Indices) -> Reals:
        """Return the corners of some triangles (k, 3, 3)."""
        return np.asarray((self.mesh.vertices[self.mesh.triangles[selection]] - self.center) / self.size)

    def rest(self, is_cut: NDArray[np.bool_], corners: Reals, rounding: float) -> Mesh | None:
        """Return the triangles that were not cut, and others (k, 3, 3); None without area."""
        is_thin = ~is_cut & (self.heights <= _LEAST_HEIGHT * rounding)
        gone = is_cut | is_thin if self.areas[is_thin].sum() <= _BALANCE * self.areas.sum() else is_cut
        if gone.all() and not len(corners):
            return None
        vertices, numbers = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        return Mesh.from_checked(
            np.concatenate([self.mesh.vertices, vertices * self.size + self.center]),
            np.concatenate([self.mesh.triangles[~gone], numbers.reshape(-1, 3) + len(self.mesh.vertices)]),
        )


def _lengths(vectors: Reals) -> Reals:
    return np.asarray(np.sqrt(np.einsum("...i,...i", vectors, vectors)))


def _measured(corners: Reals) -> tuple[Reals, Reals, Reals]:
    """Return unit normals (k, 3), areas and least heights (k,) of triangles (k, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled, longest = _lengths(normals), _lengths(corners - corners[:, [1, 2, 0]]).max(axis=1)
    divisors = np.maximum([doubled, longest], np.finfo(np.float64).tiny)
    return normals / divisors[0, :, None], doubled / 2, doubled / divisors[1]


def _shared_planes(sides: Sequence[_Side], tolerance: float) -> tuple[Reals, list[Indices]]:
    """Return planes that both meshes have (p, 4), and the number of the plane of each triangle, or -1 (m,), of both."""
    # The planes of triangles much higher than the tolerance are known to this width. Curved meshes agree in few.
    width = np.sqrt(tolerance)
    chosen = [np.flatnonzero(side.heights >= 8 * width) for side in sides]
    rows = np.concatenate([side.planes[which] for side, which in zip(sides, chosen, strict=True)])
    is_second = np.arange(len(rows)) >= len(chosen[0])
    kept, cluster = np.arange(len(rows)), np.zeros(len(rows), dtype=np.int64)
    for weights in (_PROJECTION, *np.eye(4)):
        keys = rows[kept] @ weights
        order = np.lexsort((keys, cluster))
        kept, cluster, keys = kept[order], cluster[order], keys[order]
        cluster = np.cumsum((np.diff(cluster, prepend=0) > 0) | (np.diff(keys, prepend=keys[:1]) > width))
        in_both = np.bincount(cluster, is_second[kept]) * np.bincount(cluster, ~is_second[kept]) > 0
        kept, cluster = kept[in_both[cluster]], cluster[in_both[cluster]]
    cluster, of = np.unique(cluster, return_inverse=True)[1], [np.full(len(side.areas), -1) for side in sides]
    if not len(kept):
        return np.zeros((0, 4)), of
    halves, starts = (~is_second[kept], is_second[kept]), (0, len(chosen[0]))
    members = [which[kept[half] - start] for which, half, start in zip(chosen, halves, starts, strict=True)]
    corners = [side.corners(which) for side, which in zip(sides, members, strict=True)]
    planes = _planes_through(np.concatenate(corners), np.concatenate([cluster[half] for half in halves]))
    step = max(1, _MOST_PAIRS // (8 * len(planes)))
    for side, which, own, half, plane in zip(sides, members, corners, halves, of, strict=True):
        plane[which] = np.where(_heights_above(own, planes[cluster[half]]) <= tolerance, cluster[half], -1)
        small = np.flatnonzero((side.heights < 8 * width) & (side.areas > 0))
        small = small if len(small) * len(planes) <= _MOST_PAIRS else small[:0]
        for some in (small[part] for part in slices(len(small), step)):
            is_in = _heights_above(side.corners(some)[:, None], planes) <= tolerance
            is_in &= np.abs(side.planes[some, :3] @ planes[:, :3].T) >= _LEAST_COSINE
            plane[some] = np.where(is_in.any(axis=1), is_in.argmax(axis=1), -1)
    shared = np.intersect1d(of[0], of[1])
    shared = shared[shared >= 0]
    numbers = np.full(len(planes) + 1, -1)
    numbers[shared] = np.arange(len(shared))
    return planes[shared], [numbers[plane] for plane in of]


def _heights_above(corners: Reals, planes: Reals) -> Reals:
    """Return the largest distance (...) of the corners (..., 3, 3) of triangles from planes (..., 4)."""
    along = np.einsum("...ij,...j->...i", corners, planes[..., :3])
    return np.asarray(np.abs(along - planes[..., 3:]).max(axis=-1))


def _planes_through(corners: Reals, clusters: Indices) -> Reals:
    """Return the plane (p, 4) of each cluster through corners (k, 3, 3) that are far apart, so that it holds in all."""
    points, of = corners.reshape(-1, 3), np.repeat(clusters, 3)
    ends = np.cumsum(np.bincount(of)) - 1

    def farthest(distances: Reals) -> Reals:
        return np.asarray(points[np.lexsort((distances, of))[ends]])

    first = farthest(_lengths(points - farthest(np.zeros(len(of)))[of]))
    second = farthest(_lengths(points - first[of]))
    third = farthest(_lengths(np.cross(points - first[of], (second - first)[of])))
    normals = _measured(np.stack([first, second, third], axis=1))[0]
    return np.concatenate([normals, np.einsum("ij,ij->i", normals, first)[:, None]], axis=1)


@dataclass(frozen=True, eq=False)
class _Cut:
    """Numbers of planes that were cut, the area that was removed, the corners of both rests (k, 3, 3), and `Rests`."""

    planes: Indices
    removed: float
    rests: tuple[Reals, Reals]
    areas: Reals
    distances: Reals


def _cut(sides: Sequence[_Side], of: Sequence[Indices], planes: Reals, rounding: float) -> list[_Cut]:
    """Cut planes, whose numbers triangles have, or -1 (m,); those that GEOS refuses are left out."""
    if not len(planes):
        return []
    batches, cuts = [np.arange(len(planes))], []
    while batches:
        numbers = batches.pop()
        new = np.full(len(planes) + 1, -1)
        new[numbers] = np.arange(len(numbers))
        try:
            cuts.append(_cut_together(sides, [new[plane] for plane in of], planes[numbers], numbers, rounding))
        except GEOSException:
            batches += np.array_split(numbers, 2) if len(numbers) > 1 else []
    return cuts


def _cut_together(sides: Sequence[_Side], of: list[Indices], planes: Reals, numbers: Indices, rounding: float) -> _Cut:
    count, grid = len(planes), 2.0 ** np.floor(np.log2(_GRID * rounding))
    normals = planes[:, :3]
    # Along an axis where the plane is across one: then no coordinate is rounded.
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= _lengths(first)[:, None]
    frames = np.stack([first, np.cross(normals, first)], axis=1)
    sheets = [_Sheet.of(side, plane, planes, frames, grid) for side, plane in zip(sides, of, strict=True)]
    depth = max(sheet.layers.shape[1] for sheet in sheets)
    mine, others = (
        np.pad(layers, ((0, 0), (0, depth - layers.shape[1])), constant_values=shapely.Polygon())
        for layers in (sheets[0].layers, sheets[1].layers)
    )
    # Without corners on straight sides there are fewer triangles.
    remaining = (shapely.difference(*pair, grid_size=grid) for pair in ((mine, others), (others, mine)))
    rests = [shapely.simplify(polygons, rounding) for polygons in remaining]
    covered, left = ([shapely.area(one).sum(axis=1) for one in both] for both in ((mine, others), rests))
    before, after = sheets[0].areas + sheets[1].areas, left[0] + left[1]
    off = np.abs(covered[0] - covered[1] - left[0] + left[1])
    old, new, corners, rows = np.zeros(count), np.zeros(count), [], []
    for sheet, rest, whole, uncovered in zip(sheets, rests, covered, left, strict=True):
        triangles, number = shapely.get_parts(shapely.constrained_delaunay_triangles(rest.ravel()), return_index=True)
        row = number // depth
        lifted = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3] @ frames[row]
        lifted += (planes[row, 3:] * normals[row])[:, None]
        _, areas, heights = _measured(lifted)
        is_thick = heights > _LEAST_HEIGHT * rounding
        kept = _sums(row, areas * is_thick, count)
        off = np.maximum(off, np.maximum(np.abs(sheet.areas - whole), np.abs(kept - uncovered)))
        old, new = old + np.bincount(sheet.plane, minlength=count), new + np.bincount(row, is_thick, count)
        corners.append(lifted[is_thick])
        rows.append(row[is_thick])
    is_cut = (off <= _BALANCE * before) & (new * after <= old * before) & (after < (1 - _LEAST_FRACTION) * before)
    gaps = np.maximum(sheets[0].gaps, sheets[1].gaps)
    return _Cut(
        numbers[is_cut],
        float((before - after)[is_cut].sum()),
        (corners[0][is_cut[rows[0]]], corners[1][is_cut[rows[1]]]),
        2 * depth * before[is_cut],
        np.where(gaps > rounding, gaps, 0.0)[is_cut],
    )


@dataclass(frozen=True, eq=False)
class _Sheet:
    """One mesh, projected onto some planes.

    Attributes:
        plane: Number of the plane of each triangle (k,), in ascending order.
        areas: Area of the triangles in each plane (planes,).
        gaps: Largest distance of a corner from its plane (planes,).
        layers: Polygons, each inside the one before, that cover a plane as often as triangles do (planes, layers).
    """

    plane: Indices
    areas: Reals
    gaps: Reals
    layers: _Objects

    @classmethod
    def of(cls, side: _Side, of: Indices, planes: Reals, frames: Reals, grid: float) -> Self:
        """Return the sheet of the triangles of a mesh, from the number of the plane of each, or -1 (m,)."""
        which = np.flatnonzero(of >= 0)
        which = which[np.argsort(of[which], kind="stable")]
        plane, corners, count = of[which], side.corners(which), len(planes)
        polygons = shapely.polygons(corners @ frames[plane].transpose(0, 2, 1))
        areas = _sums(plane, shapely.area(polygons), count)
        gaps = np.zeros(count)
        np.maximum.at(gaps, plane, _heights_above(corners, planes[plane]))
        counts, sets = np.bincount(plane, minlength=count), shapely.multipolygons(polygons, indices=plane)
        of_planes = np.split(polygons, np.cumsum(counts)[:-1])
        for row in np.flatnonzero(counts > _MANY).tolist():
            with suppress(GEOSException):
                # It takes a sixth of the time, and holds where triangles share whole edges and do not overlap.
                merged = shapely.coverage_union_all(of_planes[row])
                sets[row] = merged if merged.is_valid else sets[row]
        unions = shapely.union_all(sets[:, None], axis=1)
        covered_often = np.flatnonzero(np.abs(shapely.area(unions) - areas) > _BALANCE * areas).tolist()
        stacks = {row: _stack(of_planes[row], float(_BALANCE * areas[row]), grid) for row in covered_often}
        layers = np.full((count, max([1, *map(len, stacks.values())])), shapely.Polygon(), dtype=object)
        layers[:, 0] = unions
        for row, stack in stacks.items():
            layers[row, : len(stack)] = stack
        return cls(plane, areas, gaps, layers)


def _sums(rows: Indices, values: Reals, count: int) -> Reals:
    """Return the sums (count,) of values by rows in ascending order: one by one, 200,000 like ones lose 4e-12."""
    starts, sums = np.flatnonzero(np.diff(rows, prepend=-1)), np.zeros(count)
    sums[rows[starts]] = np.add.reduceat(values, starts)
    return sums


def _stack(polygons: _Objects, slack: float, grid: float) -> list[Any]:
    """Return the parts of a plane that polygons cover at least once, twice and so on; none where these are many."""
    union = shapely.union_all(polygons, grid_size=grid)
    if len(polygons) == 1 or abs(float(shapely.area(polygons).sum()) - union.area) <= slack:
        return [union]
    half = len(polygons) // 2
    first, second = (_stack(some, slack, grid) for some in (polygons[:half], polygons[half:]))
    if not first or not second or len(first) + len(second) > _MOST_LAYERS:
        return []
    stack: list[Any] = []
    shared = partial(shapely.intersection, grid_size=grid)
    for depth in range(1, len(first) + len(second) + 1):
        # What both together cover so often: the one at least i times, and the other the times that are missing.
        pairs = [(i, depth - i) for i in range(max(0, depth - len(second)), min(depth, len(first)) + 1)]
        parts = [shared(first[i - 1], second[j - 1]) if i and j else [*second[:j], *first[:i]][-1] for i, j in pairs]
        polygons = shapely.get_parts(parts)
        stack.append(shapely.union_all(polygons[shapely.get_dimensions(polygons) == _FLAT], grid_size=grid))
    return [polygon for polygon in stack if polygon.area > slack]


def without_common_parts(surfaces: Sequence[Surface]) -> Mapping[int, Surface]:
    """Return one surface, or what two do not have in common, by their signs in the difference."""
    return without_common_faces(without_shared_triangles(surfaces))


def without_shared_triangles(surfaces: Sequence[Surface]) -> Mapping[int, Surface]:
    """Return one surface, or two without the triangles that both have, by their signs; nothing of equal formulas."""
    if not (meshes := two_meshes(surfaces)):
        return {} if surfaces[:1] == surfaces[1:] else dict(zip((1, -1), surfaces, strict=False))
    shared = shared_triangles(*(mesh.vertices[mesh.triangles] for mesh in meshes))
    if shared[0].any():
        meshes = [
            Mesh.from_checked(mesh.vertices, np.ascontiguousarray(mesh.triangles[~in_both]))
            for mesh, in_both in zip(meshes, shared, strict=True)
        ]
    return signed([mesh if len(mesh.triangles) and mesh.area > 0 else None for mesh in meshes])


def without_common_faces(different: Mapping[int, Surface]) -> Mapping[int, Surface]:
    """Return surfaces by their signs, two meshes without what `rests_of` finds in both."""
    meshes = two_meshes(different.values())
    return signed(rests_of(meshes[0], meshes[1]).meshes) if meshes else different


def two_meshes(surfaces: Iterable[Surface]) -> list[Mesh]:
    """Return the meshes among surfaces if there are two, else nothing: then there is nothing to leave out."""
    meshes = [surface for surface in surfaces if isinstance(surface, Mesh)]
    return meshes if len(meshes) == 2 else []


def signed(rests: Sequence[Mesh | None]) -> Mapping[int, Surface]:
    """Return what is left of two meshes by their signs in the difference."""
    return {sign: rest for sign, rest in zip((1, -1), rests, strict=True) if rest is not None}


def shared_triangles(first: Reals, second: Reals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which triangles (m, 3, 3) and (n, 3, 3) occur in both, as often, by hashes of their corners of 64 bits."""
    hashes, other_hashes = _triangle_hashes(first), _triangle_hashes(second)
    return _matched(hashes, other_hashes), _matched(other_hashes, hashes)


def _matched(hashes: NDArray[np.uint64], others: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which hashes occur among others; of equal ones, only as many as the others have."""
    from pandas import Series

    own = Series(hashes)
    return np.asarray(own.groupby(own).cumcount() < own.map(Series(others).value_counts()).fillna(0))


def _triangle_hashes(corners: Reals) -> NDArray[np.uint64]:
    """Return the sum of the hashes of the corners of each triangle (m,), which does not depend on their order."""
    from pandas.util import hash_array

    sums = np.empty(len(corners), dtype=np.uint64)
    for part in slices(len(corners), _BATCH):
        # Zero has two signs.
        columns = np.ascontiguousarray((corners[part] + 0.0).reshape(-1, 3).T).view(np.uint64)
        mixed = np.zeros(columns.shape[1], dtype=np.uint64)
        for column in columns:
            mixed = hash_array(mixed ^ column)
        sums[part] = mixed.reshape(-1, 3).sum(axis=1)
    return sums
