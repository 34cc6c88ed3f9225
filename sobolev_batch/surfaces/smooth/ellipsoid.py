"""Ellipsoids as smooth surfaces, and icospheres stretched onto them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import elliprg

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.subdivision import icosphere
from sobolev_batch.surfaces.shapes.surface import LARGEST_LENGTH, Point, checked_point, is_finite_number, moved_point
from sobolev_batch.surfaces.smooth.smooth import Interval, Smooth

Reals = NDArray[np.float64]

# In the cosine of the polar angle the rule of a sphere is exact on spherical harmonics.
_INTERVALS = Interval(-1.0, 1.0), Interval(0.0, 2 * math.pi, periodic=True)


@dataclass(frozen=True)
class Ellipsoid(Smooth):
    """The ellipsoid Σ ((x_i - c_i) / a_i)² = 1, in the user's unit of length.

    Args:
        axes: Semi-axes a along x, y and z.
        center: Centre c.

    Raises:
        InputError: The semi-axes are not three positive finite numbers, or the centre is not three
            finite numbers.

    >>> import sobolev_batch as sb
    >>> ellipsoid = sb.Ellipsoid((1.0, 0.8, 0.5))
    >>> f"{ellipsoid.area:.4f} {ellipsoid.mesh(5).area:.4f}"
    '7.3056 7.3034'
    """

    axes: Point = (1.0, 1.0, 1.0)
    center: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.axes) != 3 or not all(is_finite_number(axis) and axis > 0 for axis in self.axes):
            raise InputError(f"an ellipsoid's semi-axes must be three positive finite numbers, found {self.axes}")
        if not all(1 / LARGEST_LENGTH <= float(axis) <= LARGEST_LENGTH for axis in self.axes):
            raise InputError(
                f"an ellipsoid's semi-axes must lie between {1 / LARGEST_LENGTH:g} and {LARGEST_LENGTH:g}, "
                f"found {self.axes}"
            )
        object.__setattr__(self, "axes", tuple(map(float, self.axes)))
        object.__setattr__(self, "center", checked_point(self.center, "an ellipsoid's center"))

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of the cosine of the polar angle, from pole to pole along z, and of the azimuth."""
        return _INTERVALS

    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...)."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        x, y, z = self.center
        return np.stack([x + a * radii * np.cos(v), y + b * radii * np.sin(v), z + c * u])

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        """Return x_u and x_v, float64 (3, ...) each; u must lie between the poles."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        cosines, sines = np.cos(v), np.sin(v)
        slopes = -u / radii
        along_u = np.stack([a * slopes * cosines, b * slopes * sines, np.full_like(u, c)])
        return along_u, np.stack([-a * radii * sines, b * radii * cosines, np.zeros_like(u)])

    def moved(self, scale: float, origin: Point) -> Ellipsoid:
        """Return the ellipsoid after x -> scale * (x - origin)."""
        a, b, c = self.axes
        return Ellipsoid((scale * a, scale * b, scale * c), moved_point(self.center, scale, origin))

    @cached_property
    def area(self) -> float:
        """Area 4π R_G(a²b², a²c², b²c²), in squared units of length.

        B. C. Carlson, "Elliptic integrals", https://dlmf.nist.gov/19.33.E1.
        """
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
