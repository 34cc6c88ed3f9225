"""Integrals over octaves, with standard errors that the samples themselves give; the tails that they make up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from sobolev_batch.spectral.budget import NormEstimate, change_of_root
from sobolev_batch.spectral.octaves.sampling import OctaveSampling

Reals = NDArray[np.float64]

# The true value lies within the statistical error with this probability, if sums over groups are normal.
_CONFIDENCE = 0.99


@dataclass(frozen=True, eq=False)
class OctaveSums:
    """Integrals of |field|² over an octave.

    Attributes:
        squares: ∫ window (1+|ξ|²)^s |field|² for each order (orders,).
        lattice_variances: Variance of their part from lattices (orders,).
        drawn_variances: Variance of their part from drawn frequencies (orders,).
        energy: Mean of ∫_{|ξ|=r} |field|² dS over the octave.
        energy_deviation: Standard error of the energy.
        lattice_degrees: Degrees of freedom of the lattices' variances.
        drawn_degrees: Degrees of freedom of the draws' variances.
    """

    squares: Reals
    lattice_variances: Reals
    drawn_variances: Reals
    energy: float
    energy_deviation: float
    lattice_degrees: int
    drawn_degrees: int

    @property
    def variances(self) -> Reals:
        """Variance of the integrals (orders,)."""
        return self.lattice_variances + self.drawn_variances


@dataclass(frozen=True, eq=False)
class OctaveWeights:
    """Weights of the samples of an octave for some orders.

    Attributes:
        sampling: Samples of the octave.
        orders: Orders s.
    """

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
        """Return the integrals of |field|², or of products of two fields, with variances, from all samples (n,).

        What is known of the integrals otherwise may have been subtracted from the samples.
        """
        sums, variances, degrees = np.zeros(len(self.by_order)), np.zeros((2, len(self.by_order))), [0, 0]
        for part in self.sampling.parts:
            if part.samples.start == part.samples.stop:
                continue
            kind = int(part.is_drawn)
            for i, weights in enumerate(self.by_order):
                terms = weights[part.samples] * squares[part.samples]
                groups = terms if part.starts is None else np.add.reduceat(terms, part.starts)
                sums[i] += groups.sum()
                # A single sample may stand for others like it that were not met.
                variances[kind, i] += len(groups) * groups.var(ddof=1) + np.abs(terms).max() ** 2
            degrees[kind] += len(groups) - 1
        deviation = float(np.sqrt(variances[:, -1].sum())) / self.width
        energy = float(sums[-1]) / self.width
        return OctaveSums(sums[:-1], variances[0, :-1], variances[1, :-1], energy, deviation, *degrees)


def squared_moduli(values: NDArray[np.complexfloating]) -> Reals:
    """Return |values|² in double precision."""
    return np.asarray(values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2)


def statistical_errors(octaves: Iterable[OctaveSums]) -> Reals:
    """Return how far off the sum of integrals over several octaves may be (orders,), at 99 %.

    It is Student's quantile for the degrees of freedom of the sum (F. E. Satterthwaite 1946, doi:10.2307/3002019).
    """
    parts = [
        part
        for octave in octaves
        for part in (
            (octave.lattice_variances, octave.lattice_degrees),
            (octave.drawn_variances, octave.drawn_degrees),
        )
    ]
    # Few sublattices stay few beside many draws.
    variances, degrees = np.array([variance for variance, _ in parts]), np.array([count for _, count in parts])
    total = variances.sum(axis=0)
    tiny = np.finfo(np.float64).tiny
    effective = total**2 / np.maximum(np.sum(variances**2 / np.maximum(degrees, 1)[:, None], axis=0), tiny)
    return np.asarray(np.sqrt(total) * stdtrit(np.maximum(effective, 1.0), (1 + _CONFIDENCE) / 2))


@dataclass(frozen=True, eq=False)
class Tail:
    """Squared norms of fields beyond the innermost frequencies, each (orders, ...).

    Attributes:
        octaves: Part of the octaves.
        statistical: How far off that may be, at 99 %.
        beyond: Part beyond the last octave.
        uncertainty: How far off that may be.
    """

    octaves: Reals
    statistical: Reals
    beyond: Reals
    uncertainty: Reals

    @classmethod
    def from_sums(cls, sums: Sequence[OctaveSums], beyond: Reals, uncertainty: Reals) -> Self:
        """Return the tail by the sums over octaves, and what lies beyond them (orders,)."""
        none = np.zeros(len(beyond))
        measured = np.sum([octave.squares for octave in sums], axis=0) if sums else none
        return cls(measured, statistical_errors(sums) if sums else none, beyond, uncertainty)

    @classmethod
    def stacked(cls, tails: Sequence[Tail]) -> Self:
        """Return the tails of several fields as one, (orders, fields)."""
        parts = ([getattr(tail, field.name) for tail in tails] for field in fields(cls))
        return cls(*(np.stack(arrays, axis=-1) for arrays in parts))

    def scaled(self, factors: Reals) -> Tail:
        """Return the tails of several fields, (orders, fields), each times a factor."""
        parts = (getattr(self, field.name) for field in fields(self))
        return Tail(*(part * factors for part in parts))

    @property
    def squares(self) -> Reals:
        """The whole tail."""
        return self.octaves + self.beyond

    def estimate(self, core: Reals, images: Reals, discretisation: Reals) -> NormEstimate:
        """Return norms with their errors, each (orders, ...).

        They follow from the squared norm of the innermost frequencies, the bound on its change by the lattice's
        spacing, and the norms of the errors of all values.
        """
        squares = np.maximum(np.maximum(core, 0.0) + self.squares, 0.0)
        return NormEstimate(
            np.sqrt(squares),
            change_of_root(squares, self.uncertainty),
            change_of_root(squares, images),
            discretisation,
            change_of_root(squares, self.statistical),
        )
