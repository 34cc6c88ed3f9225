"""Tori: smooth surfaces, and the grids of triangles that are inscribed in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.interval import Interval
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import is_finite_number

Reals = NDArray[np.float64]

# The square of a larger one overflows.
_LARGEST_RADIUS = 1e150
# Around the axis, and around the tube.
_INTERVALS = Interval(0.0, 2 * math.pi, periodic=True), Interval(0.0, 2 * math.pi, periodic=True)
# Triangles of the largest grid: what is more is a typing error.
MOST_TRIANGLES = 10**9


@dataclass(frozen=True)
class Torus(Smooth):
    """The torus around an axis along z, in the user's unit of length.

    Args:
        R: from the centre to the middle of the tube.
        r: of the tube; less than R.
        center: of the torus.

    Raises:
        InputError: radii that are not finite with 0 < r < R, or a centre that is not three finite numbers.
    """

    R: float = 1.0
    r: float = 0.4
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (is_finite_number(self.R) and is_finite_number(self.r) and 0 < self.r < self.R):
            raise InputError(f"a torus needs finite radii with 0 < r < R, found R = {self.R} and r = {self.r}")
        if float(self.R) > _LARGEST_RADIUS:
            raise InputError(f"a torus's radii must be at most {_LARGEST_RADIUS:g}, found {self.R}")
        if len(self.center) != 3 or not all(map(is_finite_number, self.center)):
            raise InputError(f"a torus's center must be three finite numbers, found {self.center}")
        object.__setattr__(self, "R", float(self.R))
        object.__setattr__(self, "r", float(self.r))
        object.__setattr__(self, "center", tuple(float(x) for x in self.center))

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """The angle around the axis, and that around the tube, which is 0 farthest from the axis."""
        return _INTERVALS

    def positions(self, u: Reals, v: Reals) -> Reals:
        """x(u, v), float64 (3, ...)."""
        radii = self.R + self.r * np.cos(v)
        return np.stack(
            [
                self.center[0] + radii * np.cos(u),
                self.center[1] + radii * np.sin(u),
                self.center[2] + self.r * np.sin(v),
            ]
        )

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals]:
        """x_u and x_v, float64 (3, ...) each."""
        radii, cosines, sines = self.R + self.r * np.cos(v), np.cos(u), np.sin(u)
        along_u = np.stack([-radii * sines, radii * cosines, np.zeros_like(u)])
        slope = -self.r * np.sin(v)
        return along_u, np.stack([slope * cosines, slope * sines, self.r * np.cos(v)])

    def moved(self, scale: float, origin: tuple[float, float, float]) -> Torus:
        """The torus after x -> scale * (x - origin)."""
        x, y, z = (scale * (p - o) for p, o in zip(self.center, origin, strict=True))
        return Torus(scale * self.R, scale * self.r, (x, y, z))

    @cached_property
    def area(self) -> float:
        """Area 4π²Rr, in squared units of length."""
        return 4 * math.pi**2 * self.R * self.r

    def highest_along(self, directions: Reals) -> Reals:
        """The greatest x · direction over the surface (k,), for unit vectors (k, 3), in units of length."""
        reach = self.R * np.hypot(directions[:, 0], directions[:, 1]) + self.r
        return np.asarray(directions @ np.array(self.center) + reach)

    @property
    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre and radius of the sphere that holds the surface."""
        return self.center, self.R + self.r

    def mesh(self, around: int, across: int) -> Mesh:
        """A grid of points on the torus, each of its cells cut into two triangles by the same diagonal.

        Args:
            around: cells around the axis.
            across: cells around the tube.

        Returns:
            around * across vertices and twice as many triangles, facing outwards.

        Raises:
            InputError: counts that are not integers of at least 3, or of more than a billion triangles.
        """
        counts = around, across
        if not all(isinstance(n, int) and not isinstance(n, bool) and n >= 3 for n in counts):
            raise InputError(f"a grid of a torus needs at least 3 cells each way, found {around!r} and {across!r}")
        if 2 * around * across > MOST_TRIANGLES:
            raise InputError(f"a grid of a torus has at most {MOST_TRIANGLES} triangles, found {2 * around * across}")
        angles = (2 * math.pi / n * np.arange(n) for n in counts)
        vertices = self.positions(*np.meshgrid(*angles, indexing="ij")).reshape(3, -1).T
        here = np.arange(around * across).reshape(counts)
        ahead, up = np.roll(here, -1, axis=0), np.roll(here, -1, axis=1)
        beyond = np.roll(ahead, -1, axis=1)
        cells = np.stack([here, ahead, beyond, here, beyond, up], axis=-1)
        return Mesh(vertices, cells.reshape(-1, 3))
