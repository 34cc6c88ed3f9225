"""The sources `icosphere` and `sphere`: surfaces that are made, not read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from sobolev_batch.surfaces.icosphere import FINEST_LEVEL, icosphere
from sobolev_batch.surfaces.similarity import Surface
from sobolev_batch.surfaces.sources import MOST_ENTRIES, Fingerprint, Member, Size, Source, at_most, installed_version
from sobolev_batch.surfaces.sphere import Sphere

# Measured peak of the subdivision, for each triangle that it makes.
_MAKING_BYTES = 140

Level = Annotated[int, Field(ge=0, le=FINEST_LEVEL)]
Levels = Annotated[tuple[Level, ...], Field(min_length=1, strict=False), at_most(MOST_ENTRIES)]


class Icospheres(Source):
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


class Spheres(Source):
    """A sphere in closed form.

    Attributes:
        radius: in units of length.
        center: likewise.
    """

    radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    center: Annotated[
        tuple[
            Annotated[float, Field(allow_inf_nan=False)],
            Annotated[float, Field(allow_inf_nan=False)],
            Annotated[float, Field(allow_inf_nan=False)],
        ],
        Field(strict=False),
    ] = (0.0, 0.0, 0.0)

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
