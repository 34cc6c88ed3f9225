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
    STUCK = "no nearer mesh was found along the last direction"
    ERROR = "the distance is down to the error of its fields"
    FARTHER = "no nearer mesh was found"
    TURNED = "a step would turn triangles over"
    LEFT = "a step would leave the lattice's period"
    INTERRUPTED = "it was interrupted"


# By the status of scipy's L-BFGS-B; any other is that of a failed line search.
_END_OF_STATUS = {0: End.CONVERGED, 1: End.STEPS}


@dataclass(frozen=True, eq=False)
class Descent:
    """Vertices after a descent.

    Attributes:
        vertices: Positions (n, 3), in units of length.
        objective: Weighted squared distances there, with the penalty of shapes.
        steps: Number of steps.
        end: Why it ended.
    """

    vertices: Reals
    objective: float
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
    """Lower a squared distance by L-BFGS, with a small penalty for triangles that lose their shape.

    Args:
        objective: Squared distance, or a weighted sum of several.
        vertices: Positions (n, 3) to start from.
        smoothing: Smoothing of the steps.
        steps: Largest number of steps.
        floor: Squared distance below which nothing is left to gain.
        unit: Length of a long step, such as that of an edge.
        notify: Called with the positions and the objective after each step.

    Returns:
        The last positions that were accepted. A step that leaves the lattice's period ends the descent before it.

    Source: R. Byrd, P. Lu, J. Nocedal, C. Zhu, "A limited memory algorithm for bound constrained optimization"
    (1995), doi:10.1137/0916069; by scipy.
    """
    path = _Path(objective, vertices, smoothing, floor, unit, notify)
    if path.value <= floor:
        return Descent(vertices, path.value, 0, End.ERROR)
    try:
        result = minimize(
            path.scaled,
            np.zeros(3 * len(smoothing.free)),
            jac=True,
            method="L-BFGS-B",
            callback=path.accept,
            options={"maxiter": steps, "maxfun": 3 * steps, "maxcor": _MEMORY, "ftol": 0.0, "gtol": 0.0},
        )
    except LatticeError:
        path.end = End.LEFT
    else:
        path.end = path.end or _END_OF_STATUS.get(result.status, End.STUCK)
    return Descent(path.vertices, path.value, path.steps, path.end)


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
        self.first = self.value = objective.value(vertices)
        self.steps = 0
        self.end: End | None = None
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
        # A triangle that lost its area could go on to any side.
        had_area = np.any(self._normals != 0, axis=1)
        if np.any(np.einsum("ij,ij->i", normals, self._normals)[had_area] <= 0):
            self._stop(End.TURNED)
        self.vertices, self._normals = vertices, normals
        self.value = float(intermediate_result.fun) * self.first
        self.steps += 1
        self._history.append(self.value)
        self.notify(vertices, self.value)
        if self.value <= self.floor:
            self._stop(End.ERROR)
        before = self._history[-_PATIENCE - 1] if len(self._history) > _PATIENCE else np.inf
        if self.value > (1 - _LEAST_PROGRESS) ** 2 * before:
            self._stop(End.CONVERGED)

    def _stop(self, end: End) -> Any:
        self.end = end
        raise StopIteration


def _normals(vertices: Reals, triangles: NDArray[np.int64]) -> Reals:
    """Return the normals of triangles (m, 3), each as long as twice its area."""
    a, b, c = (vertices[corner] for corner in triangles.T)
    return np.asarray(np.cross(b - a, c - a))
