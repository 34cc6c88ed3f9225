"""The one similarity transform that brings all surfaces of a study to its unit of length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere

Surface = Mesh | Sphere | Smooth


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
        if isinstance(surface, Sphere):
            return cls(1 / surface.radius, surface.center)
        if isinstance(surface, Smooth):
            middle, reach = surface.bounding_sphere
            return cls(1 / reach, middle)
        lower, upper = surface.bounds
        center = lower + (upper - lower) / 2
        radius = float(np.linalg.norm(surface.vertices[surface.used_vertices] - center, axis=1).max())
        return cls(1 / radius, (float(center[0]), float(center[1]), float(center[2])))

    @property
    def is_identity(self) -> bool:
        """Whether the map leaves every point where it is."""
        return self.scale == 1.0 and self.origin == (0.0, 0.0, 0.0)

    @overload
    def apply(self, surface: Mesh) -> Mesh: ...

    @overload
    def apply(self, surface: Surface) -> Surface: ...

    def apply(self, surface: Surface) -> Surface:
        """The surface in the study's unit of length."""
        if self.is_identity:
            return surface
        if isinstance(surface, Sphere):
            moved = [self.scale * (c - o) for c, o in zip(surface.center, self.origin, strict=True)]
            return Sphere(self.scale * surface.radius, (moved[0], moved[1], moved[2]))
        if isinstance(surface, Smooth):
            return surface.moved(self.scale, self.origin)
        moved_vertices = surface.vertices - np.asarray(self.origin)
        moved_vertices *= self.scale
        # Read-only, so that the mesh takes it over: of huge meshes a copy would count.
        moved_vertices.setflags(write=False)
        return Mesh(moved_vertices, surface.triangles)
