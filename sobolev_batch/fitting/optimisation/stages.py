"""The stages of a fit, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.defaults import DEFAULT_ORDER, DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.fitting.optimisation.descent import End, descend
from sobolev_batch.fitting.optimisation.problem import FitProblem
from sobolev_batch.fitting.optimisation.smoothing import Smoothing
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.spectral.shells import single_order
from sobolev_batch.surfaces.shapes.surface import is_finite_number

Reals = NDArray[np.float64]

# Far away, very negative orders lead: their kernels are wide.
_COARSE_ORDER = -4.0
# Beyond this relative distance at the coarse order, a mesh is far from its target.
_FAR = 0.05
# Smoothing of the stages that bring a far mesh near, and the fraction of all steps for each.
_FAR_SMOOTHINGS, _FAR_STEPS = (16.0, 4.0), 0.25
# The share of a squared distance at half the order, which keeps detail that the order itself hardly sees.
_DETAIL_SHARE, _HIGHEST_DETAILED = 0.1, -1.5
# After a step that would turn triangles over, smoothing is increased by this factor, so often at most.
_SMOOTHER, _MOST_RETREATS = 4.0, 4


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit.

    Attributes:
        order: Order s of the distance.
        steps: Largest number of steps.
        smoothing: Weight λ of the mesh's Laplacian in steps.
        keep_boundary: True if vertices of open boundaries stay where they are.

    Raises:
        OrderError: The order is not below -1/2.
        InputError: Another setting is out of range.
    """

    order: float = DEFAULT_ORDER
    steps: int = DEFAULT_STEPS
    smoothing: float = DEFAULT_SMOOTHING
    keep_boundary: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "order", single_order(self.order))
        if not is_whole_number(self.steps) or self.steps < 1:
            raise InputError(f"steps must be a whole number from 1 on, found {self.steps!r}")
        object.__setattr__(self, "steps", int(self.steps))
        if not is_finite_number(self.smoothing) or self.smoothing < 0:
            raise InputError(f"smoothing must be a number from 0 on, found {self.smoothing!r}")
        object.__setattr__(self, "smoothing", float(self.smoothing))
        if not isinstance(self.keep_boundary, bool):
            raise InputError(f"keep_boundary must be True or False, found {self.keep_boundary!r}")

    @property
    def coarse_order(self) -> float:
        """Order that brings far meshes near."""
        return min(self.order, _COARSE_ORDER)

    @property
    def shares(self) -> tuple[tuple[float, float], ...]:
        """Orders with the share of each in the objective."""
        detail = ((self.order / 2, _DETAIL_SHARE),) if self.order <= _HIGHEST_DETAILED else ()
        return (self.order, 1.0), *detail


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit after a step.

    Attributes:
        step: Number of steps so far.
        steps: Largest number of steps.
        relative: Square root of what the descent lowers, which is about 1 at the start of each stage: a weighted sum
            of squared distances, and a small penalty for triangles that lose their shape.

    >>> import sobolev_batch as sb
    >>> sb.FitProgress(step=3, steps=150, relative=0.5).relative
    0.5
    """

    step: int
    steps: int
    relative: float


@dataclass(frozen=True)
class Stage:
    """A part of a fit.

    Attributes:
        shares: Orders with the share of each in the objective.
        smoothing: Weight of the Laplacian in steps.
        steps: Largest number of steps.
    """

    shares: tuple[tuple[float, float], ...]
    smoothing: float
    steps: int


class Run:
    """A fit that is under way.

    Attributes:
        vertices: Positions (n, 3) after the last step, in units of length.
        taken: Number of steps so far.
        end: Why the last descent ended.
    """

    def __init__(
        self, problem: FitProblem, free: NDArray[np.int64], steps: int, notify: Callable[[FitProgress], None] | None
    ) -> None:
        self.problem, self.free, self.steps, self.notify = problem, free, steps, notify
        self.taken = 0
        self.end = End.CONVERGED
        self.vertices = np.asarray(problem.mesh.vertices)

    def carried_out(self, stages: list[Stage]) -> Reals:
        """Return the vertices after all stages, or after the last step before an interrupt."""
        try:
            for stage in stages:
                self.vertices = self._after(stage, self.vertices)
        except KeyboardInterrupt:
            self.end = End.INTERRUPTED
        return self.vertices

    def _after(self, stage: Stage, vertices: Reals) -> Reals:
        """Return the vertices after a stage: descents with ever finer fields, and smoother steps where needed."""
        weighting = self.problem.weighting(vertices, stage.shares)
        smoothing = Smoothing.of(self.problem.mesh, self.free, stage.smoothing)
        unit, retreats = self.problem.mesh.edge_length_range[0], 0
        left = min(stage.steps, self.steps - self.taken)
        while left > 0:
            objective, floor = self.problem.objective(vertices, weighting)
            descent = descend(objective, vertices, smoothing, left, floor, unit, self._counted)
            vertices, left, self.end = descent.vertices, left - descent.steps, descent.end
            if descent.end in (End.TURNED, End.LEFT) and retreats < _MOST_RETREATS:
                retreats += 1
                smoothing = replace(smoothing, amount=max(_SMOOTHER * smoothing.amount, 1.0))
            # Finer fields may show the way on, unless they are as fine as they can be.
            elif descent.end is not End.ERROR or not descent.steps:
                break
        return vertices

    def _counted(self, vertices: Reals, objective: float) -> None:
        self.vertices = vertices
        self.taken += 1
        if self.notify is not None:
            self.notify(FitProgress(self.taken, self.steps, float(np.sqrt(objective))))


def stages_of(problem: FitProblem, settings: FitSettings) -> list[Stage]:
    """Return the stages of a fit: a far mesh comes near at a coarse order first."""
    stages, smoothing = [], settings.smoothing
    if problem.relative(np.asarray(problem.mesh.vertices), settings.coarse_order) > _FAR:
        part = max(1, int(_FAR_STEPS * settings.steps))
        stages = [Stage(((settings.coarse_order, 1.0),), amount, part) for amount in _FAR_SMOOTHINGS]
        smoothing = max(smoothing, _FAR_SMOOTHINGS[-1])
    left = max(1, settings.steps - sum(stage.steps for stage in stages))
    return [*stages, Stage(settings.shares, smoothing, left)]
