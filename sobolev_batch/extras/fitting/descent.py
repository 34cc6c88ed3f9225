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


Notify = Callable[[Reals, float], None]
# These are statuses of scipy's L-BFGS-B; any other is that of a failed line search.
_END_OF_STATUS = {0: End.CONVERGED, 1: End.STEPS}


class Descent:
    """The descent of a squared distance by L-BFGS, with a small penalty for triangles that lose their shape.

    It goes on from positions (n, 3) in units of length, until the squared distance is below a floor. After each step,
    the positions and the objective are notified.

    Source: R. Byrd, P. Lu, J. Nocedal, C. Zhu, "A limited memory algorithm for bound constrained optimization"
    (1995), doi:10.1137/0916069; by scipy.
    """

    def __init__(
        self, objective: SquaredDistance, start: Reals, smoothing: Smoothing, floor: float, notify: Notify
    ) -> None:
        self.objective, self.start, self.smoothing, self.floor, self.notify = objective, start, smoothing, floor, notify
        self._history, self._triangles = [objective.value(start)], objective.transform.triangles
        self._normals = normals(start, self._triangles)
        self._references = lowest_free_qualities(start, self._triangles)
        self._ends: list[End] = []

    def run(self, steps: int) -> End:
        """Take this many steps at most, none of which leaves the lattice's period, and return why there are no more."""
        if self._history[0] <= self.floor:
            return End.ERROR
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
            return End.LEFT
        return self._ends[0] if self._ends else _END_OF_STATUS.get(result.status, End.STUCK)

    def _positions(self, parameters: Reals) -> Reals:
        """Return the vertices for parameters, the steps of free vertices in mean edges."""
        return self.start + self.smoothing.unit * self.smoothing.movement(parameters.reshape(-1, 3))

    def _scaled(self, parameters: Reals) -> tuple[float, Reals]:
        """Return the squared distance relative to the first with the penalty of shapes, and its derivative."""
        vertices, first = self._positions(parameters), self._history[0]
        value, gradient = self.objective(vertices)
        penalty, slopes = shape_penalty(vertices, self._triangles, self._references)
        total = self.smoothing.unit * self.smoothing.pulled_back(gradient / first + _SHAPE_WEIGHT * slopes)
        return value / first + _SHAPE_WEIGHT * penalty, total.ravel()

    def _accept(self, intermediate_result: OptimizeResult) -> None:
        """Take a step if it turns no triangle over, and end the descent where nothing more is to be gained."""
        vertices, before = self._positions(intermediate_result.x), self._normals
        self._normals = normals(vertices, self._triangles)
        # A triangle that lost its area could go on to any side.
        if (np.einsum("ij,ij->i", self._normals, before)[np.any(before != 0, axis=1)] <= 0).any():
            self._ends.append(End.TURNED)
            raise StopIteration
        value = float(intermediate_result.fun) * self._history[0]
        self._history.append(value)
        self.notify(vertices, value)
        if value <= self.floor:
            self._ends.append(End.ERROR)
        elif len(self._history) > _PATIENCE and value > (1 - _LEAST_PROGRESS) ** 2 * self._history[-_PATIENCE - 1]:
            self._ends.append(End.CONVERGED)
        if self._ends:
            raise StopIteration


class Smoothing:
    """The map (I + λ L)⁻¹ from steps u of the free vertices to movements of all, with the graph Laplacian L.

    An optimiser that takes its steps in u moves neighbouring vertices together, the farther the larger λ is; zero does
    not smooth. The others of the vertices stay.

    Source: B. Nicolet, A. Jacobson, W. Jakob, "Large steps in inverse rendering of geometry" (2021),
    doi:10.1145/3478513.3480501.
    """

    def __init__(self, mesh: Mesh, free: Indices, amount: float) -> None:
        self.free, self.amount, self.unit = free, amount, mesh.edge_length_range[0]
        self._count = len(mesh.vertices)
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
