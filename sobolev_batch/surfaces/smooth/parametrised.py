"""Surfaces given by a parametrisation of the user's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.surface import Point, checked_point, is_finite_number
from sobolev_batch.surfaces.smooth.smooth import Interval, Smooth

Reals = NDArray[np.float64]
# x, y and z at each pair of parameters; numbers stand for constants.
Vectors = Reals | Sequence[Reals | float]

# Largest gap between the ends of a periodic parameter, relative to the extent of the surface.
_CLOSED = 1e-9
# Derivatives are compared with differences over this fraction of an interval, whose error is about its square.
_STEP, _AGREEMENT = 1e-4, 1e-3
# Parameters along each interval at which both are checked.
_CHECKS = 7


@dataclass(frozen=True, eq=False)
class ParametrisedSurface(Smooth):
    """A surface x(u, v), as a reference or for comparison; its transform is good to the ``eps`` requested.

    The parametrisation must cover the surface once, and be smooth: at the ends of parameters too, and across
    those of periodic ones. Poles are allowed: an end of u or v may be one point, as on a sphere in its angles.
    The quadrature is the trapezoidal rule in periodic parameters and Gauss-Legendre in others, with as many
    nodes as it takes; see docs/numerics.md. In studies the functions travel to workers, so they must be
    picklable: functions of a module, or values with ``__call__``.

    Args:
        position: Function of u and v, float64 arrays of one shape (...), that returns x, y and z: three
            arrays (...) or numbers, in the user's unit of length.
        u: Interval of the first parameter.
        v: Interval of the second parameter.
        derivatives: Function of the same arguments that returns x_u and x_v, three arrays or numbers each.
            Without it, the interpolant through the nodes is differentiated, which costs at most 1e-13 of the
            area, and 120 bytes of memory for each node. With it, x_u may grow without bound towards a pole
            as long as |x_u × x_v| stays smooth, for example where u is the cosine of the polar angle.
        scale: Scale of the similarity x -> scale * (x - origin) that is applied to positions.
        origin: Origin of that similarity, in the unit of ``position``.

    Raises:
        InputError: A function returns something else or values that are not finite; the ends of a periodic
            parameter are apart; the derivatives are not those of the positions; or there is no area.

    >>> import sobolev_batch as sb
    >>> def saddle(u, v):
    ...     return u, v, 0.5 * (u**2 - v**2)
    >>> side = sb.Interval(-0.8, 0.8)
    >>> surface = sb.ParametrisedSurface(saddle, u=side, v=side)
    >>> f"{surface.area:.6f}"
    '3.044304'
    """

    position: Callable[[Reals, Reals], Vectors]
    u: Interval
    v: Interval
    derivatives: Callable[[Reals, Reals], tuple[Vectors, Vectors]] | None = None
    scale: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, interval in (("u", self.u), ("v", self.v)):
            if not isinstance(interval, Interval):
                raise InputError(f"{name} must run over an Interval, found {interval!r}")
        if not (is_finite_number(self.scale) and self.scale > 0):
            raise InputError(f"the scale must be positive and finite, found {self.scale!r}")
        checked_point(self.origin, "the origin")
        self._check_closed()
        self._check_derivatives()
        _ = self.area

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """Intervals of u and v."""
        return self.u, self.v

    def positions(self, u: Reals, v: Reals) -> Reals:
        """Return x(u, v), float64 (3, ...)."""
        positions = _vectors(self.position(u, v), u.shape, "position")
        positions -= np.reshape(self.origin, (3, *[1] * u.ndim))
        positions *= self.scale
        return positions

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals] | None:
        """Return x_u and x_v, float64 (3, ...) each; None without ``derivatives``."""
        if self.derivatives is None:
            return None
        tangents = self.derivatives(u, v)
        if not isinstance(tangents, tuple | list) or len(tangents) != 2:
            raise InputError(f"derivatives must return two vectors, x_u and x_v, found {type(tangents).__name__}")
        along_u, along_v = tangents
        return self.scale * _vectors(along_u, u.shape, "x_u"), self.scale * _vectors(along_v, u.shape, "x_v")

    def moved(self, scale: float, origin: Point) -> Self:
        """Return the surface after x -> scale * (x - origin)."""
        x, y, z = (old + shift / self.scale for old, shift in zip(self.origin, origin, strict=True))
        return replace(self, scale=scale * self.scale, origin=(x, y, z))

    @cached_property
    def _size(self) -> float:
        lower, upper = self.bounds
        return float((upper - lower).max())

    def _check_closed(self) -> None:
        along_u, along_v = (np.linspace(interval.low, interval.high, _CHECKS) for interval in self.intervals)
        for name, interval, other in (("u", self.u, along_v), ("v", self.v, along_u)):
            if not interval.periodic:
                continue
            ends = [np.full(_CHECKS, end) for end in (interval.low, interval.high)]
            first, last = (self.positions(end, other) if name == "u" else self.positions(other, end) for end in ends)
            gap = float(np.abs(first - last).max())
            if not gap <= _CLOSED * self._size:
                raise InputError(
                    f"the surface is said to be periodic in {name}, but its positions at the ends {interval.low:g} and "
                    f"{interval.high:g} are up to {gap / self.scale:.3g} apart"
                )

    def _check_derivatives(self) -> None:
        u, v = (interval.low + interval.length * (np.arange(_CHECKS) + 0.5) / _CHECKS for interval in self.intervals)
        grid = np.meshgrid(u, v, indexing="ij")
        tangents = self.tangents(*grid)
        if tangents is None:
            return
        for name, axis in (("x_u", 0), ("x_v", 1)):
            step = _STEP * self.intervals[axis].length
            shift = [step * (i == axis) for i in range(2)]
            before = self.positions(grid[0] - shift[0], grid[1] - shift[1])
            after = self.positions(grid[0] + shift[0], grid[1] + shift[1])
            expected = (after - before) / (2 * step)
            error = float(np.abs(expected - tangents[axis]).max())
            largest = float(np.abs(expected).max()) + self._size / self.intervals[axis].length
            if not error <= _AGREEMENT * largest:
                raise InputError(
                    f"{name} is not the derivative of the position: differences of that are up to "
                    f"{error / self.scale:.3g} away from it"
                )


def _vectors(returned: object, shape: tuple[int, ...], name: str) -> Reals:
    """Return the result of a user's function as float64 (3, *shape)."""
    try:
        coordinates = [np.asarray(coordinate) for coordinate in returned]  # type: ignore[attr-defined]
        if len(coordinates) != 3 or any(coordinate.dtype.kind not in "fiu" for coordinate in coordinates):
            raise ValueError
        vectors = np.stack([np.broadcast_to(coordinate, shape) for coordinate in coordinates]).astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name} must return three arrays of real numbers in the shape of u and v, {shape}, "
            f"found {_described(returned)}"
        ) from error
    if not np.isfinite(vectors).all():
        raise InputError(f"{name} is not finite everywhere on the surface")
    return vectors


def _described(returned: object) -> str:
    if isinstance(returned, np.ndarray):
        return f"{returned.dtype} {returned.shape}"
    if isinstance(returned, tuple | list):
        shapes = ", ".join(str(getattr(entry, "shape", type(entry).__name__)) for entry in returned[:4])
        return f"{len(returned)} of {shapes}"
    return type(returned).__name__
