"""Integrals over octaves, with standard errors that the samples themselves give."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.stats import t as students_t

from sobolev_batch.spectral.octaves.partition import Octave
from sobolev_batch.spectral.octaves.sampling import OctaveSampling

Reals = NDArray[np.float64]

# The true value lies within the statistical error with this probability, if sums over groups are normal.
_CONFIDENCE = 0.995


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


def octave_sums(
    sampling: OctaveSampling, values: Sequence[NDArray[np.complexfloating]], orders: Sequence[float]
) -> OctaveSums:
    """Integrate |field|² over an octave, from the values of a field at all samples."""
    # The last row is the energy.
    exponents = [*orders, None]
    sums, variances = np.zeros(len(exponents)), np.zeros((2, len(exponents)))
    degrees = [0, 0]
    for number, (part, field) in enumerate(zip(sampling.parts(), values, strict=True)):
        if not len(field):
            continue
        squares = part.weights * np.abs(field).astype(np.float64) ** 2
        drawn = number == len(sampling.lattices)
        groups = len(field) if drawn else 8
        lengths = 1 + part.radii**2
        for i, order in enumerate(exponents):
            terms = squares if order is None else squares * lengths**order
            by_group = np.bincount(part.groups, weights=terms, minlength=groups)
            sums[i] += by_group.sum()
            # A single sample may stand for others like it that were not met.
            variances[int(drawn), i] += groups * by_group.var(ddof=1) + terms.max() ** 2
        degrees[int(drawn)] += groups - 1
    width = window_integral(sampling.octave, 0.0)
    deviation = float(np.sqrt(variances[:, -1].sum())) / width
    return OctaveSums(sums[:-1], variances[0, :-1], variances[1, :-1], float(sums[-1]) / width, deviation, *degrees)


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
    return np.asarray(np.sqrt(total) * students_t.ppf(_CONFIDENCE, np.maximum(effective, 1.0)))


def window_integral(octave: Octave, order: float) -> float:
    """Return ∫ window(r) (1+r²)^s dr over an octave."""

    def integrand(radius: float) -> float:
        return float(octave.window(np.array(radius)) * (1 + radius**2) ** order)

    middle = octave.highest / 2
    return float(quad(integrand, octave.lowest, middle)[0] + quad(integrand, middle, octave.highest)[0])
