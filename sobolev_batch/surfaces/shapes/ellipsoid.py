"""Ellipsoids: smooth surfaces, and the icospheres that are stretched onto them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import elliprg

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.icosphere import icosphere
from sobolev_batch.surfaces.shapes.interval import Interval
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import is_finite_number

Reals = NDArray[np.float64]

# The square of a larger one overflows, that of a smaller one vanishes.
_LARGEST_AXIS = 1e150
# The cosine of the polar angle, which makes the rule of a sphere exact on spherical harmonics; and the azimuth.
_INTERVALS = Interval(-1.0, 1.0), Interval(0.0, 2 * math.pi, periodic=True)


@dataclass(frozen=True)
class Ellipsoid(Smooth):
    """The ellipsoid Σ ((x_i - c_i) / a_i)² = 1, in the user's unit of length.

    Args:
        axes: the semi-axes a along x, y and z.
        center: c.

    Raises:
        InputError: semi-axes that are not three positive finite numbers, or a centre that is not three
            finite numbers.
    """

    axes: tuple[float, float, float] = (1.0, 1.0, 1.0)
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.axes) != 3 or not all(is_finite_number(axis) and axis > 0 for axis in self.axes):
            raise InputError(f"an ellipsoid's semi-axes must be three positive finite numbers, found {self.axes}")
        if not all(1 / _LARGEST_AXIS <= float(axis) <= _LARGEST_AXIS for axis in self.axes):
            raise InputError(
                f"an ellipsoid's semi-axes must lie between {1 / _LARGEST_AXIS:g} and {_LARGEST_AXIS:g}, "
                f"found {self.axes}"
            )
        if len(self.center) != 3 or not all(map(is_finite_number, self.center)):
            raise InputError(f"an ellipsoid's center must be three finite numbers, found {self.center}")
        object.__setattr__(self, "axes", tuple(float(axis) for axis in self.axes))
        object.__setattr__(self, "center", tuple(float(x) for x in self.center))

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """The cosine of the polar angle, from pole to pole along z, and the azimuth."""
        return _INTERVALS

    def positions(self, u: Reals, v: Reals) -> Reals:
        """x(u, v), float64 (3, ...)."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        return np.stack(
            [
                self.center[0] + a * radii * np.cos(v),
                self.center[1] + b * radii * np.sin(v),
                self.center[2] + c * u,
            ]
        )

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        """x_u and x_v, float64 (3, ...) each; between the poles."""
        (a, b, c), radii = self.axes, np.sqrt((1 - u) * (1 + u))
        cosines, sines = np.cos(v), np.sin(v)
        growth = -u / radii
        along_u = np.stack([a * growth * cosines, b * growth * sines, np.full_like(u, c)])
        return along_u, np.stack([-a * radii * sines, b * radii * cosines, np.zeros_like(u)])

    def moved(self, scale: float, origin: tuple[float, float, float]) -> Ellipsoid:
        """The ellipsoid after x -> scale * (x - origin)."""
        (a, b, c), (x, y, z) = self.axes, (scale * (p - o) for p, o in zip(self.center, origin, strict=True))
        return Ellipsoid((scale * a, scale * b, scale * c), (x, y, z))

    @cached_property
    def area(self) -> float:
        """Area, in squared units of length: 4π R_G(a²b², a²c², b²c²).

        B. C. Carlson, "Elliptic integrals", https://dlmf.nist.gov/19.33.E1.
        """
        largest = max(self.axes)
        a, b, c = (axis / largest for axis in self.axes)
        return float(4 * math.pi * largest**2 * elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2))

    def highest_along(self, directions: Reals) -> Reals:
        """The greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length."""
        return np.asarray(directions @ np.array(self.center) + np.linalg.norm(directions * self.axes, axis=1))

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre and radius of the sphere that holds the surface."""
        return self.center, max(self.axes)

    def mesh(self, level: int) -> Mesh:
        """The icosphere T_level with its vertices moved onto the ellipsoid, along the axes.

        Raises:
            InputError: a level that is not an integer from 0 to 12.
        """
        ball = icosphere(level)
        return Mesh(ball.vertices * self.axes + self.center, ball.triangles)
