"""The one similarity transform that brings all surfaces of a study to its unit of length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import Surface

SurfaceType = TypeVar("SurfaceType", bound=Surface)


@dataclass(frozen=True)
class Similarity:
    """The map x -> scale * (x - origin), from the meshes' own unit of length to the study's.

    Raises:
        InputError: a scale that is not positive and finite, or an origin that is not three finite
            numbers.
    """

    scale: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"a similarity's scale must be positive and finite, found {self.scale}")
        if len(self.origin) != 3 or not all(math.isfinite(x) for x in self.origin):
            raise InputError(f"a similarity's origin must be three finite numbers, found {self.origin}")

    @classmethod
    def to_unit_ball(cls, surface: Surface) -> Similarity:
        """The similarity that takes a surface's bounding sphere to the unit sphere at the origin.

        A mesh's bounding sphere is the one around the centre of its bounding box that reaches its
        farthest vertex: it exists for flat meshes too and depends on nothing but the vertices. That of a
        parametrised surface likewise reaches its farthest point.
        """
        center, radius = surface.bounding_sphere
        return cls(1 / radius, center)

    @property
    def is_identity(self) -> bool:
        """Whether the map leaves every point where it is."""
        return self.scale == 1.0 and self.origin == (0.0, 0.0, 0.0)

    def apply(self, surface: SurfaceType) -> SurfaceType:
        """Return the surface in the study's unit of length."""
        return surface if self.is_identity else surface.moved(self.scale, self.origin)
