"""How close a mesh is to its target, by several measures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import xarray as xr

from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.fitting.optimisation.shapes import smallest_angle
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import Operand
from sobolev_batch.spectral.metrics.norms import distance
from sobolev_batch.surfaces.proximity import proximity
from sobolev_batch.surfaces.shapes.mesh import Mesh

# Relative errors of distances that are asked for, one after the other.
_RTOLS = (0.02, 0.1)


@dataclass(frozen=True)
class Closeness:
    """Distances of a mesh from its target, and the quality of its triangles.

    Attributes:
        distance: Sobolev distance, in the square root of a unit length.
        error: Error of the distance.
        hausdorff: Hausdorff distance, a lower bound in units of length; NaN without VTK or a target of triangles.
        chamfer: Chamfer distance, in units of length; NaN likewise.
        smallest_angle: Smallest angle of all triangles, in degrees.
        relative: Distance over the norm of the target.
        relative_error: Error of that.

    >>> import sobolev_batch as sb
    >>> sb.Closeness(distance=0.5, error=0.01, smallest_angle=30.0).distance
    0.5
    """

    distance: float
    error: float
    hausdorff: float = np.nan
    chamfer: float = np.nan
    smallest_angle: float = np.nan
    relative: float = np.nan
    relative_error: float = np.nan

    @classmethod
    def unknown(cls) -> Self:
        """Return the closeness of a mesh that was not measured."""
        return cls(np.nan, np.nan)

    @classmethod
    def of(cls, mesh: Mesh, target: Operand, order: float, lattice: Lattice) -> Self:
        """Measure how close a mesh is to a surface, or to a field on a lattice.

        The distance is measured to a relative accuracy where the target is a surface, else on the lattice.
        """
        found = None
        for rtol in () if isinstance(target, xr.DataArray) else _RTOLS:
            try:
                found = distance(mesh, target, order, rtol=rtol)
                break
            except AccuracyError:
                continue
        if found is None:
            found = distance(mesh, target, order, lattice=lattice)
        numbers = {name: found[name].item() for name in ("distance", "error", "relative", "relative_error")}
        closeness = cls(**numbers, smallest_angle=smallest_angle(mesh))
        if not isinstance(target, Mesh):
            return closeness
        try:
            near = proximity(mesh, target)
        except InputError:
            return closeness
        return replace(closeness, hausdorff=near.hausdorff, chamfer=near.chamfer)
