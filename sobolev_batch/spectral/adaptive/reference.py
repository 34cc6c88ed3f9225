"""The reference of a distance that was computed to an accuracy: its values, its norm, and its product with the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sobolev_batch.spectral.adaptive.frequencies import Frequencies
from sobolev_batch.spectral.adaptive.problem import Problem, Solution, centering, error_target, support_of
from sobolev_batch.spectral.adaptive.solve import solve
from sobolev_batch.spectral.adaptive.values import SurfaceValues
from sobolev_batch.spectral.budget import ReferenceEstimate
from sobolev_batch.surfaces.shapes.surface import Surface


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference b of a distance ||a - b||, and what is known of it.

    Attributes:
        frequencies: Frequencies of all values.
        values: Values of b.
        difference: Values whose signed sum is a - b; triangles that both have may be left out.
        signs: Signs of these.
        pair: The surfaces a and b, moved together to the centre of the lattice's period.
    """

    frequencies: Frequencies
    values: SurfaceValues
    difference: Sequence[SurfaceValues]
    signs: Sequence[int]
    pair: Sequence[Surface]

    @classmethod
    def for_problem(cls, problem: Problem, solution: Solution, seed: int) -> Self:
        """Return the reference of a distance.

        Its values are among those that the distance was computed from. But where the surfaces share triangles, which
        cancel, the reference has more than those, and gets frequencies of its own.

        Args:
            problem: Distance, between surfaces that are not equal.
            solution: Its solution.
            seed: Seed of the random frequencies of octaves.
        """
        if problem.is_whole:
            frequencies = Frequencies.from_solution(problem, solution)
            return cls(frequencies, solution.values[1], solution.values, problem.signs, problem.pair)
        move = centering(problem.pair)
        pair = [move.apply(surface) for surface in problem.pair]
        support = replace(support_of(pair), areas=np.array(pair[1].area))
        accuracy = replace(problem.accuracy, best_effort=True)
        own = replace(problem, surfaces=pair[1:], signs=(1,), support=support, accuracy=accuracy, label="the reference")
        of_reference = solve(own, seed)
        frequencies = Frequencies.from_solution(own, of_reference)
        target = error_target(solution.estimate.values, problem.orders, problem.accuracy, problem.area)
        difference = [
            frequencies.values(move.apply(surface), target, problem.execution) for surface in problem.surfaces
        ]
        return cls(frequencies, of_reference.values[0], difference, problem.signs, pair)

    def estimate(self) -> ReferenceEstimate:
        """Return the norm of the reference, and its product with the difference."""
        return self.frequencies.against(self.difference, self.signs, self.values, self.pair)
