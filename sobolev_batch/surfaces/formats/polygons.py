"""Polygons cut into triangles, and vertices merged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import MeshError


def triangle_fans(corners: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut each polygon into the fan of triangles around its first corner, exact for convex ones.

    Args:
        corners: Vertex indices of all polygons, one after the other.
        sizes: Number of corners of each polygon.

    Returns:
        Vertex indices of triangles (m, 3), int64; those of a polygon lie next to each other.

    Raises:
        MeshError: There are no polygons, or one has fewer than three corners.
    """
    if not len(sizes):
        raise MeshError("the file has no faces")
    _check_sizes(sizes)
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    first, rank = _places(sizes)
    return np.stack([corners[first], corners[first + rank + 1], corners[first + rank + 2]], axis=1)


def triangle_strips(corners: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut each strip of triangles into these, all turned the same way.

    Args:
        corners: Vertex indices of all strips, one after the other.
        sizes: Number of corners of each strip.

    Returns:
        Vertex indices of triangles (m, 3), int64.

    Raises:
        MeshError: A strip has fewer than three corners.
    """
    _check_sizes(sizes)
    first, rank = _places(sizes)
    start, odd = first + rank, rank % 2
    return np.stack([corners[start + odd], corners[start + 1 - odd], corners[start + 2]], axis=1)


def triangle_fans_of_lists(polygons: Sequence[ArrayLike]) -> NDArray[np.int64]:
    """Cut polygons, each a sequence of vertex indices, as `triangle_fans` does."""
    if not len(polygons):
        raise MeshError("the file has no faces")
    sizes = np.array([len(np.asarray(polygon)) for polygon in polygons], dtype=np.int64)
    return triangle_fans(np.concatenate([np.asarray(polygon, dtype=np.int64) for polygon in polygons]), sizes)


def merge_coincident(
    vertices: NDArray[np.floating], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Merge vertices with exactly the same coordinates, for formats that repeat them."""
    if not np.isfinite(vertices).all():
        # The mesh refuses them and names the entries.
        return vertices, triangles
    merged, indices = np.unique(vertices, axis=0, return_inverse=True)
    return merged, indices.reshape(-1)[triangles]


def _check_sizes(sizes: NDArray[np.int64]) -> None:
    short = np.flatnonzero(sizes < 3)
    if short.size:
        raise MeshError(f"face {short[0] + 1} has {sizes[short[0]]} vertices, expected three or more")


def _places(sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return, for each triangle of polygons or strips, the place of the first corner and its rank among them."""
    starts = np.cumsum(sizes) - sizes
    polygon = np.repeat(np.arange(len(sizes)), sizes - 2)
    rank = np.arange(len(polygon)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2)
    return starts[polygon], rank
