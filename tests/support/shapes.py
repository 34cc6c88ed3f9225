"""Small surfaces whose areas are known, and parametrisations, which survive pickling."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.geometry.surface import Point
from sobolev_batch.shapes import Interval, ParametrisedSurface, Torus

# A box with sides of 1, 2 and 4, so that axes cannot be confused. Its coordinates are exact in single precision.
BOX_VERTICES: Reals = np.array([(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 4)], dtype=np.float64)
BOX_QUADS: list[list[int]] = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
BOX_TRIANGLES: list[list[int]] = [[q[0], q[i], q[i + 1]] for q in BOX_QUADS for i in (1, 2)]
# Three sides of the box as quadrilaterals, three as pairs of triangles.
BOX_MIXED: list[list[int]] = [*BOX_QUADS[:3], *BOX_TRIANGLES[6:]]
BOX_AREA = 28.0

# The same box with coordinates that need all digits of double precision.
AWKWARD_VERTICES: Reals = BOX_VERTICES / 3 + 1 / 7


def mesh_counts(
    zero_area: int,
    duplicate: int,
    boundary: int,
    nonmanifold: int,
    inconsistent: int = 0,
    components: int = 1,
    euler: int = 2,
) -> dict[str, int]:
    """Return counts as `Mesh.counts` gives them, by default of one part with the Euler characteristic of a sphere."""
    return {
        "zero_area_triangles": zero_area,
        "duplicate_triangles": duplicate,
        "boundary_edges": boundary,
        "nonmanifold_edges": nonmanifold,
        "inconsistent_edges": inconsistent,
        "components": components,
        "euler_characteristic": euler,
    }


CLOSED = mesh_counts(0, 0, 0, 0)

TETRAHEDRON_VERTICES: Reals = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=np.float64)
TETRAHEDRON_TRIANGLES: list[list[int]] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
TETRAHEDRON_AREA = 1.5 + np.sqrt(3) / 2


def box() -> Mesh:
    return Mesh(BOX_VERTICES, BOX_TRIANGLES)


def tetrahedron() -> Mesh:
    """Return the corner of a unit cube, cut off."""
    return Mesh(TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES)


def soup(mesh: Mesh) -> list[list[tuple[float, ...]]]:
    """Return the triangles as sorted coordinates: equal for meshes that differ only in order and sharing."""
    return sorted(sorted(tuple(corner) for corner in triangle) for triangle in mesh.vertices[mesh.triangles].tolist())


# Around the origin, with no two sides equal.
CENTRED_BOX = Mesh(
    np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.6, 0.6) for z in (-0.7, 0.7)]),
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]],
)  # fmt: skip

HALF_TURN, TURN = Interval(0.0, math.pi), Interval(0.0, 2 * math.pi, periodic=True)
# Neither an axis nor a diagonal stays where it is.
ROTATION = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def ball(u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
    """The unit sphere in its two angles."""
    return np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)


def plate(u: Reals, v: Reals) -> tuple[Reals, Reals, float]:
    return u, v, 0.0


@dataclass(frozen=True)
class Turned:
    torus: Torus

    def __call__(self, u: Reals, v: Reals) -> Reals:
        return np.asarray(np.tensordot(ROTATION, self.torus.positions(u, v), axes=1))


def turned_torus(torus: Torus) -> ParametrisedSurface:
    return ParametrisedSurface(Turned(torus), TURN, TURN)


def angular_ball() -> ParametrisedSurface:
    return ParametrisedSurface(ball, HALF_TURN, TURN)


@dataclass(frozen=True)
class Roof(Smooth):
    """Two flat halves that meet in a ridge: no smooth surface, but its area element is constant."""

    scale: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        return Interval(-0.9, 1.0), Interval(-0.9, 1.0)

    def positions(self, u: Reals, v: Reals) -> Reals:
        x, y = np.broadcast_arrays(u, v)
        return np.asarray(self.scale * (np.stack([x, y, -np.abs(x)]) - np.reshape(self.origin, (3, *[1] * x.ndim))))

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        slopes, _ = np.broadcast_arrays(-self.scale * np.sign(u), v)
        one, zero = np.full_like(slopes, self.scale), np.zeros_like(slopes)
        return np.stack([one, zero, slopes]), np.stack([zero, one, zero])

    def moved(self, scale: float, origin: Point) -> Roof:
        x, y, z = (old + shift / self.scale for old, shift in zip(self.origin, origin, strict=True))
        return Roof(scale * self.scale, (x, y, z))
