"""Nodes that neighbouring triangles have in common, merged into one point each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.surfaces.mesh import Mesh

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]

# An edge and its triangle are sorted as one integer: twice the bits of a vertex and those of a triangle.
_BITS = 63


def merged_corners(mesh: Mesh, members: Indices) -> tuple[Reals, Reals]:
    """The corners of some triangles, each with a third of the areas that meet there.

    Returns:
        coordinates (3, n), in units of length; weights (n,), in squared units of length.
    """
    thirds = np.repeat(mesh.areas[members] / 3, 3)
    weights: Reals = np.bincount(mesh.triangles[members].ravel(), weights=thirds).astype(np.float64, copy=False)
    there = np.flatnonzero(weights)
    return np.ascontiguousarray(mesh.vertices[there].T), weights[there]


def merged_midpoints(mesh: Mesh, members: Indices) -> tuple[Reals, Reals]:
    """The edge midpoints of some triangles, each with a third of the areas that meet there.

    Returns:
        coordinates (3, n), in units of length; weights (n,), in squared units of length.
    """
    triangles, vertices = mesh.triangles[members], mesh.vertices
    triangle_bits = len(triangles).bit_length()
    if 2 * len(vertices).bit_length() + triangle_bits > _BITS:
        used, triangles = np.unique(triangles, return_inverse=True)
        vertices, triangles = vertices[used], triangles.reshape(-1, 3)
    bits = len(vertices).bit_length()
    numbers = np.arange(len(triangles))
    edges = np.empty((3, len(triangles)), dtype=np.int64)
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
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    weights = np.add.reduceat(thirds, starts)
    ends = ordered[starts]
    coordinates = np.empty((3, len(starts)))
    low, high = ends >> bits, ends & ((1 << bits) - 1)
    for axis in range(3):
        column = np.ascontiguousarray(vertices[:, axis])
        np.multiply(column[low] + column[high], 0.5, out=coordinates[axis])
    return coordinates, weights
