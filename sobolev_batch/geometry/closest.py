"""Distances of points from the triangles of a mesh, the closest ones and the sides, found by libigl's tree of boxes."""

import os
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.compiled import pays
from sobolev_batch.geometry.mesh import Mesh, cross, dot

# libigl starts a thread on each core unless this variable says otherwise. Numerical libraries all know the other one,
# by which a worker has one thread.
os.environ.setdefault("IGL_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", str(os.cpu_count() or 1)))

import igl  # it reads the variable once

# Processor seconds of a pair of a point and a triangle in arrays; a compiled loop takes a tenth.
_PAIR_SECONDS = 4e-7
# Height of a triangle over its longest side below which libigl may be far off: it loses the digits of its square.
_THIN = 0.01
# Cosine of the angle to a pseudonormal below which rounding may have chosen the side of a point, and distance from the
# surface, in its size, below which rounding may have chosen whether it winds around a point.
_UNCLEAR, _NEAR = 1e-6, 1e-6


class Triangles:
    """The triangles of a mesh, with what the distance of a point from each of them takes.

    Lengths are in units of a power of two near the largest coordinate: no digit is lost, and no square overflows.

    Attributes:
        scale: The unit.
        corners: Corner of each triangle, three arrays (3, m) of the coordinates.
        outward: For each side, from a corner to the next, the direction (3, m) in the plane that leads out of the
            triangle; of any length, and zero where the triangle has no area.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.scale = 2.0 ** float(np.frexp(np.abs(mesh.vertices).max())[1])
        self.mesh = mesh
        self._vertices = np.ascontiguousarray(mesh.vertices / self.scale)
        self._triangles = np.ascontiguousarray(mesh.triangles, dtype=np.int64)
        self._by_triangle = self._vertices[self._triangles]
        self.corners = [np.ascontiguousarray(self._vertices[self._triangles[:, k]].T) for k in range(3)]
        a, b, c = self.corners
        self._sides = [b - a, c - b, a - c]
        self._normals = np.stack(cross(self._sides[0], c - a))
        self.outward = [np.stack(cross(side, self._normals)) for side in self._sides]
        sizes, lengths = dot(self._normals, self._normals), np.stack([dot(side, side) for side in self._sides])
        self._has_area, self._thin = sizes > 0, np.flatnonzero(sizes < (_THIN * lengths.max(axis=0)) ** 2)
        self._inverse_sizes, self._inverse_lengths = _inverse(sizes), _inverse(lengths)
        self._longest = lengths.argmax(axis=0)

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self._vertices, self._triangles)
        return tree

    @cached_property
    def _boxes_of_thin(self) -> tuple[Indices, Reals]:
        """Thin triangles (n,), some of them twice, and the boxes (2n, 2 ends, 3) of a tree; see `search`."""
        order = np.resize(self._thin, (1, 1 << (len(self._thin) - 1).bit_length()))
        centers = self._by_triangle.mean(axis=1)
        while order.shape[1] > 1:
            places = centers[order]
            widest = np.ptp(places, axis=1).argmax(axis=1)[:, None, None]
            sorted_along = np.take_along_axis(places, widest, axis=2)[..., 0].argsort(axis=1, kind="stable")
            order = np.take_along_axis(order, sorted_along, axis=1).reshape(2 * len(order), -1)
        corners = self._by_triangle[order.ravel()]
        levels = [np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)]
        while len(levels[0]) > 1:
            pairs = levels[0].reshape(-1, 2, 2, 3)
            levels.insert(0, np.stack([pairs[:, :, 0].min(axis=1), pairs[:, :, 1].max(axis=1)], axis=1))
        return order.ravel(), np.concatenate([levels[0], *levels])

    @cached_property
    def across(self) -> Indices:
        """For each side, the triangle on its other side; the triangle itself where there is none (3, m)."""
        return np.where(self._adjacency[0] < 0, np.arange(len(self._triangles)), self._adjacency[0])

    @cached_property
    def is_paired(self) -> NDArray[np.bool_]:
        """For each side, whether it is one of a single pair of triangles that both name each other (3, m)."""
        found, sides = self._adjacency
        is_named = (found[sides, found] == np.arange(found.shape[1])) & (sides[sides, found] == np.arange(3)[:, None])
        return np.asarray((found >= 0) & is_named)

    @cached_property
    def _adjacency(self) -> tuple[Indices, Indices]:
        """For each side, the triangle across it, and which of its sides that is; -1 where there is none (3, m)."""
        found, sides = igl.triangle_triangle_adjacency(self._triangles)
        return found.T, sides.T

    def closest(self, points: Reals) -> tuple[Reals, Indices]:
        """Return the distance of points (n, 3) from the mesh, exact to rounding, and the triangle closest to each."""
        scaled = np.ascontiguousarray(points / self.scale)
        triangles = np.reshape(self._tree.squared_distance(self._vertices, self._triangles, scaled)[1], -1)
        squares = self.squares(scaled.T, triangles)
        if len(self._thin):
            from sobolev_batch.compiled.triangles import search

            search(scaled, self._by_triangle, *self._boxes_of_thin, squares, triangles)
        return self.scale * np.sqrt(squares), triangles

    def squares(self, points: Reals, triangles: Indices) -> Reals:
        """Return the squared distance of points (3, n) from triangles (n,), each from its own, in units of the scale.

        A point in the plane of its triangle, and within it, has exactly the distance zero.
        """
        if pays(_PAIR_SECONDS * len(triangles)):
            from sobolev_batch.compiled.triangles import fill_squares

            squares = np.empty(len(triangles))
            fill_squares(points, self._by_triangle, triangles, squares)
            return squares
        is_above = self._has_area[triangles]
        least, from_longest = np.full(len(triangles), np.inf), np.zeros_like(points)
        for k, (corners, sides, inverse, outward) in enumerate(
            zip(self.corners, self._sides, self._inverse_lengths, self.outward, strict=True)
        ):
            arms, along = points - corners[:, triangles], sides[:, triangles]
            rest = arms - np.clip(dot(arms, along) * inverse[triangles], 0.0, 1.0) * along
            least = np.minimum(least, dot(rest, rest))
            is_above &= dot(arms, outward[:, triangles]) <= 0
            from_longest = np.where(self._longest[triangles] == k, rest, from_longest)
        # The normal of a thin triangle has few digits along it, and the rest is at right angles to its longest side.
        heights = dot(from_longest, self._normals[:, triangles]) ** 2 * self._inverse_sizes[triangles]
        return np.where(is_above, np.minimum(least, heights), least)

    def squared_heights(self, points: Reals, triangles: Indices) -> Reals:
        """Return the squared distance of points (3, n) from the planes of triangles (n,)."""
        arms = points - self.corners[0][:, triangles]
        return np.asarray(dot(arms, self._normals[:, triangles]) ** 2 * self._inverse_sizes[triangles])


def signs(mesh: Mesh, points: Reals) -> Reals | None:
    """Return 1 for each point (n, 3) outside of a mesh, and -1 for each one inside; None where the mesh has no sides.

    It has some if its triangles are oriented consistently, once vertices of the same place are one. Outside of an open
    mesh is the side that triangles face, and what lies beyond its border in its plane. Sources: J. A. Baerentzen, H.
    Aanaes, "Signed distance computation using the angle weighted pseudonormal" (2005), doi:10.1109/TVCG.2005.49; G.
    Barill et al., "Fast winding numbers for soups and clouds" (2018), doi:10.1145/3197517.3201337, for closed meshes.
    """
    own = mesh.merged or mesh
    if any(own.counts[f"{kind}_edges"] for kind in ("nonmanifold", "inconsistent")):
        return None
    # Far from the origin and for large or small coordinates, digits would be lost.
    origin = own.vertices[own.triangles[0, 0]]
    vertices, places = own.vertices - origin, points - origin
    scale = 2.0 ** float(np.frexp(np.abs(vertices).max())[1])
    corners, triangles = vertices / scale, np.ascontiguousarray(own.triangles, dtype=np.int64)
    by_pseudonormals = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    signed, _, closest, across = igl.signed_distance(places / scale, corners, triangles, by_pseudonormals)
    is_inside = (np.reshape(signed, -1) < 0) != (own.volume < 0)
    # In the plane of a face that ends before, and beside a sliver that may be folded back, a normal tells no side.
    arms, across = (places / scale - np.reshape(closest, (-1, 3))).T, np.reshape(across, (-1, 3)).T
    is_unclear = np.abs(dot(arms, across)) < _UNCLEAR * np.sqrt(dot(arms, arms) * dot(across, across))
    if own.counts["boundary_edges"]:
        # Beyond the border of a flat sheet is outside.
        is_inside &= ~is_unclear
    else:
        # Parts may lie within others, overlap, or be turned inside out.
        is_unclear |= dot(arms, arms) > _NEAR**2
        turns = igl.fast_winding_number(corners, triangles, places[is_unclear] / scale)
        is_inside[is_unclear] = np.abs(np.reshape(turns, -1)) > 1 / 2
    return np.where(is_inside, -1.0, 1.0)


def _inverse(values: Reals) -> Reals:
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)
