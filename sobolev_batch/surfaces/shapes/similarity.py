"""Similarity transforms to the unit of length of a study, and doubts whether two surfaces are in one unit and place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import Extent, Point, Surface, checked_point, is_finite_number

SurfaceType = TypeVar("SurfaceType", bound=Surface)

# Factors between units that people mix up: cm and mm, inches and mm, m and cm, m and mm.
_UNITS = (10.0, 25.4, 100.0, 1000.0)
# Sizes of one surface in two units differ by such a factor within this fraction, as meshes are not the same.
_UNIT_MARGIN = 0.2
# Surfaces whose sizes differ by more are hardly the same object.
_MOST_RATIO = 4.0
# Of the smaller box, the fraction that overlaps with the other one at least.
_LEAST_OVERLAP = 0.3
# Around each box, as a fraction of the smaller size.
_MARGIN = 0.05
# A surface may extend beyond the reference's box by this fraction of its size.
_MOST_BEYOND = 0.25


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


def placement_doubt(extent: Extent, reference: Extent) -> str | None:
    """Return what makes one doubt that a surface can be compared with a reference, as a question; None if nothing does.

    Args:
        extent: Extent of the surface.
        reference: Extent of the reference, in the same unit of length.

    >>> from sobolev_batch import Sphere
    >>> placement_doubt(Sphere(25.4).extent, Sphere().extent)
    'it is 25.4 times as large as the reference: are both in the same unit of length?'
    >>> placement_doubt(Sphere(1.0, (1.5, 1.5, 0.0)).extent, Sphere().extent)
    'its bounding box hardly overlaps with that of the reference: are both in the same place?'
    """
    size, reference_size = float(extent.widths.max()), float(reference.widths.max())
    if size == 0 or reference_size == 0:
        # A single point is of any size.
        return None
    ratio = size / reference_size
    factor = max(ratio, 1 / ratio)
    if factor > _MOST_RATIO:
        near = [unit for unit in _UNITS if abs(factor / unit - 1) <= _UNIT_MARGIN]
        shown = f"about {near[0]:g}" if near and abs(factor / near[0] - 1) > 1e-3 else f"{factor:.3g}"
        word = "large" if ratio > 1 else "small"
        return f"it is {shown} times as {word} as the reference: are both in the same unit of length?"
    (low, high), (other_low, other_high) = extent.box, reference.box
    # Flat surfaces have boxes without a volume.
    margin = _MARGIN * min(size, reference_size)
    common = np.minimum(high, other_high) - np.maximum(low, other_low) + 2 * margin
    smaller = np.minimum(high - low, other_high - other_low) + 2 * margin
    if float(np.prod(np.clip(common / smaller, 0.0, 1.0))) < _LEAST_OVERLAP:
        return "its bounding box hardly overlaps with that of the reference: are both in the same place?"
    beyond = float(max(np.max(other_low - low), np.max(high - other_high)))
    if beyond > _MOST_BEYOND * reference_size:
        part = 100 * beyond / reference_size
        return f"it reaches beyond the reference by {part:.0f} % of its size: do both show the same object?"
    return None
