"""A fit before it begins: mesh and target, checked and brought to a common centre and to one lattice."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Complexes, Indices, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.extras.fitting import DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.extras.fitting.adjoint import MeshTransform, field_values
from sobolev_batch.extras.fitting.derivatives import SquaredDistance, factors_of, squares_of
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.subdivision import Edges
from sobolev_batch.geometry.surface import Extent, Similarity, centering, is_finite_number
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.tolerance import Accuracy, core_lattice, lattice_of
from sobolev_batch.norms.budget import Support
from sobolev_batch.norms.fields import USUAL_DEGREE, Operand, Quality, common_lattice, field_for, field_of, quality_of
from sobolev_batch.parameters import check_flags, is_whole_number
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, choose_settings
from sobolev_batch.transform.lattice import Lattice, SobolevWeights, single_order
from sobolev_batch.transform.probe import Sample, draws_for, estimate

# Orders s, each with the weight of its squared distance in a sum.
OrderWeights = tuple[tuple[float, float], ...]

# Start and target whose sizes differ by this factor are in different units.
_OTHER_UNIT = 20.0
# Far away, very negative orders lead: their kernels are wide.
_COARSE_ORDER = -4.0
# The share of a squared distance at half the order, which keeps detail that the order itself hardly sees.
_DETAIL_SHARE, _HIGHEST_DETAILED = 0.1, -1.5
# A lattice for a fit holds waves as long as an edge, if its M permits.
_MOST_INTERVALS = 96
# Images of the surfaces may change a distance by this fraction, and surfaces may grow by this factor.
_ALIASING, _ROOM = 1e-2, 1.2
# Errors of fields, as fractions of the distance at the start and at the start of a stage.
_TARGET_FRACTION, _MESH_FRACTION = 2e-3, 0.02
# A distance of this many errors of its fields is not lowered any further.
_LEAST_ERRORS = 5.0
# Beyond, steps lose their digits.
MOST_SMOOTHING, MOST_STEPS = 1e12, 100_000


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit, see `fit`; OrderError or InputError where one is out of range."""

    order: float = DEFAULT_ORDER
    steps: int = DEFAULT_STEPS
    smoothing: float = DEFAULT_SMOOTHING
    keep_boundary: bool = False

    def __post_init__(self) -> None:
        order = single_order(self.order)
        if not is_whole_number(self.steps) or not 1 <= self.steps <= MOST_STEPS:
            raise InputError(f"steps must be a whole number from 1 to {MOST_STEPS:,}, found {self.steps!r}")
        if not is_finite_number(self.smoothing) or not 0 <= self.smoothing <= MOST_SMOOTHING:
            raise InputError(f"smoothing must be a number from 0 to {MOST_SMOOTHING:g}, found {self.smoothing!r}")
        check_flags(keep_boundary=self.keep_boundary)
        vars(self).update(order=order, steps=int(self.steps), smoothing=float(self.smoothing))

    @property
    def coarse_order(self) -> float:
        """Order that brings far meshes near."""
        return min(self.order, _COARSE_ORDER)

    @property
    def shares(self) -> OrderWeights:
        """Orders with the share of each in the objective."""
        detail = ((self.order / 2, _DETAIL_SHARE),) if self.order <= _HIGHEST_DETAILED else ()
        return (self.order, 1.0), *detail


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A mesh and the field of its target on one lattice.

    Attributes:
        start: The same mesh, prepared: moved to the centre, in units of length; no two of its vertices coincide.
        place: Vertex of the prepared mesh for each vertex of the given one.
        target: Target, moved with the mesh.
        values: Transform of the target on the half lattice.
        given: Target and lattice as they were given.
    """

    mesh: Mesh
    start: Mesh
    place: Indices
    move: Similarity
    target: Operand
    settings: FitSettings
    lattice: Lattice
    values: Complexes
    quality: Quality | None
    execution: Execution
    given: tuple[Operand, Lattice | None]

    @classmethod
    def for_target(
        cls, mesh: Mesh, target: Operand, lattice: Lattice | None, settings: FitSettings, execution: Execution
    ) -> Self:
        """Check mesh and target, and prepare them. The field of a surface is as accurate as the distance needs."""
        require_comparable(mesh, target)
        as_given, (start, place) = (target, lattice), welded(mesh)
        move, common = Similarity(), common_lattice((target,), lattice)
        if isinstance(target, xr.DataArray):
            given = field_of(target, common, (settings.order,))
            own, values, quality = Lattice.from_field(given), field_values(given), quality_of(given)
        else:
            move = centering([start, target]) if lattice is None else move
            start, target = move.apply(start), move.apply(target)
            orders = tuple(dict.fromkeys((settings.order, settings.coarse_order)))
            if common is None:
                extent = Extent.union([start.extent, target.extent])
                support = Support(np.array(start.area + target.area), _ROOM * extent.widths, _ROOM * extent.reach)
                period = 2 * core_lattice(support, orders, Accuracy(_ALIASING)).half_period
                common = lattice_of(1 / start.edge_length_range[0], period, _MOST_INTERVALS)
            own, draws = common, draws_for([start, target], common, orders, USUAL_DEGREE)
            distances = estimate([Sample.from_surface(surface, draws) for surface in (start, target)], orders)
            rounding = np.finfo(np.float64).eps * target.area
            accuracy = ErrorTarget(orders, tuple(np.maximum(_TARGET_FRACTION * distances, rounding).tolist()))
            field = field_for(target, own, accuracy, TransformSettings(), execution)
            values, quality = np.asarray(field.values, dtype=np.complex128), field.quality
        return cls(mesh, start, place, move, target, settings, own, values, quality, execution, as_given)

    def remade(self, mesh: Mesh) -> Self:
        """Return the problem of another mesh with the same target."""
        return self.for_target(mesh, *self.given, self.settings, self.execution)

    @property
    def free_vertices(self) -> Indices:
        """Vertices that may move: those of triangles, without boundaries if these are kept."""
        free = np.asarray(self.start.used_vertices)
        if self.settings.keep_boundary:
            edges = Edges.from_mesh(self.start)
            free = np.setdiff1d(free, edges.ends[edges.on_boundary])
        if not len(free):
            raise InputError("all vertices lie on the boundary: there is nothing to move")
        return free

    def given_mesh(self, vertices: Reals) -> Mesh:
        """Return the given mesh with positions of the prepared one, at its own place."""
        return Mesh(vertices[self.place] + np.asarray(self.move.origin), self.mesh.triangles)

    def squares(self, vertices: Reals, orders: Sequence[float]) -> Reals:
        """Return the squared distances with vertices at some positions, (orders,), from coarse settings."""
        difference = self._transform(vertices, TransformSettings(1e-4)).transform(vertices) - self.values
        return squares_of(difference, self._factors(orders))

    def relative_to(self, vertices: Reals, shares: OrderWeights) -> OrderWeights:
        """Return shares of orders, each over the squared distance with vertices at some positions."""
        orders = tuple(order for order, _ in shares)
        squares = np.maximum(self.squares(vertices, orders), np.finfo(np.float64).tiny)
        return tuple((order, share / square) for (order, share), square in zip(shares, squares, strict=True))

    def relative_distance(self, order: float) -> float:
        """Return the distance of the start over the norm of the target."""
        squares = self.squares(np.asarray(self.start.vertices), [order])
        return float(np.sqrt(squares / squares_of(self.values, self._factors([order])))[0])

    def objective(self, vertices: Reals, weights: OrderWeights) -> tuple[SquaredDistance, float]:
        """Return the weighted sum of squared distances, as exact as they need, and its least value that counts."""
        orders, factors = (tuple(numbers) for numbers in zip(*weights, strict=True))
        distances = np.sqrt(np.maximum(self.squares(vertices, orders), np.finfo(np.float64).tiny))
        target = ErrorTarget(orders, tuple((_MESH_FRACTION * distances).tolist()))
        mesh = Mesh(vertices, self.start.triangles)
        transform = self._transform(vertices, choose_settings(mesh, self.lattice, target, TransformSettings()))
        own = np.array(target.norms)
        errors = own if self.quality is None else own + self.quality.error_norms(SobolevWeights(self.lattice, orders))
        of_samples = sum(factor * one for factor, one in zip(factors, self._factors(orders), strict=True))
        floor = float(np.sum(np.array(factors) * (_LEAST_ERRORS * errors) ** 2))
        return SquaredDistance(transform, self.values, np.asarray(of_samples)), floor

    def _transform(self, vertices: Reals, settings: TransformSettings) -> MeshTransform:
        return MeshTransform.from_mesh(Mesh(vertices, self.start.triangles), self.lattice, settings, self.execution)

    def _factors(self, orders: Sequence[float]) -> Reals:
        return factors_of(SobolevWeights(self.lattice, tuple(orders)))


def require_comparable(mesh: Mesh, target: Operand) -> None:
    """Refuse a mesh and target that lie apart or are in different units."""
    found = quality_of(target) if isinstance(target, xr.DataArray) else target
    if found is None:
        return
    own, other = (one.extent.widths.max() for one in (mesh, found))
    if not 1 / _OTHER_UNIT < own / other < _OTHER_UNIT:
        raise InputError(f"the start is {own:.3g} units wide and the target {other:.3g}: are both in the same unit?")
    (low, high), (other_low, other_high) = mesh.extent.box, found.extent.box
    if np.any(low > other_high) or np.any(other_low > high):
        a, b, c, d = (f"({', '.join(f'{x:.3g}' for x in corner)})" for corner in (low, high, other_low, other_high))
        raise InputError(f"the start ({a} to {b}) and the target ({c} to {d}) do not overlap: move one to the other")


def welded(mesh: Mesh) -> tuple[Mesh, Indices]:
    """Return a mesh without coinciding vertices, and the vertex there of each vertex of the mesh."""
    # Zero has two signs.
    places, place = np.unique(mesh.vertices + 0.0, axis=0, return_inverse=True)
    return Mesh(places, place.reshape(-1)[mesh.triangles]), place.reshape(-1)
