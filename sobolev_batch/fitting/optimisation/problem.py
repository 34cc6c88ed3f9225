"""A mesh and the field of its target on one lattice: what a fit computes with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.fitting.derivative.objective import SquaredDistance, factors_of
from sobolev_batch.fitting.derivative.transform import MeshTransform
from sobolev_batch.spectral.adaptive.lattice_selection import core_lattice, lattice_of
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends.arrays import Complexes
from sobolev_batch.spectral.errors.a_priori import ErrorTarget, choose_settings
from sobolev_batch.spectral.errors.budget import Support
from sobolev_batch.spectral.errors.probe import Sample, draws_for, estimate
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.fields import USUAL_DEGREE, field_for
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import field_values, quality_of
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Extent, Surface

Reals = NDArray[np.float64]

# A lattice for a fit holds waves as long as an edge, if its M permits.
_MOST_INTERVALS = 96
# Images of the surfaces may change a distance by this fraction, and surfaces may grow by this factor.
_ALIASING, _ROOM = 1e-2, 1.2
# Errors of fields, as fractions of the distance at the start and at the start of a stage.
_TARGET_FRACTION, _MESH_FRACTION = 2e-3, 0.02
# A distance of so many errors of its fields is not lowered any further.
_LEAST_ERRORS = 5.0


@dataclass(frozen=True, eq=False)
class Weighting:
    """Orders whose squared distances are added, each with a factor.

    Attributes:
        orders: Orders s.
        factors: Factor of each squared distance.
    """

    orders: tuple[float, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A mesh, and the field of its target.

    Attributes:
        mesh: Mesh at the start, in units of length; no two of its vertices coincide.
        lattice: Lattice of the field.
        target: Transform of the target on the half lattice.
        quality: Quality of this field, from which its errors follow; None if unknown.
        execution: Threads.
    """

    mesh: Mesh
    lattice: Lattice
    target: Complexes
    quality: Quality | None
    execution: Execution

    @classmethod
    def of_field(cls, mesh: Mesh, field: xr.DataArray, execution: Execution) -> Self:
        """Return the problem for a target of which only a field is known."""
        return cls(mesh, Lattice.of(field), field_values(field), quality_of(field), execution)

    @classmethod
    def of_surface(
        cls, mesh: Mesh, surface: Surface, lattice: Lattice | None, orders: tuple[float, ...], execution: Execution
    ) -> Self:
        """Return the problem for a surface, whose field is as accurate as the distance needs.

        Raises:
            LatticeError: The mesh or the surface does not fit into the lattice.
        """
        lattice = lattice or fit_lattice(mesh, surface, orders)
        draws = draws_for([mesh, surface], lattice, orders, USUAL_DEGREE)
        distances = estimate([Sample.from_surface(one, draws) for one in (mesh, surface)], orders)
        rounding = np.finfo(np.float64).eps * surface.area
        target = ErrorTarget(orders, tuple(np.maximum(_TARGET_FRACTION * distances, rounding).tolist()))
        field = field_for(surface, lattice, target, TransformSettings(), execution)
        return cls(mesh, lattice, np.asarray(field.values, dtype=np.complex128), field.quality, execution)

    def squares(self, vertices: Reals, orders: Sequence[float]) -> Reals:
        """Return the squared distances with vertices at some positions, (orders,), from coarse settings."""
        difference = self._transform(vertices, TransformSettings(1e-4)).at(vertices).transform() - self.target
        energies = difference.real**2 + difference.imag**2
        return np.array([float(np.sum(factors * energies)) for factors in self._factors(orders)])

    def weighting(self, vertices: Reals, shares: Sequence[tuple[float, float]]) -> Weighting:
        """Return orders with their shares, each relative to the squared distance with vertices at some positions."""
        orders = tuple(order for order, _ in shares)
        squares = np.maximum(self.squares(vertices, orders), np.finfo(np.float64).tiny)
        return Weighting(orders, tuple(share / one for (_, share), one in zip(shares, squares, strict=True)))

    def relative(self, vertices: Reals, order: float) -> float:
        """Return the distance with vertices at some positions over the norm of the target."""
        energies = self.target.real**2 + self.target.imag**2
        norm = float(np.sum(self._factors([order])[0] * energies))
        return float(np.sqrt(self.squares(vertices, [order])[0] / norm))

    def objective(self, vertices: Reals, weighting: Weighting) -> tuple[SquaredDistance, float]:
        """Return the weighted sum of squared distances, and the value down to which its fields can be trusted.

        Quadrature and eps follow from the value at the vertices: the farther away, the coarser.
        """
        orders = weighting.orders
        distances = np.sqrt(np.maximum(self.squares(vertices, orders), np.finfo(np.float64).tiny))
        target = ErrorTarget(orders, tuple((_MESH_FRACTION * distances).tolist()))
        mesh = Mesh(vertices, self.mesh.triangles)
        transform = self._transform(vertices, choose_settings(mesh, self.lattice, target, TransformSettings()))
        own = np.array(target.norms)
        errors = own if self.quality is None else own + self.quality.error_norms(SobolevWeights(self.lattice, orders))
        factors = sum(factor * one for factor, one in zip(weighting.factors, self._factors(orders), strict=True))
        floor = float(np.sum(np.array(weighting.factors) * (_LEAST_ERRORS * errors) ** 2))
        return SquaredDistance(transform, self.target, np.asarray(factors)), floor

    def _transform(self, vertices: Reals, settings: TransformSettings) -> MeshTransform:
        return MeshTransform.of(Mesh(vertices, self.mesh.triangles), self.lattice, settings, self.execution)

    def _factors(self, orders: Sequence[float]) -> Reals:
        return factors_of(SobolevWeights(self.lattice, tuple(orders)))


def fit_lattice(mesh: Mesh, target: Surface, orders: tuple[float, ...]) -> Lattice:
    """Return a lattice for fits: it reaches to wavelengths of an edge, as far as a moderate M allows."""
    extent = Extent.union([mesh.extent, target.extent])
    support = Support(np.array(mesh.area + target.area), _ROOM * extent.widths, _ROOM * extent.reach)
    period = 2 * core_lattice(support, orders, Accuracy(_ALIASING)).half_period
    return lattice_of(1 / mesh.edge_length_range[0], period, _MOST_INTERVALS)
