"""Quadrature nodes as linear functions of a mesh's vertices, so that they can move with these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from sobolev_batch.spectral.quadrature.meshes import RuleAssignment, TriangleBatch
from sobolev_batch.spectral.quadrature.rules import corner_rule, midpoint_rule
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]

# The corners of the four similar triangles of a triangle, in its barycentric coordinates.
_QUARTERS: Reals = np.array(
    [
        [[1, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5]],
        [[0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5]],
        [[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]],
        [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]],
    ]
)


@dataclass(frozen=True, eq=False)
class MovingNodes:
    """Quadrature nodes of a mesh for any positions of its vertices.

    Attributes:
        of_vertices: Matrix (nodes, vertices): its product with the vertices (n, 3) is the nodes.
        of_areas: Matrix (nodes, triangles): its product with the areas is the weights.
    """

    of_vertices: csr_array
    of_areas: csr_array

    @classmethod
    def of(cls, mesh: Mesh, assignment: RuleAssignment) -> Self:
        """Return the nodes of a mesh by the rules of its triangles; nodes that triangles share are merged."""
        parts = [_nodes_of(mesh, batch) for batch in assignment.batches()]
        starts = np.cumsum([0, *(part.count for part in parts)])
        shape = int(starts[-1])
        vertices = _joined([part.of_vertices for part in parts], starts, (shape, len(mesh.vertices)))
        areas = _joined([part.of_areas for part in parts], starts, (shape, len(mesh.triangles)))
        return cls(vertices, areas)

    def __len__(self) -> int:
        return int(self.of_vertices.shape[0])


@dataclass(frozen=True, eq=False)
class _Entries:
    """Entries of a matrix."""

    rows: Indices
    columns: Indices
    values: Reals


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Nodes of some triangles, and the entries of their rows of both matrices."""

    count: int
    of_vertices: _Entries
    of_areas: _Entries


def _joined(parts: list[_Entries], starts: Indices, shape: tuple[int, int]) -> csr_array:
    rows = np.concatenate([part.rows + start for part, start in zip(parts, starts, strict=False)])
    columns = np.concatenate([part.columns for part in parts])
    return coo_array((np.concatenate([part.values for part in parts]), (rows, columns)), shape=shape).tocsr()


def _nodes_of(mesh: Mesh, batch: TriangleBatch) -> _Nodes:
    triangles = np.asarray(mesh.triangles[batch.members], dtype=np.int64)
    if not batch.splits and batch.rule in (corner_rule(), midpoint_rule()):
        return _shared(triangles, batch.members, is_midpoint=batch.rule is midpoint_rule())
    barycentric, weights = batch.rule.barycentric, batch.rule.weights
    for _ in range(batch.splits):
        barycentric = np.concatenate([barycentric @ quarter for quarter in _QUARTERS])
        weights = np.tile(weights / 4, 4)
    each, count = len(weights), len(triangles)
    nodes = np.arange(each * count, dtype=np.int64)
    columns = np.repeat(triangles, each, axis=0)
    return _Nodes(
        each * count,
        _Entries(np.repeat(nodes, 3), columns.ravel(), np.tile(barycentric, (count, 1)).ravel()),
        _Entries(nodes, np.repeat(batch.members, each), np.tile(weights, count)),
    )


def _shared(triangles: Indices, members: Indices, *, is_midpoint: bool) -> _Nodes:
    """Return the corners of triangles, or the midpoints of their edges, each with a third of the areas around it."""
    of_triangle = np.repeat(members, 3)
    if not is_midpoint:
        used, nodes = np.unique(triangles, return_inverse=True)
        of_vertices = _Entries(np.arange(len(used)), used, np.ones(len(used)))
    else:
        edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        used, nodes = np.unique(edges, axis=0, return_inverse=True)
        of_vertices = _Entries(np.repeat(np.arange(len(used)), 2), used.ravel(), np.full(2 * len(used), 0.5))
    return _Nodes(len(used), of_vertices, _Entries(nodes.ravel(), of_triangle, np.full(len(of_triangle), 1 / 3)))
