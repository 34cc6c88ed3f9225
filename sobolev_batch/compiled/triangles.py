"""Loops over the triangles of a mesh: their sizes, what their errors have in common, and the edges that they share."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.compiled import Indices, Reals, loop, part

Vertices = NDArray[np.uint32]


@part
def _edges(vertices: Reals, triangle: Indices) -> tuple[float, float, float, float, float, float]:
    """Return the edges from the first corner to the second and to the third."""
    a, b, c = vertices[triangle[0]], vertices[triangle[1]], vertices[triangle[2]]
    return b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]


@loop
def measure(vertices: Reals, triangles: Indices, squares: Reals) -> None:
    """Fill in the squares of twice the area, of three times the centroid radius, and of the three sides (5, k)."""
    for i in range(len(triangles)):
        ux, uy, uz, vx, vy, vz = _edges(vertices, triangles[i])
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        squares[0, i] = nx * nx + ny * ny + nz * nz
        x, y, z = ux + vx, uy + vy, uz + vz
        largest = x * x + y * y + z * z
        x, y, z = ux + ux - vx, uy + uy - vy, uz + uz - vz
        largest = max(largest, x * x + y * y + z * z)
        x, y, z = vx + vx - ux, vy + vy - uy, vz + vz - uz
        squares[1, i] = max(largest, x * x + y * y + z * z)
        x, y, z = vx - ux, vy - uy, vz - uz
        squares[2, i] = ux * ux + uy * uy + uz * uz
        squares[3, i] = x * x + y * y + z * z
        squares[4, i] = vx * vx + vy * vy + vz * vz


@loop
def third_moments(vertices: Reals, triangles: Indices, areas: Reals) -> tuple[float, float]:
    """Return the norm of the sum of third moments, times areas, and the sum of their norms, in one unit of moments."""
    total = s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = 0.0
    for i in range(len(triangles)):
        ux, uy, uz, vx, vy, vz = _edges(vertices, triangles[i])
        x, y, z = ux + vx, uy + vy, uz + vz
        bx, by, bz, cx, cy, cz = 3 * ux - x, 3 * uy - y, 3 * uz - z, 3 * vx - x, 3 * vy - y, 3 * vz - z
        xx, yy, zz = bx * cx, by * cy, bz * cz
        xy, yz, zx = bx * cy + by * cx, by * cz + bz * cy, bz * cx + bx * cz
        m0, m1, m2 = 3 * x * xx, 3 * y * yy, 3 * z * zz
        m3, m4, m5 = x * xy + y * xx, y * yz + z * yy, z * zx + x * zz
        m6, m7, m8 = x * zx + z * xx, y * xy + x * yy, z * yz + y * zz
        m9 = x * yz + y * zx + z * xy
        square = m3 * m3 + m4 * m4 + m5 * m5 + m6 * m6 + m7 * m7 + m8 * m8
        weight = areas[i]
        total += weight * math.sqrt(m0 * m0 + m1 * m1 + m2 * m2 + 3 * square + 1.5 * m9 * m9)
        s0, s1, s2, s3, s4 = s0 + weight * m0, s1 + weight * m1, s2 + weight * m2, s3 + weight * m3, s4 + weight * m4
        s5, s6, s7, s8, s9 = s5 + weight * m5, s6 + weight * m6, s7 + weight * m7, s8 + weight * m8, s9 + weight * m9
    square = s3 * s3 + s4 * s4 + s5 * s5 + s6 * s6 + s7 * s7 + s8 * s8
    return math.sqrt(s0 * s0 + s1 * s1 + s2 * s2 + 3 * square + 1.5 * s9 * s9), total


@loop
def add_to_classes(radii: Reals, areas: Reals, edges: Reals, sums: Reals) -> None:
    """Add areas and squared areas to the sums (2, n) of the class between whose edges (n + 1,) each radius lies."""
    for i in range(len(radii)):
        number = 0
        while number < sums.shape[1] - 1 and radii[i] > edges[number + 1]:
            number += 1
        sums[0, number] += areas[i]
        sums[1, number] += areas[i] * areas[i]


@loop
def merge_edges(corners: Indices, areas: Reals, vertex_count: int) -> tuple[Vertices, Vertices, Reals]:
    """Return the lesser and the greater vertex of the edges (n,) of triangles (3, m), and the sums of their areas (n,).

    Edges are sorted by the greater vertex, and then by the lesser one: both times by counting, for they are integers.
    """
    count = 3 * corners.shape[1]
    low_places, high_places = np.zeros(vertex_count + 1, dtype=np.int64), np.zeros(vertex_count + 1, dtype=np.int64)
    for i in range(corners.shape[1]):
        for side in range(3):
            p, q = corners[side, i], corners[(side + 1) % 3, i]
            low_places[min(p, q) + 1] += 1
            high_places[max(p, q) + 1] += 1
    for vertex in range(vertex_count):
        low_places[vertex + 1] += low_places[vertex]
        high_places[vertex + 1] += high_places[vertex]
    lows, weights = np.empty(count, dtype=np.uint32), np.empty(count)
    for i in range(corners.shape[1]):
        for side in range(3):
            p, q = corners[side, i], corners[(side + 1) % 3, i]
            place = high_places[max(p, q)]
            high_places[max(p, q)] += 1
            lows[place], weights[place] = min(p, q), areas[i]
    highs, sums, first = np.empty(count, dtype=np.uint32), np.empty(count), 0
    # Each place has moved on to the end of its vertex.
    for high in range(vertex_count):
        for n in range(first, high_places[high]):
            place = low_places[lows[n]]
            low_places[lows[n]] += 1
            highs[place], sums[place] = high, weights[n]
        first = high_places[high]
    first, last = 0, -1
    for low in range(vertex_count):
        for n in range(first, low_places[low]):
            if n > first and highs[n] == highs[last]:
                sums[last] += sums[n]
            else:
                last += 1
                lows[last], highs[last], sums[last] = low, highs[n], sums[n]
        first = low_places[low]
    return lows[: last + 1], highs[: last + 1], sums[: last + 1]
