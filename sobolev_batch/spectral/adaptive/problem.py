"""A norm or a distance to compute, the accuracy that it needs, and its division among fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import AccuracyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.errors.a_priori import ErrorTarget, permits_single
from sobolev_batch.spectral.errors.budget import NormEstimate, Support
from sobolev_batch.spectral.errors.samples import Sample, draws_for, needs_probe
from sobolev_batch.spectral.fields import USUAL_DEGREE, Field
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.mesh_counts import shared_triangles
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]
Samples = tuple[Sample, ...]

# A distance is first estimated from a few frequencies; it is seldom less than this fraction of the estimate.
ESTIMATE_CAUTION = 0.7
# No field is exact to less than this fraction of its area. Near-duplicates are that close, and have no
# relative accuracy.
_ROUNDING = 1e-13
# Surfaces whose common centre is no further from the origin, relative to their extent, stay where they are.
_OFF_CENTER = 1e-3
_PAIR = 2


@dataclass(frozen=True, eq=False)
class Problem:
    """A norm of a surface, or a distance of two, and the accuracy to compute it to.

    Attributes:
        surfaces: One surface, or two; none where two surfaces cancel.
        orders: Orders s.
        accuracy: Accuracy of the norm or distance.
        support: Area of the surfaces together, and sizes of all surfaces that share the lattice.
        label: Name of the norm or distance in messages.
        threads: Threads to compute with.
    """

    surfaces: Sequence[Surface]
    orders: tuple[float, ...]
    accuracy: Accuracy
    support: Support
    label: str
    threads: int = 1

    @classmethod
    def of(
        cls, surfaces: Sequence[Surface], orders: tuple[float, ...], accuracy: Accuracy, label: str, threads: int
    ) -> Self:
        """Return the problem for surfaces alone, moved together to the centre of the lattice's period.

        Triangles that both surfaces have cancel, and are left out; none may remain.
        """
        surfaces = _without_shared_triangles(surfaces)
        if not surfaces:
            return cls((), orders, accuracy, Support(np.zeros(()), np.zeros(len(DIRECTIONS))), label, threads)
        surfaces = _centered(surfaces)
        extent = Extent.union([surface.extent for surface in surfaces])
        area = np.array(sum(surface.area for surface in surfaces))
        return cls(surfaces, orders, accuracy, Support(area, extent.widths, extent.reach), label, threads)

    @property
    def area(self) -> float:
        """Area of the surfaces together."""
        return float(self.support.areas)

    @property
    def inexact_count(self) -> int:
        """Number of fields among which an error is divided: those without a closed form, or 1."""
        return max(1, sum(needs_probe(surface, TransformSettings()) for surface in self.surfaces))

    @property
    def rounding(self) -> float:
        """Smallest norm that differs from zero by more than rounding."""
        return _ROUNDING * self.area

    def samples(self, lattice: Lattice) -> Samples:
        """Return samples of all surfaces at the same frequencies."""
        draws = draws_for(self.surfaces, lattice, self.orders, USUAL_DEGREE)
        return tuple(Sample.of(surface, draws) for surface in self.surfaces)

    def dtype(self, lattice: Lattice, target: ErrorTarget) -> ComplexDtype:
        """Return the cheapest dtype that meets a target."""
        single = all(permits_single(surface, lattice, target) for surface in self.surfaces)
        return "complex64" if single else "complex128"

    def require_above_rounding(self, values: Reals) -> None:
        """Refuse an accuracy of norms or distances (orders,) that lies below the rounding of fields.

        Raises:
            AccuracyError: The accuracy lies below rounding; the message gives the reachable rtol.
        """
        parts, floor = _discretisation_parts(self.orders, self.accuracy), self.rounding
        # A distance of no more than rounding is that of near-duplicates, and has no relative accuracy.
        below = (parts * values < floor) & (values > floor)
        if below.any():
            worst = int(np.argmax(below * floor / (parts * np.maximum(values, floor))))
            rtol = self.accuracy.rtol
            reachable = 2 * rtol * floor / float(parts[worst] * values[worst])
            raise AccuracyError(
                f"{self.label}: rtol {rtol:g} of about {values[worst]:.2g} at order {self.orders[worst]:g} is below "
                f"the rounding of double precision; about {reachable:.1g} can be reached",
                rtol,
                reachable,
            )


def error_target(values: Reals, orders: tuple[float, ...], accuracy: Accuracy, area: float) -> ErrorTarget:
    """Return the target of both fields of a pair together at these distances (orders,): never below rounding."""
    errors = np.maximum(_discretisation_parts(orders, accuracy) * values, _ROUNDING * area)
    return ErrorTarget(orders, tuple(errors.tolist()))


def _discretisation_parts(orders: Sequence[float], accuracy: Accuracy) -> Reals:
    return np.array([accuracy.discretisation_part(order) for order in orders])


def _without_shared_triangles(surfaces: Sequence[Surface]) -> Sequence[Surface]:
    """Return one surface, or what two do not have in common: both of them, one of them, or nothing."""
    if len(surfaces) < _PAIR or not all(isinstance(surface, Mesh) for surface in surfaces):
        return surfaces
    meshes = [surface for surface in surfaces if isinstance(surface, Mesh)]
    shared = shared_triangles(*(mesh.vertices[mesh.triangles] for mesh in meshes))
    if not shared[0].any():
        return surfaces
    rests = [
        Mesh.from_checked(mesh.vertices, np.ascontiguousarray(mesh.triangles[~in_both]))
        for mesh, in_both in zip(meshes, shared, strict=True)
    ]
    return [mesh for mesh in rests if len(mesh.triangles) and mesh.area > 0]


def _centered(surfaces: Sequence[Surface]) -> Sequence[Surface]:
    """Return the surfaces moved together to the centre of a lattice's period, which changes no distance."""
    lowest, highest = Extent.union([surface.extent for surface in surfaces]).box
    if np.all(np.abs(lowest + highest) <= _OFF_CENTER * (highest - lowest).max()):
        return surfaces
    x, y, z = ((lowest + highest) / 2).tolist()
    move = Similarity(1.0, (x, y, z))
    return [move.apply(surface) for surface in surfaces]


@dataclass(frozen=True, eq=False)
class Solution:
    """Norms or distances, and how they were computed.

    Attributes:
        estimate: Numbers with their errors, each (orders,).
        lattice: Lattice of the fields; None where nothing had to be computed.
        fields: Fields of the surfaces.
        octaves: Octaves that were measured beyond the lattice, as they were sampled.
    """

    estimate: NormEstimate
    lattice: Lattice | None = None
    fields: tuple[Field, ...] = ()
    octaves: tuple[OctaveSampling, ...] = ()

    @classmethod
    def zero(cls, orders: Sequence[float]) -> Self:
        """Return the distance of equal surfaces, for which nothing is computed."""
        return cls(NormEstimate(*np.zeros((5, len(orders)))))

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the numbers were computed with, as attributes."""
        if self.lattice is None:
            return {}
        settings = [field.settings for field in self.fields]
        return {
            "xi_max": self.lattice.xi_max,
            "M": self.lattice.M,
            "octaves": len(self.octaves),
            "highest_frequency": max([self.lattice.xi_max, *(one.octave.highest for one in self.octaves)]),
            "dtype": settings[0].dtype,
            "eps": [setting.eps for setting in settings],
            "tolerance": [setting.tolerance for setting in settings],
            "points": [field.points for field in self.fields],
        }
