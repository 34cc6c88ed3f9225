"""Spheres, ellipsoids and tori in closed form, and triangulations inscribed in them."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import elliprg

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import Interval, Smooth
from sobolev_batch.geometry.subdivision import icosphere
from sobolev_batch.geometry.surface import DIRECTIONS, LARGEST_LENGTH, Extent, Point, checked_point, is_finite_number
from sobolev_batch.parameters import is_whole_number

_ANGLE = Interval(0.0, 2 * math.pi, periodic=True)
# A larger grid is a typing error.
MOST_TRIANGLES = 10**9


@dataclass(frozen=True)
class Sphere:
    """A sphere, in the user's unit of length. Its Fourier transform has a closed form.

    Args:
        radius: Radius.
        center: Centre.

    Raises:
        InputError: The radius is not positive, or beyond 1e150, or the centre is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> sphere = sb.shapes.Sphere(2.0, center=(1.0, 0.0, 0.0))
    >>> f"{sphere.area:.4f}"
    '50.2655'
    """

    radius: float = 1.0
    center: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.radius) and 0 < float(self.radius) <= LARGEST_LENGTH):
            raise InputError(f"a sphere's radius must be positive, at most {LARGEST_LENGTH:g}, found {self.radius}")
        vars(self).update(radius=float(self.radius), center=checked_point(self.center, "a sphere's center"))

    @property
    def area(self) -> float:
        """Area, in squared units of length."""
        return 4 * math.pi * self.radius**2

    @cached_property
    def extent(self) -> Extent:
        """Extent along `DIRECTIONS`."""
        along = DIRECTIONS @ np.asarray(self.center)
        return Extent(tuple((along - self.radius).tolist()), tuple((along + self.radius).tolist()))

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre and radius of the sphere."""
        return self.center, self.radius

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the sphere after x -> scale * (x - origin)."""
        return type(self)(scale * self.radius, _moved(self.center, scale, origin))


@dataclass(frozen=True)
class Ellipsoid(Smooth):
    """The ellipsoid Σ ((x_i - c_i) / a_i)² = 1, in the user's unit of length.

    Args:
        axes: Semi-axes a along x, y and z.
        center: Centre c.

    Raises:
        InputError: The semi-axes are not three numbers from 1e-150 to 1e150, or the centre is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> ellipsoid = sb.shapes.Ellipsoid((1.0, 0.8, 0.5))
    >>> f"{ellipsoid.area:.4f} {ellipsoid.mesh(5).area:.4f}"
    '7.3056 7.3034'
    """

    axes: Point = (1.0, 1.0, 1.0)
    center: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        shortest = 1 / LARGEST_LENGTH
        axes = checked_point(self.axes, "an ellipsoid's semi-axes")
        if not all(shortest <= a <= LARGEST_LENGTH for a in axes):
            limits = f"between {shortest:g} and {LARGEST_LENGTH:g}"
            raise InputError(f"an ellipsoid's semi-axes must be three numbers {limits}, found {self.axes}")
        vars(self).update(axes=axes, center=checked_point(self.center, "an ellipsoid's center"))

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of the cosine of the polar angle, from pole to pole along z, and of the azimuth."""
        # In the cosine of the polar angle the rule of a sphere is exact on spherical harmonics.
        return Interval(-1.0, 1.0), _ANGLE

    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...)."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        x, y, z = self.center
        return _stacked(x + a * radii * np.cos(v), y + b * radii * np.sin(v), z + c * u)

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        """Return x_u and x_v, float64 (3, ...) each; u must lie between the poles."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        cosines, sines = np.cos(v), np.sin(v)
        slopes = -u / radii
        along_u = _stacked(a * slopes * cosines, b * slopes * sines, c)
        return along_u, _stacked(-a * radii * sines, b * radii * cosines, 0.0)

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the ellipsoid after x -> scale * (x - origin)."""
        a, b, c = self.axes
        return type(self)((scale * a, scale * b, scale * c), _moved(self.center, scale, origin))

    @cached_property
    def area(self) -> float:
        """Area 4π R_G(a²b², a²c², b²c²) (B. C. Carlson, https://dlmf.nist.gov/19.33.E1), in squared units of length."""
        largest = max(self.axes)
        a, b, c = (axis / largest for axis in self.axes)
        return float(4 * math.pi * largest**2 * elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2))

    def highest_along(self, directions: Reals) -> Reals:
        """Return the greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length."""
        return np.asarray(directions @ np.array(self.center) + np.linalg.norm(directions * self.axes, axis=1))

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre and radius of the smallest sphere that holds the surface."""
        return self.center, max(self.axes)

    def mesh(self, level: int) -> Mesh:
        """Return the icosphere T_level, stretched along the axes onto the ellipsoid.

        Raises:
            InputError: The level is not an integer from 0 to 12.
        """
        sphere = icosphere(level)
        return Mesh(sphere.vertices * self.axes + self.center, sphere.triangles)


@dataclass(frozen=True)
class Torus(Smooth):
    """A torus around an axis along z, in the user's unit of length.

    Args:
        R: Distance from the centre to the middle of the tube.
        r: Radius of the tube, less than R.
        center: Centre of the torus.

    Raises:
        InputError: The radii are not finite numbers with 0 < r < R, or the centre is not three finite numbers.

    >>> import sobolev_batch as sb
    >>> torus = sb.shapes.Torus(R=1.0, r=0.4)
    >>> f"{torus.area:.4f}"
    '15.7914'
    >>> torus.mesh(around=48, across=24)
    Mesh(1152 vertices, 2304 triangles)
    """

    R: float = 1.0
    r: float = 0.4
    center: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.R) and is_finite_number(self.r) and 0 < self.r < float(self.R) <= LARGEST_LENGTH):
            raise InputError(f"a torus needs 0 < r < R, R at most {LARGEST_LENGTH:g}, found R = {self.R}, r = {self.r}")
        vars(self).update(R=float(self.R), r=float(self.r), center=checked_point(self.center, "a torus's center"))

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of the angle around the axis and of that around the tube, 0 farthest from the axis."""
        return _ANGLE, _ANGLE

    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...)."""
        radii = self.R + self.r * np.cos(v)
        x, y, z = self.center
        return _stacked(x + radii * np.cos(u), y + radii * np.sin(u), z + self.r * np.sin(v))

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        """Return x_u and x_v, float64 (3, ...) each."""
        radii, cosines, sines = self.R + self.r * np.cos(v), np.cos(u), np.sin(u)
        along_u = _stacked(-radii * sines, radii * cosines, 0.0)
        slopes = -self.r * np.sin(v)
        return along_u, _stacked(slopes * cosines, slopes * sines, self.r * np.cos(v))

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the torus after x -> scale * (x - origin)."""
        return type(self)(scale * self.R, scale * self.r, _moved(self.center, scale, origin))

    @cached_property
    def area(self) -> float:
        """Area 4π²Rr, in squared units of length."""
        return 4 * math.pi**2 * self.R * self.r

    def highest_along(self, directions: Reals) -> Reals:
        """Return the greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length."""
        heights = self.R * np.hypot(directions[:, 0], directions[:, 1]) + self.r
        return np.asarray(directions @ np.array(self.center) + heights)

    @property
    def bounding_sphere(self) -> tuple[Point, float]:
        """Centre and radius of the smallest sphere that holds the surface."""
        return self.center, self.R + self.r

    def mesh(self, around: int, across: int) -> Mesh:
        """Return a grid of points on the torus, each of its cells cut into two triangles by the same diagonal.

        Args:
            around: Number of cells around the axis.
            across: Number of cells around the tube.

        Returns:
            A mesh of around * across vertices and twice as many triangles, facing outwards.

        Raises:
            InputError: The counts are not integers of at least 3, or make more than a billion triangles.
        """
        if not all(is_whole_number(n) and n >= 3 for n in (around, across)):
            raise InputError(f"a grid of a torus needs at least 3 cells each way, found {around!r} and {across!r}")
        # Not NumPy's, whose products may overflow.
        around, across = int(around), int(across)
        if 2 * around * across > MOST_TRIANGLES:
            raise InputError(f"a grid of a torus has at most {MOST_TRIANGLES} triangles, found {2 * around * across}")
        angles = (2 * math.pi / n * np.arange(n) for n in (around, across))
        vertices = self.positions(*np.meshgrid(*angles, indexing="ij")).reshape(3, -1).T
        corner = np.arange(around * across).reshape(around, across)
        ahead, above = np.roll(corner, -1, axis=0), np.roll(corner, -1, axis=1)
        opposite = np.roll(ahead, -1, axis=1)
        return Mesh(vertices, np.stack([corner, ahead, opposite, corner, opposite, above], axis=-1).reshape(-1, 3))


def _stacked(x: Reals, y: Reals, z: Reals | float) -> Reals:
    """Return vectors (3, ...) of coordinates that are broadcast to one shape (...)."""
    return np.stack(np.broadcast_arrays(x, y, z))


def _moved(point: Point, scale: float, origin: Point) -> Point:
    x, y, z = (scale * (coordinate - shift) for coordinate, shift in zip(point, origin, strict=True))
    return x, y, z
