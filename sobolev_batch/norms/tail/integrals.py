"""Integrals over octaves from sums over their samples, with the errors that follow from the scatter of these sums."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.norms.tail.sampling import OctaveSampling

# The true value lies within an error by chance with this probability, if sums over groups, or over points, are normal.
_CONFIDENCE = 0.99
# Images up to this many periods away along each axis: farther ones have others of sublattices beside them, which tell
# of them. And ranges of |ξ| in which samples count as one: phases of images turn by 0.5 in one, on the usual M of 64.
_FARTHEST_IMAGE, _RANGES = 5, 2048


@dataclass(frozen=True, eq=False)
class OctaveSums:
    """Integrals of |field|², or of products of two fields, over an octave.

    Attributes:
        squares: ∫ window (1+|ξ|²)^s |field|² for each order (orders,).
        variances_by_origin: Variances of what lattices and what drawn frequencies contribute (2, orders).
        degrees: Degrees of freedom of these variances (2,).
        energy: Mean of ∫_{|ξ|=r} |field|² dS over the octave.
        energy_deviation: Standard error of the energy.
    """

    squares: Reals
    variances_by_origin: Reals
    degrees: Reals
    energy: float
    energy_deviation: float

    @property
    def variances(self) -> Reals:
        """Variance of the integrals (orders,)."""
        return np.asarray(self.variances_by_origin.sum(axis=0))


@dataclass(frozen=True, eq=False)
class OctaveWeights:
    """Weights of the samples of an octave for some orders s."""

    sampling: OctaveSampling
    orders: tuple[float, ...]

    @cached_property
    def by_order(self) -> Reals:
        """Weight times (1+|ξ|²)^s for each order, and the weight alone, float64 (orders + 1, n)."""
        lengths, weights = 1 + self.sampling.radii**2, self.sampling.weights
        return np.stack([*(weights * lengths**order for order in self.orders), weights])

    def sums(self, squares: Reals) -> OctaveSums:
        """Return the integrals of |field|², or of products of two fields, with variances, from all samples (n,)."""
        sums, scatters = np.zeros(len(self.by_order)), []
        for number, sample_set in enumerate(self.sampling.sample_sets):
            if sample_set.samples.start == sample_set.samples.stop:
                continue
            groups = terms = self.by_order[:, sample_set.samples] * squares[sample_set.samples]
            unseen = np.abs(terms).max(axis=1)
            if not sample_set.is_drawn:
                groups = np.add.reduceat(terms, sample_set.starts, axis=1)
                images = deviations_by_images(self.sampling, number, terms[-1:], (*self.orders, 0.0))
                unseen = np.hypot(unseen, images[:, 0])
            sums, count = sums + groups.sum(axis=1), groups.shape[1]
            scatters.append(Scatter(sample_set.is_drawn, count * groups.var(axis=1, ddof=1), unseen, count - 1))
        by_origin, degrees = pooled(scatters)
        # The weights of the last row are those of the energy.
        width, deviation = self.sampling.octave.integral(0.0), float(np.sqrt(by_origin[:, -1].sum()))
        return OctaveSums(sums[:-1], by_origin[:, :-1], degrees, float(sums[-1]) / width, deviation / width)


def deviations_by_images(
    sampling: OctaveSampling, number: int, terms: Reals, orders: Sequence[float] | Reals, least_length: float = 1.0
) -> Reals:
    """Return the deviations (orders, fields) of sums over a lattice by images that its sublattices have in common.

    The terms (fields, n) are weights times |field|². Their factors are powers of (1 + |ξ|²) over the least length.

    The scatter among sublattices tells of images at halves of periods alone. Those at whole periods are like them where
    many images overlap. Of few, they may touch the surface where no other does: a ball meets all at its diameter at
    once, whatever the rotation. The mean of an image over directions follows from the radii of samples. It is that of
    |field|² less its mean, since a constant has no images.
    """
    lattice, samples = sampling.lattices[number], sampling.sample_sets[number].samples
    places = (sampling.radii[samples] / lattice.highest * _RANGES).astype(np.int64)
    radii = np.maximum((np.arange(_RANGES) + 0.5) / _RANGES * lattice.highest, lattice.lowest)
    even = np.bincount(places, sampling.weights[samples], _RANGES)
    profiles = np.stack([np.bincount(places, row, _RANGES) for row in terms])
    (waves, counts), found = _images_of(lattice.M), []
    for order in orders:
        factors = ((1 + radii**2) / least_length) ** order
        means = profiles @ factors / np.maximum(even @ factors, np.finfo(np.float64).tiny)
        images = (factors * (profiles - means[:, None] * even)) @ waves
        found.append(np.sqrt(images**2 @ counts))
    return np.stack(found)


@lru_cache(maxsize=8)
def _images_of(intervals: int) -> tuple[Reals, Reals]:
    """Return for images at each distance their mean waves over ranges of |ξ| (ranges, distances), and their number."""
    axis = range(-_FARTHEST_IMAGE, _FARTHEST_IMAGE + 1)
    squares, counts = np.unique([i * i + j * j + k * k for i, j, k in product(axis, axis, axis)], return_counts=True)
    # A period is half of M over the largest |ξ|.
    waves = np.sinc(intervals * np.sqrt(squares[1:]) * ((np.arange(_RANGES) + 0.5) / _RANGES)[:, None])
    return waves, counts[1:].astype(np.float64)


def squared_moduli(values: Complexes) -> Reals:
    """Return |values|² in double precision."""
    return np.asarray(values.real.astype(np.float64, copy=False) ** 2 + values.imag.astype(np.float64, copy=False) ** 2)


class Scatter(NamedTuple):
    """Variance of a sum over the samples of one lattice, or over all drawn samples of an octave.

    The variance follows from groups of samples, each (orders, ...), of which there is one more than degrees of freedom.
    It does not show the unseen deviation: the largest term, which may stand for others like it that were not met, and
    images that all groups of a lattice have.
    """

    is_drawn: bool
    variance: Reals
    unseen: Reals
    degrees: int


def pooled(scatters: Sequence[Scatter]) -> tuple[Reals, Reals]:
    """Return the variances (2, orders, ...) and degrees of freedom (2,) of what lattices and drawn samples contribute.

    Lattices count apart from draws, so that few sublattices stay few beside many draws.
    """
    variances, degrees = [np.zeros(()), np.zeros(())], np.zeros(2)
    for one in scatters:
        origin = int(one.is_drawn)
        variances[origin] = variances[origin] + (one.variance + one.unseen**2)
        degrees[origin] += one.degrees
    return np.stack(np.broadcast_arrays(*variances)), degrees


def integral_over(octaves: Sequence[OctaveSums]) -> tuple[Reals, Reals]:
    """Return the integral over several octaves (orders,), and how far off it may be at 99 %."""
    error = error_of_sum([(octave.variances_by_origin, octave.degrees) for octave in octaves])
    return np.asarray(np.sum([octave.squares for octave in octaves], axis=0)), error


def error_of_sum(octaves: Sequence[tuple[Reals, Reals]]) -> Reals:
    """Return how far off a sum over octaves may be (orders, ...) at 99 %, from what `pooled` returns for each of them.

    It is Student's quantile for the degrees of freedom of the sum (F. E. Satterthwaite 1946, doi:10.2307/3002019).
    """
    if not octaves:
        return np.zeros(())
    variances, degrees = (np.concatenate(columns) for columns in zip(*octaves, strict=True))
    total, tiny = variances.sum(axis=0), np.finfo(np.float64).tiny
    shares = variances**2 / np.maximum(degrees, 1).reshape(-1, *[1] * (variances.ndim - 1))
    effective = total**2 / np.maximum(np.sum(shares, axis=0), tiny)
    return np.asarray(np.sqrt(total) * quantile(np.maximum(effective, 1.0)))


def quantile(degrees: Reals | float) -> Reals:
    """Return how many standard errors a mean may be off at 99 %, by Student's law with some degrees of freedom."""
    return np.asarray(stdtrit(degrees, (1 + _CONFIDENCE) / 2))
