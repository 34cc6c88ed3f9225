"""Subdivision of a mesh at some of its edges, without vertices inside of edges; and icospheres, made by it."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.parameters import is_whole_number

Marks = NDArray[np.bool_]

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
    >>> sb.shapes.icosphere(2)
    Mesh(162 vertices, 320 triangles)
    """
    if not is_whole_number(level) or not 0 <= level <= FINEST_LEVEL:
        raise InputError(f"an icosphere's level must be an integer from 0 to {FINEST_LEVEL}, found {level!r}")
    mesh = _icosahedron()
    for _ in range(level):
        mesh = _projected(subdivided(mesh))
    return mesh


def subdivided(mesh: Mesh) -> Mesh:
    """Return the mesh with every triangle split into four at the middles of its edges."""
    edges = Edges.from_mesh(mesh)
    return edges.split(np.ones(len(edges.ends), dtype=bool))


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a mesh.

    Attributes:
        ends: Vertices of each edge (e, 2), the smaller first.
        sides: Edges of each triangle (m, 3), from its first vertex to its second and so on.
    """

    mesh: Mesh
    ends: Indices
    sides: Indices

    @classmethod
    def from_mesh(cls, mesh: Mesh) -> Self:
        """Return the edges of a mesh."""
        sides = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        # One number for each pair of vertices: they are sorted ten times as fast as rows.
        count = len(mesh.vertices)
        pairs, edges = np.unique(sides[:, 1] * count + sides[:, 0], return_inverse=True)
        larger, smaller = np.divmod(pairs, count)
        return cls(mesh, np.stack([smaller, larger], axis=1), edges.reshape(-1, 3))

    @property
    def on_boundary(self) -> Marks:
        """Return True for each edge of one triangle only."""
        return np.asarray(np.bincount(self.sides.ravel(), minlength=len(self.ends)) == 1)

    @cached_property
    def lengths(self) -> Reals:
        """Lengths (e,), in units of length."""
        first, second = self.mesh.vertices[self.ends.T]
        return np.asarray(np.linalg.norm(first - second, axis=1))

    def split(self, marks: Marks) -> Mesh:
        """Return the mesh with new vertices, after its own, at the middles of marked edges; of two cuts the shorter."""
        old, count = self.mesh.vertices, len(self.mesh.vertices)
        middles = np.full(len(self.ends), -1, dtype=np.int64)
        middles[marks] = count + np.arange(np.count_nonzero(marks))
        vertices = np.concatenate([old, old[self.ends[marks]].mean(axis=1)])
        triangles, on_sides = self.mesh.triangles, middles[self.sides]
        # Turned so that the first side is marked, and of three sides with two marks the last one is not.
        first = np.argmax((on_sides >= 0) & (np.roll(on_sides, 1, axis=1) < 0), axis=1)
        columns = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (ab, bc, ca) = (np.take_along_axis(one, columns, axis=1).T for one in (triangles, on_sides))
        number = np.count_nonzero(on_sides >= 0, axis=1)
        near = np.linalg.norm(vertices[a] - vertices[bc], axis=1) <= np.linalg.norm(vertices[ab] - vertices[c], axis=1)
        pieces = (
            (number == 0, [(a, b, c)]),
            (number == 1, [(a, ab, c), (ab, b, c)]),
            ((number == 2) & near, [(ab, b, bc), (a, ab, bc), (a, bc, c)]),
            ((number == 2) & ~near, [(ab, b, bc), (a, ab, c), (ab, bc, c)]),
            (number == 3, [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]),
        )
        cut = [np.stack(corners, axis=1)[chosen] for chosen, pieces_of in pieces for corners in pieces_of]
        parents = np.concatenate([np.flatnonzero(chosen) for chosen, pieces_of in pieces for _ in pieces_of])
        # Pieces of a triangle follow each other: what is near in space stays near in memory.
        return Mesh(vertices, np.concatenate(cut)[np.argsort(parents, kind="stable")])


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
            # Facing outwards.
            triangles.append((a, b, c) if np.linalg.det(corners[[a, b, c]]) > 0 else (a, c, b))
    return _projected(Mesh(corners, triangles))


def _projected(mesh: Mesh) -> Mesh:
    """Return the mesh with its vertices moved to the unit sphere."""
    return Mesh(mesh.vertices / np.linalg.norm(mesh.vertices, axis=1)[:, None], mesh.triangles)
