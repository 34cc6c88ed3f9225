"""What a lattice leaves out of a norm or distance: truncation and aliasing.

Truncation (frequencies beyond the cube) and aliasing (images at the lattice's period) follow from the same sums as the
number; discretisation comes from the fields (`transform/probe`). docs/numerics.md says how well these estimates hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, Self

import numpy as np
from scipy.special import exprel, gammaln

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.norms.bounds import bessel_logs
from sobolev_batch.transform.lattice import STEP_MIDDLE, STEP_WIDTH, SobolevWeights

# Both laws were measured on spheres, boxes, sticks and icospheres, near and far: the truncation was 0.5 to 8 times, the
# aliasing 0.25 to 2 times the true loss, or less where the narrower kernel of another order shows it.
TRUNCATION_CAUTION = 2.5
_ALIASING_CAUTION = 5.0
# With this many periods of the energy within xi_max, a trough was measured to hide no more than the tail again.
_TROUGH_PERIODS = 3.0
# Two outer ranges of |ξ|, in fractions of xi_max. The energy of a difference is extrapolated from them. Where it is
# measured beyond xi_max, they are octaves as well.
_WINDOWS, _OCTAVES = ((0.5, 0.75), (0.75, 1.0)), ((0.25, 0.5), (0.5, 1.0))
# Least power by which the energy grows below half of its ceiling, and the largest one. On a given lattice nothing but
# this law tells what lies beyond. With an accuracy, more is measured there.
_POWERS, _POWERS_IF_GIVEN = (1.0, 4.0), (2.0, 32.0)
# Surfaces end this much short of the period.
_CLEARANCE = 1.001

_CUBE = np.array(list(product(range(-3, 4), repeat=3)), dtype=np.float64)
_ODD_ENTRIES = (np.abs(_CUBE) % 2).sum(axis=1)
_PERIOD: Reals = _CUBE[(np.abs(_CUBE).max(axis=1) == 1)]
# Residues of |k|² mod 4 that make a sublattice, its index, and its further images in periods.
_SUBLATTICES: tuple[tuple[list[int], int, Reals], ...] = (
    ([0, 2], 2, _CUBE[_ODD_ENTRIES == 3] / 2),
    ([0, 3], 4, _CUBE[_ODD_ENTRIES == 2] / 2),
    ([0], 8, _CUBE[_ODD_ENTRIES > 0] / 2),
)


class Sums(NamedTuple):
    """Sums of squared fields: enough for their norms of each order and the errors of these.

    Attributes:
        totals: Squared norms (orders, ...).
        by_residue: Squared norms of the orders of `SobolevWeights.narrower` (orders, 4, ...), split by |k|² mod 4. A
            residue of 0 means that all entries of k are even, 1 and 2 that one or two are odd, 3 that all are.
        outer: Mean energy ∫_{|ξ|=r} |field|² dS over two outer ranges of r, (2, ...).
    """

    totals: Reals
    by_residue: Reals
    outer: Reals

    @classmethod
    def zeros(cls, orders: int, *shape: int) -> Self:
        """Return sums of zero for fields of a shape."""
        return cls(np.zeros((orders, *shape)), np.zeros((orders, 4, *shape)), np.zeros((2, *shape)))


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

    @property
    def least_period(self) -> float:
        """Least period 1/h of a lattice that holds the surfaces."""
        return _CLEARANCE * 2 * self.reach


def add_sums(sums: Sequence[Sums]) -> Sums:
    """Return the sums of a whole field from those of its blocks."""
    return Sums(*(np.sum(parts, axis=0) for parts in zip(*sums, strict=True)))


def sums_of_shells(shell_sums: Reals, weights: SobolevWeights) -> Sums:
    """Return the sums of fields from their sums per shell (..., shell_count)."""
    orders, residues = len(weights.orders), np.arange(weights.lattice.shell_count) % 4
    by_residue = [weights.narrower.per_shell * (residues == residue) for residue in range(4)]
    # One product for all: few rows would be summed in another order than many.
    sums = np.tensordot(np.concatenate([weights.per_shell, *by_residue, outer_windows(weights)]), shell_sums, (1, -1))
    split = sums[orders:-2].reshape(4, orders, *sums.shape[1:])
    return Sums(sums[:orders], np.moveaxis(split, 0, 1), sums[-2:])


def outer_windows(weights: SobolevWeights) -> Reals:
    """Return the weights (2, shell_count) that turn shell sums into the mean energies of `Sums.outer`."""
    lattice, ranges = weights.lattice, _WINDOWS if weights.cutoff is None else _OCTAVES
    radii = 2 / lattice.M * np.sqrt(np.arange(lattice.shell_count))
    return np.stack([((radii >= low) & (radii < high)) / ((high - low) * lattice.xi_max) for low, high in ranges])


def truncated(
    sums: Sums, weights: SobolevWeights, support: Support, highest: float | None = None, *, is_given: bool = False
) -> Reals:
    """Bound the squared norm beyond xi_max, or beyond a higher frequency (orders, ...), of a lattice chosen or given.

    The energy on |ξ| = r grows like r^p until it reaches 2 area(μ) + 2 area(ν), its mean for unrelated surfaces.
    Between two closer than the wavelength, p is 2, whatever the two ranges show, and more where detail begins. The
    energy oscillates with the surfaces' inverse width; if ξ_max covers few periods, the outer ranges may be a trough.
    """
    lattice, (least, most) = weights.lattice, _POWERS_IF_GIVEN if is_given else _POWERS
    inner, outer = sums.outer
    # A lattice of very few samples has none in the outer windows.
    outer = np.where((outer == 0) & (sums.totals > 0).any(axis=0), 2 * support.areas, outer)
    ceiling = np.maximum(2 * support.areas, outer)
    middles = [(low + high) / 2 for low, high in _WINDOWS]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        power = np.log(outer / inner) / np.log(middles[1] / middles[0])
        power = np.clip(np.nan_to_num(power, nan=0.0), 0.0, most)
        # Below half the ceiling the energy must still grow, whatever the two windows show.
        power = np.where(outer < ceiling / 2, np.maximum(power, least), power)
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
        # The tail of a lattice that reaches next to nothing is unknown.
        with np.errstate(divide="ignore", invalid="ignore"):
            tails.append(np.where(outer > 0, (growing + flat) / (2 * ratio), 0.0))
    periods = float(support.widths.max()) * lattice.xi_max
    return np.asarray(TRUNCATION_CAUTION * (1 + (_TROUGH_PERIODS / max(periods, 1e-3)) ** 2) * np.stack(tails))


def aliased(sums: Sums, weights: SobolevWeights, widths: Reals) -> Reals:
    """Estimate the contribution of images to the squared norm (orders, ...).

    A sum over a sublattice alone brings in further images, at fractions of the period. The change shows their size. The
    kernel's decay from there to the full period gives the size of the remaining images. Near-duplicates meet
    derivatives of the kernel, whose signs change within a wide peak, so that images may cancel by chance: these are
    seen with a narrower one. Under a step the kernel has a tail in which it oscillates, and which may reach images that
    are not close: see `step_images`.
    """
    spacing, whole, estimates = weights.lattice.spacing, sums.by_residue.sum(axis=1), []
    orders = list(zip(weights.orders, weights.narrower.orders, strict=True))
    for residues, index, fractions in _SUBLATTICES:
        change = np.abs(index * sums.by_residue[:, residues].sum(axis=1) - whole)
        decay = [
            narrower / order * image_weight(spacing, order, widths) / image_weight(spacing, narrower, widths, fractions)
            for order, narrower in orders
        ]
        estimates.append(change * np.reshape(decay, (-1, *[1] * (change.ndim - 1))))
    return np.asarray(_ALIASING_CAUTION * np.max(estimates, axis=0) + step_images(sums, weights, widths))


def step_images(sums: Sums, weights: SobolevWeights, widths: Reals) -> Reals:
    """Bound what the end of a step makes of images at the period in the squared norm (orders, ...); 0 without one.

    An image at a distance d is ∫ step(r) (1 + r²)^s E(r) cos(2πrd) dr where all of the energy E belongs to faces
    parallel to their images, and less where not. On scales above a unit of length, where the weight hardly falls, that
    is what the fall of the step leaves: its width decides how fast it fades, and its middle how large it is.
    """
    if weights.cutoff is None:
        return np.zeros_like(sums.totals)
    distances, middle = image_distances(weights.lattice.spacing, widths), STEP_MIDDLE * weights.cutoff
    lengths = np.exp(-((np.pi * STEP_WIDTH * weights.cutoff * distances) ** 2)) / (2 * np.pi * distances + 1 / middle)
    factors = lengths.sum() * (1 + middle**2) ** np.array(weights.orders)
    return np.asarray(np.multiply.outer(factors, np.abs(sums.outer[1])))


def decay_to_period(spacing: float, order: float, widths: Reals) -> float:
    """Return the size of images at the period over that at halves of it."""
    return image_weight(spacing, order, widths) / image_weight(spacing, order, widths, _SUBLATTICES[-1][2])


def image_weight(spacing: float, order: float, widths: Reals, images: Reals = _PERIOD) -> float:
    """Sum the kernel over the least distances of surfaces to their images at n/h, relative to its peak.

    The spacing h is in cycles per unit length; the widths are those along `DIRECTIONS`; the images are n (..., 3).
    """
    distances = image_distances(spacing, widths, images)
    # Above order -3/2 the kernel has no finite peak but the same decay: take the nearest order with one.
    nu = max(-order - 1.5, 0.25)
    logs = bessel_logs(nu, distances) - gammaln(nu) - (nu - 1) * np.log(2)
    # Never exactly zero, so that ratios exist.
    return float(np.sum(np.maximum(np.exp(np.minimum(logs, 0.0)), 1e-280)))


def image_distances(spacing: float, widths: Reals, images: Reals = _PERIOD) -> Reals:
    """Return bounds on the least distances (n,) of surfaces to their images, from below; see `image_weight`."""
    # The least distance of S to S + v is at least v·u - width(u), for every direction u.
    return np.asarray(np.maximum((np.abs(images @ DIRECTIONS.T) / spacing - widths).max(axis=1), 0.0))
