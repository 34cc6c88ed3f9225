"""Spectra of point clouds at high frequencies, from the distances of their points.

The transform of a sum of Dirac measures does not decay. Averaged over all directions, |μ^|² at |ξ| = r is
Σ w_i w_j sinc(2 r |x_i - x_j|), the equation of P. Debye (1915), doi:10.1002/andp.19153510606. Averaged over an octave
of |ξ| too, only pairs count that are closer than some wavelengths. So near neighbours tell what no lattice reaches:
points that are close together add up, and far beyond their distances Σ w_i² is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import beta, betainc

from sobolev_batch.spectral.shells import smooth_step
from sobolev_batch.surfaces.shapes.point_cloud import PointCloud, merged_weights

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Reals = NDArray[np.float64]

# Pairs farther apart than this many wavelengths, of the frequency at which octaves start, add less than 1e-7 each.
_RANGE = 12.0
# Distances are counted in classes: so many for a factor of two, down to 2^-60 of the range.
_CLASSES, _MOST_OCTAVES = 256, 60
# Below so many wavelengths, sinc is two terms of its series to five digits.
_CLOSE = 0.01
# Pairs that are looked at: if there are more, only those of some points, drawn by weight, and of so many at least.
_MOST_PAIRS, _FEWEST_POINTS, _GROUPS = 4_000_000, 64, 16
# Pairs of which all are looked at where the tail of a distance follows from them alone, and the most octaves that are
# sampled to get there.
_MOST_EXACT_PAIRS, _MOST_SAMPLED_OCTAVES = 30_000_000, 10
# Points whose neighbours are counted beforehand, and pairs that are held at a time.
_COUNTED, _HELD_PAIRS = 64, 1 << 21
# Standard errors by which a sum over some points may be off.
_CAUTION = 3.0
# Error of a sum by classes, relative to the square that it leads to, and rounding, relative to that of single points.
_CLASS_ERROR, _ROUNDING = 5e-5, 1e-12
_NODES = 256


@dataclass(frozen=True, eq=False)
class PointPairs:
    """Products of the weights of pairs of points that are close to each other, by their distance.

    Attributes:
        start: Frequency beyond which they tell all of |μ^|², in cycles per unit length.
        area: Sum of the weights' moduli, in squared units of length.
        squares: Sum of the squared weights.
        sums: Sum of w_i w_j over ordered pairs of different points by classes of distance, float64 (groups, classes).
            Each group estimates the whole; there is one where all pairs were looked at.
    """

    start: float
    area: float
    squares: float
    sums: Reals

    @classmethod
    def of(cls, clouds: Sequence[PointCloud], start: float) -> Self:
        """Return the pairs of a cloud, or of the difference of two, that tell all beyond a frequency."""
        return cls._of_difference(*_difference(clouds), start, _MOST_PAIRS)

    @classmethod
    def where_few(cls, clouds: Sequence[PointCloud], cutoff: float) -> Self:
        """Return the pairs beyond the first frequency, a cutoff doubled some times, from which all can be looked at.

        Points that lie too close to each other are a sample there.
        """
        places, weights = _difference(clouds)
        tree = _tree(places)
        starts = [cutoff * 2.0**octaves for octaves in range(_MOST_SAMPLED_OCTAVES + 1)]
        few = (start for start in starts if tree.n * _neighbours(tree, _RANGE / start) <= _MOST_EXACT_PAIRS)
        return cls._of_difference(places, weights, next(few, starts[-1]), 2 * _MOST_EXACT_PAIRS)

    @classmethod
    def _of_difference(cls, points: Reals, weights: Reals, start: float, most: int) -> Self:
        sums = _pair_sums(points, weights, _RANGE / start, most)
        return cls(start, float(np.abs(weights).sum()), float(weights @ weights), sums)

    def octaves_from(self, cutoff: float) -> int:
        """Return the number of octaves from the step that ends at a cutoff to the one that ends at ``start``."""
        return round(math.log2(self.start / cutoff))

    def beyond(self, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the squared norms beyond the step that ends at ``start`` (orders,), and how far off they may be."""
        own = self.squares * octave_masses(self.start, 1, orders)[:, 0]
        pairs, deviations = _mean_of_groups(np.stack([self._pairs_beyond(order) for order in orders]))
        squares = np.maximum(own + pairs, 0.0)
        return squares, deviations + _CLASS_ERROR * squares + _ROUNDING * own

    def spectrum(self) -> PointSpectrum:
        """Return the means of |μ^|² over octaves."""
        filled = np.flatnonzero(self.sums.any(axis=0))
        octaves = -(-(int(filled[-1]) + 1) // _CLASSES) if len(filled) else 0
        by_group = np.stack([self.sums @ _octave_means(octave) for octave in range(octaves + 1)])
        pairs, deviations = _mean_of_groups(by_group)
        levels = self.squares + pairs
        # Within an octave the mean may change as it does between octaves.
        steps = np.abs(np.diff(levels, append=levels[-1]))
        steps = np.maximum(steps, np.concatenate([steps[:1], steps[:-1]]))
        return PointSpectrum(self.start, self.area, np.maximum(levels, 0.0), deviations + steps)

    @cached_property
    def _known(self) -> dict[float, Reals]:
        return {}

    def _pairs_beyond(self, order: float) -> Reals:
        """Return what all pairs add at an order, by each group (groups,)."""
        if order not in self._known:
            filled = np.flatnonzero(self.sums.any(axis=0))
            distances = _class_distances()[filled] / self.start
            self._known[order] = self.sums[:, filled] @ _tail_kernel(distances, self.start, order)
        return self._known[order]


@dataclass(frozen=True, eq=False)
class PointSpectrum:
    """Mean |μ^|² of a sum of Dirac measures, octave by octave of |ξ| beyond a frequency.

    Octave k = 1, 2, ... lies between the `smooth_step` that ends at ``start`` · 2^(k-1) and the one at twice that.

    Attributes:
        start: Frequency at which the first of these steps ends, in cycles per unit length.
        area: Sum of the weights' moduli, in squared units of length.
        levels: Mean |μ^|² in each octave, and in all beyond them, float64 (octaves + 1,).
        deviations: How far each may be off.
    """

    start: float
    area: float
    levels: Reals
    deviations: Reals

    @classmethod
    def of(cls, clouds: Sequence[PointCloud], start: float) -> PointSpectrum | None:
        """Return the spectrum of a cloud, or of the difference of two; None without clouds."""
        return PointPairs.of(clouds, start).spectrum() if clouds else None

    @classmethod
    def between(cls, first: PointSpectrum | None, second: PointSpectrum | None) -> PointSpectrum | None:
        """Return the spectrum of the difference of two measures of which no more is known than their spectra."""
        if first is None or second is None:
            return first or second
        size = max(len(first.levels), len(second.levels))
        a, b = first.padded(size), second.padded(size)
        cross = 2 * np.sqrt(a.highest * b.highest)
        return cls(first.start, first.area + second.area, a.levels + b.levels, a.deviations + b.deviations + cross)

    @property
    def highest(self) -> Reals:
        """Upper bound of each level (octaves + 1,)."""
        return self.levels + self.deviations

    def padded(self, size: int) -> PointSpectrum:
        """Return the same spectrum with more octaves."""
        more = (0, size - len(self.levels))
        levels, deviations = np.pad(self.levels, more, "edge"), np.pad(self.deviations, more, "edge")
        return PointSpectrum(self.start, self.area, levels, deviations)

    def beyond(self, orders: Sequence[float]) -> tuple[Reals, Reals]:
        """Return the squared norms beyond the step that ends at ``start`` (orders,), and how far off they may be."""
        masses = octave_masses(self.start, len(self.levels), orders)
        return masses @ self.levels, masses @ self.deviations

    def to_table(self) -> dict[str, Any]:
        """Return the spectrum as a table, from which `from_table` makes it again."""
        return {
            "start": self.start,
            "area": self.area,
            "levels": self.levels.tolist(),
            "deviations": self.deviations.tolist(),
        }

    @classmethod
    def from_table(cls, table: dict[str, Any] | None) -> Self | None:
        """Return the spectrum that a table holds; None for none."""
        if table is None:
            return None
        return cls(table["start"], table["area"], np.array(table["levels"]), np.array(table["deviations"]))


def stacked_levels(spectra: Mapping[int, PointSpectrum], count: int) -> Reals | None:
    """Return upper bounds of the levels of some rows of many, (octaves + 1, count); zero for others, None for none."""
    if not spectra:
        return None
    size = max(len(spectrum.levels) for spectrum in spectra.values())
    levels = np.zeros((size, count))
    for row, spectrum in spectra.items():
        levels[:, row] = spectrum.padded(size).highest
    return levels


def octave_masses(start: float, count: int, orders: Sequence[float], highest: float | None = None) -> Reals:
    """Return ∫ window (1+|ξ|²)^s dξ over octaves from a frequency on, and over all beyond them, (orders, count).

    Args:
        start: Frequency at which the step before the first octave ends, in cycles per unit length.
        count: Number of octaves, and one for all beyond.
        orders: Orders s, below -3/2.
        highest: Frequency below which nothing counts; by default none.
    """
    return np.stack([_octave_masses(start, count, order, highest) for order in orders])


@lru_cache(maxsize=256)
def _octave_masses(start: float, count: int, order: float, highest: float | None) -> Reals:
    lowest = 0.0 if highest is None else highest
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    masses = np.zeros(count)
    for number in range(count):
        end = start * 2.0**number
        # The rise of an octave's window, and its fall. The last one does not fall.
        for rises, low, high in ((True, end / 2, end), (False, end, 2 * end)):
            if not rises and number == count - 1:
                continue
            low, high = max(low, lowest), max(high, lowest)
            radii = (low + high) / 2 + (high - low) / 2 * nodes
            window = 1 - smooth_step(radii, end) if rises else smooth_step(radii, 2 * end)
            masses[number] += (high - low) / 2 * weights @ (window * 4 * np.pi * radii**2 * (1 + radii**2) ** order)
    # With q = 1/(1+r²), ∫_R^∞ r² (1+r²)^s dr is half an incomplete beta integral.
    exponent, last = -order - 1.5, max(start * 2.0 ** (count - 1), lowest)
    masses[-1] += 2 * np.pi * beta(exponent, 1.5) * betainc(exponent, 1.5, 1 / (1 + last**2))
    masses.setflags(write=False)
    return masses


def _difference(clouds: Sequence[PointCloud]) -> tuple[Reals, Reals]:
    """Return the different points of a cloud, or of two, and their weights, those of the second one negative."""
    points = np.concatenate([cloud.points for cloud in clouds])
    signs = np.repeat([1.0, -1.0][: len(clouds)], [len(cloud.points) for cloud in clouds])
    return merged_weights(points, signs * np.concatenate([cloud.weights for cloud in clouds]))


def _tree(points: Reals) -> cKDTree:
    """Return the points (n, 3) as a tree of neighbours. Only clouds need its library, which takes a while to load."""
    from scipy.spatial import cKDTree

    return cKDTree(points)


def _neighbours(tree: cKDTree, reach: float) -> float:
    """Return the mean number of points around a point, itself included, from a few of them."""
    counted = np.random.default_rng(tree.n).integers(tree.n, size=_COUNTED)
    return float(np.mean(tree.query_ball_point(tree.data[counted], reach, return_length=True)))


def _pair_sums(points: Reals, weights: Reals, reach: float, most: int) -> Reals:
    """Return Σ w_i w_j over ordered pairs of different points, by classes of their distance, (groups, classes)."""
    classes = _CLASSES * _MOST_OCTAVES
    tree = _tree(points)
    neighbours = _neighbours(tree, reach)
    count = max(_FEWEST_POINTS, int(most / neighbours))
    if count >= len(points):
        chosen, factors, groups = np.arange(len(points)), weights, np.zeros(len(points), dtype=np.int64)
    else:
        area = np.abs(weights).sum()
        chosen = np.random.default_rng(len(points)).choice(len(points), count, p=np.abs(weights) / area)
        groups = np.arange(count) % _GROUPS
        factors = np.sign(weights[chosen]) * area / np.bincount(groups)[groups]
    sums = np.zeros((int(groups.max()) + 1, classes))
    counts = np.asarray(tree.query_ball_point(points[chosen], reach, return_length=True), dtype=np.int64)
    for batch in _batches(counts, _HELD_PAIRS):
        own = chosen[batch]
        pairs = _tree(points[own]).sparse_distance_matrix(tree, reach, output_type="ndarray")
        pairs = pairs[own[pairs["i"]] != pairs["j"]]
        numbers = _CLASSES * np.log2(reach / np.maximum(pairs["v"], np.finfo(np.float64).tiny))
        numbers = np.clip(numbers, 1, classes - 3)
        lower = numbers.astype(np.int64)
        terms = factors[batch][pairs["i"]] * weights[pairs["j"]]
        places = groups[batch][pairs["i"]] * classes + lower
        for shift, share in _cubic_shares(numbers - lower):
            sums += np.bincount(places + shift, weights=share * terms, minlength=sums.size).reshape(sums.shape)
    return sums


def _batches(counts: NDArray[np.int64], most: int) -> Iterator[slice]:
    """Yield slices of entries in a row whose counts add up to so many at most, or of one entry with more."""
    ends = np.cumsum(counts)
    first = 0
    while first < len(ends):
        before = ends[first] - counts[first]
        last = max(first + 1, int(np.searchsorted(ends, before + most, side="right")))
        yield slice(first, last)
        first = last


def _tail_kernel(distances: Reals, start: float, order: float) -> Reals:
    """Return ∫ (1 - step(|ξ|)) (1+|ξ|²)^s exp(2πi ξ·x) dξ at falling distances |x| (n,)."""
    kernel = np.zeros(len(distances))
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    for octave in range(_MOST_OCTAVES):
        end = start * 2.0**octave
        first, close = np.searchsorted(-distances * end, [-_RANGE, -_CLOSE])
        if first == len(distances):
            break
        radii = np.concatenate([end * (0.75 + 0.25 * nodes), end * (1.5 + 0.5 * nodes)])
        density = np.concatenate([0.25 * end * weights, 0.5 * end * weights])
        density *= (
            (smooth_step(radii, 2 * end) - smooth_step(radii, end)) * 4 * np.pi * radii**2 * (1 + radii**2) ** order
        )
        kernel[first:close] += np.sinc(2 * distances[first:close, None] * radii) @ density
        # Two terms of the series are enough below.
        kernel[close:] += density.sum() - (2 * np.pi * distances[close:]) ** 2 / 6 * (density @ radii**2)
    return kernel


def _cubic_shares(x: Reals) -> tuple[tuple[int, Reals], ...]:
    """Return the shares of four neighbouring classes, from one before to two after, at x between 0 and 1.

    Sums then see a function of the distance as its cubic interpolant, whose bends are right where two clouds are so
    close that all else cancels.
    """
    return (
        (-1, -x * (x - 1) * (x - 2) / 6),
        (0, (x + 1) * (x - 1) * (x - 2) / 2),
        (1, -(x + 1) * x * (x - 2) / 2),
        (2, (x + 1) * x * (x - 1) / 6),
    )


def _mean_of_groups(by_group: Reals) -> tuple[Reals, Reals]:
    """Return the mean of estimates (n, groups), and how far off it may be, (n,) each."""
    mean, count = by_group.mean(axis=1), by_group.shape[1]
    if count == 1:
        return mean, np.zeros(len(mean))
    return mean, _CAUTION * by_group.std(axis=1, ddof=1) / count**0.5


def _octave_means(octave: int) -> Reals:
    """Return the mean of sinc(2 r d) over an octave, counted from 0, for each class of distances d (classes,)."""
    first = _first_octave_means()
    return np.concatenate([np.zeros(octave * _CLASSES), first[: len(first) - octave * _CLASSES]])


@lru_cache(maxsize=1)
def _first_octave_means() -> Reals:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    radii = np.concatenate([0.75 + 0.25 * nodes, 1.5 + 0.5 * nodes])
    # Relative to the start; a field of constant |μ^|² at order -2.
    density = (smooth_step(radii, 2.0) - smooth_step(radii, 1.0)) * radii**-2.0
    density *= np.concatenate([0.25 * weights, 0.5 * weights])
    return np.asarray(np.sinc(2 * _class_distances()[:, None] * radii) @ density / density.sum())


def _class_distances() -> Reals:
    """Return the distances of the classes (classes,), in wavelengths of the start."""
    return np.asarray(_RANGE * 2.0 ** (-np.arange(_CLASSES * _MOST_OCTAVES) / _CLASSES))
