"""The connected parts of a mesh, which of them lie inside others, and the loops of its boundary."""

import igl
import numpy as np

from sobolev_batch.geometry.mesh import Mesh

# Among more parts, none are looked for inside others.
_MOST_PARTS = 1000


def nested_parts(mesh: Mesh) -> int:
    """Return how many parts, which share no vertices, others wind around; zero where there are more than 1000 parts.

    >>> import numpy as np
    >>> import sobolev_batch as sb
    >>> ball = sb.shapes.icosphere(1)
    >>> vertices, triangles = [np.concatenate([ball.vertices, ball.vertices / 2]), np.tile(ball.triangles, (2, 1))]
    >>> triangles[80:] += 42
    >>> nested_parts(sb.Mesh(vertices, triangles))
    1
    """
    parts = igl.vertex_components(mesh.triangles)[mesh.triangles[:, 0]]
    order = np.argsort(parts, kind="stable")
    starts = np.flatnonzero(np.diff(parts[order], prepend=-1))
    if not 1 < len(starts) <= _MOST_PARTS:
        return 0
    triangles, corners = mesh.triangles[order], mesh.vertices[mesh.triangles[order]]
    lower, upper = np.minimum.reduceat(corners.min(axis=1), starts), np.maximum.reduceat(corners.max(axis=1), starts)
    points, is_inside = corners[starts, 0], np.zeros(len(starts), bool)
    for part, own in enumerate(np.split(triangles, starts[1:])):
        others = np.flatnonzero(~is_inside & (lower > lower[part]).all(axis=1) & (upper < upper[part]).all(axis=1))
        if others.size:
            is_inside[others] = np.abs(igl.fast_winding_number(mesh.vertices, own, points[others])) > 1 / 2
    return int(np.count_nonzero(is_inside))


def boundary_loops(mesh: Mesh) -> int:
    """Return how many parts, which share no vertices, the open edges form, such as the rims of holes.

    >>> import sobolev_batch as sb
    >>> ball = sb.shapes.icosphere(2)
    >>> boundary_loops(ball), boundary_loops(sb.Mesh(ball.vertices, ball.triangles[4:-4]))
    (0, 2)
    """
    edges = igl.boundary_facets(mesh.triangles)[0]
    return len(np.unique(igl.vertex_components(edges)[edges[:, 0]])) if len(edges) else 0
