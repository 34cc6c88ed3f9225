"""Sources of closed-form surfaces, and of triangulations that converge to them.

`sphere`, `ellipsoid` and `torus` are closed forms; `icosphere`, `ellipsoid-levels` and `torus-grid` triangulate them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.closed_forms import MOST_TRIANGLES, Ellipsoid, Sphere, Torus
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.subdivision import FINEST_LEVEL, icosphere
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    Fingerprint,
    MadeMember,
    Member,
    Source,
    SurfaceMember,
    at_most,
)

# Measured peak of the subdivision, for each triangle that it makes.
_SUBDIVISION_BYTES = 140

ClosedForm = Sphere | Ellipsoid | Torus

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False)]
Lengths = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Cells = Annotated[int, Field(ge=3, le=MOST_TRIANGLES)]
Level = Annotated[int, Field(ge=0, le=FINEST_LEVEL)]
Levels = Annotated[tuple[Level, ...], Field(min_length=1, strict=False), at_most(MOST_ENTRIES)]


class ClosedFormSource(Source, ABC):
    """A source of one surface in closed form."""

    label: ClassVar[str]

    @property
    @abstractmethod
    def shape(self) -> ClosedForm:
        """The surface."""

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        try:
            _ = self.shape
        except InputError as error:
            raise ValueError(str(error)) from error
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return the one surface, with its parameters as its fingerprint."""
        return (SurfaceMember(self.label, -1, self.shape, {self.label: _parameters(self.shape)}),)


class SphereSource(ClosedFormSource):
    """A sphere in closed form.

    Attributes:
        radius: Radius, in units of length.
        center: Centre, in units of length.
    """

    label = "sphere"

    radius: Length = 1.0
    center: Triple = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Sphere:
        """The sphere."""
        return Sphere(self.radius, self.center)


class EllipsoidSource(ClosedFormSource):
    """An ellipsoid as a smooth surface.

    Attributes:
        axes: Semi-axes along x, y and z, in units of length.
        center: Centre, in units of length.
    """

    label = "ellipsoid"

    axes: Lengths
    center: Triple = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Ellipsoid:
        """The ellipsoid."""
        return Ellipsoid(self.axes, self.center)


class TorusSource(ClosedFormSource):
    """A torus as a smooth surface, its axis along z.

    Attributes:
        R: Distance from the centre to the middle of the tube, in units of length.
        r: Radius of the tube, less than R.
        center: Centre, in units of length.
    """

    label = "torus"

    R: Length
    r: Length
    center: Triple = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Torus:
        """The torus."""
        return Torus(self.R, self.r, self.center)


class IcosphereSource(Source):
    """Icosahedral triangulations T_N of the unit sphere.

    Attributes:
        levels: Levels N.
    """

    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        return tuple(
            _triangulation(level, icosphere, (level,), {"icosphere": level}, 20 << 2 * level)
            for level in sorted(set(self.levels))
        )


class EllipsoidLevelsSource(EllipsoidSource):
    """Icospheres with their vertices moved onto an ellipsoid.

    Attributes:
        levels: Levels of the icospheres.
    """

    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        shape = self.shape
        return tuple(
            _triangulation(
                level,
                Ellipsoid.mesh,
                (shape, level),
                {"ellipsoid level": level, "ellipsoid": _parameters(shape)},
                20 << 2 * level,
            )
            for level in sorted(set(self.levels))
        )


class TorusGridSource(TorusSource):
    """Grids of points on a torus, each cell cut into two triangles.

    Attributes:
        levels: Levels N, each with twice as many cells each way as the one before.
        around: Number of cells around the axis at level 0.
        across: Number of cells around the tube at level 0.
    """

    levels: Levels
    around: Cells = 12
    across: Cells = 6

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        triangles = 2 * self.around * self.across * 4 ** max(self.levels)
        if triangles > MOST_TRIANGLES:
            raise ValueError(
                f"level {max(self.levels)} of {self.around} x {self.across} cells has {triangles} triangles, "
                f"at most {MOST_TRIANGLES} are allowed"
            )
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        shape, members = self.shape, []
        for level in sorted(set(self.levels)):
            around, across = self.around << level, self.across << level
            identity = {"torus grid": [around, across], "torus": _parameters(shape)}
            members.append(_triangulation(level, Torus.mesh, (shape, around, across), identity, 2 * around * across))
        return tuple(members)


def _triangulation(
    level: int,
    make: Callable[..., Mesh],
    arguments: tuple[Any, ...],
    identity: Fingerprint,
    triangles: int,
) -> Member:
    """Return the member of a level, whose number of triangles is known before it is made."""
    return MadeMember(
        str(level),
        level,
        make,
        identity,
        arguments,
        triangles=triangles,
        triangle_bytes=_SUBDIVISION_BYTES,
    )


def _parameters(shape: ClosedForm) -> list[float]:
    """Return the parameters of a surface, in the order of its fields."""
    values: list[float] = np.hstack(astuple(shape)).tolist()
    return values
