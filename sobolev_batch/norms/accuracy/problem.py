"""A norm or a distance to compute, the accuracy that it needs, and its division among fields."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import ComplexDtype, Complexes, Reals
from sobolev_batch.errors import AccuracyError
from sobolev_batch.geometry import overlap
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.refinement import refinement_of
from sobolev_batch.geometry.surface import DIRECTIONS, Extent, Similarity, Surface, centering
from sobolev_batch.norms.accuracy.tolerance import Accuracy, first_lattice, unreachable
from sobolev_batch.norms.bounds import APART_FRACTION, norm_of_moves, norm_of_rounding, product_apart
from sobolev_batch.norms.budget import Sums, Support, sums_of_shells
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.norms.fields import USUAL_DEGREE, Field, Quality, field_for
from sobolev_batch.norms.tail.remainder import Remainder, remainder
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, cheapest_dtype
from sobolev_batch.transform.lattice import Lattice, SobolevWeights, shell_sums
from sobolev_batch.transform.probe import Sample, draws_for, estimate, needs_probe

# A distance is first estimated from a few frequencies; it is seldom less than this fraction of the estimate.
ESTIMATE_CAUTION = 0.7
# No field is exact to less than this fraction of its area. Near-duplicates, that close, have no relative accuracy.
ROUNDING = 1e-13
# What rounding to single precision changes a value by, relative to it, and the fraction of an error that it may take.
_STORED_ROUNDING, _STORED_FRACTION = 6e-8, 0.1
# Surfaces whose common centre is no further from the origin, relative to their extent, stay where they are.
OFF_CENTER = 1e-3
# Fraction of an error that faces may take that are apart by a rounding of files.
_MOVED_FRACTION = 0.1
# A rounding along one axis, as a part of what counts as one.
_LEAST_MOVE = 1 / 8
# Part of a norm below which a distance is not measured that roundings of files explain.
_ROUNDED = 1e-2
# What limits octaves.
_BY_TIME = "with as many frequencies as can be sampled in some minutes"
# An accuracy called reachable must hold when it is requested.
_REACHABLE_MARGIN = 1.3


@dataclass(frozen=True, eq=False)
class Problem:
    """A norm of a surface, or a distance of two, and the accuracy to compute it to.

    Attributes:
        surfaces: One surface, or two; none where two surfaces cancel.
        support: Area of the surfaces together, and sizes of all surfaces that share the lattice.
        label: Name of the norm or distance in messages.
        pair: Surfaces that a distance is between, with what they share; empty for a norm.
        apart: What the product of two surfaces that are far apart does not exceed (orders,); None for others.
        is_clipped: False where what both cover of flat faces is not left out yet.
        moved: Norm (orders,) that faces which were taken out do not exceed, as they are apart by a rounding of files.
    """

    surfaces: Sequence[Surface]
    orders: tuple[float, ...]
    accuracy: Accuracy
    support: Support
    label: str
    threads: int = 1
    pair: Sequence[Surface] = ()
    signs: Sequence[int] = (1, -1)
    apart: Reals | None = None
    is_clipped: bool = True
    moved: Reals | float = 0.0
    notify: Callable[[str], object] = str
    _samples: dict[Lattice, tuple[Sample, ...]] = field(default_factory=dict, init=False)

    @classmethod
    def from_surfaces(
        cls,
        surfaces: Sequence[Surface],
        orders: tuple[float, ...],
        accuracy: Accuracy,
        label: str,
        threads: int,
        *,
        most_clipped: float = np.inf,
    ) -> Self:
        """Return the problem for surfaces, moved to the centre, without what both have; none may remain.

        Those that are far apart stay where they are, since a common move would cost digits. Flat faces stay as they are
        where two meshes have more triangles than are to be clipped, beside those that are the same in both.
        """
        different, pair = overlap.without_shared_triangles(surfaces), tuple(surfaces) if len(surfaces) == 2 else ()
        settings = orders, accuracy, label, threads
        if sum(len(mesh.triangles) for mesh in overlap.two_meshes(different.values())) > most_clipped:
            return replace(cls._between(different, pair, *settings), is_clipped=False)
        different = overlap.without_common_faces(different)
        problem = cls._between(different, pair, *settings)
        meshes, rounding = overlap.two_meshes(different.values()), _rounding(pair)
        if not meshes or not rounding:
            return problem
        rests = overlap.rests_of(meshes[0], meshes[1], rounding / max(mesh.extent.reach for mesh in meshes))
        closer = cls._between(overlap.signed(rests.meshes), pair, *settings)
        moved = norm_of_moves(rests.areas, rests.distances, orders)
        if closer.surfaces and np.all(moved <= _MOVED_FRACTION * accuracy.rtol * closer.rough_values):
            return replace(closer, moved=moved)
        return problem

    def up_to_rounding(self, surfaces: Sequence[Surface]) -> Self:
        """Return the problem without surfaces where one mesh is the other one cut finer, and a file rounded them.

        It stays as it is where that may be more than a small part of the norm. The surfaces are those it was made from.
        """
        rounding, meshes = _rounding(surfaces), overlap.two_meshes(surfaces)
        if not meshes or not rounding or not self.surfaces:
            return self
        coarse, fine = sorted(meshes, key=lambda mesh: len(mesh.triangles))
        if (found := refinement_of(fine, coarse, rounding)) is None:
            return self
        distance, missing = found
        # Moves within a plane show at folds alone.
        distance = max(distance, _LEAST_MOVE * rounding)
        norms = replace(self, surfaces=self.pair[:1], signs=self.signs[:1]).rough_values
        moved = norm_of_rounding(fine.area, distance, missing, self.orders, norms)
        return replace(self, surfaces=(), moved=moved) if np.all(moved <= _ROUNDED * norms) else self

    @classmethod
    def _between(cls, different: Mapping[int, Surface], pair: Sequence[Surface], *settings: Any) -> Self:
        """Return the problem for what two surfaces do not have in common, by sign, or for one surface."""
        orders, accuracy, label, threads = settings
        if not different:
            return cls((), orders, accuracy, Support(np.zeros(()), np.zeros(len(DIRECTIONS))), label, threads)
        is_whole = all(one is other for one, other in zip(different.values(), pair, strict=False))
        apart = product_apart(tuple(different.values()), orders, accuracy.rtol) if is_whole else None
        move = centering(list(different.values()), OFF_CENTER) if apart is None else Similarity()
        surfaces = tuple(move.apply(surface) for surface in different.values())
        pair = surfaces if is_whole else tuple(move.apply(surface) for surface in pair)
        return cls(surfaces, orders, accuracy, support_of(surfaces), label, threads, pair, tuple(different), apart)

    def with_rtol(self, rtol: float) -> Self:
        """Return the same problem to another accuracy."""
        return replace(self, accuracy=replace(self.accuracy, rtol=rtol))

    @property
    def alone(self) -> tuple[Self, ...]:
        """Norms of the surfaces, each at the centre, for those that are far apart."""
        settings = self.orders, self.accuracy, self.label, self.threads
        alone = (self.from_surfaces((surface,), *settings) for surface in self.surfaces)
        return tuple(norm.with_rtol((1 - APART_FRACTION) * self.accuracy.rtol) for norm in alone)

    @property
    def area(self) -> float:
        """Area of the surfaces together."""
        return float(self.support.areas)

    @property
    def execution(self) -> Execution:
        """Threads to compute with, and memory that transforms may take."""
        return Execution(threads=self.threads, allowed_bytes=self.accuracy.allowed_bytes)

    @property
    def is_whole(self) -> bool:
        """True if the surfaces are those that a distance is between: they share no triangles."""
        return self.surfaces is self.pair

    @property
    def inexact_count(self) -> int:
        """Number of fields among which an error is divided: those without a closed form, or 1."""
        return max(1, sum(needs_probe(surface, TransformSettings()) for surface in self.surfaces))

    @property
    def rounding(self) -> float:
        """Smallest norm that differs from zero by more than rounding."""
        return ROUNDING * self.area

    def samples(self, lattice: Lattice) -> tuple[Sample, ...]:
        """Return samples of all surfaces at the same frequencies; those of a lattice are computed once."""
        if lattice not in self._samples:
            draws = draws_for(self.surfaces, lattice, self.orders, USUAL_DEGREE)
            samples = (Sample.from_surface(surface, draws, self.execution) for surface in self.surfaces)
            self._samples[lattice] = tuple(samples)
        return self._samples[lattice]

    def dtype(self, lattice: Lattice, target: ErrorTarget) -> ComplexDtype:
        """Return the cheapest dtype in which all fields meet a target."""
        return cheapest_dtype(self.surfaces, lattice, target)

    @property
    def rough_values(self) -> Reals:
        """Norms (orders,) on a small lattice, from a few frequencies."""
        lattice, _ = first_lattice(self.support, self.orders, self.accuracy)
        return np.asarray(ESTIMATE_CAUTION * estimate(self.samples(lattice), self.orders))

    def permits_single_storage(self, lattice: Lattice, target: ErrorTarget) -> bool:
        """Tell whether fields meet a target once each value is rounded to single precision."""
        norms = [estimate([sample], self.orders) for sample in self.samples(lattice)]
        return bool(np.all(_STORED_ROUNDING * np.array(norms) <= _STORED_FRACTION * np.array(target.norms)))

    def fields(self, lattice: Lattice, target: ErrorTarget, dtype: ComplexDtype | None = None) -> tuple[Field, ...]:
        """Return the fields of all surfaces, each with an error within a target, by default in the cheapest dtype."""
        settings = TransformSettings(dtype=dtype or self.dtype(lattice, target))
        execution = Execution(threads=self.threads)
        # Samples are drawn where the error weighs most at the problem's orders.
        samples = self.samples(lattice) if target.orders == self.orders else (None,) * len(self.surfaces)
        return tuple(
            field_for(surface, lattice, target, settings, execution, sample=sample)
            for surface, sample in zip(self.surfaces, samples, strict=True)
        )

    def beyond(self, cutoff: float, seed: int = 0, points: int | None = None) -> Remainder:
        """Return what lies beyond a cutoff at the orders; see `remainder`."""
        execution = Execution(threads=self.threads)
        return remainder(self.surfaces, self.signs, cutoff, self.orders, points, seed=seed, execution=execution)

    def require_above_rounding(self, values: Reals) -> None:
        """Refuse an accuracy of norms (orders,) below the rounding of fields, unless it is a best effort."""
        parts, floor = self.accuracy.discretisation_parts(self.orders), self.rounding
        # A distance of no more than rounding is that of near-duplicates, and has no relative accuracy.
        below = (parts * values < floor) & (values > floor)
        if below.any() and not self.accuracy.best_effort:
            worst = int(np.argmax(below * floor / (parts * np.maximum(values, floor))))
            rtol = self.accuracy.rtol
            reachable = 2 * rtol * floor / float(parts[worst] * values[worst])
            problem = (
                f"{self.label}: rtol {rtol:g} of about {values[worst]:.2g} at order {self.orders[worst]:g} is below "
                f"the rounding of double precision; about {reachable:.1g} can be reached; ask for that or a best effort"
            )
            raise AccuracyError(problem, rtol, reachable)

    def out_of_reach(self, found: NormEstimate, limits: str = _BY_TIME) -> AccuracyError:
        """Return the error for an accuracy out of reach, from the nearest that was reached and what limits it."""
        relative = found.errors / found.values
        worst = int(np.argmax(relative))
        reachable = _REACHABLE_MARGIN * float(relative[worst])
        return unreachable(self.label, self.orders[worst], limits, self.accuracy.rtol, reachable)


def error_target(values: Reals, orders: tuple[float, ...], accuracy: Accuracy, area: float) -> ErrorTarget:
    """Return the target of both fields of a pair together at these distances (orders,): never below rounding."""
    errors = np.maximum(accuracy.discretisation_parts(orders) * values, ROUNDING * area)
    return ErrorTarget(orders, tuple(errors.tolist()))


def only_or_difference(values: Sequence[Complexes]) -> Complexes:
    """Return the only values, or the difference of two."""
    return values[0] if len(values) == 1 else values[0] - values[1]


def sums_on(problem: Problem, fields: Sequence[Field], weights: SobolevWeights) -> tuple[Sums, Reals]:
    """Return the sums of the only field, or of the difference of two, and the norms of its error (orders,)."""
    lattice, difference = weights.lattice, only_or_difference([field.values for field in fields])
    sums = sums_of_shells(shell_sums(difference, None, lattice, lattice.half), weights)
    return sums, np.hypot.reduce([field.quality.probe.norms(weights) for field in fields]) + problem.moved


def support_of(surfaces: Sequence[Surface | Quality]) -> Support:
    """Return the area of some surfaces, or of those of some fields, and the sizes of all of them together."""
    extent = Extent.union([surface.extent for surface in surfaces])
    return Support(np.array(sum(surface.area for surface in surfaces)), extent.widths, extent.reach)


def are_equal(a: Surface, b: Surface) -> bool:
    """Return whether two meshes are equal as area measures, to rounding."""
    return abs(a.area - b.area) <= ROUNDING * (a.area + b.area) and not overlap.without_common_parts((a, b))


def _rounding(surfaces: Sequence[Surface]) -> float:
    """Return how far a file may have moved the vertices of meshes, in units of length."""
    return max([mesh.rounding for mesh in surfaces if isinstance(mesh, Mesh)], default=0.0)
