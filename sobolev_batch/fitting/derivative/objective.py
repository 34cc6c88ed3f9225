"""The squared distance of a mesh from a target as a function of the mesh's vertices, with its derivative."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.derivative.transform import MeshTransform, PlacedMesh
from sobolev_batch.spectral.backends.arrays import Complexes
from sobolev_batch.spectral.backends.backends import backend_named
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import OperandLike, common_lattice, field_of, field_values
from sobolev_batch.spectral.shells import SobolevWeights, single_order
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings, thread_count
from sobolev_batch.surfaces.formats.objects import MeshLike, as_mesh

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SquaredDistance:
    """The squared distance ||mesh - target||_s² over a lattice, as a function of the mesh's vertices.

    Call it with positions of the vertices, (n, 3) or flat (3n,): it returns the value and its derivative in the same
    shape, as `scipy.optimize.minimize` takes them with ``jac=True``. The derivative is exactly that of the value,
    to eps: both are sums over the same quadrature nodes, which move with the vertices. Their number follows from
    the shape of the mesh at first. Make a new function once triangles have become much larger.

    Attributes:
        transform: Transform of the mesh.
        target: Transform of the target on the half lattice.
        factors: Weight of each sample of the half lattice in the squared norm, float64.

    >>> import sobolev_batch as sb
    >>> from scipy.optimize import minimize
    >>> ball = sb.icosphere(1)
    >>> squared = sb.SquaredDistance.of(ball, sb.Sphere(1.1), -2.0, lattice=sb.Lattice(2.0, 20))
    >>> value, gradient = squared(ball.vertices)
    >>> gradient.shape
    (42, 3)
    >>> found = minimize(squared, ball.vertices.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 10})
    >>> bool(found.fun < value / 100)
    True
    """

    transform: MeshTransform
    target: Complexes
    factors: Reals

    @classmethod
    def of(
        cls,
        mesh: MeshLike,
        target: OperandLike,
        order: float,
        *,
        lattice: Lattice | None = None,
        eps: float | None = None,
        threads: int | None = None,
        backend: Literal["cpu", "gpu", "auto"] = "cpu",
    ) -> Self:
        """Return the function for a mesh and its target.

        Args:
            mesh: Mesh whose vertices will move, in units of length, or what `as_mesh` makes one of.
            target: Surface, what `as_mesh` makes one of, or a field from `fourier_transform` or a store.
            order: Order s < -1/2.
            lattice: Lattice to compare on. A field brings its own.
            eps: Accuracy of transforms relative to the area. Default 1e-9.
            threads: Threads of the NUFFT; one per core by default.
            backend: "cpu", "gpu", or "auto" for a GPU if one is usable.

        Raises:
            OrderError: The order is not below -1/2.
            LatticeError: Fields lie on different lattices, or a surface does not fit into the lattice.
            InputError: The mesh is none, there is no lattice, or settings are out of range.
            BackendError: "gpu", and no GPU is usable.
        """
        mesh = as_mesh(mesh)
        orders = (single_order(order),)
        field = field_of(target, common_lattice((target,), lattice), orders)
        own = Lattice.of(field)
        values = field_values(field)
        execution = Execution(backend_named(backend), thread_count(threads))
        transform = MeshTransform.of(mesh, own, TransformSettings(eps), execution)
        transform.at(np.asarray(mesh.vertices))
        return cls(transform, values, factors_of(SobolevWeights(own, orders))[0])

    def __call__(self, vertices: ArrayLike) -> tuple[float, Reals]:
        """Return the squared distance, in units of length, and its derivative in the shape of the vertices.

        Raises:
            InputError: The vertices are not finite, or not as many as the mesh has.
            LatticeError: The mesh extends beyond the lattice's half period.
        """
        placed = self._placed(vertices)
        difference = placed.transform() - self.target
        gradient = 2 * placed.derivative(self.factors * difference)
        return self._square(difference), gradient.reshape(np.shape(vertices))

    def value(self, vertices: ArrayLike) -> float:
        """Return the squared distance alone, which takes a third of the time; see `__call__`."""
        return self._square(self._placed(vertices).transform() - self.target)

    def _placed(self, vertices: ArrayLike) -> PlacedMesh:
        """Return the mesh with vertices at some positions, (n, 3) or (3n,)."""
        positions = np.asarray(vertices)
        if positions.dtype.kind not in "iuf":
            raise InputError(f"positions of vertices must be real numbers, found {positions.dtype}")
        is_flat = positions.shape == (3 * self.transform.count,)
        return self.transform.at((positions.reshape(-1, 3) if is_flat else positions).astype(np.float64, copy=False))

    def _square(self, difference: Complexes) -> float:
        return float(np.sum(self.factors * (difference.real**2 + difference.imag**2)))


def factors_of(weights: SobolevWeights) -> Reals:
    """Return the weight of each sample of the half lattice in squared norms, float64 (orders, *lattice.shape)."""
    lattice = weights.lattice
    return np.asarray(weights.per_shell[:, lattice.shells(lattice.half)] * lattice.trapezoid_weights(lattice.half))
