"""Similarity transforms, which bring all surfaces of a study to its unit of length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import Point, Surface, checked_point, is_finite_number

SurfaceType = TypeVar("SurfaceType", bound=Surface)


@dataclass(frozen=True)
class Similarity:
    """The map x -> scale * (x - origin), from the unit of length of the surfaces to that of the study.

    Args:
        scale: Factor of all lengths.
        origin: Point that goes to the origin, in the unit of length of the surfaces.

    Raises:
        InputError: The scale is not positive and finite, or the origin is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> millimetres = sb.Sphere(20.0, center=(10.0, 0.0, 0.0))
    >>> sb.Similarity(0.1, origin=(10.0, 0.0, 0.0)).apply(millimetres)
    Sphere(radius=2.0, center=(0.0, 0.0, 0.0))
    >>> sb.Similarity.to_unit_ball(millimetres)
    Similarity(scale=0.05, origin=(10.0, 0.0, 0.0))
    """

    scale: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.scale) and self.scale > 0):
            raise InputError(f"a similarity's scale must be positive and finite, found {self.scale}")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "origin", checked_point(self.origin, "a similarity's origin"))

    @classmethod
    def to_unit_ball(cls, surface: Surface) -> Similarity:
        """Return the similarity that takes the bounding sphere of a surface to the unit sphere at the origin.

        The bounding sphere lies around the centre of the bounding box and reaches the farthest point.
        Flat meshes have one too.

        Raises:
            InputError: It is a single point, or no surface, such as the path of a mesh that is still to be read.
        """
        if not hasattr(surface, "bounding_sphere"):
            raise InputError(f"a surface is needed, such as read_mesh({str(surface)[:50]!r}), found {type(surface)}")
        center, radius = surface.bounding_sphere
        if not radius > 0:
            raise InputError("a single point has no size to scale a study by; give the scaling, or another reference")
        return cls(1 / radius, center)

    @property
    def is_identity(self) -> bool:
        """True for the map that leaves every point in place."""
        return self.scale == 1.0 and self.origin == (0.0, 0.0, 0.0)

    def apply(self, surface: SurfaceType) -> SurfaceType:
        """Return the surface in the unit of length of the study."""
        return surface if self.is_identity else surface.moved(self.scale, self.origin)
