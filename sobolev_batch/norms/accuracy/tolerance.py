"""Accuracy that a user requests: its division among the sources of error, and the lattices that give it.

A first lattice follows from the sizes of surfaces, a refined one from their sums.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, repeat, takewhile
from operator import mul

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.special import betainc

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.geometry.surface import is_finite_number
from sobolev_batch.norms import budget
from sobolev_batch.norms.budget import Sums, Support
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.transform.fourier import TransformSettings, projected_bytes
from sobolev_batch.transform.lattice import LARGEST_M, Lattice, SobolevWeights
from sobolev_batch.transform.nufft_costs import FINEST_EPS

# Fraction of the accuracy for aliasing; the rest is for truncation and the fields' own errors.
_ALIASING_FRACTION = 0.1
# At orders below this one the tail falls so fast that a small fraction for truncation costs little.
_TRUNCATION_FRACTION, _HIGH_ORDER = 0.7, 2.0
_DEFAULT_BYTES = 2e9
# A relative distance below this one tells of rounding, of coordinates in files too, and not of the surfaces.
NEXT_TO_EQUAL = 1e-5
# Below this rtol, octaves would take too many samples.
LEAST_OF_OCTAVES = 1e-4
# Before a pair is measured: how much larger than the kernel alone predicts its images may be, and
# how much larger its tail than that of two surfaces close to each other.
_IMAGE_MARGIN, _TAIL_MARGIN = 150.0, 2.0
# If those laws ask for more than this, a pilot lattice of this size measures the pair first.
_PILOT_M = 64
_HIGHEST_FREQUENCY = 1e4
# Surfaces may be as small as a point, but the kernel is a unit of length wide.
_LEAST_WIDTH = 0.01
# An accuracy called reachable must hold when it is requested, on a pilot that differs a little.
_REACHABLE_MARGIN = 1.5
_STEP = 1.04
# Factor of the M of a lattice with octaves whose images are too large.
FINER_LATTICE = 1.15
# Wavelengths of the end of a step after which its images have faded to 3e-6 of the sum under it.
_STEP_WAVES = 11.0
# At this distance the kernel exp(-2πr) is below the smallest double.
_VANISHED = 120.0


@dataclass(frozen=True)
class Accuracy:
    """Relative accuracy of distances, requested in place of a lattice and settings; InputError where out of range.

    Args:
        rtol: Largest error of a distance, relative to it.
        allowed_bytes: Memory that the computation of one field may take, in bytes.
        best_effort: True if the nearest that can be reached will do where the accuracy is out of reach.
        floor: Distance below which errors are relative to it, and no longer to the distance itself.
    """

    rtol: float
    allowed_bytes: float = _DEFAULT_BYTES
    best_effort: bool = False
    floor: float = 0.0

    def __post_init__(self) -> None:
        if not (is_finite_number(self.rtol) and 0 < self.rtol < 1):
            raise InputError(f"rtol must be a number between 0 and 1, found {self.rtol!r}")

    def met(self, estimate: NormEstimate) -> NDArray[np.bool_]:
        """Tell which numbers have an error within rtol of them, or of the floor; for zero without one, no error."""
        return np.asarray(estimate.errors <= self.rtol * self.scale(estimate.values))

    def scale(self, values: Reals) -> Reals:
        """Return what errors of norms or distances are relative to: themselves, or the floor."""
        return np.maximum(values, self.floor)

    @property
    def asks_for_memory(self) -> bool:
        """True if it allows more memory than it would by default."""
        return self.allowed_bytes > _DEFAULT_BYTES

    @property
    def aliasing_part(self) -> float:
        """Largest relative error by aliasing."""
        return _ALIASING_FRACTION * self.rtol

    def truncation_parts(self, orders: Sequence[float]) -> Reals:
        """Return the largest relative error by truncation (orders,); a small one is cheaper at lower orders."""
        return np.asarray(_TRUNCATION_FRACTION * np.minimum(1.0, _HIGH_ORDER / -np.array(orders)) * self.rtol)

    def discretisation_parts(self, orders: Sequence[float]) -> Reals:
        """Return the largest relative error of both fields together (orders,)."""
        return self.rtol - self.aliasing_part - self.truncation_parts(orders)

    @property
    def largest_intervals(self) -> int:
        """Largest M for which two fields and the transform of one fit into the memory; InputError where none does."""
        candidates = range(2, LARGEST_M + 1, 2)
        if not (fitting := bisect_right(candidates, self.allowed_bytes, key=_projected_bytes)):
            found, least = self.allowed_bytes / 1e9, _projected_bytes(2) / 1e9
            raise InputError(f"{found:.3g} GB of memory are too little; the smallest lattice takes {least:.3g} GB")
        return candidates[fitting - 1]


def unreachable(label: str, order: float, limits: str, rtol: float, reachable: float) -> AccuracyError:
    """Return the error for an rtol that is out of reach by some limits, with advice by the smallest one that is not."""
    found, advice = "not even one digit can be reached", "take a more negative order, or a best effort"
    if reachable < 1:
        # An estimate has two digits; up, so that it is met.
        unit = 10.0 ** (math.floor(math.log10(reachable)) - 1)
        reachable = min(math.ceil(reachable / unit) * unit, 1.0)
        found = f"about {reachable:.2g} can be reached"
        advice = "ask for that or for a best effort, or take a more negative order"
    if rtol < LEAST_OF_OCTAVES < reachable:
        found += f" on one lattice; an rtol from {LEAST_OF_OCTAVES:g} on permits octaves, which may reach more"
    problem = f"{label}: rtol {rtol:g} is out of reach at order {order:g} {limits}"
    return AccuracyError(f"{problem}; {found}; {advice}", rtol, reachable)


def _projected_bytes(intervals: int) -> float:
    half = Lattice(1.0, intervals).half
    # An accuracy may lead to any eps, and the finest eps takes the finest grid.
    return projected_bytes(half, TransformSettings(FINEST_EPS["complex128"])) + 2 * 16 * half.size


def first_lattice(support: Support, orders: Sequence[float], accuracy: Accuracy) -> tuple[Lattice, bool]:
    """Return the lattice for two surfaces close to each other, before anything else is known of them.

    Their energy then grows like |ξ|², which makes the tail beyond ξ_max a closed form. If that requires a large
    lattice, the result is a small pilot lattice, which is likely to be `refined`, and True.
    """
    period = _first_period(support, orders, accuracy)
    radii = np.geomspace(0.5, _HIGHEST_FREQUENCY, 400)
    highest = radii[0]
    parts = accuracy.truncation_parts(orders) / (budget.TRUNCATION_CAUTION * _TAIL_MARGIN / 2)
    for order, allowed in zip(orders, parts, strict=True):
        # ∫_x^∞ r² (1+r²)^s dr over the same from zero; it diverges from order -3/2 on.
        tails = betainc(max(-order - 1.5, 1e-9), 1.5, 1 / (1 + radii**2))
        enough = np.flatnonzero(tails <= allowed)
        highest = max(highest, radii[enough[0]] if enough.size and order < -1.5 else radii[-1])
    most = min(_PILOT_M, accuracy.largest_intervals)
    return lattice_of(highest, period, most), 2 * highest * period > most


def core_lattice(support: Support, orders: Sequence[float], accuracy: Accuracy) -> Lattice:
    """Return a small lattice whose period holds the surfaces and their images apart, for the innermost frequencies.

    Octaves of larger lattices measure the rest, so that its M can be the same for every accuracy. In large units of
    length not the kernel, but the step at its end decides how far apart images are to be: then it is finer.
    """
    first, largest = _first_period(support, orders, accuracy), accuracy.largest_intervals
    lattice = lattice_of(_HIGHEST_FREQUENCY, first, min(_PILOT_M, largest))
    reach = _STEP_WAVES / lattice.xi_max
    period = next(it for it in _growing(first) if budget.image_distances(1 / it, support.widths).min() >= reach)
    if period == first:
        return lattice
    intervals = min(good_intervals(2 * lattice.xi_max * period), largest)
    return Lattice(min(lattice.xi_max, intervals / (2 * period)), intervals)


def lattice_of(highest: float, period: float, most: int) -> Lattice:
    """Return the lattice of a period 1/h that reaches to a frequency, or to the one that the largest M allows.

    A good M may reach beyond it. Frequencies are in cycles per unit length.
    """
    intervals = most if 2 * highest * period > most else min(good_intervals(2 * highest * period), most)
    return Lattice(intervals / (2 * period), intervals)


def refined(sums: Sums, weights: SobolevWeights, support: Support, accuracy: Accuracy, label: str) -> Lattice:
    """Return the lattice that distances need, from their sums on a smaller one with these weights.

    It is at least as fine and as large as the smaller one. A best effort takes the largest one at last; else
    AccuracyError, with the reachable rtol, where the lattice does not fit into the memory.
    """
    lattice, orders = weights.lattice, weights.orders
    period = _refined_period(sums, weights, support.widths, accuracy)

    def tail(highest: float) -> Reals:
        with np.errstate(divide="ignore", invalid="ignore"):
            tails = np.nan_to_num(budget.truncated(sums, weights, support, highest) / (2 * sums.totals), posinf=0.0)
        return np.asarray(tails.reshape(len(orders), -1).max(axis=1))

    most, allowed = accuracy.largest_intervals, accuracy.truncation_parts(orders)
    larger = _growing(lattice.xi_max, _STEP)
    candidates = [next(larger), *takewhile(lambda highest: 2 * highest * period <= most, larger)]
    nearest = _HIGHEST_FREQUENCY if accuracy.best_effort else None
    highest = next((highest for highest in candidates if not np.any(tail(highest) > allowed)), nearest)
    if highest is None:
        excess = tail(max(most / (2 * period), lattice.xi_max)) / allowed
        worst = int(np.argmax(excess))
        reachable = _REACHABLE_MARGIN * float(excess[worst]) * accuracy.rtol
        limits = f"within {accuracy.allowed_bytes / 1e9:.3g} GB of memory (M <= {most}; more permits a larger one)"
        raise unreachable(label, orders[worst], limits, accuracy.rtol, reachable)
    return lattice_of(highest, period, most)


def good_intervals(least: float) -> int:
    """Return an even M of at least ``least`` for which the FFT of the fine grid is fast and hardly padded."""
    smallest = 2 * math.ceil(least / 2)
    choices = range(smallest, smallest + max(8, smallest // 8), 2)
    # The fine grid has twice as many points along each axis.
    return min(choices, key=lambda M: (next_fast_len(M + 1, real=True) ** 2 * next_fast_len(M // 2 + 1, real=True), -M))


def _refined_period(sums: Sums, weights: SobolevWeights, widths: Reals, accuracy: Accuracy) -> float:
    """Return the period 1/h at which the images that the sums show are small enough."""
    with np.errstate(divide="ignore", invalid="ignore"):
        images = np.nan_to_num(budget.aliased(sums, weights, widths) / (2 * sums.totals), posinf=0.0)
    images = images.reshape(len(weights.orders), -1).max(axis=1)
    first = 1 / weights.lattice.spacing
    before = [budget.image_weight(1 / first, order, widths) for order in weights.orders]

    def suffices(period: float) -> bool:
        return period >= first + 8 or not any(
            image * budget.image_weight(1 / period, order, widths) / weight > accuracy.aliasing_part
            for image, order, weight in zip(images, weights.orders, before, strict=True)
        )

    return next(filter(suffices, accumulate(repeat(0.02 / weights.lattice.spacing), initial=first)))


def _first_period(support: Support, orders: Sequence[float], accuracy: Accuracy) -> float:
    """Return the period 1/h that holds surfaces, and at which the kernel predicts images that are small enough."""
    allowed = accuracy.aliasing_part / (_IMAGE_MARGIN / 2)
    widths, widest = support.widths, float(support.widths.max())

    def suffices(period: float) -> bool:
        farthest = period > widest + _VANISHED
        return farthest or all(budget.image_weight(1 / period, order, widths) <= allowed for order in orders)

    return max(next(filter(suffices, _growing(max(widest, _LEAST_WIDTH)))), support.least_period)


def _growing(first: float, factor: float = 1.01) -> Iterator[float]:
    return accumulate(repeat(factor), mul, initial=first)
