"""Independent values of distances, each with its own uncertainty.

Two spheres, and axis-parallel rectangles, have exact heat traces, at every order. Meshes of few triangles are
integrated in real space, the inner integral in closed form up to the sides of the faces, the outer with two rules.
Others are summed in real space on triangles that are cut finer and finer, as long as that does not take too many
points. At orders from -2 on, the rest, and what such sums find hard (surfaces nearer to each other than the points),
is taken from a far finer lattice, and above -2 from an accuracy that few others ask for, with another seed. Triangles
that both meshes have are left out. Whatever is most certain counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy.special import erf

from sobolev_batch import Lattice, Mesh, distance, fourier_transform
from sobolev_batch.arrays import Reals
from sobolev_batch.errors import AccuracyError
from sobolev_batch.geometry.surface import Extent, Surface
from sobolev_batch.shapes import Sphere
from tests.coverage.matern import Sides, divided_points, double_sum, graded_points, mesh_potentials, sphere_potential
from tests.support.rectangles import TIMES, Rectangles, integrals_of_traces

# Kernels of orders above this have a strong kink at zero, those of others hardly any.
_SMOOTH = -4.0
# Kernels of orders above this are infinite at zero, or need Bessel functions. Sums of points reach this order.
_SINGULAR, _SUMMED = -1.75, -1.0
# Triangles of both meshes together for which the inner integral is done in closed form.
_FEW, _FEW_SINGULAR, _FEW_BESSEL = 90, 30, 8
# Nodes per direction of the two outer rules.
_OUTER = (8, 11)
# Points of the double sum at most.
_POINTS_ROUGH, _POINTS_SMOOTH = 15_000, 10_000
# Lattices far finer than those under test. Surfaces within the unit ball: periods of 5 and 6 keep
# their images away.
_FINE_ROUGH, _FINE_SMOOTH = Lattice(16.0, 160), Lattice(10.0, 120)
_WIDEST_ON_LATTICE = 2.2
# The last change of an extrapolation was seen to be half of its error where levels are few, and an eighth where the
# kernel has a kink and surfaces are near-duplicates.
_EXTRAPOLATION_CAUTION, _KINK_CAUTION = 3.0, 10.0
# Two outer rules were seen to agree by chance: so much of the square is uncertain anyway, more at infinite kernels.
_RULE_SLACK, _SINGULAR_SLACK = 2e-7, 5e-5
# Accuracy, seed and memory of a distance that others are compared with.
_OWN_RTOL, _OWN_SEED, _OWN_MEMORY = {-1.0: 3e-2, -1.5: 1e-2}, 54321, 500_000_000
# A common rotation moves coordinates by about so much, and faces of both surfaces that coincide off each other. At the
# squared distance per area of faces at a gap g, which is at most some 20 (2πg)^(2a-1), this counts at order -0.6.
_TURN_GAP, _TURN_FACTOR = 2e-16, 20.0
# Rounding of sums of some thousand terms, relative to the squared norms.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class Truth:
    """An independent value of a distance, with its uncertainty."""

    value: float
    uncertainty: float

    @classmethod
    def of_square(cls, square: float, slack: float) -> Truth:
        value = np.sqrt(max(square, 0.0))
        low, high = np.sqrt(max(square - slack, 0.0)), np.sqrt(max(square + slack, 0.0))
        return cls(float(value), float(max(high - value, value - low)))


@dataclass(frozen=True, eq=False)
class Pair:
    """Two surfaces.

    They may be made of axis-parallel `rectangles`, and `turned` and moved together; or be `equal`, one surface in
    different triangles. Or the first one is `alone`, and its norm is asked for: of rectangles, the second are none.
    """

    first: Surface
    second: Surface
    rectangles: tuple[Rectangles, Rectangles] | None = None
    turned: bool = False
    equal: bool = False
    alone: bool = False

    @property
    def surfaces(self) -> tuple[Surface, Surface]:
        return self.first, self.second

    def swapped(self) -> Pair:
        return replace(self, first=self.second, second=self.first)

    def truths(self, orders: Sequence[float]) -> Sequence[Truth | None]:
        """Return the true distance for each order; None where nothing is known of it."""
        if self.equal:
            return [Truth(0.0, 0.0)] * len(orders)
        if self.rectangles is not None:
            return truths_of_rectangles(*self.rectangles, orders, turned=self.turned)
        if isinstance(self.first, Sphere) and isinstance(self.second, Sphere):
            return truths_of_spheres(self.first, None if self.alone else self.second, orders)
        return truths_in_space(self.first, self.second, orders)


def truths_of_spheres(first: Sphere, second: Sphere | None, orders: Sequence[float]) -> list[Truth]:
    """Return the distance of two spheres, or the norm of one, by their heat trace; see `tests.support.rectangles`.

    At a distance r from the centre of a sphere of radius R, exp(-k²|x-y|²) has the mean
    [exp(-k²(r-R)²) - exp(-k²(r+R)²)] / (4k²rR) over it, k = π/√t. Over another sphere, r has a density in proportion
    to itself.
    """
    rates = np.pi / np.sqrt(TIMES)

    def mean_of_gaussian(center: float, middle: float, half: float) -> Reals:
        """Return the mean of exp(-k²(r-center)²) over the distances r within a half width of a middle."""
        nodes, weights = np.polynomial.legendre.leggauss(16)
        inner = np.exp(-((rates[:, None] * (middle - center + half * nodes)) ** 2)) @ weights / 2
        low, high = (rates * (middle + sign * half - center) for sign in (-1, 1))
        wide = rates * half > 1
        outer = np.sqrt(np.pi) / 4 * (erf(high) - erf(low)) / np.where(wide, rates * half, 1.0)
        return np.where(wide, outer, inner)

    traces, scales = np.zeros_like(TIMES), np.zeros_like(TIMES)
    signed = [(first, 1.0)] if second is None else [(first, 1.0), (second, -1.0)]
    for (one, sign), (other, other_sign) in product(signed, repeat=2):
        apart = math.dist(one.center, other.center)
        middle, half = max(apart, other.radius), min(apart, other.radius)
        means = mean_of_gaussian(one.radius, middle, half) - mean_of_gaussian(-one.radius, middle, half)
        terms = one.area * other.area * rates / (4 * np.pi**1.5 * one.radius * middle) * means
        traces, scales = traces + sign * other_sign * terms, scales + terms
    squares, slacks = integrals_of_traces(traces, scales, orders)
    return list(map(Truth.of_square, squares.tolist(), slacks.tolist()))


def truths_of_rectangles(a: Rectangles, b: Rectangles, orders: Sequence[float], *, turned: bool) -> list[Truth]:
    """Return the distance of two surfaces of rectangles for each order; `turned` if both were turned afterwards."""
    squares, slacks = a.squared_distance(b, orders)
    if turned:
        area = float(a.mesh().area + b.mesh().area)
        slacks = slacks + _TURN_FACTOR * area * (2 * np.pi * _TURN_GAP) ** (-2 * np.array(orders) - 1)
    return list(map(Truth.of_square, squares.tolist(), slacks.tolist()))


def truths_in_space(a: Surface, b: Surface, orders: Sequence[float]) -> list[Truth | None]:
    """Return the distance of two surfaces, one of them a mesh, for each order; None where nothing is known of it."""
    if isinstance(a, Mesh) and isinstance(b, Mesh):
        a, b = without_common_triangles(a, b)
    by_order: dict[float, Truth | None] = {}
    for low, high, points in (
        (-np.inf, _SMOOTH, _POINTS_SMOOTH),
        (_SMOOTH, _SINGULAR, _POINTS_ROUGH),
        (_SINGULAR, 0.0, _POINTS_ROUGH),
    ):
        chosen = [order for order in orders if low < order <= high]
        if chosen:
            by_order |= dict(zip(chosen, _most_certain(a, b, chosen, points), strict=True))
    return [by_order[order] for order in orders]


def without_common_triangles(a: Mesh, b: Mesh) -> tuple[Mesh, Mesh]:
    """Return two meshes without the triangles that both have, whose areas cancel; each keeps one at least."""
    _, places = np.unique(np.concatenate([a.vertices, b.vertices]), axis=0, return_inverse=True)
    numbers = np.split(places.ravel(), [len(a.vertices)])
    corners = [np.sort(number[mesh.triangles], axis=1) for mesh, number in zip((a, b), numbers, strict=True)]
    shared = {tuple(corner) for corner in corners[0].tolist()} & {tuple(corner) for corner in corners[1].tolist()}
    distinct = all(len(np.unique(corner, axis=0)) == len(corner) for corner in corners)
    if not shared or not distinct:
        return a, b
    kept = [np.array([tuple(corner) not in shared for corner in each.tolist()]) for each in corners]
    if not all(keep.any() for keep in kept):
        one = next(iter(shared))
        kept = [keep | (each == one).all(axis=1) for keep, each in zip(kept, corners, strict=True)]
    first, second = (Mesh(mesh.vertices, mesh.triangles[keep]) for mesh, keep in zip((a, b), kept, strict=True))
    return first, second


def _most_certain(a: Surface, b: Surface, orders: Sequence[float], points: int) -> list[Truth | None]:
    triangles = sum(len(surface.triangles) for surface in (a, b) if isinstance(surface, Mesh))
    singular, rough = max(orders) > _SINGULAR, max(orders) > _SMOOTH
    few = _FEW_BESSEL if max(orders) > _SUMMED else _FEW_SINGULAR if singular else _FEW
    # An extrapolation needs two levels at least.
    summable = 24 * triangles <= points and max(orders) <= _SUMMED
    narrow = bool(np.all(Extent.union([surface.extent for surface in (a, b)]).widths <= _WIDEST_ON_LATTICE))
    candidates: list[Sequence[Truth | None]] = []
    if rough and triangles <= few:
        candidates.append(closed_within(a, b, orders))
        # Still useful against spheres, whose potential has a kink where they cross a face.
        points = _POINTS_SMOOTH
    elif singular:
        candidates.append([measured_with_another_seed(a, b, order) for order in orders])
    elif narrow and (rough or not summable):
        candidates.append(on_fine_lattice(a, b, orders))
    if summable:
        candidates.append(summed_in_real_space(a, b, orders, points))
    known = [[truth for truth in alternatives if truth] for alternatives in zip(*candidates, strict=True)]
    known = known or [[] for _ in orders]
    return [min(alternatives, key=lambda truth: truth.uncertainty, default=None) for alternatives in known]


def closed_within(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """Integrate the potentials of the faces; the uncertainty is the change from one outer rule to a finer one."""
    powers = [-order for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    meshes = [(Sides.from_mesh(surface), sign) for surface, sign in signed if isinstance(surface, Mesh)]
    candidates = []
    for count in _OUTER:
        squares = norms = _spheres_alone(a, b, orders)
        for surface, sign in signed:
            if not isinstance(surface, Mesh):
                continue
            points, weights = graded_points(surface, count)
            potentials = sum((other * mesh_potentials(sides, points, powers) for sides, other in meshes), 0.0)
            squares = squares + sign * (potentials @ weights)
            norms = norms + np.abs(potentials) @ weights
            # The mesh against a sphere, and the sphere against the mesh.
            squares = squares + 2 * sign * (_of_spheres(signed, points, powers) @ weights)
        candidates.append(squares)
    coarse, fine = candidates
    singular = np.array(orders) > _SINGULAR
    slack = np.where(singular, 2.0, 1.0) * np.abs(fine - coarse) + _ROUNDING * norms
    slack += np.where(singular, _SINGULAR_SLACK, _RULE_SLACK) * np.abs(fine)
    return tuple(map(Truth.of_square, fine.tolist(), slack.tolist()))


def summed_in_real_space(
    a: Surface, b: Surface, orders: Sequence[float], most: int = _POINTS_SMOOTH
) -> tuple[Truth, ...]:
    """Extrapolate double sums over points; the uncertainty is a multiple of the last extrapolation's change.

    The kernel of a = -s has the term r^(2a-3), which leaves an error of h^(2a-1) beside the rule's h^6.
    """
    powers = [-order for order in orders]
    signed = ((a, 1.0), (b, -1.0))
    triangles = sum(len(surface.triangles) for surface, _ in signed if isinstance(surface, Mesh))
    levels = [level for level in range(6) if 6 * triangles * 4**level <= most][-3:]
    rows = []
    for level in levels:
        squares = norms = _spheres_alone(a, b, orders)
        sets = [(divided_points(surface, level), sign) for surface, sign in signed if isinstance(surface, Mesh)]
        points = np.concatenate([points for (points, _), _ in sets])
        weights = np.concatenate([sign * weights for (_, weights), sign in sets])
        squares = squares + double_sum(points, weights, powers)
        squares = squares + 2 * (_of_spheres(signed, points, powers) @ weights)
        rows.append(squares)
    scale = norms + np.abs(weights).sum() ** 2
    rates = np.array([[2.0 ** min(2 * a - 1, 6), 2.0 ** min(2 * a, 6)] for a in powers]).T
    table = [rows]
    for rate in rates[: len(levels) - 1]:
        last = table[-1]
        table.append([fine + (fine - coarse) / (rate - 1) for coarse, fine in pairwise(last)])
    best, before = table[-1][-1], table[-2][-1]
    caution = np.where(np.array(orders) > _SMOOTH, _KINK_CAUTION, _EXTRAPOLATION_CAUTION)
    slack = caution * np.abs(best - before) + _ROUNDING * scale
    return tuple(map(Truth.of_square, best.tolist(), slack.tolist()))


def on_fine_lattice(a: Surface, b: Surface, orders: Sequence[float]) -> tuple[Truth, ...]:
    """Compute on a lattice far finer than those under test; the uncertainty is the error reported there.

    This relies on the reported errors, but only where they are small.
    """
    lattice = _FINE_ROUGH if max(orders) > _SMOOTH else _FINE_SMOOTH
    first, second = (fourier_transform(surface, lattice, 1e-13, order=orders) for surface in (a, b))
    fine = distance(first, second, orders)
    pairs = zip(fine["distance"].values, fine["error"].values, strict=True)
    return tuple(Truth(float(value), float(error)) for value, error in pairs)


def measured_with_another_seed(a: Surface, b: Surface, order: float) -> Truth | None:
    """Ask for a high accuracy, with other random frequencies; the uncertainty is the error reported there.

    This relies on the reported errors, and shows only where others are far too small.
    """
    if order not in _OWN_RTOL:
        return None
    try:
        found = distance(a, b, order, rtol=_OWN_RTOL[order], memory=_OWN_MEMORY, seed=_OWN_SEED)
    except AccuracyError:
        return None
    return Truth(found["distance"].item(), found["error"].item())


def _spheres_alone(a: Surface, b: Surface, orders: Sequence[float]) -> Reals:
    alone = np.zeros(len(orders))
    for surface in (a, b):
        if isinstance(surface, Sphere):
            pole = np.add(surface.center, [[0.0, 0.0, surface.radius]])
            alone += [surface.area * sphere_potential(surface, pole, -order).item() for order in orders]
    return alone


def _of_spheres(signed: Sequence[tuple[Surface, float]], points: Reals, powers: Sequence[float]) -> Reals:
    """Return the signed potential of the spheres among the surfaces, (len(powers), n)."""
    total = np.zeros((len(powers), len(points)))
    for surface, sign in signed:
        if isinstance(surface, Sphere):
            total += sign * np.stack([sphere_potential(surface, points, power) for power in powers])
    return total
