"""The protocol of surfaces and their extents, the map to the unit of a study, and doubts about unit and place."""

import math
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from itertools import product
from numbers import Real
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals, slices
from sobolev_batch.errors import InputError

Point = tuple[float, float, float]

# Squares of larger lengths overflow, squares of the reciprocal vanish.
LARGEST_LENGTH = 1e150

_NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)], dtype=np.float64)
# The axes, the diagonals of the faces and those of the cube: unit vectors (13, 3).
_LENGTHS = np.linalg.norm(_NEIGHBOURS, axis=1)
DIRECTIONS: Reals = _NEIGHBOURS / _LENGTHS[:, None]
# Points that are measured at a time: their temporaries stay in cache.
_BATCH = 1 << 15
_AXES = [int(np.argmax(np.abs(DIRECTIONS[:, axis]))) for axis in range(3)]
SurfaceType = TypeVar("SurfaceType", bound="Surface")

# Surfaces whose sizes differ by more are hardly the same object.
_MOST_RATIO = 4.0
# What such a ratio suggests, where it is met to this fraction of it.
_UNITS = {
    10: "millimetres and the other in centimetres",
    25.4: "millimetres and the other in inches",
    100: "centimetres and the other in metres",
    1000: "millimetres and the other in metres",
}
_UNIT_MARGIN = 0.02
# The least fraction of the smaller box that overlaps with the other one.
_LEAST_OVERLAP = 0.3
# Around each box, as a fraction of the smaller size.
_MARGIN = 0.05
# A surface may extend beyond the reference's box by this fraction of its size.
_MOST_BEYOND = 0.25


@dataclass(frozen=True)
class Extent:
    """The least and the greatest x · direction over a surface, for each of `DIRECTIONS`.

    Attributes:
        lowest: Least values (13,), in units of length.
        highest: Greatest values (13,), in units of length.
    """

    lowest: tuple[float, ...]
    highest: tuple[float, ...]

    @classmethod
    def union(cls, extents: Sequence[Self]) -> Self:
        """Return the extent of several surfaces together."""
        lowest = np.min([extent.lowest for extent in extents], axis=0)
        highest = np.max([extent.highest for extent in extents], axis=0)
        return cls(tuple(lowest.tolist()), tuple(highest.tolist()))

    @classmethod
    def of_points(cls, coordinates: Reals) -> Self:
        """Return the extent of points (3, n), n > 0."""
        # Products with -1, 0 and 1 have no rounding.
        batches = (_NEIGHBOURS @ coordinates[:, part] for part in slices(coordinates.shape[1], _BATCH))
        ends = ((along.min(axis=1) / _LENGTHS, along.max(axis=1) / _LENGTHS) for along in batches)
        return cls.union([cls(tuple(low.tolist()), tuple(high.tolist())) for low, high in ends])

    @property
    def widths(self) -> Reals:
        """Width along each direction (13,), in units of length."""
        return np.subtract(self.highest, self.lowest)

    @property
    def box(self) -> tuple[Reals, Reals]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        return np.array(self.lowest)[_AXES], np.array(self.highest)[_AXES]

    @property
    def reach(self) -> float:
        """Largest |coordinate|, in units of length."""
        return float(np.abs(self.box).max())


class Surface(Protocol):
    """A surface in three-dimensional space, in the user's unit of length: a mesh or a closed form."""

    @property
    def area(self) -> float:
        """Total area, in squared units of length."""

    @property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre of the bounding box, and radius of the smallest sphere around it that holds the surface."""

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""


@dataclass(frozen=True)
class Similarity:
    """The map x -> scale * (x - origin), from the unit of length of the surfaces to that of the study.

    Args:
        scale: Factor of all lengths.
        origin: Point that goes to the origin, in the unit of length of the surfaces.

    Raises:
        InputError: The scale is not positive and finite, or the origin is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> millimetres = sb.shapes.Sphere(20.0, center=(10.0, 0.0, 0.0))
    >>> sb.shapes.Similarity(0.1, origin=(10.0, 0.0, 0.0)).apply(millimetres)
    Sphere(radius=2.0, center=(0.0, 0.0, 0.0))
    >>> sb.shapes.Similarity.to_unit_ball(millimetres)
    Similarity(scale=0.05, origin=(10.0, 0.0, 0.0))
    """

    scale: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.scale) and self.scale > 0):
            raise InputError(f"a similarity's scale must be positive and finite, found {self.scale}")
        vars(self).update(scale=float(self.scale), origin=checked_point(self.origin, "a similarity's origin"))

    @classmethod
    def to_unit_ball(cls, surface: Surface) -> Self:
        """Return the similarity that takes the bounding sphere of a surface to the unit sphere at the origin.

        The sphere lies around the centre of the bounding box and reaches the farthest point; flat meshes have one too.

        Raises:
            InputError: It is a single point, or no surface, such as the path of a mesh that is still to be read.
        """
        _require_surface(surface)
        center, radius = surface.bounding_sphere
        if not radius > 0:
            raise InputError("a single point has no size to scale a study by; give the scaling, or another reference")
        return cls(1 / radius, center)

    @property
    def is_identity(self) -> bool:
        """True for the map that leaves every point in place."""
        return self.scale == 1.0 and self.origin == (0.0, 0.0, 0.0)

    def apply(self, surface: SurfaceType) -> SurfaceType:
        """Return the surface in the unit of length of the study; InputError if it is none, such as bare arrays."""
        _require_surface(surface)
        return surface if self.is_identity else surface.moved(self.scale, self.origin)


def _require_surface(value: object) -> None:
    if not hasattr(value, "bounding_sphere"):
        raise InputError(f"a surface is needed, as as_mesh makes one of arrays or of a file, found {type(value)}")


def centering(surfaces: Sequence[Surface], tolerance: float = 0.0) -> Similarity:
    """Return the move of surfaces together to the origin; none where they are as near, relative to their size."""
    low, high = Extent.union([surface.extent for surface in surfaces]).box
    if np.all(np.abs(low + high) <= tolerance * (high - low).max()):
        return Similarity()
    x, y, z = ((low + high) / 2).tolist()
    return Similarity(1.0, (x, y, z))


def placement_doubt(extent: Extent, reference: Extent) -> str | None:
    """Return what makes one doubt that a surface can be compared with a reference, as a question; None if nothing does.

    >>> from sobolev_batch.shapes import Sphere
    >>> placement_doubt(Sphere(25.4).extent, Sphere().extent)
    'it is 25.4 times as large as the reference: is one in millimetres and the other in inches?'
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
        word = "large" if ratio > 1 else "small"
        units = next((names for one, names in _UNITS.items() if abs(factor / one - 1) < _UNIT_MARGIN), "")
        question = f"is one in {units}" if units else "are both in the same unit of length"
        return f"it is {float(f'{factor:.3g}'):,g} times as {word} as the reference: {question}?"
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


def is_finite_number(value: object) -> bool:
    """Return whether a value is a finite real number other than True and False."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def checked_point(point: Sequence[float], label: str) -> Point:
    """Return a point as three floats; InputError, which begins with the label, where it is not three finite numbers."""
    given = [*point] if isinstance(point, Iterable) and not isinstance(point, Set) else []
    if len(given) != 3 or not all(map(is_finite_number, given)):
        raise InputError(f"{label} must be three finite numbers, found {point!r}")
    x, y, z = map(float, given)
    return x, y, z


def normals(vertices: Reals, triangles: NDArray[np.integer]) -> Reals:
    """Return the normals of triangles (m, 3), each as long as twice its area."""
    a, b, c = (vertices[corner] for corner in triangles.T)
    return np.asarray(np.cross(b - a, c - a))
