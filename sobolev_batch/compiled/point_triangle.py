"""The loop over pairs of a point and a triangle that gives their squared distances: see `geometry.closest`."""

from __future__ import annotations

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.compiled import loop


@loop
def fill_squares(points: Reals, corners: Reals, triangles: Indices, squares: Reals) -> None:
    """Fill in squared distances (n,) of points (3, n), each from its triangle of corners (m, 3, 3)."""
    for i in range(len(triangles)):
        corner = corners[triangles[i]]
        x, y, z = points[0, i], points[1, i], points[2, i]
        ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
        vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        size = nx * nx + ny * ny + nz * nz
        is_above, least, height = size > 0, 0.0, 0.0
        for k in range(3):
            start, end = corner[k], corner[(k + 1) % 3]
            sx, sy, sz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
            ax, ay, az = x - start[0], y - start[1], z - start[2]
            length = sx * sx + sy * sy + sz * sz
            share = min(max((ax * sx + ay * sy + az * sz) / length, 0.0), 1.0) if length > 0 else 0.0
            rx, ry, rz = ax - share * sx, ay - share * sy, az - share * sz
            square = rx * rx + ry * ry + rz * rz
            least = square if k == 0 else min(least, square)
            height = ax * nx + ay * ny + az * nz
            # Whether it lies on the inner side of this side: its direction outward is the side times the normal.
            ox, oy, oz = sy * nz - sz * ny, sz * nx - sx * nz, sx * ny - sy * nx
            is_above = is_above and ax * ox + ay * oy + az * oz <= 0
        squares[i] = min(least, height * height / size) if is_above else least
