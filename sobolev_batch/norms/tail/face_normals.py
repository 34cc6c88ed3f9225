"""Normals of flat faces, around which transforms are concentrated, and a density of directions that follows them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from sobolev_batch.arrays import Reals, slices
from sobolev_batch.geometry.mesh import Mesh, cross, dot
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.transform.backends import combine

# Normals whose entries agree to this many parts are one direction.
_DIRECTION_PARTS = 500
# Numbers that an entry can be rounded to; three of them make a key of 32 bits.
_KEYS_PER_AXIS = 2 * _DIRECTION_PARTS + 1
# Triangles whose normals are taken at a time.
_BATCH = 1 << 14
# A direction counts if the faces along it hold this fraction of the area; this many directions at most.
_LEAST_SHARE, _MOST_DIRECTIONS = 0.01, 64
# κ as a fraction of 2π |ξ| · size of the faces: the spots around normals are about 1/κ wide.
_SPOT_FRACTION = 0.5
# No direction of small whole numbers is orthogonal to this one, where rounding would decide.
_UPWARDS = np.array([1.0, np.sqrt(2.0), np.pi])
_NO_NORMALS = (np.zeros((0, 3)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """Directions of the flat faces of some surfaces, and a density of directions that follows them.

    The transform of a flat face is concentrated around its normal, in a spot as wide as the inverse size of the face,
    and falls off from there like the inverse third power. So does the density around each normal n, which is
    (1 + κ²) / (4π (1 + κ² sin²θ)^(3/2)) at an angle θ to n, with κ in proportion to |ξ| times the size.

    Attributes:
        directions: Unit normals, float64 (n, 3); the density is the same at opposite directions.
        shares: Area of the faces along each normal over that along all of them, float64 (n,).
        sizes: Typical width of these faces, float64 (n,), in units of length.
    """

    directions: Reals
    shares: Reals
    sizes: Reals

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Surface]) -> Self:
        """Return the normals of the flat faces of surfaces; none for curved ones."""
        found = [_main_normals(surface) for surface in surfaces if isinstance(surface, Mesh)]
        directions, areas, sizes = (np.concatenate(rows) for rows in zip(_NO_NORMALS, *found, strict=True))
        return cls(directions, areas / max(float(areas.sum()), np.finfo(np.float64).tiny), sizes)

    def __bool__(self) -> bool:
        return len(self.shares) > 0

    def draw(self, radii: Reals, rng: np.random.Generator) -> Reals:
        """Draw a unit direction on the side of a normal for each |ξ| (n,) by the density, float64 (n, 3)."""
        chosen = rng.choice(len(self.shares), len(radii), p=self.shares)
        axes = self.directions[chosen]
        squares = self._concentrations(radii, self.sizes[chosen])
        levels = rng.random(len(radii))
        # The distribution of u = |cos θ| is u / √(1 + κ² - κ² u²), which inverts in closed form.
        spread = 1 + squares * levels**2
        cosines, sines = levels * np.sqrt((1 + squares) / spread), np.sqrt((1 - levels**2) / spread)
        turns = 2 * np.pi * rng.random(len(radii))
        across = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        sideways = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(axes, across)
        # A direction stands for its opposite too, since all integrands are even.
        return np.asarray(cosines[:, None] * axes + sines[:, None] * sideways)

    def density(self, directions: Reals, radii: Reals) -> Reals:
        """Return the density per solid angle (n,) at unit directions (n, 3), for their |ξ| (n,)."""
        total, columns = np.zeros(len(radii)), np.ascontiguousarray(directions.T)
        for axis, share, size in zip(self.directions, self.shares, self.sizes, strict=True):
            squares = self._concentrations(radii, size)
            # Of angles below 1e-8, cosines tell nothing.
            across = np.stack(cross(axis[:, None], columns))
            spread = 1 + squares * dot(across, across)
            total += share / (4 * np.pi) * (1 + squares) / (spread * np.sqrt(spread))
        return total

    @staticmethod
    def _concentrations(radii: Reals, sizes: Reals | float) -> Reals:
        """Return κ² of the density."""
        return np.asarray((_SPOT_FRACTION * 2 * np.pi * radii * sizes) ** 2)


def _main_normals(mesh: Mesh) -> tuple[Reals, Reals, Reals]:
    """Return the normals, areas and face sizes of the directions that hold much of a mesh's area."""
    count, areas = len(mesh.triangles), mesh.areas
    normals, keys = np.empty((count, 3)), np.empty(count, dtype=np.int32)
    # The corners and temporaries of all triangles of a fine mesh would take gigabytes.
    for part in slices(count, _BATCH):
        a, b, c = mesh.corners(part)
        crosses = np.cross(b - a, c - a)
        # A normal and its opposite are one direction. Triangles without area have none.
        crosses[combine(_UPWARDS, crosses.T) < 0] *= -1
        lengths = 2 * areas[part]
        normals[part] = crosses / np.where(lengths > 0, lengths, 1.0)[:, None]
        # A number for each normal, the same for those that count as one direction.
        x, y, z = np.round(normals[part] * _DIRECTION_PARTS).astype(np.int32).T
        keys[part] = (x * _KEYS_PER_AXIS + y) * _KEYS_PER_AXIS + z
    _, members = np.unique(keys, return_inverse=True)
    sums = np.bincount(members, weights=areas)
    largest = np.argsort(-sums)[:_MOST_DIRECTIONS]
    largest = largest[sums[largest] > _LEAST_SHARE * areas.sum()]
    directions, sizes = np.empty((len(largest), 3)), np.empty(len(largest))
    for number, group in enumerate(largest):
        face = members == group
        directions[number] = areas[face] @ normals[face]
        used = np.zeros(len(mesh.vertices), dtype=bool)
        used[mesh.triangles[face]] = True
        # Between the width of one triangle and that of all faces along the normal: spots of both lie there.
        sizes[number] = np.sqrt(np.ptp(mesh.vertices[used], axis=0).max() * np.sqrt(areas[face].mean()))
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return directions, sums[largest], sizes
