"""Nodes that neighbouring triangles share, merged into one point each."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sobolev_batch.spectral.backends.arrays import Array, sums_of_runs

# An edge and its triangle are sorted as one integer, which takes twice the bits of a vertex and those of a triangle.
_BITS = 63


class Faces(Protocol):
    """The arrays of a mesh that points are made from, on any backend."""

    @property
    def vertices(self) -> Array:
        """float64 (n, 3), in units of length."""

    @property
    def triangles(self) -> Array:
        """int64 (m, 3)."""

    @property
    def areas(self) -> Array:
        """float64 (m,), in squared units of length."""


def merged_corners(mesh: Faces, members: Array) -> tuple[Array, Array]:
    """Return the corners of some triangles, each with a third of the areas that meet there.

    Returns:
        Coordinates (3, n), in units of length, and weights (n,), in squared units of length.
    """
    thirds = np.repeat(mesh.areas[members] / 3, 3)
    weights = np.bincount(mesh.triangles[members].ravel(), weights=thirds).astype(np.float64, copy=False)
    corners = np.flatnonzero(weights)
    return np.ascontiguousarray(mesh.vertices[corners].T, like=weights), weights[corners]


def merged_midpoints(mesh: Faces, members: Array) -> tuple[Array, Array]:
    """Return the edge midpoints of some triangles, each with a third of the areas that meet there.

    Returns:
        Coordinates (3, n), in units of length, and weights (n,), in squared units of length.
    """
    triangles, vertices = mesh.triangles[members], mesh.vertices
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
    thirds = (mesh.areas[members] / 3)[ordered & ((1 << triangle_bits) - 1)]
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
