"""The triangles of a mesh in arrays of a backend."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sobolev_batch.arrays import Array, Indices, slices
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.backends import CPU, Backend

# Triangles of a device at a time, whose temporaries take some 200 MB.
_HELD = 1 << 19


@dataclass(frozen=True, eq=False)
class FaceArrays:
    """Triangles in arrays of one backend, a row for each axis or corner.

    Attributes:
        columns: Coordinates of the vertices, float64 (3, n), in units of length.
        corners: Indices of the vertices, int64 (3, m).
        areas: Area of each triangle, float64 (m,), in squared units of length.
        radii: Distance from the centroid of each triangle to its farthest corner, float64 (m,).
    """

    columns: Array
    corners: Array
    areas: Array
    radii: Array
    backend: Backend = CPU

    @classmethod
    def of_mesh(cls, mesh: Mesh, backend: Backend = CPU) -> Self:
        """Return the triangles of a mesh on a backend."""
        arrays = mesh.vertices, mesh.triangles, mesh.areas, mesh.centroid_radii
        vertices, triangles, areas, radii = map(backend.upload, arrays)
        return cls(np.ascontiguousarray(vertices.T, like=vertices), triangles.T, areas, radii, backend)

    def __len__(self) -> int:
        return len(self.areas)

    def part(self, which: slice | Indices) -> Self:
        """Return some of the triangles, with all vertices, in contiguous rows."""
        which = which if isinstance(which, slice) else self.backend.upload(which)
        corners = np.ascontiguousarray(self.corners[:, which], like=self.corners)
        return replace(self, corners=corners, areas=self.areas[which], radii=self.radii[which])

    def at(self, corner: int) -> Array:
        """Return the coordinates (3, m) of one corner of each triangle."""
        return np.take(self.columns, self.corners[corner], axis=1)

    def batches(self, size: int) -> Iterator[Self]:
        """Return the triangles in batches: of a size on the processor, where temporaries stay in its cache."""
        return map(self.part, slices(len(self), size if self.backend is CPU else _HELD))
