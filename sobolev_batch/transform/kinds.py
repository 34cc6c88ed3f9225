"""The kinds of surfaces, and what transforms need of each: quadrature points, exact values, and how both are chosen.

A further kind of surface is one more class here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import groupby
from operator import itemgetter
from typing import Any, Self

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import MOST_GAUSS_NODES, MOST_NODES, Counts, Smooth, doubled
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.transform.backends import CPU, Backend, cosine_and_sine
from sobolev_batch.transform.exact import exact_transform, sampled_transform
from sobolev_batch.transform.lattice import Block, FrequencyLattice
from sobolev_batch.transform.quadrature import RuleUse, WeightedPoints, assign_rules
from sobolev_batch.transform.rule_errors import loosest_tolerance, weight_masses
from sobolev_batch.transform.spheres import sphere_block, sphere_transform

# Less is rounding: of the transform, and of derivatives that come from an interpolant.
FINEST_CHANGE = 1e-13
# Random sums over few nodes may agree to a few percent by chance.
COARSEST_CHANGE = 1e-4
# Nodes that the spacing on a surface is measured with, and nodes beyond two for each wavelength.
_SPACING_NODES, _MARGIN, _EXTRA = 31, 1.1, 12
# Number of probe directions that are neither axes nor diagonals, and shorter lengths that are probed too.
_RANDOM_DIRECTIONS, _FRACTIONS = 9, (0.0, 0.3, 0.7)
# Pairs of a node and a frequency at a time: their temporaries stay in cache.
_PAIRS = 1 << 18
# The change that exact values are resolved to, and the nodes that may be spent on them.
_EXACT_CHANGE, _MOST_EXACT_NODES = 1e-12, 1 << 19


@lru_cache(maxsize=16)
def resolution_of(surface: Smooth, highest_frequency: float, tolerance: float) -> tuple[Counts, float]:
    """Return the nodes along u and v that the transform of a surface takes up to a frequency, and how far it is off.

    That is the change of the transform when the nodes are doubled along u, plus that along v, over the area: the
    largest one over the probe frequencies. The tolerance of it is clipped to 1e-13 to 1e-4; frequencies are in cycles
    per unit length. InputError where more than 4,194,304 nodes would be needed, or 2,048 along a parameter that is not
    periodic: the parametrisation is not smooth, or the surface is large or thin compared with the wavelength.
    """
    tolerance = min(max(tolerance, FINEST_CHANGE), COARSEST_CHANGE)
    (u, v), change = _refined(surface, highest_frequency, tolerance, MOST_NODES)
    if change > tolerance:
        progress = "it would take more to begin with"
        if math.isfinite(change):
            progress = f"with {u} x {v} it still changes by {change:.2g} of the area"
        raise InputError(
            f"the transform of the parametrised surface up to |xi| = {highest_frequency:.4g} is not settled to "
            f"{tolerance:.2g} of its area with {MOST_NODES} nodes, the most that are tried ({MOST_GAUSS_NODES} along a "
            f"parameter that is not periodic); {progress}. Its parametrisation is not smooth (a kink, a corner, an "
            "unmarked period), or the surface is large or thin beside the shortest wavelength; lower xi_max, or allow "
            "a larger eps"
        )
    return (u, v), change


def direct_transform(surface: Smooth, counts: Counts, frequencies: Reals) -> Complexes:
    """Return the transform Σ w exp(-2πi ξ·x) over the nodes of a rule (P,), summed one by one.

    The frequencies are float64 (P, 3), in cycles per unit length. The values have a few rounding errors of the area.
    """
    wave_vectors = -2 * np.pi * np.asarray(frequencies, dtype=np.float64)
    values = np.zeros(len(wave_vectors), dtype=np.complex128)
    for points, weights in surface.nodes(counts, max(1, _PAIRS // max(len(wave_vectors), 1))):
        cosines, sines = cosine_and_sine(wave_vectors @ points)
        values += cosines @ weights + 1j * (sines @ weights)
    return values


def exact_values(surface: Smooth, frequencies: Reals) -> Complexes:
    """Return the transform (P,) at frequencies (P, 3), with twice the nodes along each parameter at which it converges.

    On a smooth surface the error is about 1e-14 of the area. If half a million nodes do not suffice, the values are
    those of twice as many along each parameter, and have the error of these.
    """
    if not len(frequencies):
        return np.zeros(0, dtype=np.complex128)
    highest = float(np.linalg.norm(frequencies, axis=1).max())
    return direct_transform(surface, _exact_counts(surface, highest), frequencies)


@lru_cache(maxsize=16)
def _exact_counts(surface: Smooth, highest: float) -> Counts:
    counts, _ = _refined(surface, highest, _EXACT_CHANGE, _MOST_EXACT_NODES)
    return doubled(counts)


def _refined(surface: Smooth, highest: float, tolerance: float, most: int) -> tuple[Counts, float]:
    """Double the nodes along each parameter that needs it, until the change is small or the nodes are too many.

    Returns what `resolution_of` does; the change is infinite if even the first nodes are too many.
    """
    counts = _first_counts(surface, highest)
    if _too_many(surface, counts, most):
        return counts, math.inf
    frequencies = highest * _unit_frequencies()
    values = direct_transform(surface, counts, frequencies)
    while True:
        twice = doubled(counts)
        along = (twice[0], counts[1]), (counts[0], twice[1])
        finer = [direct_transform(surface, more, frequencies) for more in along]
        changes = [float(np.abs(more - values).max()) / surface.area for more in finer]
        if sum(changes) <= tolerance:
            return counts, sum(changes)
        coarse = [change > tolerance / 2 for change in changes]
        larger = (twice[0] if coarse[0] else counts[0], twice[1] if coarse[1] else counts[1])
        if _too_many(surface, larger, most):
            return counts, sum(changes)
        counts = larger
        values = finer[coarse.index(True)] if sum(coarse) == 1 else direct_transform(surface, counts, frequencies)


def _too_many(surface: Smooth, counts: Counts, most: int) -> bool:
    along = zip(surface.intervals, counts, strict=True)
    return math.prod(counts) > most or any(n > MOST_GAUSS_NODES and not interval.periodic for interval, n in along)


def _first_counts(surface: Smooth, highest: float) -> Counts:
    """Return two nodes for each wavelength where nodes are farthest apart, and some more; odd numbers."""
    points = np.concatenate([batch for batch, _ in surface.nodes((_SPACING_NODES, _SPACING_NODES))], axis=1)
    grid = points.reshape(3, _SPACING_NODES, _SPACING_NODES)
    counts = []
    for axis in (1, 2):
        widest = float(np.linalg.norm(np.diff(grid, axis=axis), axis=0).max())
        # The number may exceed all bounds, and is refused then.
        count = min(_MARGIN * _SPACING_NODES * widest * 2 * highest, float(MOST_NODES))
        counts.append(math.ceil(count) + _EXTRA | 1)
    return counts[0], counts[1]


@lru_cache(maxsize=1)
def _unit_frequencies() -> Reals:
    """Return probe frequencies (25, 3): of unit length in all directions, and a few shorter ones."""
    rng = np.random.default_rng(20)
    random = rng.normal(size=(_RANDOM_DIRECTIONS, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    return np.concatenate([DIRECTIONS, random, *(fraction * random[:1] for fraction in _FRACTIONS)])


# Nodes of a parametrised surface that are made at a time: their temporaries take 4 MB.
_NODES = 1 << 14
# The error of a parametrised surface's nodes grows with the frequency like that of a rule of a high degree: of the
# degrees tried on tori and ellipsoids with too few nodes, 8 and 16 drew frequencies that showed most of it.
_SMOOTH_DEGREE = 16
# A parametrised surface has at least this many nodes.
_FEWEST_NODES = 500


@dataclass(frozen=True, eq=False)
class SurfaceKind(ABC):
    """A surface as transforms see it: exact values anywhere, and points that stand for it up to a frequency.

    `kind_of` makes it for exact values, and `plan` for points. These are chosen when first needed, and made batch by
    batch.

    Attributes:
        surface: Surface in units of length.
        highest_frequency: Largest |ξ| at which the points stand for the surface, in cycles per unit length.
        eps: Largest quadrature error at any such frequency, relative to the area. Only "auto" and parametrised
            surfaces observe it.
        quadrature: Method to choose the rules of triangles: see `fixed_rule`.
        tolerance: Largest error of the rule on any one triangle, relative to its area, or of the nodes of a
            parametrised surface, relative to the whole area; None for what eps needs.
    """

    surface: Any
    highest_frequency: float = 0.0
    eps: float = 0.0
    quadrature: str | int = "auto"
    tolerance: float | None = None

    def plan(
        self, highest_frequency: float, eps: float, quadrature: str | int = "auto", tolerance: float | None = None
    ) -> Self:
        """Return the surface with points up to a frequency; see the attributes."""
        return replace(self, highest_frequency=highest_frequency, eps=eps, quadrature=quadrature, tolerance=tolerance)

    @property
    def is_closed_form(self) -> bool:
        """True if the transform is a formula at every frequency."""
        return False

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return 0

    @property
    def fewest_points(self) -> int:
        """Number of quadrature points at least, among which the errors of a NUFFT spread."""
        return 1

    @property
    @abstractmethod
    def expected_points(self) -> float:
        """Expected number of points."""

    @property
    @abstractmethod
    def largest_points(self) -> int:
        """Bound on the number of points, before shared ones are merged."""

    @property
    @abstractmethod
    def lowest_degree(self) -> int:
        """Lowest degree among the rules, whose error shows first; 0 for a closed form."""

    @property
    def change(self) -> float:
        """Change of values when nodes are doubled, over the area, where exact values come from such nodes too."""
        return 0.0

    @abstractmethod
    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        """Yield the points in nearly equal batches of at most a number, 8 times that of the largest rule or more."""

    @abstractmethod
    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        """Return the exact transform at frequencies (P, 3), complex128 (P,). Threads and a backend may help."""

    def sampled_values(self, frequencies: Reals, threads: int, backend: Backend = CPU) -> Complexes:
        """Return the transform at frequencies (P, 3) by the fastest formula, complex128 (P,)."""
        return self.exact_values(frequencies)

    def block_values(self, lattice: FrequencyLattice, block: Block) -> Complexes:
        """Return the transform of a closed form on a block of a lattice, complex128 (block.shape)."""
        raise TypeError(f"{type(self).__name__} has no closed form")

    def loosest_tolerance(self, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
        """Return the largest tolerance of points whose error is predicted to have at most some norms (orders,)."""
        raise TypeError(f"{type(self).__name__} has no quadrature")


class _Triangles(SurfaceKind):
    @cached_property
    def uses(self) -> tuple[RuleUse, ...]:
        """Rules of the triangles, which take four bytes for each."""
        return assign_rules(self.surface, self.highest_frequency, self.eps, self.quadrature, self.tolerance)

    @property
    def triangles(self) -> int:
        return len(self.surface.triangles)

    @property
    def fewest_points(self) -> int:
        return self.triangles

    @property
    def expected_points(self) -> float:
        return sum((use.expected_points for use in self.uses), 0.0)

    @property
    def largest_points(self) -> int:
        return sum(use.largest_points for use in self.uses)

    @property
    def lowest_degree(self) -> int:
        return min(use.rule.degree for use in self.uses)

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        # Nodes are merged within a batch of triangles: these are large where nodes are shared.
        fits = self.expected_points <= capacity
        most = {True: capacity // (1 if fits else 2), False: capacity // 8}
        triangles = [batch for use in self.uses for batch in use.split(most[use.rule.shares])]
        expected = [batch.expected_points for batch in triangles]
        ends = np.cumsum(expected)
        total = float(ends[-1])
        margin = 0 if fits else max(expected)
        count = math.ceil(total / (capacity - margin))
        # A batch of triangles goes where its first point goes, so that each batch of points exceeds its equal
        # number by at most one batch of triangles.
        numbers = (np.concatenate([[0], ends[:-1]]) * count // total).astype(int).tolist()
        mesh = self.surface
        arrays = backend.upload(mesh.vertices), backend.upload(mesh.triangles), backend.upload(mesh.areas)
        for _, group in groupby(zip(numbers, triangles, strict=True), key=itemgetter(0)):
            points = WeightedPoints.concatenated([batch.points(arrays, backend) for _, batch in group])
            # Where neighbours share fewer nodes than those of a closed mesh, there are more points than expected.
            for first in range(0, len(points.weights), capacity):
                yield points.part(slice(first, first + capacity))

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        return exact_transform(self.surface, frequencies, backend, threads)

    def sampled_values(self, frequencies: Reals, threads: int, backend: Backend = CPU) -> Complexes:
        return sampled_transform(self.surface, frequencies, threads, backend)

    def loosest_tolerance(self, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
        return loosest_tolerance(self.surface, lattice, orders, norms)


class _Parametrised(SurfaceKind):
    fewest_points = _FEWEST_NODES
    lowest_degree = _SMOOTH_DEGREE

    @property
    def resolution(self) -> tuple[Counts, float]:
        """Nodes along both parameters, and the change of the transform when they are doubled."""
        return resolution_of(self.surface, self.highest_frequency, self.tolerance or self.eps)

    @property
    def expected_points(self) -> float:
        return float(self.largest_points)

    @property
    def largest_points(self) -> int:
        return math.prod(self.resolution[0])

    @property
    def change(self) -> float:
        return self.resolution[1]

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        gathered: list[WeightedPoints] = []
        count = 0
        for coordinates, weights in self.surface.nodes(self.resolution[0], min(capacity, _NODES)):
            if count + len(weights) > capacity:
                yield WeightedPoints.concatenated(gathered)
                gathered, count = [], 0
            gathered.append(WeightedPoints(backend.upload(coordinates), backend.upload(weights)))
            count += len(weights)
        yield WeightedPoints.concatenated(gathered)

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        return exact_values(self.surface, frequencies)

    def loosest_tolerance(self, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
        # The tolerance bounds the error at every single frequency: assume it at all of them.
        return float(np.min(norms / (self.surface.area * np.sqrt(weight_masses(lattice, orders)))))


class _ClosedForm(SurfaceKind):
    is_closed_form = True
    expected_points, largest_points, lowest_degree = 0.0, 0, 0

    def batches(self, capacity: int, backend: Backend = CPU) -> Iterator[WeightedPoints]:
        yield from ()

    def exact_values(self, frequencies: Reals, threads: int = 1, backend: Backend = CPU) -> Complexes:
        return sphere_transform(self.surface, frequencies)

    def block_values(self, lattice: FrequencyLattice, block: Block) -> Complexes:
        return sphere_block(self.surface, lattice, block)


_KINDS: Mapping[type, type[SurfaceKind]] = {Mesh: _Triangles, Smooth: _Parametrised, Sphere: _ClosedForm}


def kind_of(surface: object) -> SurfaceKind:
    """Return a surface as transforms see it; InputError where it is of no known kind."""
    for surface_type, kind in _KINDS.items():
        if isinstance(surface, surface_type):
            return kind(surface)
    raise InputError(
        "a surface must be a Mesh, a Sphere or a parametrised surface (Ellipsoid, Torus, ParametrisedSurface), "
        f"found {type(surface).__name__}"
    )
