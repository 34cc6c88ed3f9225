"""Squared distances as functions of the vertices of a mesh: value, derivative, and the error of that."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.extras.fitting.adjoint import MeshTransform, field_values
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Extent
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.budget import Support, decay_to_period, sums_of_shells, truncated
from sobolev_batch.norms.columns import NUMBER, VARIABLES, labelled, lattice_attributes
from sobolev_batch.norms.estimate import PARTS
from sobolev_batch.norms.fields import Operand, OperandLike, as_operand, common_lattice, field_of, quality_of
from sobolev_batch.norms.tail.integrals import squared_moduli
from sobolev_batch.transform.backends import backend_named
from sobolev_batch.transform.fourier import Execution, TransformSettings, thread_count
from sobolev_batch.transform.lattice import Lattice, Orders, SobolevWeights, check_orders, shell_sums, single_order
from sobolev_batch.transform.nufft_costs import FINEST_EPS

# The derivative is computed twice, the second time with an eps smaller by this factor, which is the one reported.
_REFINEMENT = 30.0
# The derivative's tail was measured to be at most this many times what the tail of the squared distance suggests.
_TRUNCATION_CAUTION = 3.0
# Images change derivatives by more than what the change at half the period suggests: up to 25 times were measured
# where surfaces fill three quarters of the period.
_ALIASING_CAUTION = 40.0
# Steps to find the largest change of the transform by a movement, which comes out too small by this factor at most.
_POWER_STEPS, _POWER_CAUTION = 4, 1.5
# Movement of vertices in a difference, relative to the mean edge.
_DIFFERENCE = 1e-4


@dataclass(frozen=True, eq=False)
class SquaredDistance:
    """The squared distance ||mesh - target||_s² over a lattice, as a function of the mesh's vertices.

    Call it with positions of the vertices, (n, 3) or flat (3n,): it returns the value and its derivative in the same
    shape, as `scipy.optimize.minimize` takes them with ``jac=True``. The derivative is that of the value to eps: both
    are sums over the same quadrature nodes, which move with the vertices. Their number follows from the first shape of
    the mesh. Make a new function once triangles have become much larger.

    Attributes:
        transform: Transform of the mesh.
        target: Transform of the target on the half lattice.
        factors: Weight of each sample of the half lattice in the squared norm, float64.

    >>> import sobolev_batch as sb
    >>> from scipy.optimize import minimize
    >>> ball = sb.shapes.icosphere(1)
    >>> squared = sb.fitting.SquaredDistance.for_mesh(ball, sb.shapes.Sphere(1.1), -2.0, lattice=sb.Lattice(2.0, 20))
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
    def for_mesh(
        cls,
        mesh: MeshLike,
        target: OperandLike,
        order: float = DEFAULT_ORDER,
        *,
        lattice: Lattice | None = None,
        eps: float | None = None,
        threads: int | None = None,
        backend: Literal["cpu", "gpu", "auto"] = "cpu",
    ) -> Self:
        """Return the function for a mesh whose vertices will move, with the parameters of `gradient`."""
        mesh, orders = as_mesh(mesh), (single_order(order),)
        field = field_of(target, common_lattice((target,), lattice), orders)
        own, execution = Lattice.from_field(field), Execution(backend_named(backend), thread_count(threads))
        transform = MeshTransform.from_mesh(mesh, own, TransformSettings(eps), execution)
        transform.nodes(mesh.vertices)
        return cls(transform, field_values(field), factors_of(SobolevWeights(own, orders))[0])

    def __call__(self, vertices: ArrayLike) -> tuple[float, Reals]:
        """Return the squared distance, in units of length, and its derivative in the shape of the vertices.

        Raises:
            InputError: The vertices are not finite, or not as many as the mesh has.
            LatticeError: The mesh extends beyond the lattice's half period.
        """
        positions = self._positions(vertices)
        difference = self.transform.transform(positions) - self.target
        gradient = 2 * self.transform.derivative(positions, self.factors * difference)
        return float(squares_of(difference, [self.factors])[0]), gradient.reshape(np.shape(vertices))

    def value(self, vertices: ArrayLike) -> float:
        """Return the squared distance alone, which takes a third of the time; see `__call__`."""
        difference = self.transform.transform(self._positions(vertices)) - self.target
        return float(squares_of(difference, [self.factors])[0])

    def _positions(self, vertices: ArrayLike) -> Reals:
        """Return positions of vertices, given as (n, 3) or (3n,)."""
        positions = np.asarray(vertices)
        if positions.dtype.kind not in "iuf":
            raise InputError(f"positions of vertices must be real numbers, found {positions.dtype}")
        is_flat = positions.shape == (3 * self.transform.count,)
        return (positions.reshape(-1, 3) if is_flat else positions).astype(np.float64, copy=False)


def factors_of(weights: SobolevWeights) -> Reals:
    """Return the weight of each sample of the half lattice in squared norms, float64 (orders, *lattice.shape)."""
    lattice = weights.lattice
    return np.asarray(weights.per_shell[:, lattice.shells(lattice.half)] * lattice.trapezoid_weights(lattice.half))


def squares_of(values: Complexes, factors: Iterable[Reals]) -> Reals:
    """Return the squared norms of values on the half lattice, one for the weights of samples of each order."""
    energies = squared_moduli(values)
    return np.array([np.sum(one * energies) for one in factors])


def gradient(
    mesh: MeshLike,
    target: OperandLike,
    order: Orders = DEFAULT_ORDER,
    *,
    lattice: Lattice | None = None,
    eps: float | None = None,
    threads: int | None = None,
    backend: Literal["cpu", "gpu", "auto"] = "cpu",
) -> xr.Dataset:
    """Return the derivative of the squared distance ||mesh - target||_s² with respect to every vertex, with its error.

    It is the derivative of the sum over the lattice. An optimiser takes `SquaredDistance`, which gives value and
    derivative without the error in a third of the time.

    Args:
        mesh: Mesh in units of length, or what `as_mesh` makes one of.
        target: Surface, what `as_mesh` makes one of, or a field from `fourier_transform` or a store.
        order: One order s < -1/2, or several.
        lattice: Lattice to compare on. A field brings its own.
        eps: Accuracy of transforms relative to the area. Default 1e-9.
        threads: Threads of the NUFFT; one per core by default.
        backend: "cpu", "gpu", or "auto" for a GPU if one is usable.

    Returns:
        Dataset over `order` with `gradient` (order, vertex, axis), float64, without a unit: length over length. The
        other variables are over `order` alone: `squared_distance`, in units of length, and the `error` of the
        gradient in the Euclidean norm over all vertices and axes. It is the sum of `error_part` over `part`:
        truncation (frequencies beyond the lattice) and aliasing (its spacing), both estimates, discretisation
        (quadrature, NUFFT and the error of a field), which is measured, and statistical, which is zero. It is NaN for
        a field without the attribute `quality`. A single order has no dimension. The vector points where the squared
        distance grows fastest.

    Raises:
        OrderError: An order is not below -1/2.
        LatticeError: Fields lie on different lattices, or a surface does not fit into the lattice.
        InputError: The mesh is none, there is no lattice, or settings are out of range.
        BackendError: "gpu", and no GPU is usable.

    >>> import sobolev_batch as sb
    >>> found = sb.fitting.gradient(sb.shapes.icosphere(1), sb.shapes.Sphere(1.1), -4.0, lattice=sb.Lattice(2.0, 20))
    >>> found["gradient"].shape
    (42, 3)
    >>> outwards = (found["gradient"].values * sb.shapes.icosphere(1).vertices).sum(axis=1)
    >>> bool((outwards < 0).all())  # the squared distance falls where vertices move outwards
    True
    >>> bool(found["error"] < 0.2 * abs(found["gradient"]).sum())
    True
    """
    (mesh,), (target,) = each(as_mesh, {"mesh": mesh}), each(as_operand, {"target": target})
    orders = check_orders(order)
    settings = TransformSettings(eps)
    finer = TransformSettings(max(settings.eps / _REFINEMENT, FINEST_EPS["complex128"]))
    execution = Execution(backend_named(backend), thread_count(threads))
    own = common_lattice((target,), lattice)
    pair = [_Difference(mesh, target, own, orders, one, execution) for one in (settings, finer)]
    coarser, gradients = (one.gradients(one.factors) for one in pair)
    fine = pair[-1]
    parts = fine.errors(gradients)
    parts[:, PARTS.index("discretisation")] += _norms(gradients - coarser)
    squares = squares_of(fine.values, fine.factors)
    numbers = {"squared_distance": squares, "error": parts.sum(axis=1), "error_part": parts}
    dataset = labelled(order, numbers, lattice_attributes(fine.weights.lattice, fine.field))
    for name in ("error", "error_part"):
        dataset[name].attrs = {**dataset[name].attrs, "units": NUMBER}
    dims = (*dataset["error"].dims, "vertex", "axis")
    values = gradients.reshape(*dataset["error"].shape, *gradients.shape[1:])
    return dataset.assign(gradient=(dims, values, VARIABLES["gradient"])).assign_coords(axis=["x", "y", "z"])


class _Difference:
    """The difference of the transforms of a mesh and its target on the half lattice, by one choice of settings."""

    def __init__(
        self,
        mesh: Mesh,
        target: Operand,
        lattice: Lattice | None,
        orders: tuple[float, ...],
        settings: TransformSettings,
        execution: Execution,
    ) -> None:
        self.mesh, self.field = mesh, field_of(target, lattice, orders, settings.eps)
        # A given field has an error of its own.
        self.is_given = isinstance(target, xr.DataArray)
        self.weights = SobolevWeights(Lattice.from_field(self.field), orders)
        self.factors = factors_of(self.weights)
        self.transform = MeshTransform.from_mesh(mesh, self.weights.lattice, settings, execution)
        self.values = self.transform.transform(np.asarray(mesh.vertices)) - field_values(self.field)

    def gradients(self, factors: Reals) -> Reals:
        """Return the derivatives of `squares_of` the values with respect to the vertices, (orders, n, 3)."""
        return np.array([2 * self._derivative(one * self.values) for one in factors])

    def _derivative(self, coefficients: Complexes) -> Reals:
        return self.transform.derivative(np.asarray(self.mesh.vertices), coefficients)

    def errors(self, gradients: Reals) -> Reals:
        """Return the parts of the gradients' errors (orders, part), besides quadrature and NUFFT."""
        quality = quality_of(self.field)
        if quality is None:
            return np.full((len(gradients), len(PARTS)), np.nan)
        extent = Extent.union([self.mesh.extent, quality.extent])
        support = Support(np.array(self.mesh.area + quality.area), extent.widths)
        none = np.zeros(len(gradients))
        # A given field's own error counts by the largest change of the transform by a movement.
        own = zip(self.factors, quality.error_norms(self.weights), strict=True) if self.is_given else ()
        of_field = np.array([2 * self._sensitivity(one) * error for one, error in own]) if self.is_given else none
        return np.stack([self._truncation(support), self._aliasing(support, gradients), of_field, none], axis=1)

    def _truncation(self, support: Support) -> Reals:
        """Estimate the derivative of the tail: to that of the outer half lattice it is as the squares are."""
        lattice = self.weights.lattice
        outer = self.factors * (lattice.shells(lattice.half) >= (lattice.M // 4) ** 2)
        sums = sums_of_shells(shell_sums(self.values, None, lattice, lattice.half), self.weights)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.nan_to_num(truncated(sums, self.weights, support) / squares_of(self.values, outer), posinf=0.0)
        return np.asarray(_TRUNCATION_CAUTION * ratios * _norms(self.gradients(outer)))

    def _aliasing(self, support: Support, gradients: Reals) -> Reals:
        """Estimate the part of images at the period, from the change if images came to half of it."""
        lattice, orders = self.weights.lattice, self.weights.orders
        x, y, z = (lattice.half.indices(axis) % 2 == 0 for axis in range(3))
        even = x[:, None, None] & y[:, None] & z
        changes = _norms(self.gradients(8.0 * self.factors * even) - gradients)
        decays = [decay_to_period(lattice.spacing, order, support.widths) for order in orders]
        return np.asarray(_ALIASING_CAUTION * changes * decays)

    def _sensitivity(self, factors: Reals) -> float:
        """Return the largest norm of the transform's derivative along movements of length 1, by power iteration."""
        vertices = np.asarray(self.mesh.vertices)
        step = _DIFFERENCE * self.mesh.edge_length_range[0]
        movement = self._derivative(factors * self.values)
        largest = 0.0
        for _ in range(_POWER_STEPS):
            movement = movement / max(float(np.linalg.norm(movement)), np.finfo(np.float64).tiny)
            length = step / max(float(np.abs(movement).max()), np.finfo(np.float64).tiny)
            ends = [self.transform.transform(vertices + sign * length * movement) for sign in (1, -1)]
            change = (ends[0] - ends[1]) / (2 * length)
            largest = max(largest, float(np.sqrt(np.sum(factors * np.abs(change) ** 2))))
            movement = self._derivative(factors * change)
        return _POWER_CAUTION * largest


def _norms(gradients: Reals) -> Reals:
    return np.asarray(np.sqrt(np.sum(gradients**2, axis=(1, 2))))
