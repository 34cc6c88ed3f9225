"""Integrals over octaves from sums over their samples, with the errors that follow from the scatter of these sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.tail.sampling import OctaveSampling

# The true value lies within an error by chance with this probability, if sums over groups, or over points, are normal.
_CONFIDENCE = 0.99


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

    @cached_property
    def width(self) -> float:
        """Integral of the octave's window over |ξ|."""
        return self.sampling.octave.integral(0.0)

    def integrals(self, products: Reals) -> Reals:
        """Return ∫ window (1+|ξ|²)^s products for each order (orders,), from values at all samples (n,)."""
        return np.asarray(self.by_order[:-1] @ products)

    def sums(self, squares: Reals) -> OctaveSums:
        """Return the integrals of |field|², or of products of two fields, with variances, from all samples (n,)."""
        sums, scatters = np.zeros(len(self.by_order)), []
        for sample_set in self.sampling.sample_sets:
            if sample_set.samples.start == sample_set.samples.stop:
                continue
            columns = []
            for weights in self.by_order:
                terms = weights[sample_set.samples] * squares[sample_set.samples]
                groups = terms if sample_set.starts is None else np.add.reduceat(terms, sample_set.starts)
                columns.append((groups.sum(), len(groups) * groups.var(ddof=1), np.abs(terms).max()))
            values, variances, largest = np.array(columns).T
            sums += values
            scatters.append(Scatter(sample_set.is_drawn, variances, largest, len(groups) - 1))
        by_origin, degrees = pooled(scatters)
        # The weights of the last row are those of the energy.
        deviation = float(np.sqrt(by_origin[:, -1].sum())) / self.width
        return OctaveSums(sums[:-1], by_origin[:, :-1], degrees, float(sums[-1]) / self.width, deviation)


def squared_moduli(values: NDArray[np.complexfloating]) -> Reals:
    """Return |values|² in double precision."""
    return np.asarray(values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2)


class Scatter(NamedTuple):
    """Variance of a sum over the samples of one lattice, or over all drawn samples of an octave.

    The variance follows from groups of samples, each (orders, ...), of which there is one more than degrees of freedom.
    """

    is_drawn: bool
    variance: Reals
    largest_term: Reals
    degrees: int


def pooled(scatters: Sequence[Scatter]) -> tuple[Reals, Reals]:
    """Return the variances (2, orders, ...) and degrees of freedom (2,) of what lattices and drawn samples contribute.

    A single sample may stand for others like it that were not met: the largest one counts as a further deviation.
    Lattices count apart from draws, so that few sublattices stay few beside many draws.
    """
    variances, degrees = [np.zeros(()), np.zeros(())], np.zeros(2)
    for one in scatters:
        origin = int(one.is_drawn)
        variances[origin] = variances[origin] + (one.variance + one.largest_term**2)
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
