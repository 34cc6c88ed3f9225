"""Shapes of triangles: what keeps them from degenerating while vertices move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]

# A triangle may lose this fraction of its quality freely, and any down to this quality.
_FREE_LOSS, _GOOD = 0.5, 0.3
_EQUILATERAL = 4 * np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class ShapePenalty:
    """A sum over the triangles that become much worse than they were.

    The quality q of a triangle is 4√3 area / (sum of its squared edges), one for equilateral triangles and zero without
    an area. It costs ((r - q) / r)² where it falls below a reference r, and nothing above.

    Attributes:
        triangles: Indices of corners, int64 (m, 3).
        references: r of each triangle (m,).
    """

    triangles: NDArray[np.int64]
    references: Reals

    @classmethod
    def of(cls, vertices: Reals, triangles: NDArray[np.int64]) -> Self:
        """Return the penalty of triangles relative to their present shapes."""
        quality = _Quality(vertices, triangles)
        return cls(triangles, np.minimum(_FREE_LOSS * quality.values, _GOOD))

    def value_and_gradient(self, vertices: Reals) -> tuple[float, Reals]:
        """Return the penalty for vertices (n, 3), and its derivative with respect to them."""
        quality = _Quality(vertices, self.triangles)
        bad = np.flatnonzero(quality.values < self.references)
        lacks = 1 - quality.values[bad] / self.references[bad]
        gradient = np.zeros_like(vertices)
        for corner, slopes in enumerate(quality.gradients(bad)):
            terms = (-2 * lacks / self.references[bad])[:, None] * slopes
            np.add.at(gradient, self.triangles[bad, corner], terms)
        return float(np.sum(lacks**2)), gradient


class _Quality:
    """Qualities of triangles, and their derivatives."""

    def __init__(self, vertices: Reals, triangles: NDArray[np.int64]) -> None:
        self.corners = [vertices[corner] for corner in triangles.T]
        a, b, c = self.corners
        self.normals = np.cross(b - a, c - a)
        self.areas = np.linalg.norm(self.normals, axis=1) / 2
        self.squares = sum(np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c))
        # A triangle that is a point has no quality to lose.
        self.values: Reals = np.where(self.squares > 0, _EQUILATERAL * self.areas / np.maximum(self.squares, 1e-300), 0)

    def gradients(self, selected: NDArray[np.intp]) -> list[Reals]:
        """Return the derivatives of some triangles' qualities with respect to each of their corners, (k, 3)."""
        corners = [corner[selected] for corner in self.corners]
        units = self.normals[selected] / np.maximum(2 * self.areas[selected], 1e-300)[:, None]
        squares, values = self.squares[selected][:, None], self.values[selected][:, None]
        found = []
        for corner in range(3):
            this, following, previous = corners[corner], corners[corner - 2], corners[corner - 1]
            of_area = np.cross(units, previous - following) / 2
            of_squares = 2 * (2 * this - following - previous)
            found.append((_EQUILATERAL * of_area - values * of_squares) / squares)
        return found


def smallest_angle(mesh: Mesh) -> float:
    """Return the smallest angle of all triangles, in degrees; zero with a triangle without an area."""
    corners = [mesh.vertices[corner] for corner in mesh.triangles.T]
    angles = []
    for corner in range(3):
        this, following, previous = corners[corner], corners[corner - 2], corners[corner - 1]
        one, other = following - this, previous - this
        # Small angles keep their digits, unlike those by the law of cosines.
        sines = np.linalg.norm(np.cross(one, other), axis=1)
        angles.append(np.arctan2(sines, np.einsum("ij,ij->i", one, other)))
    return float(np.degrees(np.min(angles)))
