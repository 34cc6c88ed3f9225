"""The largest distance of pieces of triangles from many triangles of a mesh together, which cover them.

Seen along the normal of a piece, triangles that cover it have a point above or below each of its points, and no point
of the piece is farther from them than their largest height there.

They are gathered from one to the next, across each side that is seen within the piece. So the boundary of their sum
modulo 2 is seen beside the piece, and winds around all of its points equally often: where that is odd, all are covered.
Each piece is drawn together first, so that the mesh may turn away a little before the piece ends.
"""

import numpy as np

from sobolev_batch.arrays import Indices, Reals, slices
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.mesh import cross, dot

# Pieces at a time, steps from one triangle to the next, and pairs of a piece and a triangle in each, in some 600 bytes.
_PIECES, _STEPS, _PAIRS = 1 << 13, 256, 1 << 17
# Least square of twice an area, beside the fourth power of the size, and at all: coordinates overflow for less.
_THIN, _SMALL = 1e-12, 1e-200
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def cover_distances(corners: Reals, other: Triangles, starts: Indices, most: float) -> Reals:
    """Return how far points of pieces (3 corners, 3, n) are at most from triangles that cover them, in units of scale.

    Covers are searched from triangles close to the centers. It is infinite (n,) without one, or maybe above `most`.
    """
    if len(starts) > _PIECES:
        groups = slices(len(starts), _PIECES)
        return np.concatenate([cover_distances(corners[..., group], other, starts[group], most) for group in groups])
    center = corners.mean(axis=0)
    reach = np.sqrt(np.max([dot(arm, arm) for arm in corners - center], axis=0))
    # Points move by this within the plane, and heights are at right angles to it.
    move = np.minimum(most / 4, reach / 2)
    limits = np.sqrt(most**2 - move**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, c = center + (1 - move / reach) * (corners - center)
        normals = np.stack(cross(b - a, c - a))
        sizes = dot(normals, normals)
        # Barycentric coordinates of a point, and its height, are its products with these rows less an offset.
        rows = [np.stack(cross(normals, side)) / sizes for side in (c - b, a - c)] + [normals / np.sqrt(sizes)]
    offsets = [dot(row, point) for row, point in zip(rows, (b, c, a), strict=True)]
    planes = np.stack([*np.stack(rows, axis=1), np.stack(offsets)])
    largest, is_odd = np.zeros(len(reach)), np.zeros(len(reach), dtype=bool)
    is_open = ~(sizes > np.maximum(_THIN * reach**4, _SMALL))
    count = len(other.mesh.triangles)
    keys = np.flatnonzero(~is_open) * count + starts[~is_open]
    before = keys[:0]
    for _ in range(_STEPS):
        piece, triangle = np.divmod(keys, count)
        own = planes[:, :, piece]
        # A corner has the same digits in each of its triangles, so that sides of two of them cancel out.
        found = [dot(own[:3], corner[:, None, triangle]) - own[3] for corner in other.corners]
        within, heights = np.stack([[x, y, 1 - x - y] for x, y, _ in found]), np.stack([height for *_, height in found])
        most_here = np.abs(heights).max(axis=0)
        high = np.flatnonzero(most_here > limits[piece])
        most_here[high] = _heights_within(within[..., high], heights[:, high])
        np.maximum.at(largest, piece, most_here)
        is_open[piece[~(most_here <= limits[piece])]] = True
        # Which sides cross the ray that leads from the center through the first corner, beyond that corner.
        along, turn = within[:, 0] - 0.5, within[:, 1] - within[:, 2]
        size, is_left = np.abs(turn), turn > 0
        crosses = (is_left != is_left[_NEXT]) & (along * size[_NEXT] + along[_NEXT] * size > 0)
        is_odd ^= np.bincount(piece[np.logical_xor.reduce(crosses)], minlength=len(is_odd)) % 2 > 0
        is_beyond = within <= 0
        side, at = np.nonzero(~(is_beyond & is_beyond[_NEXT]).any(axis=1) & ~is_open[piece])
        is_open[piece[at[~other.is_paired[side, triangle[at]]]]] = True
        # Triangles are met again in the same step and in the two before.
        met = np.concatenate([before, keys, piece[at] * count + other.across[side, triangle[at]]])
        met, first = np.unique(met, return_index=True)
        before, keys = keys, met[first >= len(before) + len(keys)]
        is_open[keys[_PAIRS:] // count] = True
        keys = keys[:_PAIRS]
        if not len(keys):
            break
    is_open[keys // count] = True
    return np.where(is_odd & ~is_open, np.sqrt(largest**2 + move**2), np.inf)


def _heights_within(corners: Reals, heights: Reals) -> Reals:
    """Return the largest height (n,) that triangles have within their pieces, where no coordinate is negative.

    Corners have barycentric coordinates (3 corners, 3, n) and heights (3, n). Heights are largest where sides enter and
    leave the piece, or at its corners.
    """
    ends, changes = corners[_NEXT], heights[_NEXT] - heights
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        shares = corners / (corners - ends)
        enter = np.where(corners < 0, np.where(ends < 0, np.inf, shares), 0.0).max(axis=1)
        leave = np.where((ends < 0) & (corners >= 0), shares, 1.0).min(axis=1)
        at_sides = np.maximum(np.abs(heights + enter * changes), np.abs(heights + leave * changes))
        weights = np.stack(cross(corners[:, _NEXT], corners[:, _LAST]))
        weights /= weights.sum(axis=0)
        at_corners = np.abs((weights * heights[:, None]).sum(axis=0))
    at_sides[~(enter <= leave)] = 0.0
    at_corners[~(weights >= 0).all(axis=0)] = 0.0
    return np.asarray(np.maximum(at_sides, at_corners).max(axis=0))
