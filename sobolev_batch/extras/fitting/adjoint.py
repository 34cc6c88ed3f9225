"""The transform of a mesh as a function of its vertices, and the derivatives of sums over it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from scipy.sparse import coo_array, csr_array, vstack

from sobolev_batch.arrays import Complexes, Indices, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import normals
from sobolev_batch.transform.fourier import ON_CPU, Execution, TransformSettings, require_points_inside
from sobolev_batch.transform.lattice import AXES, Lattice
from sobolev_batch.transform.nufft import WeightedPoints, transform_points
from sobolev_batch.transform.nufft_costs import NufftSpec
from sobolev_batch.transform.quadrature import RuleUse, assign_rules, quarters


@dataclass(frozen=True, eq=False)
class MeshTransform:
    """The transform of a mesh with given triangles on a half lattice, for any positions of the vertices.

    Attributes:
        triangles: Indices of the corners of each triangle, int64 (m, 3).
        of_vertices: Matrix (nodes, vertices): its product with the vertices (n, 3) is the quadrature nodes.
        of_areas: Matrix (nodes, triangles): its product with the areas is their weights.
    """

    triangles: Indices
    of_vertices: csr_array
    of_areas: csr_array
    lattice: Lattice
    eps: float
    execution: Execution = ON_CPU

    @classmethod
    def from_mesh(
        cls, mesh: Mesh, lattice: Lattice, settings: TransformSettings, execution: Execution = ON_CPU
    ) -> Self:
        """Return the transform of a mesh, with the triangle rules that its present shape needs."""
        uses = assign_rules(mesh, lattice.highest_frequency, settings.eps, settings.quadrature, settings.tolerance)
        pairs = [pair for use in uses for pair in _node_matrices(mesh, use)]
        of_vertices, of_areas = (vstack(parts, format="csr") for parts in zip(*pairs, strict=True))
        return cls(np.asarray(mesh.triangles, dtype=np.int64), of_vertices, of_areas, lattice, settings.eps, execution)

    @property
    def count(self) -> int:
        """Number n of vertices."""
        return int(self.of_vertices.shape[1])

    def nodes(self, vertices: Reals) -> WeightedPoints:
        """Return the quadrature nodes with the vertices at positions (n, 3), in units of length.

        InputError where these are not finite or not (n, 3), LatticeError where nodes lie beyond the lattice's half
        period.
        """
        if vertices.shape != (self.count, 3):
            n = self.count
            raise InputError(f"the mesh has {n} vertices: pass ({n}, 3) or {3 * n} numbers, found {vertices.shape}")
        coordinates = np.ascontiguousarray((self.of_vertices @ vertices).T)
        if not np.isfinite(coordinates).all():
            raise InputError("positions of vertices must be finite: found NaN or infinity")
        require_points_inside(coordinates, self.lattice)
        areas = np.linalg.norm(normals(vertices, self.triangles), axis=1) / 2
        return WeightedPoints(coordinates, self.of_areas @ areas)

    def transform(self, vertices: Reals) -> Complexes:
        """Return the transform on the half lattice, complex128; see `nodes` for the positions."""
        nodes, backend = self.nodes(vertices), self.execution.backend
        spec = NufftSpec(self.lattice.shape, self.eps, threads=self.execution.threads)
        with backend.work():
            points = WeightedPoints(backend.upload(nodes.coordinates), backend.upload(nodes.weights))
            values, _ = transform_points([points], self.lattice, self.lattice.half, spec, backend)
            return np.asarray(backend.download(values))

    def derivative(self, vertices: Reals, coefficients: Complexes) -> Reals:
        """Return the derivative of Re Σ conj(c(ξ)) μ^(ξ) over the half lattice with respect to the vertices, (n, 3).

        It is that of the sum over quadrature nodes x_j with weights a_j, at any number of nodes. The function
        w(x) = Re Σ c(ξ) exp(+2πi ξ·x) and its gradient at the nodes give Σ_j (w(x_j) da_j + a_j ∇w(x_j) · dx_j). The
        coefficients c are complex128 on the half lattice.
        """
        nodes = self.nodes(vertices)
        values, slopes = self._evaluated(nodes, coefficients)
        gradient, of_areas = self.of_vertices.T @ (nodes.weights[:, None] * slopes), self.of_areas.T @ values
        for ends, derivatives in zip(self.triangles.T, area_derivatives(vertices, self.triangles), strict=True):
            for axis in range(3):
                gradient[:, axis] += np.bincount(ends, of_areas * derivatives[:, axis], self.count)
        return np.asarray(gradient)

    def _evaluated(self, nodes: WeightedPoints, coefficients: Complexes) -> tuple[Reals, Reals]:
        """Return the function of the coefficients (k,) and its gradient (k, 3) at the nodes.

        Each NUFFT gives two real functions, as real and imaginary part: the coefficients of f + i g on the whole
        lattice are F + i G with those of f and g.
        """
        lattice, backend = self.lattice, self.execution.backend
        # Samples of the half lattice stand for two of the whole one.
        inner = coefficients[:, :, 1:] / 2
        whole = np.concatenate([inner[::-1, ::-1, ::-1].conj(), coefficients[:, :, :1], inner], axis=2)
        axis = 2 * np.pi * lattice.spacing * np.arange(-(lattice.M // 2), lattice.M // 2 + 1)
        x, y, z = np.ix_(axis, axis, axis)
        spec = NufftSpec(whole.shape, self.eps, threads=self.execution.threads)
        points = nodes.coordinates
        pairs = (whole * (1 - x), whole * (1j * y - z))
        with backend.work():
            plan = backend.plan(backend.costs.with_oversampling(spec, points.shape[1]), adjoint=True)
            # setpts keeps references, not copies: the angles live until both functions are evaluated.
            angles = [backend.upload(row) for row in 2 * np.pi * lattice.spacing * points]
            plan.setpts(*angles)
            first, second = (backend.download(plan.execute(backend.upload(pair))) for pair in pairs)
        return first.real, np.stack([first.imag, second.real, second.imag], axis=1)


def area_derivatives(vertices: Reals, triangles: Indices) -> list[Reals]:
    """Return derivatives of the areas of triangles by each corner, (m, 3) each; zero for those without an area."""
    units, corners = normals(vertices, triangles), [vertices[corner] for corner in triangles.T]
    units /= np.maximum(np.linalg.norm(units, axis=1), np.finfo(np.float64).tiny)[:, None]
    return [np.cross(units, corners[corner - 1] - corners[corner - 2]) / 2 for corner in range(3)]


def _node_matrices(mesh: Mesh, use: RuleUse) -> Iterator[tuple[csr_array, csr_array]]:
    """Yield the rows of both matrices for the nodes of some triangles; nodes that triangles share are merged."""
    triangles, rule = np.asarray(mesh.triangles[use.members], dtype=np.int64), use.rule
    members, inner, inner_weights = use.members.astype(np.int64), *rule.inner_nodes

    def matrices(
        corners: Indices, coefficients: Reals, nodes: Indices, owners: Indices, weights: Reals
    ) -> tuple[csr_array, csr_array]:
        rows = np.repeat(np.arange(len(corners)), corners.shape[1])
        of_vertices = coo_array((coefficients.ravel(), (rows, corners.ravel())), (len(corners), len(mesh.vertices)))
        of_areas = coo_array((weights, (nodes, owners)), (len(corners), len(mesh.triangles)))
        return of_vertices.tocsr(), of_areas.tocsr()

    if use.splits:
        inner, inner_weights = rule.barycentric, rule.weights
        x, y, z = np.eye(3)
        for _ in range(use.splits):
            inner = np.concatenate([inner @ quarter for quarter in quarters((x, y, z))])
            inner_weights = np.tile(inner_weights / 4, 4)
    elif rule.shares:
        edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=2)
        corner = [(np.ones(1), rule.corner_weight)] if rule.corner_weight else []
        on_edge = list(zip(*rule.edge_nodes, strict=True))
        for ends, shared in ((triangles[:, :, None], corner), (edges, on_edge)):
            if shared:
                used, nodes = np.unique(ends.reshape(-1, ends.shape[2]), axis=0, return_inverse=True)
                shares = nodes.ravel(), np.repeat(members, 3)
                for coefficients, weight in shared:
                    of_each = np.tile(coefficients, (len(used), 1))
                    yield matrices(used, of_each, *shares, np.full(nodes.size, weight))
    if count := len(inner):
        corners, coefficients = np.repeat(triangles, count, axis=0), np.tile(inner, (len(triangles), 1))
        shares = np.arange(len(corners)), np.repeat(members, count)
        yield matrices(corners, coefficients, *shares, np.tile(inner_weights, len(triangles)))


def field_values(field: xr.DataArray) -> Complexes:
    """Return all samples of a field, complex128 on the half lattice; refuse any that is not finite."""
    values = np.asarray(field.transpose(*AXES).to_numpy(), dtype=np.complex128)
    if not np.isfinite(values).all():
        raise InputError(f"the field has {np.count_nonzero(~np.isfinite(values)):,} values that are NaN or infinite")
    return values
