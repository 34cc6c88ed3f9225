"""Icosahedral triangulations of the unit sphere."""

from __future__ import annotations

import trimesh

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.surfaces.shapes.mesh import Mesh

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
    sphere = trimesh.creation.icosphere(subdivisions=int(level), radius=1.0)
    return Mesh(sphere.vertices, sphere.faces)
