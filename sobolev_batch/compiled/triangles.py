"""Loops over the triangles of a mesh: distances of points from them."""

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.compiled import loop, part


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
