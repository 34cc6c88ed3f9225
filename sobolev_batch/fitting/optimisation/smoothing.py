"""Smooth movements of a mesh's vertices, by its Laplacian."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import splu

from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Smoothing:
    """The map (I + λ L)⁻¹ from steps u of the free vertices to movements of all, with the graph Laplacian L.

    An optimiser that takes its steps in u moves neighbouring vertices together, the farther the larger λ is.

    Source: B. Nicolet, A. Jacobson, W. Jakob, "Large steps in inverse rendering of geometry" (2021),
    doi:10.1145/3478513.3480501.

    Attributes:
        graph: Graph Laplacian of all vertices.
        free: Indices of the vertices that may move.
        amount: λ; zero for steps without smoothing.
    """

    graph: csc_array
    free: Indices
    amount: float

    @classmethod
    def of(cls, mesh: Mesh, free: Indices, amount: float) -> Self:
        """Return the smoothing for a mesh."""
        count = len(mesh.vertices)
        ends = np.asarray(mesh.triangles)[:, [0, 1, 2, 1, 2, 0]].reshape(-1, 2, 3)
        one, other = ends[:, 0].ravel(), ends[:, 1].ravel()
        both = np.concatenate([one, other]), np.concatenate([other, one])
        neighbours = coo_array((np.ones(len(both[0])), both), shape=(count, count)).tocsr()
        neighbours.data[:] = 1.0
        graph: Any = laplacian(neighbours)
        return cls(csc_array(graph), free, amount)

    def movement(self, steps: Reals) -> Reals:
        """Return the movement of all vertices (n, 3) for steps of the free ones (k, 3); the others stay."""
        movement = np.zeros((self.graph.shape[0], 3))
        movement[self.free] = self._solved(steps)
        return movement

    def pulled_back(self, gradient: Reals) -> Reals:
        """Return the derivative with respect to the steps (k, 3) from that with respect to all vertices (n, 3)."""
        return self._solved(gradient[self.free])

    def _solved(self, values: Reals) -> Reals:
        return values if self.amount == 0 else np.asarray(self._factors.solve(np.ascontiguousarray(values)))

    @cached_property
    def _factors(self) -> Any:
        among_free = self.graph[self.free][:, self.free]
        return splu(csc_array(eye_array(len(self.free)) + self.amount * among_free))
