"""Surfaces that a parametrisation of the user's own gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.interval import Interval
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import is_finite_number

Reals = NDArray[np.float64]
# x, y and z at each of some parameters; numbers stand for constant ones.
Vectors = Reals | Sequence[Reals | float]

# How far the ends of a periodic parameter may be apart, relative to the surface's extent.
_CLOSED = 1e-9
# Derivatives are held against differences over this part of an interval, whose own error is about its square.
_STEP, _AGREEMENT = 1e-4, 1e-3
_CHECKS = 7


@dataclass(frozen=True, eq=False)
class ParametrisedSurface(Smooth):
    """A surface x(u, v), as a reference or for comparison; its transform is good to the ``eps`` asked for.

    The parametrisation must be smooth, up to the ends and across those of periodic parameters, and cover
    the surface once. Poles are allowed: an end of u or v may be one point, as on a sphere in its angles.
    It is integrated by the trapezoidal rule in periodic parameters and by Gauss-Legendre in others, with
    as many nodes as it takes; see docs/numerics.md. For studies, such as travel to workers, the
    functions must be picklable: functions of a module, or values with ``__call__``.

    Args:
        position: takes u and v, float64 arrays of one shape (...), to x, y and z: three arrays (...) or numbers,
            in the user's unit of length.
        u: what u runs over.
        v: likewise.
        derivatives: takes the same to x_u and x_v, three arrays or numbers each. Without it they are those
            of the interpolant through the nodes, which costs no more than 1e-13 of the area, and 120 bytes
            of memory for each of the nodes. With it, x_u may grow without bound towards a pole, as long as
            |x_u × x_v| stays smooth there: where u is the cosine of the polar angle, for example.
        scale: of the similarity x -> scale * (x - origin) that is applied to positions.
        origin: of the same, in the unit of ``position``.

    Raises:
        InputError: functions that return something else, or are not finite; a parameter called periodic whose
            ends are apart; derivatives that are not those of the positions; no area.
    """

    position: Callable[[Reals, Reals], Vectors]
    u: Interval
    v: Interval
    derivatives: Callable[[Reals, Reals], tuple[Vectors, Vectors]] | None = None
    scale: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, interval in (("u", self.u), ("v", self.v)):
            if not isinstance(interval, Interval):
                raise InputError(f"{name} must run over an Interval, found {interval!r}")
        if not (is_finite_number(self.scale) and self.scale > 0):
            raise InputError(f"the scale must be positive and finite, found {self.scale!r}")
        if len(self.origin) != 3 or not all(map(is_finite_number, self.origin)):
            raise InputError(f"the origin must be three finite numbers, found {self.origin!r}")
        self._check_closed()
        self._check_derivatives()
        _ = self.area

    @property
    def intervals(self) -> tuple[Interval, Interval]:
        """What u and v run over."""
        return self.u, self.v

    def positions(self, u: Reals, v: Reals) -> Reals:
        """x(u, v), float64 (3, ...)."""
        found = _vectors(self.position(u, v), u.shape, "position")
        found -= np.reshape(self.origin, (3, *[1] * u.ndim))
        found *= self.scale
        return found

    def tangents(self, u: Reals, v: Reals) -> tuple[Reals, Reals] | None:
        """x_u and x_v, float64 (3, ...) each, where they were given."""
        if self.derivatives is None:
            return None
        found = self.derivatives(u, v)
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise InputError(f"derivatives must return two vectors, x_u and x_v, found {type(found).__name__}")
        along_u, along_v = (
            self.scale * _vectors(vectors, u.shape, name) for vectors, name in zip(found, ("x_u", "x_v"), strict=True)
        )
        return along_u, along_v

    def moved(self, scale: float, origin: tuple[float, float, float]) -> Self:
        """The surface after x -> scale * (x - origin)."""
        x, y, z = (old + shift / self.scale for old, shift in zip(self.origin, origin, strict=True))
        return replace(self, scale=scale * self.scale, origin=(x, y, z))

    @cached_property
    def _extent(self) -> float:
        lower, upper = self.bounds
        return float((upper - lower).max())

    def _check_closed(self) -> None:
        along_u, along_v = (np.linspace(interval.low, interval.high, _CHECKS) for interval in self.intervals)
        for name, interval, other in (("u", self.u, along_v), ("v", self.v, along_u)):
            if not interval.periodic:
                continue
            ends = [np.full(_CHECKS, end) for end in (interval.low, interval.high)]
            first, last = (self.positions(end, other) if name == "u" else self.positions(other, end) for end in ends)
            apart = float(np.abs(first - last).max())
            if not apart <= _CLOSED * self._extent:
                raise InputError(
                    f"the surface is said to be periodic in {name}, but its positions at the ends {interval.low:g} and "
                    f"{interval.high:g} are up to {apart / self.scale:.3g} apart"
                )

    def _check_derivatives(self) -> None:
        u, v = (interval.low + interval.length * (np.arange(_CHECKS) + 0.5) / _CHECKS for interval in self.intervals)
        grid = np.meshgrid(u, v, indexing="ij")
        given = self.tangents(*grid)
        for name, axis in (("x_u", 0), ("x_v", 1)):
            if given is None:
                return
            step = _STEP * self.intervals[axis].length
            moved = [[part + (sign * step if i == axis else 0.0) for i, part in enumerate(grid)] for sign in (-1, 1)]
            before, after = (self.positions(*parts) for parts in moved)
            expected = (after - before) / (2 * step)
            error = float(np.abs(expected - given[axis]).max())
            largest = float(np.abs(expected).max()) + self._extent / self.intervals[axis].length
            if not error <= _AGREEMENT * largest:
                raise InputError(
                    f"{name} is not the derivative of the position: differences of that are up to "
                    f"{error / self.scale:.3g} away from it"
                )


def _vectors(found: object, shape: tuple[int, ...], name: str) -> Reals:
    """What a user's function returned, as float64 (3, *shape)."""
    try:
        parts = [np.asarray(part) for part in found]  # type: ignore[attr-defined]
        if len(parts) != 3 or any(part.dtype.kind not in "fiu" for part in parts):
            raise ValueError
        vectors = np.stack([np.broadcast_to(part, shape) for part in parts]).astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name} must return three arrays of real numbers in the shape of u and v, {shape}, "
            f"found {_described(found)}"
        ) from error
    if not np.isfinite(vectors).all():
        raise InputError(f"{name} is not finite everywhere on the surface")
    return vectors


def _described(found: object) -> str:
    if isinstance(found, np.ndarray):
        return f"{found.dtype} {found.shape}"
    if isinstance(found, tuple | list):
        return f"{len(found)} of " + ", ".join(f"{getattr(part, 'shape', type(part).__name__)}" for part in found[:4])
    return type(found).__name__
