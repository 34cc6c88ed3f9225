"""Norms and distances whose tail is measured: a small lattice, octaves around it, and the limit beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.adaptive.lattice_selection import FINER_LATTICE, core_lattice, good_intervals
from sobolev_batch.spectral.adaptive.problem import ESTIMATE_CAUTION, Problem, Solution, error_target
from sobolev_batch.spectral.adaptive.values import SurfaceValues
from sobolev_batch.spectral.errors.budget import aliased, change_of_root, sums_of_shells
from sobolev_batch.spectral.errors.probe import estimate
from sobolev_batch.spectral.fields import Field, field_for
from sobolev_batch.spectral.lattice import Lattice, OctaveLattice
from sobolev_batch.spectral.octaves.costs import POINTS_PER_SQUARE, SurfaceSize
from sobolev_batch.spectral.octaves.limit import EnergyLimit, tail_integral
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sampling import DrawnFrequencies, OctaveSampling
from sobolev_batch.spectral.octaves.sums import OctaveSums, OctaveWeights, squared_moduli, window_integral
from sobolev_batch.spectral.octaves.tail import Tail
from sobolev_batch.spectral.octaves.values import OctaveValues, SampledOctave, octave_values, settings_for
from sobolev_batch.spectral.shells import SobolevWeights, shell_sums
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.surfaces.smooth.smooth import Smooth

Reals = NDArray[np.float64]

_ROUNDS = 6
_MOST_OCTAVES, _FEWEST_OCTAVES_OF_FACES = 24, 2
# Fraction of the tail's share of the accuracy that is left to what lies beyond the last octave.
_LIMIT_FRACTION = 0.4
# Fraction of the permitted variance that may come from octaves that are not refined.
_LEFT_FRACTION = 0.5
# Octaves among which the statistical error is divided before anything is known of them, and Student's quantile.
_USUAL_OCTAVES, _QUANTILE = 6, 2.9
# Samples along an axis of the first lattice of an octave, and of the largest one.
_FIRST_M, _LARGEST_M = 64, 192
# Draws of an octave: the fewest, the most, and the most time for draws beside a lattice, as a fraction of its own.
_FEWEST_DRAWS, _MOST_DRAWS, _DRAWS_FRACTION = 256, 1_000_000, 0.5
# The fewest on flat faces without a lattice: where faces repeat, few draws would miss the frequency of the period.
_FEWEST_FLAT_DRAWS = 20_000
# Uniform directions among the draws, beside a lattice and without one.
_UNIFORM_BESIDE_LATTICE, _UNIFORM_ALONE = 0.1, 0.5
# Deviation of |field|² over its mean among draws, on curved surfaces and on flat faces.
_CURVED_DEVIATION, _FLAT_DEVIATION = 1.3, 3.0
# Between octaves the energy grows at most like |ξ|² as long as surfaces are closer than the wavelength.
_GROWTH = 4.0
# Predicted seconds that the first samples of an octave may take if drawn, and all of the samples together.
_OCTAVE_SECONDS, _MOST_SECONDS = 20.0, 200.0
# Nodes that a parametrised surface may have; beyond the frequency that they resolve it has no octaves.
_MOST_SMOOTH_NODES = 2e6


@dataclass(frozen=True, eq=False)
class Core:
    """The innermost frequencies: fields on a small lattice, under a smooth step.

    Attributes:
        lattice: Lattice of the fields.
        fields: Fields of the surfaces.
        squares: Squared norm of their difference under the step for each order (orders,).
        images: Bound on the change of the squares by the lattice's spacing (orders,).
        errors: Norms of the fields' own errors (orders,).
        energies: Energy ∫_{|ξ|=r} |field|² dS in the last two octaves below ξ_max.
    """

    lattice: Lattice
    fields: tuple[Field, ...]
    squares: Reals
    images: Reals
    errors: Reals
    energies: tuple[float, ...]

    @classmethod
    def for_problem(cls, problem: Problem, lattice: Lattice, cutoff: float) -> Self:
        """Return the core of a problem; the step ends at the cutoff."""
        samples = problem.samples(lattice)
        values = problem.accuracy.scale(ESTIMATE_CAUTION * estimate(samples, problem.orders))
        problem.require_above_rounding(values)
        # The octaves' values have errors of their own.
        target = error_target(values, problem.orders, problem.accuracy, problem.area).tightened(
            2 * problem.inexact_count
        )
        settings = TransformSettings(dtype=problem.dtype(lattice, target))
        fields = tuple(
            field_for(surface, lattice, target, settings, Execution(threads=problem.threads), sample=sample)
            for surface, sample in zip(problem.surfaces, samples, strict=True)
        )
        weights = SobolevWeights(lattice, problem.orders, cutoff)
        sums = sums_of_shells(
            shell_sums(_difference([one.values for one in fields]), None, lattice, lattice.half), weights
        )
        errors = np.sum([one.quality.probe.norms(weights) for one in fields], axis=0)
        images = aliased(sums, weights, problem.support.widths)
        return cls(lattice, fields, np.maximum(sums.totals, 0.0), images, errors, tuple(sums.outer.tolist()))


@dataclass(frozen=True, eq=False)
class MeasuredOctave:
    """An octave: where it was sampled, the surfaces' values there, and their integrals.

    Attributes:
        values: Values of each surface.
        sums: Integrals of the squared difference.
    """

    values: tuple[OctaveValues, ...]
    sums: OctaveSums

    @property
    def sampling(self) -> OctaveSampling:
        """Samples of the octave, common to all surfaces."""
        return self.values[0].octave.sampling

    def error_norms(self, orders: Sequence[float]) -> Reals:
        """Return the norms of the values' own errors (orders,), those of all surfaces added."""
        return np.asarray(np.sum([values.error_norms(orders) for values in self.values], axis=0))


def solve_in_octaves(problem: Problem, seed: int, aim: float = 1.0) -> Solution:
    """Compute a norm or a distance to an accuracy, with its tail measured in octaves.

    Args:
        problem: Surfaces, orders and accuracy.
        seed: Seed of the random frequencies. The same seed gives the same result.
        aim: Fraction of the rtol to aim at.

    Returns:
        The first solution that meets the aim; else the last one that can be sampled in some minutes.

    Raises:
        AccuracyError: The accuracy lies below the rounding of fields.
    """
    aimed = replace(problem, accuracy=replace(problem.accuracy, rtol=aim * problem.accuracy.rtol))
    search = _Search.begin(aimed, seed)
    for rounds_left in reversed(range(_ROUNDS)):
        search.measure_outwards()
        solution = search.solution()
        if np.all(aimed.accuracy.met(solution.estimate)) or not (rounds_left and search.refine()):
            break
    if np.all(problem.accuracy.met(solution.estimate)):
        return solution
    limits = "with as many frequencies as can be sampled in some minutes"
    return replace(solution, shortfall=problem.out_of_reach(solution.estimate, limits))


class _Search:
    """Octaves that are added and refined until the accuracy is met."""

    def __init__(self, problem: Problem, core: Core, cutoff: float, rng: np.random.Generator) -> None:
        self.problem = problem
        self.core = core
        self.cutoff = cutoff
        self.rng = rng
        self.octaves: list[MeasuredOctave] = []
        self.seconds = 0.0
        self.sizes = [SurfaceSize.from_surface(surface) for surface in problem.surfaces]
        self.normals = FaceNormals.from_surfaces(problem.surfaces)
        self.limit = EnergyLimit.from_surfaces(problem.surfaces, [1, -1][: len(problem.surfaces)])

    @classmethod
    def begin(cls, problem: Problem, seed: int) -> Self:
        lattice = core_lattice(problem.support, problem.orders, problem.accuracy)
        core = Core.for_problem(problem, lattice, lattice.xi_max)
        return cls(problem, core, lattice.xi_max, np.random.default_rng(seed))

    @property
    def squares(self) -> Reals:
        """Squared norms (orders,): what has been measured, and what lies beyond it for certain."""
        tail = self._tail()
        known = tail.octaves + np.maximum(tail.beyond - tail.uncertainty, 0.0)
        return np.asarray(self.core.squares + known)

    @property
    def tail_changes(self) -> Reals:
        """Largest permitted error of the squares by the tail (orders,)."""
        parts = np.array([self.problem.accuracy.truncation_part(order) for order in self.problem.orders])
        return np.asarray(2 * parts * np.maximum(self.squares, self.problem.accuracy.floor**2))

    @property
    def permitted_variances(self) -> Reals:
        """Largest permitted variance of the squares (orders,)."""
        return np.asarray(((1 - _LIMIT_FRACTION) * self.tail_changes / _QUANTILE) ** 2)

    def measure_outwards(self) -> None:
        """Add octaves until what lies beyond them is known well enough, or no more can be had."""
        while len(self.octaves) < _MOST_OCTAVES and self.seconds < _MOST_SECONDS and not self._knows_the_rest():
            octave = Octave(self.cutoff, len(self.octaves) + 1)
            if octave.highest > self._resolvable_frequency():
                break
            self.octaves.append(self._measured(self._first_sampling(octave)))

    def solution(self) -> Solution:
        """Return the numbers by what has been measured so far."""
        core, orders = self.core, self.problem.orders
        squares = core.errors**2 + np.sum([octave.error_norms(orders) ** 2 for octave in self.octaves], axis=0)
        found = self._tail().estimate(core.squares, core.images, np.sqrt(squares))
        values = tuple(
            SurfaceValues(field, tuple(octave.values[number] for octave in self.octaves))
            for number, field in enumerate(core.fields)
        )
        return Solution(found, core.lattice, values, has_tail=bool(self.octaves))

    def refine(self) -> bool:
        """Take more samples where they are needed most; tell whether any could be taken."""
        refined = False
        accuracy = self.problem.accuracy
        values = accuracy.scale(np.sqrt(self.squares))
        if np.any(change_of_root(self.squares, self.core.images) > accuracy.aliasing_part * values):
            lattice = self.core.lattice
            larger = good_intervals(FINER_LATTICE * lattice.M)
            if larger <= accuracy.largest_intervals:
                self.core = Core.for_problem(self.problem, Lattice(lattice.xi_max, larger), self.cutoff)
                refined = True
        permitted = self.permitted_variances
        totals = sum((octave.sums.variances for octave in self.octaves), np.zeros(len(permitted)))
        order = int(np.argmax(totals / permitted))
        if totals[order] > permitted[order]:
            each = permitted[order] / len(self.octaves)
            variances = np.array([octave.sums.variances[order] for octave in self.octaves])
            # Those that matter least together stay as they are.
            ascending = np.argsort(variances)
            decisive = ascending[np.cumsum(variances[ascending]) > _LEFT_FRACTION * permitted[order]]
            finer = {int(n): self._finer_sampling(self.octaves[n], order, each) for n in decisive}
            samplings = {n: sampling for n, sampling in finer.items() if sampling is not None}
            seconds = sum(self._seconds(sampling, self.octaves[n].sampling) for n, sampling in samplings.items())
            if self.seconds + seconds <= _MOST_SECONDS:
                for number, sampling in samplings.items():
                    self.octaves[number] = self._measured(sampling, self.octaves[number])
                    refined = True
        return refined

    def _knows_the_rest(self) -> bool:
        # Where faces repeat, the energy may jump from one octave to the next.
        if len(self.octaves) < (_FEWEST_OCTAVES_OF_FACES if self.normals else 1):
            return False
        return bool(np.all(self._tail().uncertainty <= _LIMIT_FRACTION * self.tail_changes))

    def _tail(self) -> Tail:
        octaves = [octave.sampling.octave for octave in self.octaves]
        sums = [octave.sums for octave in self.octaves]
        return Tail.from_sums(octaves, sums, self.limit, self.problem.orders, self.core.energies)

    def _measured(self, sampling: OctaveSampling, known: MeasuredOctave | None = None) -> MeasuredOctave:
        problem = self.problem
        self.seconds += self._seconds(sampling, known.sampling if known else None)
        values = problem.accuracy.scale(np.sqrt(self.squares))
        target = error_target(values, problem.orders, problem.accuracy, problem.area)
        target = target.tightened(2 * problem.inexact_count * np.sqrt(_USUAL_OCTAVES))
        settings = settings_for(target)
        execution = Execution(threads=problem.threads, allowed_bytes=problem.accuracy.allowed_bytes)
        octave = SampledOctave.from_sampling(sampling)
        found = tuple(
            octave_values(
                surface, octave, problem.orders, settings, execution, known=known.values[number] if known else None
            )
            for number, surface in enumerate(problem.surfaces)
        )
        squares = squared_moduli(_difference([one.values for one in found]))
        return MeasuredOctave(found, OctaveWeights(octave.quadrature, problem.orders).sums(squares))

    def _first_sampling(self, octave: Octave) -> OctaveSampling:
        """Return the sampling that is predicted to be the cheapest one."""
        energy = self._predicted_energy()
        orders = self.problem.orders
        inside = np.array([window_integral(octave, order) for order in orders])
        outside = np.array([tail_integral(octave.highest, order) for order in orders])
        deviation = _FLAT_DEVIATION if self.normals else _CURVED_DEVIATION
        # Relative errors of the energy that the octave's own part permits, and what lies beyond it.
        # Very negative orders have nothing there.
        with np.errstate(divide="ignore"):
            own = np.sqrt(self.permitted_variances / _USUAL_OCTAVES) / (energy * inside)
            further = _LIMIT_FRACTION * self.tail_changes / (_QUANTILE * energy * outside)
        count = int(np.clip((deviation / min(own.min(), further.min())) ** 2, _FEWEST_DRAWS, _MOST_DRAWS))
        lattice = self._lattice(octave, _FIRST_M)
        seconds = self._lattice_seconds(lattice)
        alone = max(count, _FEWEST_FLAT_DRAWS) if self.normals else count
        alone = min(alone, max(_FEWEST_DRAWS, int(_OCTAVE_SECONDS / self._draw_seconds)))
        if self._can_draw and alone * self._draw_seconds < seconds:
            return OctaveSampling(octave, (), self._drawn(octave, alone, _UNIFORM_ALONE))
        beside = 0
        if self.normals and self._can_draw:
            affordable = _DRAWS_FRACTION * seconds / self._draw_seconds
            beside = int(np.clip(min(count, affordable), _FEWEST_DRAWS, _MOST_DRAWS))
        return OctaveSampling(octave, (lattice,), self._drawn(octave, beside, _UNIFORM_BESIDE_LATTICE))

    def _predicted_energy(self) -> float:
        """Predict the energy of the next octave."""
        energy = self.octaves[-1].sums.energy if self.octaves else self.core.energies[-1]
        return min(_GROWTH * energy, max(self.limit.value, energy))

    def _finer_sampling(self, octave: MeasuredOctave, order: int, permitted: float) -> OctaveSampling | None:
        """Return a sampling of an octave with a smaller variance, or None if it is small enough."""
        sampling, sums = octave.sampling, octave.sums
        excess = float(sums.variances[order]) / permitted
        if excess <= 1:
            return None
        lattices, drawn = sampling.lattices, sampling.drawn
        count = int(min(len(drawn) * np.clip(1.5 * excess, 1.5, 16.0), _MOST_DRAWS))
        from_draws = sums.drawn_variances[order] > sums.lattice_variances[order]
        first = self._lattice(sampling.octave, _FIRST_M)
        if not lattices and count * self._draw_seconds > self._lattice_seconds(first):
            beside = len(drawn) if self.normals else 0
            lattices = (first,)
            drawn = self._drawn(sampling.octave, beside, _UNIFORM_BESIDE_LATTICE)
        elif from_draws:
            drawn = self._drawn(sampling.octave, count, drawn.uniform_fraction)
        else:
            intervals = 2 * round(lattices[-1].M * np.clip(excess**0.5, 1.25, 2.0) / 2)
            lattices = (*lattices, self._lattice(sampling.octave, intervals))
        return replace(sampling, lattices=lattices, drawn=drawn)

    def _lattice(self, octave: Octave, intervals: int) -> OctaveLattice:
        largest = min(_LARGEST_M, self.problem.accuracy.largest_intervals)
        return OctaveLattice.random(octave.lowest, octave.highest, min(intervals, largest), self.rng)

    def _drawn(self, octave: Octave, count: int, uniform_fraction: float) -> DrawnFrequencies:
        seed = int(self.rng.integers(2**53))
        return DrawnFrequencies(octave, count, seed, self.normals, uniform_fraction)

    @property
    def _draw_seconds(self) -> float:
        return sum(size.draw_seconds for size in self.sizes)

    def _lattice_seconds(self, lattice: OctaveLattice) -> float:
        return sum(size.lattice_seconds(lattice) for size in self.sizes)

    def _seconds(self, sampling: OctaveSampling, known: OctaveSampling | None = None) -> float:
        """Predict the processor time of the samples of an octave, without those that are known."""
        return sum(size.sampling_seconds(sampling, known) for size in self.sizes)

    @property
    def _can_draw(self) -> bool:
        """Tell whether single frequencies are cheaper than whole lattices; sums over many nodes are not."""
        return not any(isinstance(surface, Smooth) for surface in self.problem.surfaces)

    def _resolvable_frequency(self) -> float:
        """Return the frequency up to which all surfaces can be transformed."""
        smooth = [surface.area for surface in self.problem.surfaces if isinstance(surface, Smooth)]
        return float((_MOST_SMOOTH_NODES / (4 * POINTS_PER_SQUARE * max(smooth))) ** 0.5) if smooth else np.inf


def _difference(values: Sequence[NDArray[np.complexfloating]]) -> NDArray[np.complexfloating]:
    """Return the only field, or the difference of two."""
    return values[0] if len(values) == 1 else values[0] - values[1]
