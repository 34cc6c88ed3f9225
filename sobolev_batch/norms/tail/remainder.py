"""What lies beyond a frequency, from pairs of close points: the part of a squared norm that no sample shows.

Beyond a cutoff X the squared norm of a signed area measure m is

    ∫ (1 - step(|ξ|)) (1 + |ξ|²)^s |m^(ξ)|² dξ = ∬ K(|x - y|) dm(x) dm(y),

where step is `smooth_step` and K falls off within a few wavelengths 1/X. So only close points matter; periods, layers
and parts that coincide count for what they are. The points x are random, and the integral over y, a potential, is
computed triangle by triangle (see `potentials`).

Where surfaces coincide the potential is zero, and points there have no variance to tell what they miss. But the
potential of a part that differs reaches where the kernel does, so points no farther apart than that see every part.
Where few of them saw much, further points are drawn in proportion to what they saw. Fewer points than that may miss a
part, and their error allows for one point on a surface of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from typing import NamedTuple, Self

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.overlap import without_common_parts
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.tail.close_points import Draw, Moved, Sheets
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.integrals import quantile
from sobolev_batch.norms.tail.potentials import (
    Kernels,
    add_of_triangles,
    centers_and_radii,
    of_sphere,
    reach_of,
    seconds_of,
    tail_integral,
    tail_nodes,
)
from sobolev_batch.transform.fourier import ON_CPU, Execution

# Random points of the first estimate: usually, at least, at most, and where it is a scale or a bound. Pairs of a point
# and a triangle that they may take, and those of points from which nothing is hidden.
_USUAL_POINTS, _FEWEST_POINTS, _MOST_POINTS, _FEW_POINTS = 256, 40, 1024, 64
# Triangles of two meshes with flat faces: to clip one and to look at it takes some 25 microseconds and a kilobyte.
_MOST_FLAT = 200_000
# The most on a surface alone in large units, below a cutoff of 1: edges are narrow there, and few points meet them.
_MOST_POINTS_ALONE = 16_384
_USUAL_PAIRS, _MOST_PAIRS = 150_000, 500_000
# Share of the squared errors that is most of them, and a relative error that may be smaller for some more points; it
# may be much smaller for surfaces that are large beside the unit, below a cutoff of 1.
MOSTLY, _ROUGH, _ROUGH_OF_LARGE = 0.5, 0.15, 0.01
# The distance over which a kernel falls that begins at a low cutoff: its weight has the unit of length. Without this
# limit, 12 of 63 pairs of sheets of 10 to 1,000 units lay outside of their errors, whose edges no point had met.
_LONGEST_REACH = 1.0
# Points for each square of the reach, so that none is farther than it from the next; and those of them that are
# computed again with twice the reach and twice the nodes.
_PER_REACH, _CONTROLS = 2.0, 24
# What the cut at the reach and the nodes change a potential by, as a part of what a surface alone has: at most 4e-4 in
# the mean over points on scans, a cow, spheres and a square, at all orders. Controls are drawn where that is a larger
# fraction of the other errors. What they leave was at most 4e-5 for single pairs of a point and a triangle.
_CUT, _CUT_FRACTION, _CUT_LEFT = 1e-3, 0.3, 2e-5
# A move of corners is little where the same move of a plane changes its potential by less than this part, in the mean.
_LITTLE = 0.5
# Pairs of points of which only heights are computed: for each pair of a draw, at most, and never fewer for each.
_HEIGHTS, _MOST_HEIGHTS, _FEWEST_HEIGHTS = 1000, 1 << 18, 4
# Points saw unevenly where the mean square of what they saw exceeds the square of the mean by this factor, and nothing
# where it is this fraction of what a surface alone has.
_UNEVEN, _NOTHING = 2.0, 1e-11
# Orders between which the logarithm of the mean energy beyond a frequency is interpolated; those below the lowest are
# bounded by it, but not beyond a cutoff where their weights hardly fall yet.
_USUAL_ORDERS, LOWEST_ORDER = (-0.55, -0.7, -1.0, -1.5, -2.0, -2.5, -3.0), -4.0
# The least energy whose logarithm is interpolated, in errors of it; and what this may be off by, as a part of what it
# changes. Of boxes that moved by 1e-5 to 1e-1 it was off by 0.02 of that at order -0.51.
_OF_ERROR, _OF_CHANGE = 0.1, 0.03
# Cycles after which a sinc counts as averaged out.
_SINC_CYCLES = 8.0


@dataclass(frozen=True)
class Remainder:
    """The part of a squared norm beyond a cutoff, as mean energies: the energy is ∫_{|ξ|=r} |m^(ξ)|² dS.

    Attributes:
        cutoff: |ξ| at which the `smooth_step` ends beyond which the part lies, in cycles per unit length.
        orders: Orders s in descending order.
        energies: Mean of the energy beyond the cutoff, weighted by (1 - step(r)) (1 + r²)^s, for each order.
        errors: How far off these may be at 99 %.
        pairs: Number of pairs of a point and a triangle.
        covering: Number of points from which no part of a surface is hidden.
        hidden: Largest share of the squared errors that allows for what too few points may have missed.
        excesses: The energies of the product of a difference a - b with a + b, and how far off they may be.
    """

    cutoff: float
    orders: tuple[float, ...]
    energies: tuple[float, ...]
    errors: tuple[float, ...]
    points: int = 0
    pairs: int = 0
    covering: int = 0
    hidden: float = 0.0
    excesses: tuple[tuple[float, ...], ...] = ((), ())

    @classmethod
    def alike(cls, cutoff: float, energy: float = 0.0, error: float = 0.0) -> Self:
        """Return a part with one mean energy for all orders; its error is infinite where nobody has looked at it."""
        return cls(cutoff, (-1.0,), (energy,), (error,))

    @property
    def is_known(self) -> bool:
        """True if errors are finite."""
        return bool(np.all(np.isfinite(self.errors)))

    def at(self, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the part of the squared norm (orders,), and how far off it may be."""
        values, errors = np.zeros(len(orders)), np.zeros(len(orders))
        for number, order in enumerate(orders):
            # Every weight of a lower order is at most this factor times that of the lowest one.
            known = max(order, min(LOWEST_ORDER, self.orders[-1]))
            factor = (1 + (self.cutoff / 2) ** 2) ** (order - known) * tail_integral(self.cutoff, known)
            values[number], errors[number] = factor * np.array(self._interpolated(known))
            if order < known:
                errors[number] += values[number] / 2
                values[number] /= 2
        return values, errors

    def products_at(self, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the part of the product of a difference a - b with b (orders,), and how far off it may be.

        It is half of what the excess differs by from the squared norm. It is known at the own orders alone.
        """
        values, errors = np.zeros(len(orders)), np.full(len(orders), np.inf)
        for number, (order, excess, error) in enumerate(zip(self.orders, *self.excesses, strict=False)):
            here, scale = np.equal(orders, order), tail_integral(self.cutoff, order) / 2
            values[here] = scale * (excess - self.energies[number])
            errors[here] = scale * (error + self.errors[number])
        return values, errors

    def bounds(self, orders: Sequence[float]) -> Reals:
        """Bound the squared norm of all beyond the cutoff, where a lattice ends that has no step (orders,)."""
        known = np.maximum(orders, LOWEST_ORDER)
        values, errors = self.at(known.tolist())
        # No frequency there weighs more than this at a lower order.
        return np.asarray((1 + self.cutoff**2) ** (orders - known) * (np.maximum(values, 0.0) + errors))

    def _interpolated(self, order: float) -> tuple[float, float]:
        """Return the mean energy at an order between others, or near one, and how far off it may be.

        It is close to a power of a length where the energy begins to grow, with an exponent that is linear in s.
        """
        at, places = -max(order, self.orders[-1]), -np.array(self.orders)
        energy, error = (float(np.interp(at, places, values)) for values in (self.energies, self.errors))
        if len(places) == 1 or -at in self.orders or not (self.is_known and energy > error):
            return energy, error
        # It takes a tenth of a second to import, and a first field does without.
        from scipy.interpolate import PchipInterpolator, make_interp_spline

        # Energies below their errors may be negative.
        logs = np.log(np.maximum(self.energies, _OF_ERROR * np.array(self.errors)) + np.finfo(np.float64).tiny)
        lines = make_interp_spline(places, logs, k=1), PchipInterpolator(places, logs)
        straight, curved = (math.exp(line(at)) for line in lines)
        return curved, error + abs(curved - straight) + _OF_CHANGE * abs(curved - energy)

    def seconds(self, points: int) -> float:
        """Predict the processor time of an estimate from another number of points."""
        return seconds_of(self.pairs * points / max(self.points, 1), len(self.orders))


def remainder(
    surfaces: Sequence[Surface],
    signs: Sequence[int],
    cutoff: float,
    orders: Sequence[float] = (),
    points: int | None = None,
    seed: int = 0,
    execution: Execution = ON_CPU,
    *,
    is_scale: bool = False,
    is_bound: bool = False,
) -> Remainder:
    """Estimate what lies beyond a cutoff in the norm of a signed sum of surfaces, in units of length.

    The cutoff is the |ξ| at which the `smooth_step` ends, in cycles per unit length. By default there are enough orders
    to interpolate between. What too few random points may miss is not most of a large error, if more of them take at
    most about a second. For a norm that only serves as a scale, and for a bound, few points will do.
    """
    # The order whose weight falls at the cutoff as that of the lowest one does far out.
    lowest = LOWEST_ORDER * (1 + cutoff**-2)
    known = tuple(sorted({max(order, lowest) for order in orders or _USUAL_ORDERS}, reverse=True))
    sheets = Sheets.from_surfaces(surfaces, signs, cutoff)
    kernels = Kernels.of_orders(cutoff, known, largest_coordinate=sheets.reach)
    seen_by, rng = _Seen(sheets, kernels, execution), np.random.default_rng(seed)
    if points is not None or is_scale:
        return _estimate(seen_by, points or _FEW_POINTS, rng, is_exact=not is_scale)
    affordable = seen_by.affordable(rng)
    found = _estimate(seen_by, min(affordable, _FEW_POINTS) if is_bound else affordable, rng, is_bound=is_bound)
    rough = _ROUGH if cutoff > 1 else _ROUGH_OF_LARGE
    if found.hidden > MOSTLY and np.any(np.array(found.errors) > rough * np.abs(found.energies)):
        # Nothing is hidden from more of them.
        count = min(found.covering, _MOST_PAIRS * found.points // max(found.pairs, 1))
        found = _estimate(seen_by, count, rng) if count > found.points else found
    return found


def remainder_between(
    pair: Sequence[Surface],
    cutoff: float,
    orders: Sequence[float] = (),
    execution: Execution = ON_CPU,
    *,
    is_bound: bool = False,
) -> Remainder:
    """Estimate what lies beyond a cutoff in the distance of two surfaces; see `remainder`."""
    # Only what they do not have in common counts.
    if rests := without_common_parts(pair):
        found = remainder(list(rests.values()), list(rests), cutoff, orders, execution=execution, is_bound=is_bound)
        return replace(found, excesses=((), ()))
    return Remainder.alike(cutoff)


def remainder_of_flat(
    pair: Sequence[Surface], cutoff: float, orders: Sequence[float] = (), execution: Execution = ON_CPU
) -> Remainder | None:
    """Return what lies beyond a cutoff in the distance of two surfaces if one has flat faces, well enough for a bound.

    The tail of flat faces follows no law that a lattice could extrapolate, since they may repeat. None for large
    meshes, where it would take much longer than their fields.
    """
    triangles = sum(len(surface.triangles) for surface in pair if isinstance(surface, Mesh))
    if triangles > _MOST_FLAT or not FaceNormals.from_surfaces(pair):
        return None
    return remainder_between(pair, cutoff, orders, execution, is_bound=True)


def _estimate(
    seen_by: _Seen, count: int, rng: np.random.Generator, *, is_exact: bool = True, is_bound: bool = False
) -> Remainder:
    little = seen_by.moved
    found = _from_pairs(seen_by, *little, count, rng) if little else _from_points(seen_by, count, rng)
    terms, covering, n, means = found.terms, seen_by.covering, len(found.terms), found.terms.mean(axis=0)
    # A single point may stand for others like it that were not met.
    variances = terms.var(axis=0, ddof=1) / n + (np.abs(terms - means).max(axis=0) / n) ** 2 + found.variances
    missed = (found.largest * seen_by.alone) ** 2 * float(found.total < covering)
    variances += missed
    hidden = float((missed / np.maximum(variances, np.finfo(np.float64).tiny)).max())
    errors = np.sqrt(variances) * quantile(n - 1)
    scale = seen_by.sheets.area * seen_by.alone
    # A move changes what tables leave in proportion to itself, and smooth kernels in proportion to its square.
    cut, left = _CUT * found.share * scale, _CUT_LEFT * np.sqrt(found.share) * scale
    excesses, scatter = _excesses(found.draw, found.potentials)
    excess_errors = np.sqrt(scatter + missed) * quantile(n - 1) + cut + left
    # A bound is little more where the cut is little of all.
    if is_exact and np.any(cut > _CUT_FRACTION * (errors + (np.abs(means) if is_bound else 0.0))):
        corrections, cut = seen_by.corrections(found.draw, found.potentials, rng)
        means += corrections
    # Facets of smooth surfaces are off by up to 6e-5 of the area, most of the error where nothing cancels.
    lacking = 0.0 if seen_by.sheets.cancel else seen_by.sheets.lacking
    means, left = means * (1 + lacking / seen_by.sheets.area), left + abs(lacking) * seen_by.alone
    kernels = seen_by.kernels
    scales = np.array([tail_integral(kernels.cutoff, order) for order in kernels.orders])
    several = means, errors + cut + left, excesses, excess_errors
    energies, errors, *of_excess = (tuple((values / scales).tolist()) for values in several)
    known = kernels.cutoff, kernels.orders, energies, errors, found.total, found.pairs, covering, hidden
    return Remainder(*known, tuple(of_excess)) if seen_by.sheets.cancel else Remainder(*known)


def _excesses(draw: Draw, potentials: Reals) -> tuple[Reals, Reals]:
    """Return the product of a difference with the sum of both surfaces (orders,), and its variance.

    How many points lie on each surface is no chance.
    """
    parts = np.abs(draw.weights)[..., None] * potentials
    groups = [parts.sum(axis=0)] if len(parts) > 1 else [parts[0][draw.weights[0] * sign > 0] for sign in (1, -1)]
    groups = [group for group in groups if len(group) > 1]
    offs = [group - group.mean(axis=0) for group in groups]
    variances = sum(len(off) * off.var(axis=0, ddof=1) + np.abs(off).max(axis=0) ** 2 for off in offs)
    return np.sum([group.sum(axis=0) for group in groups], axis=0), np.asarray(variances)


class _Found(NamedTuple):
    """Points (k, n), where k is 2 for pairs, with their potentials (k, n, orders), and n terms whose mean is wanted.

    Attributes:
        variances: Variance of the mean that the scatter of the terms does not show (orders,).
        share: Part of `_Seen.alone` that is there to be seen, in the mean (orders,).
        largest: Area that one point stands for at most, times that part there (orders,).
        total: Number of points that were looked at.
        pairs: Number of pairs of a point and a triangle.
    """

    draw: Draw
    potentials: Reals
    terms: Reals
    variances: Reals
    share: Reals
    largest: Reals
    total: int
    pairs: int


def _from_pairs(seen_by: _Seen, moved: Moved, shares: Reals, count: int, rng: np.random.Generator) -> _Found:
    """Return what pairs of points on meshes with the same triangles see, where a plane would have shares (m, orders).

    Near a plane the potential at a height above it is known. It is most of what a pair sees, and its mean over many
    more pairs takes no time: only how the rest scatters counts.
    """
    kernels, share, n = seen_by.kernels, moved.areas @ shares / moved.areas.sum(), (count + 1) // 2
    densities = (shares / share).sum(axis=1)
    draw, heights, chosen = moved.in_proportion(densities, n, rng)
    potentials, pairs = seen_by.potentials(draw.points.reshape(-1, 3))
    potentials = potentials.reshape(2, n, -1)

    def near_planes(draw: Draw, heights: Reals) -> Reals:
        drops = kernels.looked_up(kernels.drops, heights)
        return np.asarray(2 * np.pi * heights.shape[1] * (np.abs(draw.weights)[..., None] * drops).sum(axis=0))

    most = max(min(_HEIGHTS * n, _MOST_HEIGHTS), _FEWEST_HEIGHTS * n)
    few, many = near_planes(draw, heights), near_planes(*moved.in_proportion(densities, most, rng)[:2])
    terms, scatter = n * (draw.weights[..., None] * potentials).sum(axis=0), few - few.mean(axis=0)
    squares = np.maximum((scatter**2).sum(axis=0), np.finfo(np.float64).tiny)
    slopes = np.clip((scatter * terms).sum(axis=0) / squares, 0.0, 1.0)
    terms -= slopes * (few - many.mean(axis=0))
    largest = (np.abs(draw.weights).sum(axis=0)[:, None] * shares[chosen]).max(axis=0)
    return _Found(draw, potentials, terms, slopes**2 * many.var(axis=0) / most, share, largest, 2 * n, pairs)


def _from_points(seen_by: _Seen, count: int, rng: np.random.Generator) -> _Found:
    """Return the potentials at some points; where these saw unevenly, at more of them."""
    share = seen_by.sheets.area / count
    sheets = replace(seen_by.sheets, spacing=max(seen_by.squared_reach, share) ** 0.5)
    draw = sheets.even(min(count, max(seen_by.covering, _USUAL_POINTS)), rng)
    potentials, pairs = seen_by.potentials(draw.points)
    total, seen = len(draw.points), seen_by.shares(potentials)
    if (seen**2).mean() > _UNEVEN * seen.mean() ** 2 and seen.max() > _NOTHING:
        densities = sheets.around(draw.points, seen)
        # A part that is small beside the wavelength is seen from around it, and is more than is seen there.
        looked_at = sheets.largest(densities, total)
        found, more = seen_by.potentials(sheets.centers[looked_at])
        densities[looked_at] = np.maximum(densities[looked_at], seen_by.shares(found))
        total, pairs = total + len(looked_at), pairs + more
        draw = sheets.in_proportion(densities, max(count - total, total // 2, _USUAL_POINTS), rng)
        potentials, more = seen_by.potentials(draw.points)
        total, pairs = total + len(draw.points), pairs + more
    elif count > total:
        further = sheets.even(count - total, rng)
        found, more = seen_by.potentials(further.points)
        points, weights = map(np.concatenate, zip(draw, further, strict=True))
        # Both have the same density.
        weights *= np.repeat([total / count, (count - total) / count], [total, count - total])
        draw, potentials = Draw(points, weights), np.concatenate([potentials, found])
        total, pairs = count, pairs + more
    terms, largest = len(draw.points) * draw.weights[:, None] * potentials, np.abs(draw.weights).max()
    draw = Draw(draw.points[None], draw.weights[None])
    return _Found(draw, potentials[None], terms, np.zeros(()), np.ones(()), largest, total, pairs)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Potentials of surfaces at points on them."""

    sheets: Sheets
    kernels: Kernels
    execution: Execution

    @property
    def squared_reach(self) -> float:
        """Squared reach of the kernel that reaches least."""
        return float(min(reach_of(self.kernels.orders[0]) / self.kernels.cutoff, _LONGEST_REACH) ** 2)

    @property
    def covering(self) -> int:
        """Number of points from which nothing is hidden; nothing can cancel in a sum without differences."""
        return int(_PER_REACH * self.sheets.area / self.squared_reach) if self.sheets.cancel else 0

    @property
    def alone(self) -> Reals:
        """Potential of a plane on itself (orders,): no spot of a smooth surface alone has more."""
        return 2 * np.pi * self.kernels.totals

    @cached_property
    def moved(self) -> tuple[Moved, Reals] | None:
        """Meshes of the same triangles that are a little moved, and the parts of `alone` that a plane so far has."""
        if (moved := self.sheets.moved) is None:
            return None
        (one, _), (other, _) = moved.meshes
        squares = ((one.vertices - other.vertices) ** 2).sum(axis=1)[one.triangles].max(axis=1)
        shares = self.kernels.looked_up(self.kernels.drops, squares) / self.kernels.totals
        means = moved.areas @ shares / moved.areas.sum()
        return (moved, shares) if np.all((means > 0) & (means < _LITTLE)) else None

    def shares(self, potentials: Reals) -> Reals:
        """Return the size of potentials (n, orders) at the order where it is largest, as parts of `alone` (n,)."""
        return np.asarray((np.abs(potentials) / self.alone).max(axis=1))

    def potentials(self, points: Reals) -> tuple[Reals, int]:
        """Return the potentials (n, orders) at points (n, 3), and the number of pairs of a point and a triangle."""
        found, pairs = np.zeros((len(points), len(self.kernels.totals))), 0
        for triangles in self.sheets.triangles():
            pairs += add_of_triangles(found, points, triangles, self.kernels, self.execution)
        for sphere, sign in self.sheets.spheres:
            found += sign * of_sphere(points, sphere, self.kernels)
        return found, pairs

    def corrections(self, draw: Draw, potentials: Reals, rng: np.random.Generator) -> tuple[Reals, Reals]:
        """Return what twice the reach and twice the nodes change (orders,), and how far that may be off.

        Some of the points tell. Between surfaces that nearly cancel, what is cut at the reach is much of the rest.
        """
        count = min(_CONTROLS, n := draw.weights.shape[1])
        chosen = np.sort(rng.choice(n, count, replace=False))
        kernels = Kernels.of_orders(self.kernels.cutoff, self.kernels.orders, 2, self.sheets.reach)
        finer = _Seen(self.sheets, kernels, self.execution)
        changes = finer.potentials(draw.points[:, chosen].reshape(-1, 3))[0]
        changes = changes.reshape(-1, count, changes.shape[1]) - potentials[:, chosen]
        changes = n * (draw.weights[:, chosen, None] * changes).sum(axis=0)
        return changes.mean(axis=0), changes.std(axis=0, ddof=1) / np.sqrt(count) * quantile(count - 1)

    def affordable(self, rng: np.random.Generator) -> int:
        """Return the number of points that do not take long."""
        if not self.sheets.meshes:
            return _USUAL_POINTS
        places, pairs = self.sheets.even(_FEWEST_POINTS, rng).points, 0
        for mesh, _ in self.sheets.meshes:
            # A few triangles stand for all of them.
            step = max(1, len(mesh.triangles) // 2000)
            centers, radii = centers_and_radii(mesh.vertices[mesh.triangles[::step]])
            offsets = np.linalg.norm(places[:, None] - centers, axis=2)
            pairs += step * int(np.count_nonzero(offsets < self.kernels.reach + radii))
        most = _MOST_POINTS if self.sheets.cancel or self.kernels.cutoff > 1 else _MOST_POINTS_ALONE
        return int(np.clip(_USUAL_PAIRS * _FEWEST_POINTS // max(pairs, 1), _FEWEST_POINTS, most))


def mean_sinc(cutoff: float, order: float, length: float) -> float:
    """Return the mean of sinc(2 r length) beyond a cutoff, weighted by (1 - step(r)) (1+r²)^s: 1 for a short length."""
    # Farther out it averages to nothing.
    octaves = takewhile(lambda octave: octave[0] * length < _SINC_CYCLES, tail_nodes(cutoff, order))
    integral = sum(float(weights @ np.sinc(2 * radii * length)) for _, radii, weights in octaves)
    return integral / tail_integral(cutoff, order)
