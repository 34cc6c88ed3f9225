"""Counts of unusual triangles and edges of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Triangles that are sorted at a time.
_BATCH = 1 << 14
# Odd numbers without pattern, which spread three indices over 64 bits.
_MIXERS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC2B2AE3D27D4EB4F)


@dataclass(frozen=True)
class MeshCounts:
    """Counts of what is unusual about a mesh. All of it is legitimate in a surface measure, none is repaired.

    Attributes:
        zero_area: Number of triangles whose area is zero to double precision.
        duplicate: Number of triangles that repeat the three vertices of an earlier one, in any orientation.
        boundary_edges: Number of edges of exactly one triangle.
        nonmanifold_edges: Number of edges of more than two triangles.
    """

    zero_area: int
    duplicate: int
    boundary_edges: int
    nonmanifold_edges: int


def boundary_and_nonmanifold_edges(triangles: NDArray[np.int64], vertex_count: int) -> tuple[int, int]:
    """Return the numbers of edges of exactly one triangle and of more than two."""
    keys = np.empty(3 * len(triangles), dtype=np.int64)
    for start in range(0, len(triangles), _BATCH):
        low, middle, high = np.sort(triangles[start : start + _BATCH], axis=1).T
        batch_keys = keys[3 * start : 3 * (start + len(low))].reshape(3, -1)
        # A triangle that repeats a vertex has fewer than three edges, each once.
        batch_keys[0] = np.where(low == middle, -1, low * vertex_count + middle)
        batch_keys[1] = np.where(middle == high, -1, middle * vertex_count + high)
        batch_keys[2] = np.where((low == middle) | (middle == high), -1, low * vertex_count + high)
    keys.sort()
    keys = keys[np.searchsorted(keys, 0) :]
    if not keys.size:
        return 0, 0
    repeats = np.concatenate([[False], keys[1:] == keys[:-1], [False, False]])
    first, second, third = ~repeats[:-2], repeats[1:-1], repeats[2:]
    return int(np.count_nonzero(first & ~second)), int(np.count_nonzero(first & second & third))


def duplicate_triangles(triangles: NDArray[np.int64]) -> int:
    """Return the number of triangles that repeat the three vertices of an earlier one."""
    hashes = np.empty(len(triangles), dtype=np.uint64)
    for start in range(0, len(triangles), _BATCH):
        low, middle, high = np.sort(triangles[start : start + _BATCH], axis=1).astype(np.uint64).T
        hashes[start : start + len(low)] = (low * _MIXERS[0] + middle) * _MIXERS[1] + high
    ordered = np.sort(hashes)
    repeated = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    if not repeated.size:
        return 0
    # Different triangles may have one hash, so those with a repeated hash are compared themselves.
    nearest = np.minimum(np.searchsorted(repeated, hashes), len(repeated) - 1)
    candidates = np.sort(triangles[repeated[nearest] == hashes], axis=1)
    return len(candidates) - len(np.unique(candidates, axis=0))
