"""Frequencies at which surfaces are compared, with the norms and products that follow from values there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, cast

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.geometry.surface import Surface, centering
from sobolev_batch.norms.accuracy.problem import (
    OFF_CENTER,
    Problem,
    Solution,
    SurfaceValues,
    error_target,
    support_of,
)
from sobolev_batch.norms.accuracy.solve import solve
from sobolev_batch.norms.budget import (
    NormEstimate,
    ReferenceEstimate,
    Sums,
    Support,
    aliased,
    estimate_norms,
    product_rounding,
    sums_of_shells,
)
from sobolev_batch.norms.fields import field_for
from sobolev_batch.norms.tail.remainder import mean_sinc, remainder
from sobolev_batch.norms.tail.sampling import OctaveSampling
from sobolev_batch.norms.tail.values import (
    OctaveSums,
    OctaveWeights,
    Tail,
    octave_values,
    settings_for,
    squared_moduli,
    statistical_errors,
)
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, permits_single
from sobolev_batch.transform.lattice import Lattice, SobolevWeights, shell_sums


@dataclass(frozen=True, eq=False)
class Measure:
    """Values of a signed sum of surfaces: complex ones on the half lattice, and at the samples of each octave."""

    lattice: Complexes
    octaves: tuple[Complexes, ...]

    @classmethod
    def from_values(cls, surfaces: Sequence[SurfaceValues], signs: Sequence[int]) -> Self:
        """Return the sum of some surfaces, each with its sign."""
        signed = list(zip(surfaces, signs, strict=True))
        lattice = sum(sign * one.field.values for one, sign in signed)
        octaves = (
            sum(sign * one.octaves[number].values for one, sign in signed) for number in range(len(surfaces[0].octaves))
        )
        return cls(np.asarray(lattice), tuple(map(np.asarray, octaves)))


@dataclass(frozen=True, eq=False)
class Frequencies:
    """A lattice of the innermost frequencies, and octaves beyond it.

    Attributes:
        widths: Widths of all surfaces together, see `Support`.
        has_tail: True where all that lies beyond the lattice is known, from octaves.
    """

    lattice: Lattice
    octaves: tuple[OctaveSampling, ...]
    orders: tuple[float, ...]
    widths: Reals
    has_tail: bool = False

    @classmethod
    def from_solution(cls, problem: Problem, solution: Solution) -> Self:
        """Return the frequencies that a problem was solved with, for which something had to be computed."""
        widths = problem.support.widths
        return cls(cast(Lattice, solution.lattice), solution.octaves, problem.orders, widths, solution.has_tail)

    @cached_property
    def weights(self) -> SobolevWeights:
        """Weights of the lattice, with a step where a tail follows."""
        return SobolevWeights(self.lattice, self.orders, self.lattice.xi_max if self.has_tail else None)

    @cached_property
    def _octave_weights(self) -> tuple[OctaveWeights, ...]:
        return tuple(OctaveWeights(octave, self.orders) for octave in self.octaves)

    @property
    def _cutoff(self) -> float:
        """Highest frequency, beyond which the tail lies."""
        return self.octaves[-1].octave.highest if self.octaves else self.lattice.xi_max

    def values(self, surface: Surface, target: ErrorTarget, execution: Execution) -> SurfaceValues:
        """Return the values of a surface within an error target; LatticeError where it exceeds the half period."""
        single = permits_single(surface, self.lattice, target)
        settings = TransformSettings(dtype="complex64" if single else "complex128")
        field = field_for(surface, self.lattice, target, settings, Execution(threads=execution.threads))
        octaves = (
            octave_values(surface, octave, self.orders, settings_for(target), execution) for octave in self.octaves
        )
        return SurfaceValues(field, tuple(octaves))

    def norms(self, values: Sequence[SurfaceValues], surfaces: Sequence[Surface], signs: Sequence[int]) -> NormEstimate:
        """Return the norms of a signed sum of surfaces."""
        return self.norms_of(Measure.from_values(values, signs), surfaces, signs, self.errors(values))

    def moved(self, values: SurfaceValues, surface: Surface, length: float) -> Reals:
        """Return the distance (orders,) of a surface to itself moved by a length: the rms over all directions."""
        # ∫ |1 - exp(-2πi ξ·v)|² over directions of v, on average: 2 - 2 sin(2π|ξ||v|)/(2π|ξ||v|).
        own = Measure.from_values([values], [1])
        radii = self.lattice.spacing * np.sqrt(np.arange(self.lattice.shell_count))
        shells = shell_sums(own.lattice, None, self.lattice, self.lattice.half)
        squares = self.weights.per_shell @ (shells * (2 - 2 * np.sinc(2 * radii * length)))
        for weights, octave in zip(self._octave_weights, own.octaves, strict=True):
            factors = 2 - 2 * np.sinc(2 * weights.sampling.radii * length)
            squares = squares + weights.integrals(squared_moduli(octave) * factors)
        if self.has_tail:
            means = np.array([mean_sinc(self._cutoff, order, length) for order in self.orders])
            squares = squares + (2 - 2 * means) * self.tail(own, [surface], [1]).beyond
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    def errors(self, values: Sequence[SurfaceValues]) -> Reals:
        """Return the norms of the values' own errors (orders,), added."""
        return np.asarray(np.sum([one.error_norms(self.weights) for one in values], axis=0))

    def norms_of(
        self,
        measure: Measure,
        surfaces: Sequence[Surface],
        signs: Sequence[int],
        errors: Reals,
        tail: Tail | None = None,
    ) -> NormEstimate:
        """Return the norms of a measure from the norms of its values' own errors (orders,); the tail may be known."""
        sums = self.lattice_sums(measure, measure)
        if not self.has_tail:
            support = Support(support_of(surfaces).areas, self.widths)
            return estimate_norms(sums, self.weights, support, errors)
        images = aliased(sums, self.weights, self.widths)
        return (tail or self.tail(measure, surfaces, signs)).estimate(sums.totals, images, errors)

    def lattice_sums(self, measure: Measure, other: Measure) -> Sums:
        """Return the sums of Re(a conj b) over the lattice."""
        return sums_of_shells(shell_sums(measure.lattice, other.lattice, self.lattice, self.lattice.half), self.weights)

    def octave_sums(self, measure: Measure, other: Measure) -> list[OctaveSums]:
        """Return the integrals of Re(a conj b) over each octave."""
        return [
            weights.sums((a.astype(np.complex128) * b.conj()).real)
            for weights, a, b in zip(self._octave_weights, measure.octaves, other.octaves, strict=True)
        ]

    def tail(self, measure: Measure, surfaces: Sequence[Surface], signs: Sequence[int]) -> Tail:
        """Return the tail from the octaves, and what is known to lie beyond them."""
        # Norms of single surfaces serve as scales.
        beyond = remainder(surfaces, signs, self._cutoff, self.orders, is_scale=len(surfaces) == 1)
        return Tail.from_sums(self.octave_sums(measure, measure), *beyond.at(self.orders))


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference b of a distance ||a - b||, and what is known of it.

    Attributes:
        difference: Values of surfaces whose signed sum is a - b.
        surfaces: These surfaces, moved like the pair; what a and b both have may be left out.
        signs: Signs of these.
        pair: The surfaces a and b, moved together to the centre of the lattice's period; of surfaces far apart b alone.
        known: Estimate for surfaces far apart, which follows from the norm of b; None for others.
        moved: What the difference lacks, see `Problem`.
    """

    frequencies: Frequencies
    values: SurfaceValues
    difference: Sequence[SurfaceValues]
    surfaces: Sequence[Surface]
    signs: Sequence[int]
    pair: Sequence[Surface]
    known: ReferenceEstimate | None = None
    moved: Reals | float = 0.0

    @classmethod
    def for_problem(cls, problem: Problem, solution: Solution, seed: int) -> Self:
        """Return the reference of a distance between surfaces that are not equal.

        Its values are among those that the distance was computed from. But where the surfaces have parts in common,
        which cancel, the reference has more than those, and gets frequencies of its own.
        """
        if problem.is_whole and problem.apart is not None:
            own, of_own = problem.alone[1], solution.alone[1]
            norms = of_own.estimate
            known = ReferenceEstimate(
                norms, -(norms.values**2), (2 * norms.values + norms.errors) * norms.errors + problem.apart
            )
            frequencies = Frequencies.from_solution(own, of_own)
            return cls(frequencies, of_own.values[0], of_own.values, own.surfaces, own.signs, own.surfaces, known)
        if problem.is_whole:
            frequencies = Frequencies.from_solution(problem, solution)
            return cls(frequencies, solution.values[1], solution.values, problem.surfaces, problem.signs, problem.pair)
        move = centering(problem.pair, OFF_CENTER)
        pair = [move.apply(surface) for surface in problem.pair]
        support = replace(support_of(pair), areas=np.array(pair[1].area))
        accuracy = replace(problem.accuracy, best_effort=True)
        alone = replace(problem, signs=(1,), label="the reference", apart=None, moved=0.0)
        own = replace(alone, surfaces=pair[1:], support=support, accuracy=accuracy)
        of_reference = solve(own, seed)
        frequencies = Frequencies.from_solution(own, of_reference)
        target = error_target(solution.estimate.values, problem.orders, problem.accuracy, problem.area)
        surfaces = [move.apply(surface) for surface in problem.surfaces]
        difference = [frequencies.values(surface, target, problem.execution) for surface in surfaces]
        return cls(frequencies, of_reference.values[0], difference, surfaces, problem.signs, pair, moved=problem.moved)

    def estimate(self) -> ReferenceEstimate:
        """Return the norm of b, and the product <a - b, b>."""
        if self.known is not None:
            return self.known
        at, values = self.frequencies, self.values
        difference, own = Measure.from_values(self.difference, self.signs), Measure.from_values([values], [1])
        other = Measure.from_values([*self.difference, values], [*self.signs, 1])
        # Of a, b and their difference.
        parts = (other, self.pair[:1], [1]), (own, self.pair[1:], [1]), (difference, self.surfaces, self.signs)
        tails = [at.tail(*part) for part in parts] if at.has_tail else [None] * len(parts)
        norms = at.norms_of(*parts[1], at.errors([values]), tails[1])
        distances = at.norms_of(*parts[2], at.errors(self.difference) + self.moved, tails[2])
        products = at.lattice_sums(difference, own)
        if not at.has_tail:
            return ReferenceEstimate.on_lattice(products, distances, norms, at.weights, at.widths)
        of_a, of_b, of_difference = (cast(Tail, tail) for tail in tails)
        in_octaves = at.octave_sums(difference, own)
        statistical = statistical_errors(in_octaves) if in_octaves else 0.0
        # Beyond the octaves ||a||² - ||b||² - ||a - b||² is twice the product <a - b, b>.
        beyond = (of_a.beyond - of_b.beyond - of_difference.beyond) / 2
        uncertainty = np.sum([tail.uncertainty for tail in (of_a, of_b, of_difference)], axis=0) / 2 + statistical
        images = aliased(products, at.weights, at.widths)
        return ReferenceEstimate(
            norms,
            products.totals + np.sum([one.squares for one in in_octaves], axis=0) + beyond,
            uncertainty + images + product_rounding(distances, norms),
        )
