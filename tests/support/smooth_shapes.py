"""Parametrisations for tests, as functions of a module, which survive pickling."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch import Interval, ParametrisedSurface, Torus

Reals = NDArray[np.float64]

HALF_TURN, TURN = Interval(0.0, math.pi), Interval(0.0, 2 * math.pi, periodic=True)
# Neither an axis nor a diagonal stays where it is.
ROTATION = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def ball(u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
    """The unit sphere in its two angles."""
    return np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)


def ball_derivatives(u: Reals, v: Reals) -> tuple[tuple[Reals, Reals, Reals], tuple[Reals, Reals, float]]:
    """The derivatives of the unit sphere."""
    along_u = np.cos(u) * np.cos(v), np.cos(u) * np.sin(v), -np.sin(u)
    return along_u, (-np.sin(u) * np.sin(v), np.sin(u) * np.cos(v), 0.0)


def plate(u: Reals, v: Reals) -> tuple[Reals, Reals, float]:
    """A flat rectangle."""
    return u, v, 0.0


def roof(u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
    """Two flat halves that meet in a ridge."""
    return u, v, -np.abs(u)


def roof_derivatives(u: Reals, v: Reals) -> tuple[tuple[float, float, Reals], tuple[float, float, float]]:
    """The derivatives of the roof; its area element is constant."""
    return (1.0, 0.0, -np.sign(u)), (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Turned:
    """The points of a torus, turned about its centre."""

    torus: Torus

    def __call__(self, u: Reals, v: Reals) -> Reals:
        """The positions (3, ...)."""
        return np.asarray(np.tensordot(ROTATION, self.torus.positions(u, v), axes=1))


def angular_ball(derivatives: bool) -> ParametrisedSurface:
    """Return the unit sphere in its two angles."""
    return ParametrisedSurface(ball, HALF_TURN, TURN, ball_derivatives if derivatives else None)


def turned_torus(torus: Torus) -> ParametrisedSurface:
    """Return a torus turned about its centre, without derivatives."""
    return ParametrisedSurface(Turned(torus), TURN, TURN)
