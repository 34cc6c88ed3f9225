"""Polygons cut into triangles, by rules that depend neither on the corner that a file lists first nor on its order."""

from typing import Any

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.parsing import Raw
from sobolev_batch.geometry.mesh import cross, cross_lengths, dot

# Polygons that are cut at a time: their corners and temporaries stay in cache.
_BATCH = 1 << 13
# Cosines that differ by less are equal: those of bends below a ten thousandth, which single precision may have made.
_EQUAL_COSINES = 1e-9
# Cosine in place of that beside a triangle without area: the other diagonal is better, even if it bends the face.
_NO_COSINE = -0.5
# Weights of the axes in the height of a vertex: no usual edge is at right angles to them, so that none lies level.
_AXES = (1.0, 0.618, 0.414)
# Faces that are bent by less, as a fraction of the size of the mesh, are flat: single precision rounds as much. Areas
# that differ by less, as a fraction, are equal, and those below a fraction of the squared size are rounding.
_FLAT, _EQUAL_AREAS, _NO_AREA = 1e-6, 1e-6, 1e-12
# The largest turn to the wrong side of a convex polygon, in radians, and error of the sum of all, in whole turns.
_WRONG_TURN, _WRONG_SUM = 1e-9, 1e-4
# Corners of an outline up to which it is cut by ears whatever it lies around, and how often a longer one may lie around
# a place: ears of others take the cube of its corners in time. Parts of its corners below levels that show it.
_MOST_WINDING, _MOST_AROUND, _LEVELS = 300, 3, np.arange(1, 16) / 16
# Of faces: heights above and below their planes, areas, those with another cut, and whether they cross themselves.
_Measures = list[tuple[Reals, Reals, Reals, NDArray[np.bool_]]]


def cut_polygons(vertices: NDArray[Any], corners: Indices, sizes: Indices) -> Raw:
    """Cut polygons into triangles (m, 3), those of each next to each other, and note what leaves their area open.

    A quadrilateral is cut along the diagonal at which it bends less, and of two equal ones from its lowest corner. A
    polygon of more corners is cut from its lowest corner if it is convex, and else by its ears, seen along its normal;
    holes may be joined to its outline by bridges. The vertices are (n, 3). The corners are vertex indices of all
    polygons, one after the other, the sizes their numbers.
    """
    if not len(sizes):
        points = f": its {len(vertices):,} vertices are points or lines; make a surface of them first"
        raise MeshError(f"the file has no faces{points * (len(vertices) > 0)}")
    short = np.flatnonzero(sizes < 3)
    if short.size:
        raise MeshError(f"face {short[0] + 1} has {sizes[short[0]]} vertices, expected three or more")
    if (sizes == 3).all():
        return Raw(vertices, corners.reshape(-1, 3))
    if corners.min() < 0 or corners.max() >= len(vertices):
        face = int(np.searchsorted(np.cumsum(sizes), np.argmax((corners < 0) | (corners >= len(vertices))), "right"))
        raise MeshError(f"face {face + 1} has an index outside 0..{len(vertices) - 1}")
    axes = [np.ascontiguousarray(axis, np.float64) for axis in vertices.T]
    # Vertices that no face uses may lie anywhere, and be no numbers.
    is_used = np.zeros(len(vertices), bool)
    is_used[corners] = True
    size = float(np.linalg.norm([np.ptp(axis[is_used]) for axis in axes]))
    found: _Measures = [(*np.zeros((3, 0)), np.zeros(0, bool))]
    if (sizes == 4).all():
        return Raw(vertices, _cut_quads(axes, corners.reshape(-1, 4), found), _notes(found, size, len(sizes)))
    starts, parts, owners = np.cumsum(sizes) - sizes, [], []
    for number in (3, 4):
        faces = np.flatnonzero(sizes == number)
        of_faces = corners[starts[faces, None] + np.arange(number)]
        parts.append(of_faces if number == 3 else _cut_quads(axes, of_faces, found))
        owners.append(faces.repeat(number - 2))
    others = np.flatnonzero(sizes > 4)
    for faces in (others[batch] for batch in slices(len(others), _BATCH)):
        own = sizes[faces]
        places = np.repeat(starts[faces] - np.cumsum(own) + own, own) + np.arange(own.sum())
        triangles, polygon = _cut_others(axes, corners[places], own, found)
        parts.append(triangles)
        owners.append(faces[polygon])
    order = np.argsort(np.concatenate(owners), kind="stable")
    return Raw(vertices, np.concatenate(parts)[order], _notes(found, size, len(sizes)))


def _notes(found: _Measures, size: float, faces: int) -> tuple[str, ...]:
    """Return what leaves the area of faces open, in words, from the size of the mesh and the number of faces."""
    heights, areas, others = (np.concatenate([one[i] for one in found]) for i in range(3))
    has_area = areas > _NO_AREA * size**2
    is_crossed = has_area & np.concatenate([one[3] for one in found])
    is_bent = has_area & ~is_crossed & (heights > _FLAT * size)
    notes = []
    if bent := np.count_nonzero(is_bent):
        notes.append(
            f"{bent:,} of {faces:,} faces are not flat: the other way to cut them moves them by up to "
            f"{heights[is_bent].max():.2g} and changes their area of {areas[is_bent].sum():.3g} by "
            f"{np.abs(areas - others)[is_bent].sum():.2g}"
        )
    if crossed := np.count_nonzero(is_crossed):
        notes.append(
            f"{crossed:,} of {faces:,} faces cross themselves or fold over, so that nothing tells their area; "
            f"{areas[is_crossed].sum():.3g} is counted"
        )
    return tuple(notes)


def _cut_quads(axes: list[Reals], quads: Indices, found: _Measures) -> Indices:
    """Return the triangles (2 k, 3) of quadrilaterals (k, 4)."""
    cut = quads.take([0, 1, 2, 0, 2, 3], axis=1)
    for part in slices(len(quads), _BATCH):
        edges = _edges(axes, quads[part])
        first, second = cross(edges[0], edges[1]), cross(edges[1], edges[2])
        product = dot(first, second)
        is_flat = product * np.abs(product) > (1 - 2 * _EQUAL_COSINES) * dot(first, first) * dot(second, second)
        rest = part.start + np.flatnonzero(~is_flat)
        if rest.size:
            turned = rest[_is_turned(axes, quads[rest], found)]
            cut[turned] = quads[turned].take([1, 2, 3, 1, 3, 0], axis=1)
    return cut.reshape(-1, 3)


def _edges(axes: list[Reals], quads: Indices) -> list[tuple[Reals, Reals, Reals]]:
    """Return the vectors from the first corner of each quadrilateral to the others, by their coordinates."""
    (a, *others), (x, y, z) = np.ascontiguousarray(quads.T), axes
    first = x.take(a), y.take(a), z.take(a)
    return [(x.take(one) - first[0], y.take(one) - first[1], z.take(one) - first[2]) for one in others]


def _is_turned(axes: list[Reals], quads: Indices, found: _Measures) -> NDArray[np.bool_]:
    """Tell which quadrilaterals (k, 4) are better cut from their second corner, and measure them."""
    b, c, d = (np.array(edge) for edge in _edges(axes, quads))
    # Twice the areas, with the normals, of the triangles abc, acd, bcd and abd.
    first, second, fourth = (np.array(cross(*pair)) for pair in ((b, c), (c, d), (b, d)))
    whole = first + second
    lengths = np.sqrt([dot(normal, normal) for normal in (first, second, whole - fourth, fourth, whole)])
    products = lengths[0] * lengths[1], lengths[2] * lengths[3]
    # Beside a triangle without area nothing bends, but the other diagonal is better if it does not fold the face.
    cosines = [
        np.divide(dot(one, other), product, out=np.full(len(quads), _NO_COSINE), where=product > 0)
        for one, other, product in zip((first, whole - fourth), (second, fourth), products, strict=True)
    ]
    heights = [sum(weight * axis[corner] for weight, axis in zip(_AXES, axes, strict=True)) for corner in quads.T]
    is_lower = np.minimum(heights[1], heights[3]) < np.minimum(heights[0], heights[2])
    gain = cosines[1] - cosines[0]
    turned: NDArray[np.bool_] = np.where(np.abs(gain) < _EQUAL_COSINES, is_lower, gain > 0)
    areas = [(lengths[0] + lengths[1]) / 2, (lengths[2] + lengths[3]) / 2]
    offsets = np.divide(np.abs(dot(whole, b)), lengths[4], out=np.zeros(len(quads)), where=lengths[4] > 0)
    found.append((offsets, np.where(turned, *areas[::-1]), np.where(turned, *areas), np.maximum(*cosines) < _NO_COSINE))
    return turned


def _cut_others(axes: list[Reals], corners: Indices, sizes: Indices, found: _Measures) -> tuple[Indices, Indices]:
    """Return the triangles (k, 3) of polygons of more than four corners, and the polygon of each triangle (k,)."""
    starts, polygon = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    begins, rank = starts[polygon], np.arange(len(corners)) - starts[polygon]
    corners = corners[begins + (rank + _lowest(axes, corners, starts, polygon)[polygon]) % sizes[polygon]]
    following = begins + (rank + 1) % sizes[polygon]
    # From a point nearby: far from the origin, the parts cancel.
    points = np.array([axis[corners] - axis[corners[begins]] for axis in axes])
    # A corner that is there several times in a row is one: between them, nothing tells how the outline turns.
    is_new = (points != points[:, following]).any(axis=0)
    left = np.bincount(polygon, is_new, len(sizes)).astype(np.int64)
    if ((left < sizes) & (left > 2)).any():
        return _cut_others(axes, corners[is_new | (left < 3)[polygon]], np.where(left < 3, sizes, left), found)
    # Newell's normals, of twice the area that the outline encloses along them.
    normals = np.add.reduceat(np.array(cross(points, points[:, following])), starts, axis=1)
    # Without the axis that is nearest to its normal, a polygon is as convex as along it.
    dropped = np.abs(normals).argmax(axis=0)
    twice = normals[dropped, np.arange(len(sizes))]
    plane = np.array([points[(dropped[polygon] + shift) % 3, np.arange(len(corners))] for shift in (1, 2)])
    turns = _turns(plane, following, np.sign(twice)[polygon])
    whole_turns = np.add.reduceat(turns, starts) / (2 * np.pi)
    is_convex = (np.minimum.reduceat(turns, starts) > -_WRONG_TURN) & (np.abs(whole_turns - 1) < _WRONG_SUM)
    # Where an outline turns back by half a turn, nothing tells the side to which it turns.
    winds = whole_turns - np.add.reduceat(turns > np.pi - _WRONG_TURN, starts) > 3 / 2
    # Coordinates that are no numbers are refused later.
    is_convex |= ~np.isfinite(np.add.reduceat(np.abs(points).sum(axis=0), starts))
    for one in np.flatnonzero(~is_convex & (sizes > _MOST_WINDING)):
        is_convex[one] = _most_around(*plane[:, starts[one] : starts[one] + sizes[one]]) > _MOST_AROUND
    triangles, owners = _fans_and_ears(plane, sizes, is_convex, twice)
    lengths = np.sqrt(dot(normals, normals))
    offsets = dot(points, normals[:, polygon] / np.where(lengths > 0, lengths, 1.0)[polygon])
    heights = np.maximum.reduceat(offsets, starts) - np.minimum.reduceat(offsets, starts)
    a, b, c = (points[:, corner] for corner in triangles.T)
    areas = np.bincount(owners, cross_lengths(b - a, c - a), len(sizes)) / 2
    u, v = plane[:, triangles[:, 1:]] - plane[:, triangles[:, :1]]
    in_plane = np.bincount(owners, np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), len(sizes))
    is_crossed = (np.abs(in_plane - np.abs(twice)) > _EQUAL_AREAS * in_plane) | winds | (twice == 0)
    found.append((heights, areas, lengths / 2, is_crossed))
    return corners[triangles], owners


def _lowest(axes: list[Reals], corners: Indices, starts: Indices, polygon: Indices) -> Indices:
    """Return the rank of the lowest corner of each polygon, from the places where they start."""
    heights = np.nan_to_num(sum(weight * axis[corners] for weight, axis in zip(_AXES, axes, strict=True)))
    lowest = np.flatnonzero(heights == np.minimum.reduceat(heights, starts)[polygon])
    return np.asarray(lowest[np.searchsorted(polygon[lowest], np.arange(len(starts)))] - starts)


def _turns(plane: Reals, following: NDArray[Any], side: Reals) -> Reals:
    """Return by how much outlines (2, n) turn at the corner behind each, in radians, positive to the side of each."""
    sides = plane[:, following] - plane
    nexts = sides[:, following]
    return np.asarray(np.arctan2((sides[0] * nexts[1] - sides[1] * nexts[0]) * side, (sides * nexts).sum(0)))


def _fans_and_ears(plane: Reals, sizes: Indices, is_convex: NDArray[np.bool_], twice: Reals) -> tuple[Indices, Indices]:
    """Return triangles (k, 3) of outlines (2, n), and their polygons (k,): fans of convex ones, and ears of others."""
    starts, owners = np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes - 2)
    ranks = np.arange(len(owners)) - (np.cumsum(sizes - 2) - (sizes - 2))[owners]
    fans = starts[owners, None] + np.stack([np.zeros_like(ranks), ranks + 1, ranks + 2], axis=1)
    parts, others = [fans[is_convex[owners]]], np.flatnonzero(~is_convex)
    for one in others:
        own = slice(starts[one], starts[one] + sizes[one])
        ears = mapbox_earcut.triangulate_float64(plane[:, own].T.copy(), np.array(sizes[one : one + 1], np.uint32))
        # All ears face the same side. Without any the outline encloses nothing.
        ears = ears.reshape(-1, 3)[:, :: 1 if twice[one] > 0 else -1].astype(np.int64) + starts[one]
        parts.append(ears if len(ears) else fans[owners == one])
    of_others = np.repeat(others, [len(part) for part in parts[1:]])
    return np.concatenate(parts), np.concatenate([owners[is_convex[owners]], of_others])


def _most_around(x: Reals, y: Reals) -> int:
    """Return how often an outline lies around a place, at most, where some levels cross it."""
    most, steps, rises, heights = 0, np.roll(x, -1) - x, np.roll(y, -1) - y, np.unique(y)
    for place in np.searchsorted(heights[:-1], np.quantile(y, _LEVELS), "right"):
        # Between corners, where sides do not meet.
        level = heights[place - 1 : place + 1].mean()
        is_below = y < level
        cut = np.flatnonzero(is_below != np.roll(is_below, -1))
        order = np.argsort(x[cut] + (level - y[cut]) / rises[cut] * steps[cut])
        most = max(most, np.abs(np.cumsum(np.where(is_below[cut[order]], 1, -1))).max(initial=0))
    return int(most)
