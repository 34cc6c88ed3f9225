"""Loops over the triangles of a mesh: what their errors have in common, and distances from them."""

import math

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.compiled import loop, part


@part
def _edges(vertices: Reals, triangle: Indices) -> tuple[float, float, float, float, float, float]:
    """Return the edges from the first corner to the second and to the third."""
    a, b, c = vertices[triangle[0]], vertices[triangle[1]], vertices[triangle[2]]
    return b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]


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


@part
def _square(corner: Reals, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point from the triangle of some corners (3, 3)."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = nx * nx + ny * ny + nz * nz
    is_above, least, height, longest = size > 0, 0.0, 0.0, -1.0
    for k in range(3):
        start, end = corner[k], corner[(k + 1) % 3]
        sx, sy, sz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
        ax, ay, az = x - start[0], y - start[1], z - start[2]
        length = sx * sx + sy * sy + sz * sz
        share = min(max((ax * sx + ay * sy + az * sz) / length, 0.0), 1.0) if length > 0 else 0.0
        rx, ry, rz = ax - share * sx, ay - share * sy, az - share * sz
        square = rx * rx + ry * ry + rz * rz
        least = square if k == 0 else min(least, square)
        # The normal of a thin triangle has few digits along it, and the rest is at right angles to its longest side.
        if length > longest:
            longest, height = length, rx * nx + ry * ny + rz * nz
        # Whether it lies on the inner side of this side: its direction outward is the side times the normal.
        ox, oy, oz = sy * nz - sz * ny, sz * nx - sx * nz, sx * ny - sy * nx
        is_above = is_above and ax * ox + ay * oy + az * oz <= 0
    return min(least, height * height / size) if is_above else least


@loop
def fill_squares(points: Reals, corners: Reals, triangles: Indices, squares: Reals) -> None:
    """Fill in squared distances (n,) of points (3, n), each from its triangle of corners (m, 3, 3)."""
    for i in range(len(triangles)):
        squares[i] = _square(corners[triangles[i]], points[0, i], points[1, i], points[2, i])


@loop
def search(points: Reals, corners: Reals, order: Indices, boxes: Reals, squares: Reals, closest: Indices) -> None:
    """Replace squared distances (n,) of points (n, 3), and the closest triangles, where those of a tree are closer.

    The tree has the boxes of i in 2i and 2i + 1, from that of all in 1 on. Those of triangles, in an order, are last.
    """
    count = len(order)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        node = 1
        while node:
            low, high = boxes[node, 0], boxes[node, 1]
            dx = max(low[0] - x, x - high[0], 0.0)
            dy = max(low[1] - y, y - high[1], 0.0)
            dz = max(low[2] - z, z - high[2], 0.0)
            if dx * dx + dy * dy + dz * dz < squares[i]:
                if node < count:
                    node *= 2
                    continue
                square = _square(corners[order[node - count]], x, y, z)
                if square < squares[i]:
                    squares[i], closest[i] = square, order[node - count]
            while node % 2:
                node //= 2
            node += node > 0
