"""Descent of a squared distance by L-BFGS, on smooth steps that turn no triangle over."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, minimize
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import splu

from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.errors import LatticeError
from sobolev_batch.extras.fitting.adjoint import area_derivatives
from sobolev_batch.extras.fitting.derivatives import SquaredDistance
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.subdivision import Edges
from sobolev_batch.geometry.surface import normals

# Pairs of steps and gradients that L-BFGS remembers.
_MEMORY = 20
# Cost of a triangle that loses its area, relative to the squared distance at the start.
_SHAPE_WEIGHT = 1e-3
# A descent ends when the distance has fallen by less than this fraction over this many steps.
_LEAST_PROGRESS, _PATIENCE = 0.01, 10
# A triangle may lose this fraction of its quality freely, and any down to this quality.
_FREE_LOSS, _GOOD = 0.5, 0.3
_EQUILATERAL = 4 * np.sqrt(3.0)


class End(Enum):
    """Reason for which a descent ended."""

    STEPS = "all steps are taken"
    CONVERGED = "the distance hardly falls any more"
    STUCK = "no nearer mesh was found along the last direction"
    ERROR = "the distance is down to the error of its fields"
    FARTHER = "no nearer mesh was found"
    TURNED = "a step would turn triangles over"
    LEFT = "a step would leave the lattice's period"
    INTERRUPTED = "it was interrupted"


# These are statuses of scipy's L-BFGS-B; any other is that of a failed line search.
_END_OF_STATUS = {0: End.CONVERGED, 1: End.STEPS}


class Descent:
    """The descent of a squared distance by L-BFGS, with a small penalty for triangles that lose their shape.

    It goes on from positions (n, 3) in units of length, until the squared distance is below a floor. The unit is the
    length of a long step, such as that of an edge. After each step, the positions and the objective are notified.

    Source: R. Byrd, P. Lu, J. Nocedal, C. Zhu, "A limited memory algorithm for bound constrained optimization"
    (1995), doi:10.1137/0916069; by scipy.
    """

    def __init__(
        self,
        objective: SquaredDistance,
        vertices: Reals,
        smoothing: Smoothing,
        floor: float,
        unit: float,
        notify: Callable[[Reals, float], None],
    ) -> None:
        self.objective, self.smoothing, self.floor, self.unit, self.notify = objective, smoothing, floor, unit, notify
        self.start = self.vertices = vertices
        self.first = objective.value(vertices)
        self.steps = 0
        self.end: End | None = None
        self._history = [self.first]
        self._triangles = objective.transform.triangles
        self._normals = normals(vertices, self._triangles)
        self._references = lowest_free_qualities(vertices, self._triangles)

    def run(self, steps: int) -> None:
        """Take this many steps at most. One that leaves the lattice's period ends the descent before it."""
        if self.first <= self.floor:
            self.end = End.ERROR
            return
        try:
            result = minimize(
                self._scaled,
                np.zeros(3 * len(self.smoothing.free)),
                jac=True,
                method="L-BFGS-B",
                callback=self._accept,
                options={"maxiter": steps, "maxfun": 3 * steps, "maxcor": _MEMORY, "ftol": 0.0, "gtol": 0.0},
            )
        except LatticeError:
            self.end = End.LEFT
        else:
            self.end = self.end or _END_OF_STATUS.get(result.status, End.STUCK)

    def _positions(self, parameters: Reals) -> Reals:
        """Return the vertices for parameters, the steps of free vertices in long steps."""
        return self.start + self.unit * self.smoothing.movement(parameters.reshape(-1, 3))

    def _scaled(self, parameters: Reals) -> tuple[float, Reals]:
        """Return the squared distance relative to the first with the penalty of shapes, and its derivative."""
        vertices = self._positions(parameters)
        value, gradient = self.objective(vertices)
        penalty, slopes = shape_penalty(vertices, self._triangles, self._references)
        total = gradient / self.first + _SHAPE_WEIGHT * slopes
        return value / self.first + _SHAPE_WEIGHT * penalty, (self.unit * self.smoothing.pulled_back(total)).ravel()

    def _accept(self, intermediate_result: OptimizeResult) -> None:
        """Keep a step if it turns no triangle over, and end the descent where nothing more is to be gained."""
        vertices = self._positions(intermediate_result.x)
        turned = normals(vertices, self._triangles)
        # A triangle that lost its area could go on to any side.
        had_area = np.any(self._normals != 0, axis=1)
        if np.any(np.einsum("ij,ij->i", turned, self._normals)[had_area] <= 0):
            self._stop(End.TURNED)
        self.vertices, self._normals = vertices, turned
        value = float(intermediate_result.fun) * self.first
        self._history.append(value)
        self.steps += 1
        self.notify(vertices, value)
        if value <= self.floor:
            self._stop(End.ERROR)
        if self.steps >= _PATIENCE and value > (1 - _LEAST_PROGRESS) ** 2 * self._history[-_PATIENCE - 1]:
            self._stop(End.CONVERGED)

    def _stop(self, end: End) -> Any:
        self.end = end
        raise StopIteration


class Smoothing:
    """The map (I + λ L)⁻¹ from steps u of the free vertices to movements of all, with the graph Laplacian L.

    An optimiser that takes its steps in u moves neighbouring vertices together, the farther the larger λ is; zero does
    not smooth. The others of the vertices stay.

    Source: B. Nicolet, A. Jacobson, W. Jakob, "Large steps in inverse rendering of geometry" (2021),
    doi:10.1145/3478513.3480501.
    """

    def __init__(self, mesh: Mesh, free: Indices, amount: float) -> None:
        self.free, self.amount, self._count = free, amount, len(mesh.vertices)
        ends = Edges.from_mesh(mesh).ends
        neighbours = coo_array((np.ones(len(ends)), ends.T), shape=(self._count, self._count)).tocsr()
        graph: Any = laplacian(neighbours, symmetrized=True)
        self._factors = splu(csc_array(eye_array(len(free)) + amount * csc_array(graph)[free][:, free]))

    def movement(self, steps: Reals) -> Reals:
        """Return the movement of all vertices (n, 3) for steps of the free ones (k, 3)."""
        movement = np.zeros((self._count, 3))
        movement[self.free] = self._factors.solve(np.ascontiguousarray(steps))
        return movement

    def pulled_back(self, gradient: Reals) -> Reals:
        """Return the derivative with respect to the steps (k, 3) from that with respect to all vertices (n, 3)."""
        return np.asarray(self._factors.solve(np.ascontiguousarray(gradient[self.free])))


def triangle_qualities(vertices: Reals, triangles: Indices) -> Reals:
    """Return 4√3 area / (sum of squared edges) of triangles (m,), one for equilateral ones and zero without an area."""
    a, b, c = (vertices[corner] for corner in triangles.T)
    areas = np.linalg.norm(normals(vertices, triangles), axis=1) / 2
    # A triangle that is a point has no quality to lose.
    squares = _squared_edges(a, b, c)
    return np.where(squares > 0, _EQUILATERAL * areas / np.maximum(squares, 1e-300), 0)


def lowest_free_qualities(vertices: Reals, triangles: Indices) -> Reals:
    """Return the quality (m,) that each triangle may come down to without a penalty."""
    return np.minimum(_FREE_LOSS * triangle_qualities(vertices, triangles), _GOOD)


def shape_penalty(vertices: Reals, triangles: Indices, references: Reals) -> tuple[float, Reals]:
    """Return a penalty for triangles that become much worse than they were, and its derivative (n, 3).

    A quality q costs ((r - q) / r)² where it falls below a reference r (m,), and nothing above.
    """
    qualities = triangle_qualities(vertices, triangles)
    bad = np.flatnonzero(qualities < references)
    lacks = 1 - qualities[bad] / references[bad]
    gradient = np.zeros_like(vertices)
    corners = [vertices[corner] for corner in triangles[bad].T]
    squares = _squared_edges(*corners)[:, None]
    for corner, of_area in enumerate(area_derivatives(vertices, triangles[bad])):
        of_squares = 2 * (2 * corners[corner] - corners[corner - 2] - corners[corner - 1])
        slopes = (_EQUILATERAL * of_area - qualities[bad, None] * of_squares) / squares
        np.add.at(gradient, triangles[bad, corner], (-2 * lacks / references[bad])[:, None] * slopes)
    return float(np.sum(lacks**2)), gradient


def _squared_edges(a: Reals, b: Reals, c: Reals) -> Reals:
    return np.asarray(sum(np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c)))
