"""Point clouds with an area for each point, checked once and then frozen."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import MeshError, OrderError
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.mesh import checked_points
from sobolev_batch.surfaces.shapes.surface import LARGEST_LENGTH, Point, Surface, is_finite_number

Reals = NDArray[np.float64]

# The norm of a Dirac measure is finite only for orders below this one: (1 + |ξ|²)^s is integrable in three dimensions.
HIGHEST_ORDER = -1.5
_SMALLEST_AREA, _LARGEST_AREA = 1e-100, 1e100
_LISTED = 3


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A point cloud, as a sum of Dirac measures: each point stands for a piece of a surface, with its area as weight.

    Both arrays are copied, converted to float64 and made read-only. Its norm is finite for orders s < -3/2 only. Points
    may repeat: their areas add up.

    Args:
        points: Coordinates, real (n, 3), finite, n > 0, in the user's unit of length.
        weights: Area of each point, real (n,), positive and finite, in squared units of length. For points that all
            stand for the same area, see `uniform`.

    Raises:
        MeshError: There are no points or no weights, the shapes differ, or numbers are not finite or not positive. The
            message names the entries.

    >>> import sobolev_batch as sb
    >>> corners = sb.icosphere(2)
    >>> cloud = sb.PointCloud(corners.vertices[:3], [0.1, 0.2, 0.3])
    >>> cloud, round(cloud.area, 12)
    (PointCloud(3 points), 0.6)
    """

    points: Reals
    weights: Reals

    def __init__(self, points: ArrayLike, weights: ArrayLike | None = None) -> None:
        if weights is None:
            raise MeshError(
                "a point cloud needs the area of each point; for equal areas, pass the total area of the surface: "
                "PointCloud.uniform(points, area), for example that of the mesh that you compare the cloud with"
            )
        checked = checked_points(points, "points")
        if not len(checked):
            raise MeshError("the point cloud has no points")
        largest = float(np.abs(checked).max())
        if largest > LARGEST_LENGTH:
            raise MeshError(f"the points have coordinates so large that squared lengths overflow: {largest:.3g}")
        object.__setattr__(self, "points", checked)
        object.__setattr__(self, "weights", _checked_weights(weights, len(checked)))
        if not _SMALLEST_AREA <= self.area <= _LARGEST_AREA:
            raise MeshError(
                f"the areas of the points add up to {self.area:.3g}, beyond what double precision can square (from "
                f"{_SMALLEST_AREA:g} to {_LARGEST_AREA:g}); take another unit of length"
            )

    @classmethod
    def uniform(cls, points: ArrayLike, area: float) -> PointCloud:
        """Return a cloud whose points all stand for the same area.

        That holds for points that were drawn uniformly, not for those of a scanner, which lie denser where it is near.

        Args:
            points: Coordinates, real (n, 3), finite, in the user's unit of length.
            area: Total area, in squared units of length.

        Raises:
            MeshError: As for the class, or the area is not positive and finite.

        >>> import sobolev_batch as sb
        >>> mesh = sb.icosphere(3)
        >>> cloud = sb.PointCloud.uniform(mesh.vertices, mesh.area)
        >>> f"{sb.distance(cloud, mesh, -4, rtol=1e-2)['distance'].item():.1e}"
        '6.6e-02'
        """
        if not (is_finite_number(area) and area > 0):
            raise MeshError(f"the total area of a point cloud must be positive and finite, found {area!r}")
        checked = checked_points(points, "points")
        return cls(checked, np.full(len(checked), float(area) / max(len(checked), 1)))

    @cached_property
    def area(self) -> float:
        """Sum of the weights, in squared units of length."""
        with np.errstate(over="ignore"):
            return float(self.weights.sum())

    @cached_property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""
        return Extent.of_points(np.ascontiguousarray(self.points.T))

    @property
    def bounds(self) -> tuple[Reals, Reals]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre of the bounding box, and distance from it to the farthest point; zero for a single point."""
        lower, upper = self.bounds
        center = lower + (upper - lower) / 2
        radius = float(np.linalg.norm(self.points - center, axis=1).max())
        return (float(center[0]), float(center[1]), float(center[2])), radius

    def moved(self, scale: float, origin: Point) -> PointCloud:
        """Return the cloud after x -> scale * (x - origin), with areas times scale squared."""
        return PointCloud(scale * (self.points - np.asarray(origin)), scale**2 * self.weights)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the points and weights, in hexadecimal."""
        digest = hashlib.sha256()
        for array in (self.points, self.weights):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        return digest.hexdigest()

    def __repr__(self) -> str:
        return f"PointCloud({len(self.points)} points)"

    def __reduce__(self) -> tuple[type[PointCloud], tuple[Reals, Reals]]:
        return PointCloud, (self.points, self.weights)


def require_finite_norm(orders: Sequence[float]) -> None:
    """Refuse orders at which the norm of a point cloud is infinite.

    Raises:
        OrderError: One of the orders is not below -3/2.
    """
    infinite = [order for order in orders if not order < HIGHEST_ORDER]
    if infinite:
        raise OrderError(
            f"the norm of a point cloud is finite only for orders below -3/2, found {infinite[0]:g}: the Fourier "
            "transform of a point does not decay. Take a more negative order, such as -2, or a mesh of the points"
        )


def clouds_among(surfaces: Sequence[Surface]) -> list[PointCloud]:
    """Return the point clouds among some surfaces."""
    return [surface for surface in surfaces if isinstance(surface, PointCloud)]


def without_common_points(first: PointCloud, second: PointCloud) -> tuple[PointCloud | None, PointCloud | None]:
    """Return two clouds of the same difference that share no point; None for one of which nothing remains.

    Clouds that share none are returned as they are.
    """
    signed = np.concatenate([first.weights, -second.weights])
    places, weights = merged_weights(np.concatenate([first.points, second.points]), signed)
    if len(places) == sum(len(merged_weights(cloud.points, cloud.weights)[0]) for cloud in (first, second)):
        return first, second
    rests = ((places[sign * weights > 0], sign * weights[sign * weights > 0]) for sign in (1, -1))
    own, other = (PointCloud(points, some) if len(points) else None for points, some in rests)
    return own, other


def merged_weights(points: Reals, weights: Reals) -> tuple[Reals, Reals]:
    """Return each different point (m, 3) once, and the sum of its weights (m,), which may have any sign."""
    # Zero has two signs.
    places, members = np.unique(points + 0.0, axis=0, return_inverse=True)
    return places, np.bincount(members.ravel(), weights=weights, minlength=len(places)).astype(np.float64, copy=False)


def _checked_weights(weights: ArrayLike, count: int) -> Reals:
    try:
        array = np.asarray(weights)
    except ValueError as error:
        raise MeshError("weights must be one number for each point") from error
    if array.dtype.kind not in "fiu" or np.ma.is_masked(weights):
        raise MeshError(f"weights must be real numbers without masked entries, found dtype {array.dtype}")
    if array.shape != (count,):
        raise MeshError(f"weights must have shape ({count},), one for each point, found {array.shape}")
    checked = np.array(array, dtype=np.float64)
    bad = np.flatnonzero(~(np.isfinite(checked) & (checked > 0)))
    if bad.size:
        entries = ", ".join(f"#{row} = {checked[row]}" for row in bad[:_LISTED])
        raise MeshError(
            f"{bad.size} of {count} weights are not positive and finite: {entries}{', ...' * (len(bad) > _LISTED)}; "
            "leave points without area out"
        )
    checked.setflags(write=False)
    return checked
