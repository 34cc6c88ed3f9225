"""Errors of a norm or distance: truncation, aliasing and discretisation.

Truncation (frequencies beyond the cube) and aliasing (images of the surfaces at the lattice's period)
follow from the same sums as the number itself; discretisation comes from the probes of the fields.
docs/numerics.md says how well these estimates hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Self

import numpy as np
from scipy.special import beta, exprel, gamma, gammaln, kve, zeta

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.transform.lattice import SobolevWeights

# Both laws were measured on spheres, boxes, sticks and icospheres, near and far: the truncation was
# 0.5 to 8 times, the aliasing 0.25 to 2 times the true loss.
TRUNCATION_CAUTION = 2.5
ALIASING_CAUTION = 5.0
# With this many periods of the energy within xi_max, a trough was measured to hide no more than the tail again.
_TROUGH_PERIODS = 3.0
# Two outer ranges of |ξ|, in fractions of xi_max. The energy of a difference is extrapolated from them. Where it is
# measured beyond xi_max, they are octaves as well.
_WINDOWS, _OCTAVES = ((0.5, 0.75), (0.75, 1.0)), ((0.25, 0.5), (0.5, 1.0))

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
    """Sums of squared fields: enough for their norms of each order and the errors of these.

    Attributes:
        squares: Squared norms (orders, 4, ...), split by |k|² mod 4. A residue of 0 means that all
            entries of k are even, 1 and 2 that one or two are odd, 3 that all are.
        outer: Mean energy ∫_{|ξ|=r} |field|² dS over two outer ranges of r, (2, ...).
    """

    squares: Reals
    outer: Reals

    @classmethod
    def zeros(cls, orders: int, *shape: int) -> Sums:
        """Return sums of zero for fields of a shape."""
        return cls(np.zeros((orders, 4, *shape)), np.zeros((2, *shape)))

    @property
    def totals(self) -> Reals:
        """Squared norms (orders, ...)."""
        return np.asarray(self.squares.sum(axis=1))


@dataclass(frozen=True, eq=False)
class Support:
    """Sizes of the surfaces behind a norm or distance, in units of length.

    Attributes:
        areas: Area of the surface, or of both together, (...).
        widths: Widths of all surfaces together along `DIRECTIONS`, (13,).
        reach: Largest |coordinate| of them; lattices are chosen by it.
    """

    areas: Reals
    widths: Reals
    reach: float = 0.0


# Of an error, in the order of `NormEstimate`.
PARTS = ("truncation", "aliasing", "discretisation", "statistical")
# Of a distance, each with its error, in the order of `ReferenceEstimate.parts`.
AREA_AND_SHAPE = ("area_part", "area_part_error", "shape_part", "shape_part_error")


@dataclass(frozen=True)
class NormEstimate:
    """Norms or distances with their errors, each (orders, ...).

    Attributes:
        truncation: Bound on the error by frequencies beyond the highest one; without octaves they can only add.
        aliasing: Estimate of the change by the lattice's spacing, either way.
        discretisation: Bound on the error by the triangle rules and the NUFFT.
        statistical: Bound on the error by random frequencies, which holds with a probability; zero without these.
    """

    values: Reals
    truncation: Reals
    aliasing: Reals
    discretisation: Reals
    statistical: Reals = field(default_factory=lambda: np.zeros(()))

    def __iter__(self) -> Iterator[Reals]:
        yield from (self.values, self.truncation, self.aliasing, self.discretisation)
        yield np.broadcast_to(self.statistical, np.shape(self.values))

    @property
    def errors(self) -> Reals:
        """Total error: the true value differs from the reported one by no more."""
        return self.truncation + self.aliasing + self.discretisation + self.statistical

    def relative_to(self, norms: NormEstimate) -> tuple[Reals, Reals]:
        """Return the values over some norms, and bounds on the errors; see `quotients`."""
        return quotients((self.values, self.errors), (norms.values, norms.errors))

    def named(self, name: str) -> dict[str, Reals]:
        """Return the values under a name, the error, and as "error_part" its `PARTS` (orders, ..., part)."""
        return {name: self.values, "error": self.errors, "error_part": np.stack([*self][1:], axis=-1)}


def quotients(values: tuple[Reals, Reals], norms: tuple[Reals, Reals]) -> tuple[Reals, Reals]:
    """Return values over norms, and bounds on the errors, from both with their errors; NaN up to a norm's own error."""
    (value, error), (norm, norm_error) = values, norms
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = value / norm
        errors = (error + relative * norm_error) / (norm - norm_error)
    return relative, np.where(norm_error < norm, errors, np.nan)


def add_sums(sums: Sequence[Sums]) -> Sums:
    """Return the sums of a whole field from those of its blocks."""
    return Sums(np.sum([one.squares for one in sums], axis=0), np.sum([one.outer for one in sums], axis=0))


def sums_of_shells(shell_sums: Reals, weights: SobolevWeights) -> Sums:
    """Return the sums of fields from their sums per shell (..., shell_count)."""
    residues = np.arange(weights.lattice.shell_count) % 4
    by_residue = np.stack([weights.per_shell * (residues == residue) for residue in range(4)], axis=1)
    squares = np.tensordot(by_residue, shell_sums, axes=(2, -1))
    return Sums(squares, np.tensordot(outer_windows(weights), shell_sums, axes=(1, -1)))


def outer_windows(weights: SobolevWeights) -> Reals:
    """Return the weights (2, shell_count) that turn shell sums into the mean energies of `Sums.outer`."""
    lattice, ranges = weights.lattice, _WINDOWS if weights.cutoff is None else _OCTAVES
    radii = 2 / lattice.M * np.sqrt(np.arange(lattice.shell_count))
    return np.stack(
        [((radii >= low) & (radii < high)) / ((high - low) * lattice.xi_max) for low, high in ranges]
    ).astype(np.float64)


def estimate_norms(sums: Sums, weights: SobolevWeights, support: Support, discretisation: Reals) -> NormEstimate:
    """Return norms from the sums of fields or of differences, and from the norms of their own errors (orders, ...).

    The errors of both fields of a difference are added.
    """
    totals: Reals = np.maximum(sums.totals, 0.0)
    values = np.sqrt(totals)
    tails = truncated(sums, weights, support)
    images = aliased(sums, weights, support.widths)
    return NormEstimate(values, np.sqrt(totals + tails) - values, change_of_root(totals, images), discretisation)


def change_of_root(totals: Reals, changes: Reals) -> Reals:
    """Return how much the root of totals changes at most if the totals are off by some changes, either way."""
    values = np.sqrt(totals)
    lower = np.sqrt(np.maximum(totals - changes, 0.0))
    return np.asarray(np.maximum(np.sqrt(totals + changes) - values, values - lower))


def truncated(sums: Sums, weights: SobolevWeights, support: Support, highest: float | None = None) -> Reals:
    """Bound the squared norm beyond xi_max, or beyond a higher frequency (orders, ...).

    The energy on |ξ| = r grows like r^p until it reaches 2 area(μ) + 2 area(ν), its mean for unrelated
    surfaces. Between two surfaces closer than the wavelength, p is 2. The energy oscillates with the
    inverse width of the surfaces; if ξ_max covers few of these periods, the outer ranges may lie in a trough.
    """
    lattice = weights.lattice
    inner, outer = sums.outer
    # A lattice of very few samples has none in the outer windows.
    outer = np.where((outer == 0) & (sums.totals > 0).any(axis=0), 2 * support.areas, outer)
    ceiling = np.maximum(2 * support.areas, outer)
    middles = [(low + high) / 2 for low, high in _WINDOWS]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        power = np.log(outer / inner) / np.log(middles[1] / middles[0])
        power = np.clip(np.nan_to_num(power, nan=0.0), 0.0, 4.0)
        # Below half the ceiling the energy must still grow, whatever the two windows show.
        power = np.where(outer < ceiling / 2, np.maximum(power, 1.0), power)
        start = 1 + (highest or lattice.xi_max) ** 2
        reached = (middles[1] * lattice.xi_max) * (ceiling / outer) ** (1 / power)
    saturated = np.maximum(1 + np.minimum(np.nan_to_num(reached, nan=0.0), 1e150) ** 2, start)
    # With q = 1 + r², dr = dq / (2 √(q-1)), and √(q-1) >= ratio √q from xi_max on.
    ratio = np.sqrt(1 - 1 / start)
    tails = []
    for order in weights.orders:
        exponent = (power - 1) / 2 + order + 1
        growth = outer * (middles[1] * lattice.xi_max) ** -power * start**exponent * np.log(saturated / start)
        growing = growth * exprel(exponent * np.log(saturated / start))
        flat = ceiling * saturated ** (order + 0.5) / (-order - 0.5)
        # Of lattices that reach next to nothing the tail is unknown.
        with np.errstate(divide="ignore", invalid="ignore"):
            tails.append(np.where(outer > 0, (growing + flat) / (2 * ratio), 0.0))
    periods = float(support.widths.max()) * lattice.xi_max
    return np.asarray(TRUNCATION_CAUTION * (1 + (_TROUGH_PERIODS / max(periods, 1e-3)) ** 2) * np.stack(tails))


def area_bound(area: float, order: float, highest: float) -> float:
    """Return what no squared norm beyond a frequency exceeds, if no more than two layers lie in one place.

    The energy on |ξ| = r is twice the area on average, and twice that where layers reinforce each other. If surfaces
    repeat, it comes in pulses at the odd multiples of a frequency; the first may lie just beyond. Besides, no
    value of the transform is larger than the area.
    """
    factor, power = min(area_bounds(area, order), key=lambda bound: bound[0] * highest ** -bound[1])
    return float(factor * highest**-power)


def area_bounds(area: float, order: float) -> list[tuple[float, float]]:
    """Return the bounds of `area_bound` as factors and powers: factor / frequency^power."""
    power = -2 * order - 3
    bounds = [(4 * area * (1 - 4**order) * float(zeta(-2 * order)), -2 * order - 1)]
    if power > 0:
        bounds.append((4 * np.pi * area**2 / power, power))
    return bounds


def modulus_bound(area: float, orders: Reals, highest: float) -> Reals:
    """Return what no squared norm beyond a frequency exceeds (orders,), by the area; infinite from order -3/2 on."""
    powers = -2 * orders - 3
    with np.errstate(divide="ignore", over="ignore"):
        return np.where(powers > 0, 4 * np.pi * area**2 * highest**-powers / np.maximum(powers, 0.0), np.inf)


def norm_of_moves(areas: Reals, distances: Reals, orders: Sequence[float]) -> Reals:
    """Return what no norm changes by (orders,) if flat faces of some areas move by distances out of their planes.

    By Parseval's identity along a plane, the square is at most area ∫ (1 + z²)^s 4 sin²(πzd) dz. There sin² x is at
    most x^2p for all p from 0 to 1, and at high orders (1 + z²)^s at most |z|^2s. Norms of different planes add.
    """
    exponents, norms = np.linspace(0, 1, 41), []
    for a in -np.array(orders):
        p = exponents[exponents < a - 0.5]
        squares = (4 * (np.pi * distances[:, None]) ** (2 * p) * beta(p + 0.5, a - 0.5 - p)).min(axis=1)
        if a < 1.5:
            powers = 2 * np.pi * (2 * np.pi * distances) ** (2 * a - 1) / (gamma(2 * a) * -np.cos(np.pi * a))
            squares = np.minimum(squares, powers)
        norms.append(np.sqrt(np.where(distances > 0, areas * squares, 0.0)).sum())
    return np.array(norms)


def aliased(sums: Sums, weights: SobolevWeights, widths: Reals) -> Reals:
    """Estimate the contribution of images to the squared norm (orders, ...).

    A sum over a sublattice alone brings in further images, at fractions of the period. The change shows
    their size. The kernel's decay from there to the full period gives the size of the remaining images.
    """
    spacing = weights.lattice.spacing
    estimates = []
    for residues, index, fractions in _SUBLATTICES:
        change = np.abs(index * sums.squares[:, residues].sum(axis=1) - sums.totals)
        decay = [
            image_weight(spacing, order, widths) / image_weight(spacing, order, widths, fractions)
            for order in weights.orders
        ]
        estimates.append(change * np.reshape(decay, (-1, *[1] * (change.ndim - 1))))
    largest: Reals = np.max(estimates, axis=0)
    return ALIASING_CAUTION * largest


def decay_to_period(spacing: float, order: float, widths: Reals) -> float:
    """Return the size of images at the period over that at half of it, which even indices alone bring."""
    (_, _, halves) = _SUBLATTICES[-1]
    return image_weight(spacing, order, widths) / image_weight(spacing, order, widths, halves)


def image_weight(spacing: float, order: float, widths: Reals, images: Reals = _PERIOD) -> float:
    """Sum the kernel over the least distances of surfaces to their images at n/h, relative to its peak.

    The spacing h is in cycles per unit length; the widths are those along `DIRECTIONS`; the images are n (..., 3).
    """
    # The least distance of S to S + v is at least v·u - width(u), for every direction u.
    offsets = np.abs(images @ DIRECTIONS.T) / spacing
    distances = np.maximum((offsets - widths).max(axis=1), 0.0)
    # Above order -3/2 the kernel has no finite peak but the same decay: take the nearest order with one.
    nu = max(-order - 1.5, 0.25)
    # In logarithms, since powers of both signs overflow at low orders; K itself does so at small arguments.
    # Beyond the upper bound K is zero, and its routine gives up.
    arguments = np.clip(2 * np.pi * distances, 1e-6, 1e6)
    with np.errstate(over="ignore"):
        logs = nu * np.log(arguments) + np.log(kve(nu, arguments)) - arguments - gammaln(nu) - (nu - 1) * np.log(2)
    # Never exactly zero, so that ratios exist.
    return float(np.sum(np.maximum(np.exp(np.minimum(logs, 0.0)), 1e-280)))


@dataclass(frozen=True, eq=False)
class ReferenceEstimate:
    """The norm of the reference b of a distance ||a - b||, and the product <a - b, b>, each (orders,).

    Attributes:
        products: Products of the difference with the reference, in units of length.
        product_errors: Bounds on the errors of the products.
    """

    norms: NormEstimate
    products: Reals
    product_errors: Reals

    @classmethod
    def of_equal(cls, count: int) -> Self:
        """Return the estimate for equal surfaces at some orders: whatever the norm, they differ by none of it."""
        zeros = np.zeros(count)
        return cls(NormEstimate(zeros + 1, zeros, zeros, zeros), zeros, zeros)

    @classmethod
    def on_lattice(
        cls, products: Sums, distances: NormEstimate, norms: NormEstimate, weights: SobolevWeights, widths: Reals
    ) -> Self:
        """Return the estimate where the surfaces are known on a lattice alone, from the sums of <a - b, b>.

        Beyond the lattice a product is at most the product of the norms of both factors there.
        """
        ours, own = ((one.values + one.truncation) ** 2 - one.values**2 for one in (distances, norms))
        errors = np.sqrt(ours * own) + aliased(products, weights, widths)
        return cls(norms, products.totals, errors + product_rounding(distances, norms))

    def area_shares(self, distances: NormEstimate) -> tuple[Reals, Reals]:
        """Return which share of the squared distances a change of total area explains, and bounds on their errors.

        The best multiple c b of the reference explains <a - b, b>² / ||b||² of ||a - b||².
        """
        products, norms = np.abs(self.products), self.norms
        lowest, highest = self._area_bounds
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.minimum((products / (distances.values * norms.values)) ** 2, 1.0)
            fewest = lowest / (distances.values + distances.errors)
            most = highest / np.maximum(distances.values - distances.errors, 0.0)
        return shares, np.maximum(shares - fewest**2, np.minimum(most**2, 1.0) - shares)

    @property
    def _area_bounds(self) -> tuple[Reals, Reals]:
        """Bounds on |<a - b, b>| / ||b||."""
        products, norms, error = np.abs(self.products), self.norms, self.product_errors
        with np.errstate(divide="ignore", invalid="ignore"):
            lowest = np.maximum(products - error, 0.0) / (norms.values + norms.errors)
            return lowest, (products + error) / np.maximum(norms.values - norms.errors, 0.0)

    def parts(self, distances: NormEstimate) -> dict[str, Reals]:
        """Return two orthogonal parts of distances, that of area and the rest, by name, and bounds on their errors.

        For the difference e = a - b they follow from ||e||, <e, b> and ||b||. The multiple of b nearest to a is c b
        with c = 1 + <e, b>/<b, b>, in which nothing cancels for near-duplicates. Then e = (c - 1) b + (a - c b). The
        squares of the norms of both parts are good to 1e-15 of the squared distance.
        """
        (lowest, highest), values = self._area_bounds, distances.values
        least, most = np.maximum(values - distances.errors, 0.0), values + distances.errors
        with np.errstate(divide="ignore", invalid="ignore"):
            # Rounding may make the projection longer than what it projects.
            area = np.minimum(np.abs(self.products) / self.norms.values, values)
            highest = np.minimum(highest, most)
        shape, shortest, longest = (
            np.sqrt(np.maximum(distance**2 - part**2, 0.0))
            for distance, part in ((values, area), (least, highest), (most, lowest))
        )
        errors = (np.maximum(area - lowest, highest - area), np.maximum(shape - shortest, longest - shape))
        return dict(zip(AREA_AND_SHAPE, (area, errors[0], shape, errors[1]), strict=True))

    @property
    def excesses(self) -> Reals:
        """Difference from one of the multiple of the reference that is nearest to the other surface (orders,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.products / self.norms.values**2)


def product_rounding(distances: NormEstimate, norms: NormEstimate) -> Reals:
    """Return how far off products may be by the errors of the values of both factors (orders,)."""
    rounding, of_reference = distances.discretisation, norms.discretisation
    return np.asarray(rounding * (norms.values + of_reference) + of_reference * distances.values)
