"""Families from formulas: closed forms and their triangulations; docs/studies.md has their keys."""

from dataclasses import astuple, fields
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from sobolev_batch.errors import refused_by_pydantic
from sobolev_batch.geometry.closed_forms import MOST_TRIANGLES, Ellipsoid, Sphere, Torus
from sobolev_batch.geometry.subdivision import FINEST_LEVEL, icosphere
from sobolev_batch.sources.registry import Fingerprint, MadeMember, Member, Several, Source, SurfaceMember

# A level of known size; 140 is the measured peak of the subdivision, for each triangle that it makes.
_triangulation = partial(MadeMember, triangle_bytes=140)

ClosedForm = Sphere | Ellipsoid | Torus

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False)]
Lengths = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Cells = Annotated[int, Field(ge=3, le=MOST_TRIANGLES)]
Levels = Several[Annotated[int, Field(ge=0, le=FINEST_LEVEL)]]


class ClosedFormSource(Source):
    """A source of a closed form, whose fields a subclass has, or of its triangulations where that has levels."""

    label: ClassVar[str]
    form: ClassVar[type[ClosedForm]]

    @property
    def shape(self) -> ClosedForm:
        """The surface."""
        return self.form(**{one.name: getattr(self, one.name) for one in fields(self.form)})

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        with refused_by_pydantic():
            _ = self.shape
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return the one surface, or a triangulation for each level, coarse to fine."""
        identity = {self.label: np.hstack(astuple(self.shape)).tolist()}
        if (levels := getattr(self, "levels", None)) is None:
            return (SurfaceMember(self.label, -1, self.shape, identity),)
        return tuple(self.triangulation(level, identity) for level in sorted(set(levels)))

    def triangulation(self, level: int, identity: Fingerprint) -> Member:
        """Return the triangulation of a level, for surfaces that have them, from the fingerprint of the surface."""
        raise NotImplementedError


class SphereSource(ClosedFormSource):
    """A sphere in closed form."""

    label, form = "sphere", Sphere

    radius: Length = 1.0
    center: Triple = (0.0, 0.0, 0.0)


class EllipsoidSource(ClosedFormSource):
    """An ellipsoid as a smooth surface, or icospheres with their vertices moved onto it."""

    label, form = "ellipsoid", Ellipsoid

    axes: Lengths
    center: Triple = (0.0, 0.0, 0.0)
    levels: Levels | None = None

    def triangulation(self, level: int, identity: Fingerprint) -> Member:
        """Return the icosphere of a level, moved onto the ellipsoid."""
        own = {"ellipsoid level": level, **identity}
        return _triangulation(str(level), level, Ellipsoid.mesh, own, (self.shape, level), triangles=20 << 2 * level)


class TorusSource(ClosedFormSource):
    """A torus as a smooth surface, its axis along z, or grids of points on it, each cell cut into two triangles.

    Each level has twice as many cells each way as the one before.
    """

    label, form = "torus", Torus

    R: Length
    r: Length
    center: Triple = (0.0, 0.0, 0.0)
    levels: Levels | None = None
    around: Cells = 12
    across: Cells = 6

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        finest = max(self.levels or (0,))
        triangles = 2 * self.around * self.across * 4**finest
        if triangles > MOST_TRIANGLES:
            cells = f"level {finest} of {self.around} x {self.across} cells"
            raise ValueError(f"{cells} has {triangles} triangles, at most {MOST_TRIANGLES} are allowed")
        return self

    def triangulation(self, level: int, identity: Fingerprint) -> Member:
        """Return the grid of a level."""
        around, across = self.around << level, self.across << level
        own, triangles = {"torus grid": [around, across], **identity}, 2 * around * across
        return _triangulation(str(level), level, Torus.mesh, own, (self.shape, around, across), triangles=triangles)


class IcosphereSource(Source):
    """Icosahedral triangulations T_N of the unit sphere."""

    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        levels = sorted(set(self.levels))
        return tuple(
            _triangulation(str(n), n, icosphere, {"icosphere": n}, (n,), triangles=20 << 2 * n) for n in levels
        )
