"""The sources of surfaces that are made, not read: smooth ones, and triangulations that converge to them.

`sphere`, `ellipsoid` and `torus` are the smooth ones, `icosphere`, `ellipsoid-levels` and `torus-grid` their levels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.ellipsoid import Ellipsoid
from sobolev_batch.surfaces.shapes.icosphere import FINEST_LEVEL, icosphere
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.shapes.torus import MOST_TRIANGLES, Torus
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    Fingerprint,
    Member,
    Size,
    Source,
    at_most,
    installed_version,
)

# Measured peak of the subdivision, for each triangle that it makes.
_MAKING_BYTES = 140

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False)]
Lengths = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Cells = Annotated[int, Field(ge=3, le=MOST_TRIANGLES)]
Level = Annotated[int, Field(ge=0, le=FINEST_LEVEL)]
Levels = Annotated[tuple[Level, ...], Field(min_length=1, strict=False), at_most(MOST_ENTRIES)]


class IcosphereSource(Source):
    """Icosahedral triangulations T_N of the unit sphere.

    Attributes:
        levels: the levels N to make.
    """

    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """One member per level, coarse to fine."""
        return tuple(IcosphereMember(str(level), level) for level in sorted(set(self.levels)))


@dataclass(frozen=True)
class IcosphereMember(Member):
    """The icosphere whose level is the member's."""

    def load(self) -> Surface:
        """Make the mesh."""
        return icosphere(self.level)

    def fingerprint(self) -> Fingerprint:
        """The level, and the version of the library that subdivides."""
        return {"icosphere": self.level, "trimesh": installed_version("trimesh")}

    def expected_size(self) -> Size:
        """Its number of triangles is known."""
        triangles = 20 * 4**self.level
        return Size(triangles, _MAKING_BYTES * triangles)


class SphereSource(Source):
    """A sphere in closed form.

    Attributes:
        radius: in units of length.
        center: likewise.
    """

    radius: Length = 1.0
    center: Triple = (0.0, 0.0, 0.0)

    def members(self, folder: Path) -> tuple[Member, ...]:
        """The one sphere."""
        return (SphereMember("sphere", -1, Sphere(self.radius, self.center)),)


@dataclass(frozen=True)
class SphereMember(Member):
    """A sphere."""

    sphere: Sphere

    def load(self) -> Surface:
        """The sphere itself."""
        return self.sphere

    def fingerprint(self) -> Fingerprint:
        """Its radius and centre."""
        return {"sphere": [self.sphere.radius, *self.sphere.center]}


@dataclass(frozen=True)
class SmoothMember(Member):
    """A parametrised surface, which must survive pickling.

    Attributes:
        surface: the surface.
        identity: JSON-able values that determine it: the name of its parametrisation, its parameters, and the
            version of what makes it.
    """

    surface: Smooth
    identity: Fingerprint

    def load(self) -> Surface:
        """The surface itself."""
        return self.surface

    def fingerprint(self) -> Fingerprint:
        """What was named as its identity."""
        return self.identity


class EllipsoidSource(Source):
    """An ellipsoid as a smooth surface.

    Attributes:
        axes: the semi-axes along x, y and z, in units of length.
        center: likewise.
    """

    axes: Lengths
    center: Triple = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Ellipsoid:
        """The surface."""
        return Ellipsoid(self.axes, self.center)

    @property
    def identity(self) -> dict[str, list[float]]:
        """What determines it."""
        return {"ellipsoid": [*self.shape.axes, *self.shape.center]}

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        _require(Ellipsoid, self.axes, self.center)
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """The one ellipsoid."""
        return (SmoothMember("ellipsoid", -1, self.shape, self.identity),)


class EllipsoidLevelsSource(EllipsoidSource):
    """Icospheres with their vertices moved onto an ellipsoid.

    Attributes:
        levels: of the icospheres.
    """

    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """One member per level, coarse to fine."""
        return tuple(EllipsoidMember(str(level), level, self.shape) for level in sorted(set(self.levels)))


@dataclass(frozen=True)
class EllipsoidMember(Member):
    """The icosphere whose level is the member's, stretched."""

    ellipsoid: Ellipsoid

    def load(self) -> Surface:
        """Make the mesh."""
        return self.ellipsoid.mesh(self.level)

    def fingerprint(self) -> Fingerprint:
        """The ellipsoid, the level, and the version of the library that subdivides."""
        shape = [*self.ellipsoid.axes, *self.ellipsoid.center]
        return {"ellipsoid level": self.level, "ellipsoid": shape, "trimesh": installed_version("trimesh")}

    def expected_size(self) -> Size:
        """Its number of triangles is known."""
        triangles = 20 * 4**self.level
        return Size(triangles, _MAKING_BYTES * triangles)


class TorusSource(Source):
    """A torus as a smooth surface, its axis along z.

    Attributes:
        R: from the centre to the middle of the tube, in units of length.
        r: of the tube; less than R.
        center: in units of length.
    """

    R: Length
    r: Length
    center: Triple = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> Torus:
        """The surface."""
        return Torus(self.R, self.r, self.center)

    @property
    def identity(self) -> dict[str, list[float]]:
        """What determines it."""
        return {"torus": [self.shape.R, self.shape.r, *self.shape.center]}

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        _require(Torus, self.R, self.r, self.center)
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """The one torus."""
        return (SmoothMember("torus", -1, self.shape, self.identity),)


class TorusGridSource(TorusSource):
    """Grids of points on a torus, each cell of them cut into two triangles.

    Attributes:
        levels: N, each with twice as many cells each way as the one before.
        around: cells around the axis at level 0.
        across: cells around the tube at level 0.
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
        """One member per level, coarse to fine."""
        return tuple(
            TorusMember(str(level), level, self.shape, self.around << level, self.across << level)
            for level in sorted(set(self.levels))
        )


@dataclass(frozen=True)
class TorusMember(Member):
    """A grid on a torus."""

    torus: Torus
    around: int
    across: int

    def load(self) -> Surface:
        """Make the mesh."""
        return self.torus.mesh(self.around, self.across)

    def fingerprint(self) -> Fingerprint:
        """The torus and the cells each way."""
        shape = [self.torus.R, self.torus.r, *self.torus.center]
        return {"torus grid": [self.around, self.across], "torus": shape}

    def expected_size(self) -> Size:
        """Its number of triangles is known."""
        triangles = 2 * self.around * self.across
        return Size(triangles, _MAKING_BYTES * triangles)


def _require(shape: Callable[..., Smooth], *parameters: object) -> None:
    """Refuse parameters that make no surface."""
    try:
        shape(*parameters)
    except InputError as error:
        raise ValueError(str(error)) from error
