"""Frequencies at which surfaces are compared, with the norms and products that follow from values there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, cast

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.geometry.surface import Surface, centering
from sobolev_batch.norms.accuracy.problem import OFF_CENTER, Problem, error_target, support_of
from sobolev_batch.norms.accuracy.solution import Solution, SurfaceValues
from sobolev_batch.norms.accuracy.solve import solve
from sobolev_batch.norms.budget import Sums, Support, sums_of_shells
from sobolev_batch.norms.estimate import NormEstimate, ReferenceEstimate, Tail, estimate_norms
from sobolev_batch.norms.fields import field_for
from sobolev_batch.norms.tail.integrals import OctaveWeights, integral_over, squared_moduli
from sobolev_batch.norms.tail.remainder import Remainder, mean_sinc, remainder
from sobolev_batch.norms.tail.sampling import OctaveSampling
from sobolev_batch.norms.tail.values import octave_values
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, cheapest_dtype
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
        numbers = range(len(surfaces[0].octaves))
        octaves = (sum(sign * one.octaves[number].values for one, sign in signed) for number in numbers)
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
        return cls(cast(Lattice, solution.lattice), solution.octaves, problem.orders, widths, bool(solution.remainders))

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
        settings = TransformSettings(dtype=cheapest_dtype([surface], self.lattice, target))
        field = field_for(surface, self.lattice, target, settings, Execution(threads=execution.threads))
        octaves = (octave_values(surface, octave, self.orders, target, execution) for octave in self.octaves)
        return SurfaceValues(field, tuple(octaves))

    def moved(self, values: SurfaceValues, surface: Surface) -> Callable[[float], NormEstimate]:
        """Return a function of the distance (orders,) of a surface to itself moved by a length: the rms of directions.

        Its errors are what a lattice without a tail leaves out. Others are alike for all that these values are part of.
        """
        own = Measure.from_values([values], [1])
        radii = self.lattice.spacing * np.sqrt(np.arange(self.lattice.shell_count))
        shells = shell_sums(own.lattice, None, self.lattice, self.lattice.half)
        energies, tail = [squared_moduli(octave) for octave in own.octaves], self.tail(own, [surface], [1])
        support, none = Support(2 * support_of([surface]).areas, self.widths), np.zeros(len(self.orders))

        def by(length: float) -> NormEstimate:
            # ∫ |1 - exp(-2πi ξ·v)|² over directions of v, on average: 2 - 2 sin(2π|ξ||v|)/(2π|ξ||v|).
            sums = shells * (2 - 2 * np.sinc(2 * radii * length))
            if not self.has_tail:
                return estimate_norms(sums_of_shells(sums, self.weights), self.weights, support, none)
            squares = self.weights.per_shell @ sums
            for weights, energy in zip(self._octave_weights, energies, strict=True):
                factors = 2 - 2 * np.sinc(2 * weights.sampling.radii * length)
                squares = squares + weights.by_order[:-1] @ (energy * factors)
            if tail is not None:
                means = np.array([mean_sinc(self._cutoff, order, length) for order in self.orders])
                squares = squares + (2 - 2 * means) * tail.remainder
            return NormEstimate(np.sqrt(np.maximum(squares, 0.0)), none, none, none)

        return by

    def norms_of(self, measure: Measure, surfaces: Sequence[Surface], errors: Reals, tail: Tail | None) -> NormEstimate:
        """Return the norms of a measure from its tail and the norms of its values' own errors (orders,)."""
        support = Support(support_of(surfaces).areas, self.widths)
        return estimate_norms(self.lattice_sums(measure, measure), self.weights, support, errors, tail)

    def lattice_sums(self, measure: Measure, other: Measure) -> Sums:
        """Return the sums of Re(a conj b) over the lattice."""
        return sums_of_shells(shell_sums(measure.lattice, other.lattice, self.lattice, self.lattice.half), self.weights)

    def octave_integral(self, measure: Measure, other: Measure) -> tuple[Reals, Reals]:
        """Return the integral of Re(a conj b) over all octaves (orders,), and how far off it may be at 99 %."""
        octaves = zip(self._octave_weights, measure.octaves, other.octaves, strict=True)
        return integral_over([weights.sums((a.astype(np.complex128) * b.conj()).real) for weights, a, b in octaves])

    def tail(
        self, measure: Measure, surfaces: Sequence[Surface], signs: Sequence[int], beyond: Remainder | None = None
    ) -> Tail | None:
        """Return the tail from the octaves and what is known to lie beyond them; None where the lattice is all."""
        if not self.has_tail:
            return None
        beyond = beyond or self._beyond(surfaces, signs)
        return Tail(*self.octave_integral(measure, measure), *beyond.at(self.orders))

    def _beyond(self, surfaces: Sequence[Surface], signs: Sequence[int]) -> Remainder:
        # Norms of single surfaces serve as scales.
        return remainder(surfaces, signs, self._cutoff, self.orders, is_scale=len(surfaces) == 1)

    def against(
        self, problem: Problem, solution: Solution, difference: Sequence[SurfaceValues], reference: SurfaceValues
    ) -> ReferenceEstimate:
        """Return the norm of the reference b of a problem's pair a, b, and the product <a - b, b>.

        The difference a - b is the signed sum of the problem's surfaces, whose values are given. The solution may know
        what lies beyond some cutoffs.
        """
        surfaces, signs, pair = problem.surfaces, problem.signs, problem.pair
        a_minus_b, b = Measure.from_values(difference, signs), Measure.from_values([reference], [1])
        a = Measure.from_values([*difference, reference], [*signs, 1])
        known = next((one for one in solution.remainders if one.cutoff == self._cutoff and one.is_known), None)
        beyond = (known or self._beyond(surfaces, signs)) if self.has_tail else None
        of_difference = self.tail(a_minus_b, surfaces, signs, beyond)
        of_b = self.tail(b, pair[1:], [1])
        norms = self.norms_of(b, pair[1:], reference.error_norms(self.weights), of_b)
        errors = np.hypot.reduce([one.error_norms(self.weights) for one in difference]) + problem.moved
        distances = self.norms_of(a_minus_b, surfaces, errors, of_difference)
        tails = self.tail(a, pair[:1], [1]), of_b, of_difference
        products, tail = self.lattice_sums(a_minus_b, b), Tail.of_product(self.octave_integral(a_minus_b, b), *tails)
        if beyond is not None and tail is not None and problem.is_whole:
            # Of whole surfaces the points of the distance show the product too.
            values, errors = beyond.products_at(self.orders)
            values = np.where(errors < tail.remainder_error, values, tail.remainder)
            tail = replace(tail, remainder=values, remainder_error=np.minimum(errors, tail.remainder_error))
        return ReferenceEstimate.from_products(products, self.weights, self.widths, distances, norms, tail)


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference b of a distance ||a - b||, and what is known of it.

    Attributes:
        surface: The surface b as its values are of it, moved to the centre of the lattice's period.
        estimate: The norm of b, and the product <a - b, b>.
    """

    frequencies: Frequencies
    values: SurfaceValues
    surface: Surface
    estimate: ReferenceEstimate

    @classmethod
    def for_problem(cls, problem: Problem, solution: Solution, seed: int) -> Self:
        """Return the reference of a distance between surfaces that are not equal.

        Its values are among those that the distance was computed from. But where the surfaces have parts in common,
        which cancel, the reference has more than those, and gets frequencies of its own.
        """
        if problem.is_whole and problem.apart is not None:
            own, of_own = problem.alone[1], solution.alone[1]
            norms = of_own.estimate
            errors = (2 * norms.values + norms.errors) * norms.errors + problem.apart
            known = ReferenceEstimate(norms, -(norms.values**2), errors)
            return cls(Frequencies.from_solution(own, of_own), of_own.values[0], own.surfaces[0], known)
        if problem.is_whole:
            frequencies, of_b = Frequencies.from_solution(problem, solution), solution.values[1]
            known = frequencies.against(problem, solution, solution.values, of_b)
            return cls(frequencies, of_b, problem.pair[1], known)
        move = centering(problem.pair, OFF_CENTER)
        pair = [move.apply(surface) for surface in problem.pair]
        support = replace(support_of(pair), areas=np.array(pair[1].area))
        accuracy = replace(problem.accuracy, best_effort=True)
        alone = replace(problem, signs=(1,), label="the reference", apart=None, moved=0.0)
        own = replace(alone, surfaces=pair[1:], support=support, accuracy=accuracy)
        of_reference = solve(own, seed)
        frequencies, values = Frequencies.from_solution(own, of_reference), of_reference.values[0]
        if not problem.surfaces:
            norms = of_reference.estimate
            errors = problem.moved * (norms.values + norms.errors)
            return cls(frequencies, values, pair[1], ReferenceEstimate(norms, 0 * errors, errors))
        target = error_target(solution.estimate.values, problem.orders, problem.accuracy, problem.area)
        placed = replace(problem, surfaces=[move.apply(surface) for surface in problem.surfaces], pair=pair)
        difference = [frequencies.values(surface, target, problem.execution) for surface in placed.surfaces]
        return cls(frequencies, values, pair[1], frequencies.against(placed, solution, difference, values))
