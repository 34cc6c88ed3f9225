"""Descent of a squared distance by L-BFGS, on smooth steps that turn no triangle over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize

from sobolev_batch.errors import LatticeError
from sobolev_batch.fitting.derivative.objective import SquaredDistance
from sobolev_batch.fitting.optimisation.shapes import ShapePenalty
from sobolev_batch.fitting.optimisation.smoothing import Smoothing

Reals = NDArray[np.float64]
Notify = Callable[[Reals, float], None]

# Pairs of steps and gradients that L-BFGS remembers.
_MEMORY = 20
# Cost of a triangle that loses its area, relative to the squared distance at the start.
_SHAPE_WEIGHT = 1e-3
# A descent ends when the distance has fallen by less than this fraction over so many steps.
_LEAST_PROGRESS, _PATIENCE = 0.01, 10


class End(Enum):
    """Why a descent ended."""

    STEPS = "all steps are taken"
    CONVERGED = "the distance hardly falls any more"
    ERROR = "the distance is down to the error of its fields"
    TURNED = "a step would turn triangles over"
    LEFT = "a step would leave the lattice's period"
    INTERRUPTED = "it was interrupted"


@dataclass(frozen=True, eq=False)
class Descent:
    """Vertices after a descent.

    Attributes:
        vertices: Positions (n, 3), in units of length.
        squared: Squared distance there.
        steps: Number of steps.
        end: Why it ended.
    """

    vertices: Reals
    squared: float
    steps: int
    end: End


def descend(
    objective: SquaredDistance,
    vertices: Reals,
    smoothing: Smoothing,
    steps: int,
    floor: float,
    unit: float,
    notify: Notify,
) -> Descent:
    """Lower a squared distance by L-BFGS.

    Args:
        objective: Squared distance.
        vertices: Positions (n, 3) to start from.
        smoothing: Smoothing of the steps.
        steps: Largest number of steps.
        floor: Squared distance below which nothing is left to gain.
        unit: Length of a long step, such as that of an edge.
        notify: Called with the positions and the squared distance after each step.

    Source: R. Byrd, P. Lu, J. Nocedal, C. Zhu, "A limited memory algorithm for bound constrained optimization"
    (1995), doi:10.1137/0916069; by scipy.
    """
    path = _Path(objective, vertices, smoothing, floor, unit, notify)
    if path.squared <= floor:
        return Descent(vertices, path.squared, 0, End.ERROR)
    try:
        minimize(
            path.scaled,
            np.zeros(3 * len(smoothing.free)),
            jac=True,
            method="L-BFGS-B",
            callback=path.accept,
            options={"maxiter": steps, "maxfun": 3 * steps, "maxcor": _MEMORY, "ftol": 0.0, "gtol": 0.0},
        )
    except LatticeError:
        path.end = End.LEFT
    if path.end is End.CONVERGED and path.steps >= steps:
        path.end = End.STEPS
    return Descent(path.vertices, path.squared, path.steps, path.end)


class _Path:
    """The accepted positions on the way down, and the functions that scipy calls."""

    def __init__(
        self,
        objective: SquaredDistance,
        vertices: Reals,
        smoothing: Smoothing,
        floor: float,
        unit: float,
        notify: Notify,
    ) -> None:
        self.objective, self.smoothing, self.floor, self.unit, self.notify = objective, smoothing, floor, unit, notify
        self.start = self.vertices = vertices
        self.first = self.squared = objective.value(vertices)
        self.steps = 0
        self.end = End.CONVERGED
        self._history = [self.first]
        self._normals = _normals(vertices, objective.transform.triangles)
        self._penalty = ShapePenalty.of(vertices, objective.transform.triangles)

    def positions(self, parameters: Reals) -> Reals:
        """Return the vertices for parameters, the steps of free vertices in long steps."""
        return self.start + self.unit * self.smoothing.movement(parameters.reshape(-1, 3))

    def scaled(self, parameters: Reals) -> tuple[float, Reals]:
        """Return the squared distance relative to the first with the penalty of shapes, and its derivative."""
        vertices = self.positions(parameters)
        value, gradient = self.objective(vertices)
        penalty, slopes = self._penalty.value_and_gradient(vertices)
        total = gradient / self.first + _SHAPE_WEIGHT * slopes
        return value / self.first + _SHAPE_WEIGHT * penalty, (self.unit * self.smoothing.pulled_back(total)).ravel()

    def accept(self, intermediate_result: OptimizeResult) -> None:
        """Keep a step if it turns no triangle over, and end the descent where nothing more is to be gained."""
        vertices = self.positions(intermediate_result.x)
        normals = _normals(vertices, self.objective.transform.triangles)
        if np.any(np.einsum("ij,ij->i", normals, self._normals) < 0):
            self._stop(End.TURNED)
        self.vertices, self._normals = vertices, normals
        self.squared = float(intermediate_result.fun) * self.first
        self.steps += 1
        self._history.append(self.squared)
        self.notify(vertices, self.squared)
        if self.squared <= self.floor:
            self._stop(End.ERROR)
        before = self._history[-_PATIENCE - 1] if len(self._history) > _PATIENCE else np.inf
        if self.squared > (1 - _LEAST_PROGRESS) ** 2 * before:
            self._stop(End.CONVERGED)

    def _stop(self, end: End) -> Any:
        self.end = end
        raise StopIteration


def _normals(vertices: Reals, triangles: NDArray[np.int64]) -> Reals:
    """Return the normals of triangles (m, 3), each as long as twice its area."""
    a, b, c = (vertices[corner] for corner in triangles.T)
    return np.asarray(np.cross(b - a, c - a))
