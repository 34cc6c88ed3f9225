"""Counts of unusual triangles and edges of a mesh, and triangles that two meshes share."""

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


def shared_triangles(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which triangles of two meshes occur in both, in any orientation, each as often in one as in the other.

    Args:
        first: Corners of the triangles of one mesh, float64 (m, 3, 3).
        second: Corners of the triangles of the other mesh, float64 (n, 3, 3).
    """
    in_first, in_second = np.zeros(len(first), dtype=bool), np.zeros(len(second), dtype=bool)
    # Most triangles that only one mesh has are told apart by a sum that needs no order of the corners.
    sums, other_sums = _hash_sums(first), _hash_sums(second)
    candidates, others = np.flatnonzero(_occurs(sums, other_sums)), np.flatnonzero(_occurs(other_sums, sums))
    in_first[candidates], in_second[others] = _matched(first[candidates], second[others])
    return in_first, in_second


def _matched(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the same as `shared_triangles`, of triangles that may well occur in both."""
    (own, own_keys), (others, other_keys) = _ordered_corners(first), _ordered_corners(second)
    order, other_order = np.argsort(own_keys, kind="stable"), np.argsort(other_keys, kind="stable")
    sorted_keys, sorted_others = own_keys[order], other_keys[other_order]
    # The k-th of equal triangles is matched with the k-th of the other mesh.
    rank = np.arange(len(order)) - np.searchsorted(sorted_keys, sorted_keys, "left")
    match = np.searchsorted(sorted_others, sorted_keys, "left") + rank
    exists = match < np.searchsorted(sorted_others, sorted_keys, "right")
    places, other_places = order[exists], other_order[match[exists]]
    equal = np.all(own[places] == others[other_places], axis=(1, 2))
    in_first, in_second = np.zeros(len(first), dtype=bool), np.zeros(len(second), dtype=bool)
    in_first[places[equal]] = in_second[other_places[equal]] = True
    return in_first, in_second


def _occurs(keys: NDArray[np.uint64], others: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which keys occur among others. NumPy's own function takes three times as long for 64-bit keys."""
    ordered = np.sort(others)
    return np.asarray(ordered[np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)] == keys)


def _ordered_corners(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    """Return corners in an order that does not depend on that of the mesh, and a hash of each triangle."""
    hashes = _corner_hashes(corners)
    order = np.argsort(hashes, axis=1, kind="stable")
    low, middle, high = np.take_along_axis(hashes, order, axis=1).T
    return np.take_along_axis(corners, order[:, :, None], axis=1), (low * _MIXERS[0] + middle) * _MIXERS[1] + high


def _hash_sums(corners: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the sum of the hashes of the corners of each triangle (m,), which does not depend on their order."""
    sums = np.empty(len(corners), dtype=np.uint64)
    for start in range(0, len(corners), _BATCH):
        sums[start : start + _BATCH] = _corner_hashes(corners[start : start + _BATCH]).sum(axis=1)
    return sums


def _corner_hashes(corners: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a hash of each corner, uint64 (m, 3)."""
    # Zero has two signs.
    bits = np.ascontiguousarray(corners + 0.0).view(np.uint64)
    x, y, z = np.moveaxis(bits ^ (bits >> np.uint64(29)), -1, 0)
    hashes: NDArray[np.uint64] = ((x * _MIXERS[0] + y) * _MIXERS[1] + z) * _MIXERS[0]
    hashes ^= hashes >> np.uint64(32)
    return hashes
