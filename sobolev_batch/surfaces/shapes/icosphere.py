"""Icosahedral triangulations of the unit sphere."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.subdivision import subdivided

# 20 * 4^12 is 335 million triangles, some 24 GB of indices and corners: a finer level is a typing error.
FINEST_LEVEL = 12


def icosphere(level: int) -> Mesh:
    """Return the icosahedral triangulation T_level of the unit sphere around the origin.

    T_0 is the inscribed icosahedron. Each level splits every triangle at the midpoints of its edges and
    projects the new vertices to the sphere: 10*4^level + 2 vertices, 20*4^level triangles.

    Args:
        level: Number of subdivisions, from 0 to 12.

    Raises:
        InputError: The level is not an integer from 0 to 12.

    >>> import sobolev_batch as sb
    >>> sb.icosphere(2)
    Mesh(162 vertices, 320 triangles)
    """
    if not is_whole_number(level) or not 0 <= level <= FINEST_LEVEL:
        raise InputError(f"an icosphere's level must be an integer from 0 to {FINEST_LEVEL}, found {level!r}")
    mesh = _icosahedron()
    for _ in range(level):
        mesh = _projected(subdivided(mesh))
    return mesh


def _icosahedron() -> Mesh:
    """Return the icosahedron whose corners are those of three golden rectangles in the coordinate planes."""
    golden = (1 + math.sqrt(5)) / 2
    rectangle = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    corners = np.concatenate([np.roll(rectangle, turn, axis=1) for turn in range(3)])
    # Edges are as long as the short sides of the rectangles, 2; other corners are at least 3 apart.
    linked = np.linalg.norm(corners[:, None] - corners, axis=2) < 2.5
    triangles = []
    for a, b, c in combinations(range(len(corners)), 3):
        if linked[a, b] and linked[b, c] and linked[c, a]:
            outwards = np.linalg.det(corners[[a, b, c]]) > 0
            triangles.append((a, b, c) if outwards else (a, c, b))
    return _projected(Mesh(corners, triangles))


def _projected(mesh: Mesh) -> Mesh:
    """Return the mesh with its vertices moved to the unit sphere."""
    vertices = np.asarray(mesh.vertices)
    return Mesh(vertices / np.linalg.norm(vertices, axis=1)[:, None], mesh.triangles)
