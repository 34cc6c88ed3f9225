"""Norms and distances whose tail is measured: a small lattice, octaves around it, and what lies beyond them.

Random points measure the part beyond the lattice, and beyond each octave (see `remainder`). It must agree with the
octaves farther out: a difference outside both errors counts as an error, unless more and new points remove it. Until
the accuracy is met, octaves get more samples, or more points are drawn, or an octave is added, whichever is cheapest.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.norms.accuracy.problem import ESTIMATE_CAUTION, Problem, error_target, only_or_difference, sums_on
from sobolev_batch.norms.accuracy.solution import Solution, SurfaceValues
from sobolev_batch.norms.accuracy.tolerance import FINER_LATTICE, core_lattice, good_intervals
from sobolev_batch.norms.budget import Sums, aliased
from sobolev_batch.norms.estimate import Tail, change_of_root, estimate_norms
from sobolev_batch.norms.fields import Field
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.integrals import OctaveSums, OctaveWeights, integral_over, squared_moduli
from sobolev_batch.norms.tail.potentials import tail_integral
from sobolev_batch.norms.tail.remainder import MOSTLY, Remainder
from sobolev_batch.norms.tail.sampling import Octave, OctaveSampling
from sobolev_batch.norms.tail.values import POINTS_PER_SQUARE, OctaveValues, SurfaceSize, octave_values
from sobolev_batch.transform.lattice import Lattice, OctaveLattice, SobolevWeights
from sobolev_batch.transform.probe import estimate as estimate_from

_ROUNDS, _MOST_OCTAVES = 6, 24
# Fraction of the tail's share of the accuracy that is left to what lies beyond the last octave.
_REMAINDER_FRACTION = 0.4
# The same for a surface alone without octaves, which have no share then. Octaves of a large smooth one are sampled at
# lattices whose images may all touch it at once, which their scatter tells little of.
_ALONE_FRACTION = 0.9
# How far off, relatively, other pairs may be beyond the octaves of a pilot: chosen, not derived.
_OF_OTHERS = 1 / 8
# Fraction of the permitted variance that may come from octaves that are not refined.
_LEFT_FRACTION = 0.5
# Octaves among which the statistical error is divided before anything is known of them, and Student's quantile.
_USUAL_OCTAVES, _QUANTILE = 6, 2.9
# Samples along an axis of the first lattice of an octave, at least and at most, and of the largest one.
_FEWEST_M, _FIRST_M, _LARGEST_M = 32, 64, 192
# Samples of an octave on a lattice, as a fraction of M³.
_FILLED = np.pi / 12 * 7 / 8
# Draws of an octave: the fewest, the most, and the most time for draws beside a lattice, as a fraction of its own.
_FEWEST_DRAWS, _MOST_DRAWS, _DRAWS_FRACTION = 256, 1_000_000, 0.5
# Part of the draws that flat faces need which they usually take beside lattices: chosen, not derived.
_OF_DRAWS = 0.1
# The fewest on flat faces without a lattice: where faces repeat, few draws would miss the frequency of the period.
_FEWEST_FLAT_DRAWS = 20_000
# Uniform directions among the draws, beside a lattice and without one.
_UNIFORM_BESIDE_LATTICE, _UNIFORM_ALONE = 0.1, 0.5
# Deviation of |field|² over its mean among draws, on curved surfaces and on flat faces.
_CURVED_DEVIATION, _FLAT_DEVIATION = 1.3, 3.0
# Between octaves the energy grows at most like |ξ|² as long as surfaces are closer than the wavelength. It grows ever
# less: by more than this fraction of what it last grew by.
_GROWTH, _OF_GROWTH = 4.0, 0.7
# Predicted seconds that the first samples of an octave may take if drawn, and all of the samples together.
_OCTAVE_SECONDS, _MOST_SECONDS = 20.0, 200.0
# Random points of a remainder at most, how many more than needed are taken, and how many more to check it again.
_MOST_POINTS, _MORE_POINTS, _MORE_TO_CHECK = 400_000, 1.3, 4
# Nodes that a parametrised surface may have; beyond the frequency that they resolve it has no octaves.
_MOST_SMOOTH_NODES = 2e6


@dataclass(frozen=True, eq=False)
class Core:
    """The innermost frequencies: fields on a small lattice, under a smooth step that ends at a cutoff.

    Attributes:
        weights: Weights of the lattice, with the step.
        sums: Sums of the squared difference of the fields under the step.
        errors: Norms of the fields' own errors (orders,).
    """

    weights: SobolevWeights
    fields: tuple[Field, ...]
    sums: Sums
    errors: Reals

    @classmethod
    def on_lattice(cls, problem: Problem, lattice: Lattice) -> Self:
        """Compute the fields of a problem on a lattice, at whose end the step ends."""
        values = problem.accuracy.scale(ESTIMATE_CAUTION * estimate_from(problem.samples(lattice), problem.orders))
        problem.require_above_rounding(values)
        # The octaves' values have errors of their own.
        target = error_target(values, problem.orders, problem.accuracy, problem.area)
        fields = problem.fields(lattice, target.tightened(2 * problem.inexact_count))
        weights = SobolevWeights(lattice, problem.orders, lattice.xi_max)
        return cls(weights, fields, *sums_on(problem, fields, weights))

    @property
    def energy(self) -> float:
        """Energy ∫_{|ξ|=r} |field|² dS in the last octave below ξ_max."""
        return float(self.sums.outer[1])


@dataclass(frozen=True, eq=False)
class MeasuredOctave:
    """An octave with the values of each surface there, and the integrals of the squared difference."""

    values: tuple[OctaveValues, ...]
    sums: OctaveSums


@dataclass(frozen=True, eq=False)
class State:
    """A norm or a distance in the course of its computation.

    Attributes:
        octaves: Octaves around the core, from the inside out.
        remainders: What lies beyond the core, and beyond each octave.
        for_others: True if other pairs are to be compared at the same frequencies.
        seconds: Processor time that was predicted for the octaves and remainders.
        steps: Number of steps taken: each draws other frequencies.
    """

    problem: Problem
    seed: int
    core: Core
    octaves: tuple[MeasuredOctave, ...]
    remainders: tuple[Remainder, ...]
    for_others: bool = False
    seconds: float = 0.0
    steps: int = 0

    @cached_property
    def tail(self) -> Tail:
        """All beyond the core. What two ways to it disagree about counts as uncertain."""
        octaves = integral_over([octave.sums for octave in self.octaves])
        tail = Tail(*octaves, *self.remainders[-1].at(self.problem.orders))
        return replace(tail, remainder_error=tail.remainder_error + self.disagreements.max(axis=0))

    @cached_property
    def disagreements(self) -> Reals:
        """Gap of each remainder to what was measured there otherwise, outside of both errors (remainders, orders)."""
        orders, disagreements = self.problem.orders, []
        for number, beyond in enumerate(self.remainders):
            octaves = integral_over([octave.sums for octave in self.octaves[number:]])
            outer, (value, error) = Tail(*octaves, *self.remainders[-1].at(orders)), beyond.at(orders)
            disagreements.append(np.abs(outer.totals - value) - outer.octaves_error - outer.remainder_error - error)
        disagreements[-1] = self._missing
        return np.maximum(disagreements, 0.0)

    @property
    def _missing(self) -> Reals:
        """Energy that the last octave has and the last remainder lacks, outside of both errors, beyond it (orders,).

        From octave to octave the energy grows until it is twice the area of all that differs. Only what repeats with a
        period has less of it farther out, and points that nothing is hidden from see that.
        """
        orders, beyond = self.problem.orders, self.remainders[-1]
        return np.zeros(len(orders)) if beyond.points >= beyond.covering else self.expected - sum(beyond.at(orders))

    @property
    def expected(self) -> Reals:
        """Squared norm beyond all octaves if the energy of the last one does not grow (orders,)."""
        least = self.core.energy
        if self.octaves:
            least = self.octaves[-1].sums.energy - _QUANTILE * self.octaves[-1].sums.energy_deviation
        cutoff = self.remainders[-1].cutoff
        return np.array([least * tail_integral(cutoff, order) for order in self.problem.orders])

    @cached_property
    def squares(self) -> Reals:
        """Squared norms (orders,): what has been measured, and what lies beyond it for certain."""
        certain = np.maximum(self.tail.remainder - self.tail.remainder_error, 0.0)
        return np.asarray(np.maximum(self.core.sums.totals, 0.0) + self.tail.octaves + certain)

    @cached_property
    def permitted(self) -> Reals:
        """Largest permitted error of the squares by the tail (orders,)."""
        return self._permitted_of(self.squares)

    def _permitted_of(self, squares: Reals) -> Reals:
        accuracy = self.problem.accuracy
        return 2 * accuracy.truncation_parts(self.problem.orders) * np.maximum(squares, accuracy.floor**2)

    @property
    def permitted_variances(self) -> Reals:
        """Largest permitted variance of the squares (orders,)."""
        return np.asarray(((1 - _REMAINDER_FRACTION) * self.permitted / _QUANTILE) ** 2)

    @property
    def excess(self) -> float:
        """Error of the remainder over the permitted one, at the worst order; most likely more where it is not known."""
        # Without octaves, the lattice of others ends sharply, and all of the remainder is an error.
        of_others = _OF_OTHERS if self.octaves else 1.0
        if not self.remainders[-1].is_known:
            energies = [self.core.energy, *(octave.sums.energy for octave in self.octaves)]
            growth = energies[-1] / energies[-2] if self.octaves and energies[-2] > 0 else 1.0
            expected = self.expected * np.clip(_OF_GROWTH * growth, 1.0, _GROWTH)
            permitted = _REMAINDER_FRACTION * self._permitted_of(self.squares + expected)
            with np.errstate(divide="ignore"):
                return float(np.max(of_others * expected / permitted))
        values, errors = self.remainders[-1].at(self.problem.orders)
        if self.for_others:
            errors = np.maximum(errors, of_others * np.abs(values))
        fraction = _ALONE_FRACTION if len(self.problem.surfaces) == 1 and not self.octaves else _REMAINDER_FRACTION
        return float(np.max(errors / (fraction * self.permitted)))

    @cached_property
    def sizes(self) -> list[SurfaceSize]:
        """Sizes of the surfaces, which times follow from."""
        return [SurfaceSize.from_surface(surface) for surface in self.problem.surfaces]

    @cached_property
    def normals(self) -> FaceNormals:
        """Normals of flat faces."""
        return FaceNormals.from_surfaces(self.problem.surfaces)

    @property
    def draw_seconds(self) -> float:
        """Time of the transforms at one frequency."""
        return sum(size.draw_seconds for size in self.sizes)

    @property
    def can_draw(self) -> bool:
        """True where single frequencies are cheaper than whole lattices; sums over many nodes are not."""
        return not any(isinstance(surface, Smooth) for surface in self.problem.surfaces)

    def sampling_seconds(self, sampling: OctaveSampling, known: OctaveSampling | None = None) -> float:
        """Predict the time of the samples of an octave, without those that are known."""
        return sum(size.sampling_seconds(sampling, known) for size in self.sizes)

    def redrawn(self, number: int, points: int | None = None) -> Self:
        """Return the state after a step that estimates one remainder from new points."""
        problem, known = self.problem, list(self.remainders)
        cutoff, seconds, seed = known[number].cutoff, known[number].seconds(points or 0), self.seed + self.steps + 1
        known[number] = problem.beyond(cutoff, seed, points)
        return self.advanced(seconds, remainders=tuple(known))

    def advanced(self, seconds: float, **changes: object) -> Self:
        """Return the state after a step of some predicted time."""
        self.problem.notify(f"{self.problem.label}: short wavelengths, step {self.steps + 1}")
        return replace(self, seconds=self.seconds + seconds, steps=self.steps + 1, **changes)  # type: ignore[arg-type]


def solve_in_octaves(problem: Problem, seed: int, aim: float = 1.0, for_others: bool = False) -> Solution:
    """Compute a norm or a distance to an accuracy, with its tail measured in octaves.

    The same seed gives the same random frequencies and result. The aim is a fraction of the rtol. Octaves reach farther
    for others: pairs whose part beyond the octaves is known less well. Return the first solution that meets the aim;
    else the last one that can be sampled in some minutes. AccuracyError where the accuracy lies below rounding.
    """
    aimed = problem.with_rtol(aim * problem.accuracy.rtol)
    problem.notify(f"{problem.label}: short wavelengths")
    lattice = core_lattice(aimed.support, aimed.orders, aimed.accuracy)
    core = Core.on_lattice(aimed, lattice)
    beyond = Remainder.alike(lattice.xi_max, error=np.inf) if for_others else aimed.beyond(lattice.xi_max, seed)
    state = State(aimed, seed, core, (), (beyond,), for_others, beyond.seconds(beyond.points))
    for _ in range(_ROUNDS):
        while (farther := farther_out(state)) is not None:
            state = farther
        solution = solution_of(state)
        if np.all(aimed.accuracy.met(solution.estimate)) or (finer := refined(state)) is None:
            break
        state = finer
    solution = solution_of(state)
    if np.all(problem.accuracy.met(solution.estimate)):
        return solution
    return replace(solution, shortfall=problem.out_of_reach(solution.estimate))


def solution_of(state: State) -> Solution:
    """Return the numbers by what is known so far."""
    core, support = state.core, state.problem.support
    of_octaves = [values.error_norms(core.weights.orders) for octave in state.octaves for values in octave.values]
    errors = np.asarray(np.hypot.reduce([core.errors, *of_octaves]))
    found = estimate_norms(core.sums, core.weights, support, errors, state.tail)
    values = [SurfaceValues(own, tuple(one.values[n] for one in state.octaves)) for n, own in enumerate(core.fields)]
    return Solution(found, core.weights.lattice, tuple(values), remainders=state.remainders)


def farther_out(state: State) -> State | None:
    """Return a state whose remainder is known better, by more points or one more octave; None if it is known well.

    For others, what lies beyond is first looked at where the energy of the last octave permits that it is enough.
    """
    problem, beyond = state.problem, state.remainders[-1]
    # The law that extrapolates from a lattice alone does not hold for flat faces.
    needs_octave = state.for_others and bool(state.normals) and not state.octaves
    if (state.excess <= 1 and not needs_octave) or state.seconds >= _MOST_SECONDS:
        return _looked_at(state)
    octave = Octave(state.remainders[0].cutoff, len(state.octaves) + 1)
    smooth = max((surface.area for surface in problem.surfaces if isinstance(surface, Smooth)), default=0.0)
    # The nodes of surfaces by formula resolve no more.
    highest = np.sqrt(_MOST_SMOOTH_NODES / (4 * POINTS_PER_SQUARE * smooth)) if smooth else np.inf
    can_go_on = len(state.octaves) < _MOST_OCTAVES and octave.highest <= highest
    # What points may have missed falls with their number, and what they scatter with its root.
    scattered, missed = (1 - beyond.hidden) * state.excess**2 / 2, beyond.hidden * state.excess**2
    points = int(_MORE_POINTS * beyond.points * (scattered + np.sqrt(scattered**2 + missed)))
    if beyond.hidden > MOSTLY:
        # Nothing is hidden from this many.
        points = min(points, beyond.covering)
    sampling = _first_sampling(state, octave) if can_go_on else None
    seconds = np.inf if sampling is None else state.sampling_seconds(sampling) + beyond.seconds(beyond.points) / 4
    # On flat faces the first samples of an octave are the least of what it takes.
    whole = _OF_DRAWS * _draws_needed(state, octave) * state.draw_seconds if state.normals and state.can_draw else 0.0
    affordable = min(max(seconds, whole), _MOST_SECONDS)
    if not state.for_others and points <= _MOST_POINTS and beyond.seconds(points) < affordable:
        return state.redrawn(len(state.octaves), points)
    if sampling is None:
        return _looked_at(state)
    measured = _measured(state, sampling)
    unknown = Remainder.alike(octave.highest, error=np.inf)
    outer = unknown if state.for_others else problem.beyond(octave.highest, state.seed)
    return state.advanced(seconds, octaves=(*state.octaves, measured), remainders=(*state.remainders, outer))


def _looked_at(state: State) -> State | None:
    """Return a state whose remainder is known; None if it is."""
    return None if state.remainders[-1].is_known else state.redrawn(len(state.octaves))


def refined(state: State) -> State | None:
    """Return a state with more samples where they are needed most; None where no more can be taken."""
    problem, accuracy, core = state.problem, state.problem.accuracy, state.core
    values, lattice = accuracy.scale(np.sqrt(state.squares)), core.weights.lattice
    images = aliased(core.sums, core.weights, problem.support.widths)
    if np.any(change_of_root(state.squares, images) > accuracy.aliasing_part * values):
        larger = good_intervals(FINER_LATTICE * lattice.M)
        if larger <= accuracy.largest_intervals:
            core = Core.on_lattice(problem, Lattice(lattice.xi_max, larger))
    finer = _finer_samplings(state)
    seconds = sum(state.sampling_seconds(one, state.octaves[n].values[0].sampling) for n, one in finer.items())
    if state.seconds + seconds > _MOST_SECONDS:
        finer, seconds = {}, 0.0
    if core is state.core and not finer:
        return _checked_again(state)
    octaves = (_measured(state, finer[n], one) if n in finer else one for n, one in enumerate(state.octaves))
    return state.advanced(seconds, core=core, octaves=tuple(octaves))


def _checked_again(state: State) -> State | None:
    """Return a state whose worst disagreement is judged by more and new points; None where it cannot be chance."""
    # Each check is at 99 %, and a study makes many: some fail by chance. Checks at a higher level would see less. So
    # one that fails is made again, from new points with half the error, where a real difference fails again. More than
    # twice the error, five standard deviations, is real.
    relative = state.disagreements / state.permitted
    number, order = np.unravel_index(np.argmax(relative), relative.shape)
    beyond = state.remainders[number]
    points, (_, errors) = _MORE_TO_CHECK * beyond.points, beyond.at(state.problem.orders)
    is_affordable = points <= _MOST_POINTS and state.seconds + beyond.seconds(points) <= _MOST_SECONDS
    may_be_chance = 0 < state.disagreements[number, order] < errors[order]
    return state.redrawn(int(number), points) if is_affordable and may_be_chance else None


def _measured(state: State, sampling: OctaveSampling, known: MeasuredOctave | None = None) -> MeasuredOctave:
    """Return an octave at some samples; values that are known are not computed again."""
    problem = state.problem
    values = problem.accuracy.scale(np.sqrt(state.squares))
    target = error_target(values, problem.orders, problem.accuracy, problem.area)
    target = target.tightened(2 * problem.inexact_count * np.sqrt(_USUAL_OCTAVES))
    known_values = known.values if known else [None] * len(problem.surfaces)
    of_surfaces = tuple(
        octave_values(surface, sampling, problem.orders, target, problem.execution, known=values)
        for surface, values in zip(problem.surfaces, known_values, strict=True)
    )
    squares = squared_moduli(only_or_difference([one.values for one in of_surfaces]))
    return MeasuredOctave(of_surfaces, OctaveWeights(sampling, problem.orders).sums(squares))


def _first_sampling(state: State, octave: Octave) -> OctaveSampling:
    """Return the sampling of an octave that is predicted to be the cheapest one."""
    normals, count = state.normals, _draws_needed(state, octave)
    rng = np.random.default_rng([state.seed, state.steps])
    # As many samples as draws would need.
    intervals = int(np.clip(good_intervals((count / _FILLED) ** (1 / 3)), _FEWEST_M, _FIRST_M))
    lattice = _lattice(state, octave, intervals, rng)
    seconds = sum(size.lattice_seconds(lattice) for size in state.sizes)
    alone = max(count, _FEWEST_FLAT_DRAWS) if normals else count
    alone = min(alone, max(_FEWEST_DRAWS, int(_OCTAVE_SECONDS / state.draw_seconds)))
    seed = int(rng.integers(2**53))
    if state.can_draw and alone * state.draw_seconds < seconds:
        return OctaveSampling(octave, (), alone, seed, normals, _UNIFORM_ALONE)
    affordable = min(count, _DRAWS_FRACTION * seconds / state.draw_seconds)
    beside = int(np.clip(affordable, _FEWEST_DRAWS, _MOST_DRAWS)) if normals and state.can_draw else 0
    return OctaveSampling(octave, (lattice,), beside, seed, normals, _UNIFORM_BESIDE_LATTICE)


def _draws_needed(state: State, octave: Octave) -> int:
    """Return how many drawn frequencies are likely to tell enough of an octave."""
    orders = state.problem.orders
    energy = state.octaves[-1].sums.energy if state.octaves else state.core.energy
    energy = max(_GROWTH * energy, *state.remainders[-1].energies)
    inside = np.array([octave.integral(order) for order in orders])
    outside = np.array([tail_integral(octave.highest, order) for order in orders])
    deviation = _FLAT_DEVIATION if state.normals else _CURVED_DEVIATION
    # Relative errors of the energy that the octave's own part permits, and what lies beyond it.
    # Very negative orders have nothing there.
    with np.errstate(divide="ignore"):
        own = np.sqrt(state.permitted_variances / _USUAL_OCTAVES) / (energy * inside)
        further = _REMAINDER_FRACTION * state.permitted / (_QUANTILE * energy * outside)
    return int(np.clip((deviation / min(own.min(), further.min())) ** 2, _FEWEST_DRAWS, _MOST_DRAWS))


def _finer_samplings(state: State) -> dict[int, OctaveSampling]:
    """Return samplings for the octaves whose variance is too large."""
    permitted = state.permitted_variances
    totals = sum((octave.sums.variances for octave in state.octaves), np.zeros(len(permitted)))
    order = int(np.argmax(totals / permitted))
    if totals[order] <= permitted[order]:
        return {}
    variances = np.array([octave.sums.variances[order] for octave in state.octaves])
    # Those that matter least together stay as they are.
    ascending = np.argsort(variances)
    decisive = ascending[np.cumsum(variances[ascending]) > _LEFT_FRACTION * permitted[order]]
    of_each = permitted[order] / len(state.octaves)
    too_large = decisive[variances[decisive] > of_each]
    return {n: _finer_sampling(state, state.octaves[n], order, of_each) for n in too_large.tolist()}


def _finer_sampling(state: State, octave: MeasuredOctave, order: int, permitted: float) -> OctaveSampling:
    """Return a sampling of an octave with a smaller variance."""
    sampling, sums = octave.values[0].sampling, octave.sums
    rng = np.random.default_rng([state.seed, state.steps, sampling.octave.index])
    excess = float(sums.variances[order]) / permitted
    count = int(min(sampling.draws * np.clip(1.5 * excess, 1.5, 16.0), _MOST_DRAWS))
    first = _lattice(state, sampling.octave, _FIRST_M, rng)
    seconds = sum(size.lattice_seconds(first) for size in state.sizes)
    if not sampling.lattices and count * state.draw_seconds > seconds:
        beside = sampling.draws if state.normals else 0
        seed = int(rng.integers(2**53))
        return OctaveSampling(sampling.octave, (first,), beside, seed, sampling.normals, _UNIFORM_BESIDE_LATTICE)
    of_lattices, of_draws = sums.variances_by_origin[:, order]
    if of_draws > of_lattices:
        return replace(sampling, draws=count, seed=int(rng.integers(2**53)))
    intervals = 2 * round(sampling.lattices[-1].M * np.clip(excess**0.5, 1.25, 2.0) / 2)
    return replace(sampling, lattices=(*sampling.lattices, _lattice(state, sampling.octave, intervals, rng)))


def _lattice(state: State, octave: Octave, intervals: int, rng: np.random.Generator) -> OctaveLattice:
    largest = min(_LARGEST_M, state.problem.accuracy.largest_intervals)
    return OctaveLattice.random(octave.lowest, octave.highest, min(intervals, largest), rng)
