"""The error of a norm or distance: what the lattice cut off, folded, and what the fields lack.

Truncation (the frequencies beyond the cube) and aliasing (images of the surfaces at the lattice's
period) are read off the very sums that make the number; discretisation comes from the fields'
probes. docs/numerics.md explains the laws and how well they hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, kve

from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import shell_weights
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS

Reals = NDArray[np.float64]

# Both laws were measured on spheres, boxes, sticks and icospheres, near and far: the truncation
# between 0.5 and 8 times, the aliasing between 0.25 and 2 times what was truly lost.
TRUNCATION_CAUTION = 2.5
ALIASING_CAUTION = 5.0
# With so many periods of the energy within xi_max, a trough was measured to hide no more than the tail again.
_TROUGH_PERIODS = 3.0
# The energy of the difference of two surfaces is followed from the first of these shells, in
# fractions of xi_max, to the second, and carried on from there.
_WINDOWS = ((0.5, 0.75), (0.75, 1.0))

_CUBE = np.array(list(product(range(-3, 4), repeat=3)), dtype=np.float64)
_ODD_ENTRIES = (np.abs(_CUBE) % 2).sum(axis=1)
_PERIOD: Reals = _CUBE[(np.abs(_CUBE).max(axis=1) == 1)]
# Residues of |k|² mod 4 that make a sublattice, its index, and its further images in periods.
_SUBLATTICES: tuple[tuple[list[int], int, Reals], ...] = (
    ([0, 2], 2, _CUBE[_ODD_ENTRIES == 3] / 2),
    ([0, 3], 4, _CUBE[_ODD_ENTRIES == 2] / 2),
    ([0], 8, _CUBE[_ODD_ENTRIES > 0] / 2),
)


@dataclass(frozen=True)
class Sums:
    """What is kept of a squared field: enough for its norm of each order and that norm's error.

    Attributes:
        squares: (orders, 4, ...) the squared norm, split by |k|² mod 4. A residue of 0 means that
            all of k is even, 1 and 2 that one or two of its entries are odd, 3 that all are.
        outer: (2, ...) mean energy ∫_{|ξ|=r} |field|² dS over two outer ranges of r.
    """

    squares: Reals
    outer: Reals

    @classmethod
    def zeros(cls, orders: int, *shape: int) -> Sums:
        """Room for what is to be added up."""
        return cls(np.zeros((orders, 4, *shape)), np.zeros((2, *shape)))


@dataclass(frozen=True)
class NormEstimate:
    """Norms or distances with their errors, each (orders, ...).

    Attributes:
        values: the numbers.
        truncation: bound on what lies beyond xi_max; it can only add to the value.
        aliasing: estimate of what the lattice's spacing adds or takes.
        discretisation: bound from the triangle rules and the NUFFT.
    """

    values: Reals
    truncation: Reals
    aliasing: Reals
    discretisation: Reals

    def __iter__(self) -> Iterator[Reals]:
        yield from (self.values, self.truncation, self.aliasing, self.discretisation)

    @property
    def errors(self) -> Reals:
        """The total: the true value lies within it of the reported one."""
        return self.truncation + self.aliasing + self.discretisation


def add_sums(parts: Sequence[Sums]) -> Sums:
    """The sums of a whole from those of its blocks."""
    return Sums(np.sum([part.squares for part in parts], axis=0), np.sum([part.outer for part in parts], axis=0))


def sums_of_shells(shell_sums: Reals, lattice: Lattice, orders: Sequence[float]) -> Sums:
    """The sums of fields from their sums per shell (..., shell_count)."""
    weights = shell_weights(lattice, orders)
    residues = np.arange(lattice.shell_count) % 4
    by_residue = np.stack([weights * (residues == residue) for residue in range(4)], axis=1)
    squares = np.tensordot(by_residue, shell_sums, axes=(2, -1))
    return Sums(squares, np.tensordot(outer_windows(lattice), shell_sums, axes=(1, -1)))


def outer_windows(lattice: Lattice) -> Reals:
    """Weights (2, shell_count) that take shell sums to the mean energies of `Sums.outer`."""
    radii = 2 / lattice.M * np.sqrt(np.arange(lattice.shell_count))
    return np.stack(
        [((radii >= low) & (radii < high)) / ((high - low) * lattice.xi_max) for low, high in _WINDOWS]
    ).astype(np.float64)


def estimate_norms(
    sums: Sums, lattice: Lattice, orders: Sequence[float], *, areas: Reals, widths: Reals, discretisation: Reals
) -> NormEstimate:
    """Square roots of squared norms, with their errors.

    Args:
        sums: of the fields or of their differences.
        lattice: on which they were summed.
        orders: s, each.
        areas: (...) the area of the surface, or of both together.
        widths: (13,) extents of all surfaces together along `DIRECTIONS`.
        discretisation: (orders, ...) norms of the fields' errors, those of both added.
    """
    totals: Reals = np.maximum(sums.squares.sum(axis=1), 0.0)
    values = np.sqrt(totals)
    beyond = truncated(sums, lattice, orders, areas, widths)
    images = aliased(sums, lattice, orders, widths)
    return NormEstimate(
        values,
        np.sqrt(totals + beyond) - values,
        # The larger of the two sides: the square may come out too large as well as too small.
        np.maximum(np.sqrt(totals + images) - values, values - np.sqrt(np.maximum(totals - images, 0.0))),
        discretisation,
    )


def truncated(
    sums: Sums,
    lattice: Lattice,
    orders: Sequence[float],
    areas: Reals,
    widths: Reals,
    highest: float | None = None,
) -> Reals:
    """Bound on the squared norm beyond xi_max, or beyond a frequency above it (orders, ...).

    The energy on |ξ| = r grows like r^p, as it does for two surfaces apart by less than the
    wavelength (p = 2), until it reaches 2 area(μ) + 2 area(ν), its mean for unrelated surfaces.
    It oscillates with the inverse width of the surfaces; where ξ_max covers few of these periods, the
    outer ranges may lie in a trough.
    """
    inner, outer = sums.outer
    ceiling = np.maximum(2 * areas, outer)
    middles = [(low + high) / 2 for low, high in _WINDOWS]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        power = np.log(outer / inner) / np.log(middles[1] / middles[0])
        power = np.clip(np.nan_to_num(power, nan=0.0), 0.0, 4.0)
        # Below half the ceiling the growth must still come, whatever two windows say.
        power = np.where(outer < ceiling / 2, np.maximum(power, 1.0), power)
        start = 1 + (highest or lattice.xi_max) ** 2
        reached = (middles[1] * lattice.xi_max) * (ceiling / outer) ** (1 / power)
    saturated = np.maximum(1 + np.minimum(np.nan_to_num(reached, nan=0.0), 1e150) ** 2, start)
    # With q = 1 + r², dr = dq / (2 √(q-1)), and √(q-1) is at least this part of √q from xi_max on.
    part = np.sqrt(1 - 1 / start)
    tails = []
    for order in orders:
        exponent = (power - 1) / 2 + order + 1
        growth = outer * (middles[1] * lattice.xi_max) ** -power * start**exponent * np.log(saturated / start)
        growing = growth * _exprel(exponent * np.log(saturated / start))
        flat = ceiling * saturated ** (order + 0.5) / (-order - 0.5)
        tails.append(np.where(outer > 0, (growing + flat) / (2 * part), 0.0))
    periods = float(widths.max()) * lattice.xi_max
    return TRUNCATION_CAUTION * (1 + (_TROUGH_PERIODS / max(periods, 1e-3)) ** 2) * np.stack(tails)


def aliased(sums: Sums, lattice: Lattice, orders: Sequence[float], widths: Reals) -> Reals:
    """Estimate of the images' part in the squared norm (orders, ...).

    Summing over a sublattice alone brings in further images, at fractions of the period. How much
    that changes the sum tells their size, and the kernel's decay from there to the full period the
    size of the images that the sum itself has.
    """
    full = sums.squares.sum(axis=1)
    estimates = []
    for residues, index, fractions in _SUBLATTICES:
        change = np.abs(index * sums.squares[:, residues].sum(axis=1) - full)
        decay = [
            image_weight(lattice.spacing, order, widths) / image_weight(lattice.spacing, order, widths, fractions)
            for order in orders
        ]
        estimates.append(change * np.reshape(decay, (-1, *[1] * (change.ndim - 1))))
    largest: Reals = np.max(estimates, axis=0)
    return ALIASING_CAUTION * largest


def image_weight(spacing: float, order: float, widths: Reals, images: Reals = _PERIOD) -> float:
    """The kernel summed over the least distances of surfaces to their images at n/h, relative to its peak.

    Args:
        spacing: h.
        order: s.
        widths: see `support_widths`.
        images: n, (..., 3); by default all that differ by one period or none along each axis.
    """
    # The least distance of S to S + v is at least v·u - width(u), for every direction u.
    offsets = np.abs(images @ DIRECTIONS.T) / spacing
    distances = np.maximum((offsets - widths).max(axis=1), 0.0)
    # Of order above -3/2 the kernel has no finite peak, but the same decay: the nearest order that has.
    nu = max(-order - 1.5, 0.25)
    # In logarithms, since powers of both signs overflow at low orders; at small arguments K does, at the peak.
    arguments = np.maximum(2 * np.pi * distances, 1e-6)
    with np.errstate(over="ignore"):
        logs = nu * np.log(arguments) + np.log(kve(nu, arguments)) - arguments - gammaln(nu) - (nu - 1) * np.log(2)
    # Never exactly zero, so that ratios of it exist: 1e-280 is as good as nothing.
    return float(np.sum(np.maximum(np.exp(np.minimum(logs, 0.0)), 1e-280)))


def _exprel(x: Reals) -> Reals:
    """(exp(x) - 1) / x, 1 at zero."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(np.abs(x) < 1e-12, 1.0, np.expm1(x) / x)
