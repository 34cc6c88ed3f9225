"""From the accuracy that is asked for to the lattice that gives it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.spectral.errors.budget import (
    ALIASING_CAUTION,
    TRUNCATION_CAUTION,
    NormEstimate,
    Sums,
    aliased,
    image_weight,
    truncated,
)
from sobolev_batch.spectral.lattice import LARGEST_M, Lattice
from sobolev_batch.spectral.transform.settings import FINEST_EPS, TransformSettings
from sobolev_batch.spectral.transform.transform import projected_bytes

Reals = NDArray[np.float64]

# The part of the accuracy that aliasing may use up; the rest is for truncation and the fields' own errors.
_ALIASING_SHARE = 0.1
# At orders below this one the tail falls so fast that leaving it less costs little.
_TRUNCATION_SHARE, _HIGH_ORDER = 0.7, 2.0
_DEFAULT_MEMORY = 2e9
# Before anything is known of a pair: how much larger than the kernel alone says its images are, and
# by how much a tail may exceed that of two surfaces close to each other.
_IMAGE_MARGIN, _TAIL_MARGIN = 30.0, 2.0
# Where those laws ask for more than this, a lattice of this size finds out first.
_PILOT_M = 64
# Before an accuracy is refused, a larger one may look further.
_LARGER_PILOT_M = 128
_HIGHEST_FREQUENCY = 1e4
# Surfaces end this much short of the period.
_ROOM = 1.001
# What is called reachable must hold when it is asked for, on a pilot that differs a little.
_PROMISE = 1.5
_STEP = 1.04


@dataclass(frozen=True)
class Accuracy:
    """What is asked of distances instead of a lattice and settings.

    Args:
        rtol: largest error of a distance, relative to it.
        memory: bytes that the computing of one field may take.

    Raises:
        InputError: an rtol that is not between 0 and 1, or memory that is not positive.
    """

    rtol: float
    memory: float = _DEFAULT_MEMORY

    def __post_init__(self) -> None:
        for name in ("rtol", "memory"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
                raise InputError(f"{name} must be a number, found {value!r}")
        if not 0 < self.rtol < 1:
            raise InputError(f"rtol must lie between 0 and 1, found {self.rtol!r}")
        if not (math.isfinite(self.memory) and self.memory > 0):
            raise InputError(f"memory must be a positive number of bytes, found {self.memory!r}")

    def met(self, found: NormEstimate) -> NDArray[np.bool_]:
        """Which numbers have an error within rtol of them; of a zero, only where nothing is uncertain about it."""
        return np.asarray(found.errors <= self.rtol * found.values)

    @property
    def aliasing_part(self) -> float:
        """The largest error by aliasing, relative."""
        return _ALIASING_SHARE * self.rtol

    def truncation_part(self, order: float) -> float:
        """The largest error by truncation at an order, relative: the lower the order, the cheaper a small one."""
        return _TRUNCATION_SHARE * min(1.0, _HIGH_ORDER / -order) * self.rtol

    def discretisation_part(self, order: float) -> float:
        """The largest error of both fields together at an order, relative."""
        return self.rtol - self.aliasing_part - self.truncation_part(order)

    @property
    def largest_intervals(self) -> int:
        """The largest M whose fields fit into the memory, two of them and the transform that makes one.

        Raises:
            InputError: not even the smallest lattice fits.
        """
        candidates = range(2, LARGEST_M + 1, 2)
        fitting = bisect_right(candidates, self.memory, key=self._bytes)
        if not fitting:
            raise InputError(
                f"{self.memory / 1e9:.3g} GB of memory are too little, {self._bytes(2) / 1e9:.3g} GB the least"
            )
        return candidates[fitting - 1]

    @staticmethod
    def _bytes(intervals: int) -> float:
        half = Lattice(1.0, intervals).half
        # What is asked for may lead to any eps, and the finest takes the finest grid.
        return projected_bytes(half, TransformSettings(FINEST_EPS["complex128"])) + 2 * 16 * half.size


def first_lattice(widths: Reals, reach: float, orders: Sequence[float], accuracy: Accuracy) -> tuple[Lattice, bool]:
    """The lattice that two surfaces close to each other need, before anything else is known of them.

    Their energy then grows like |ξ|², which makes the tail beyond ξ_max a closed form. Where that is
    too much to compute without having looked, the lattice is a pilot.

    Args:
        widths: extents (13,) of all surfaces together, see `support_widths`.
        reach: their largest |coordinate|: the period is above twice that.
        orders: s, each.
        accuracy: what is asked for.

    Returns:
        A lattice, and whether it is a pilot that is likely to be `refined`.
    """
    period = max(_first_period(widths, orders, accuracy), _ROOM * 2 * reach)
    radii = np.geomspace(0.5, _HIGHEST_FREQUENCY, 400)
    highest = radii[0]
    for order in orders:
        # ∫_x^∞ r² (1+r²)^s dr over the same from zero; it diverges from order -3/2 on.
        tails = betainc(max(-order - 1.5, 1e-9), 1.5, 1 / (1 + radii**2))
        allowed = accuracy.truncation_part(order) / (TRUNCATION_CAUTION * _TAIL_MARGIN / 2)
        enough = np.flatnonzero(tails <= allowed)
        highest = max(highest, radii[enough[0]] if enough.size and order < -1.5 else radii[-1])
    most = min(_PILOT_M, accuracy.largest_intervals)
    return lattice_of(highest, period, most), 2 * highest * period > most


def larger_pilot(lattice: Lattice, accuracy: Accuracy) -> Lattice | None:
    """A pilot that sees further than one from which an accuracy seemed out of reach, or None."""
    intervals = min(_LARGER_PILOT_M, accuracy.largest_intervals)
    return Lattice(intervals * lattice.spacing / 2, intervals) if intervals > lattice.M else None


def lattice_of(highest: float, period: float, most: int) -> Lattice:
    """The lattice of a period 1/h that reaches to a frequency, or as far as M allows.

    Args:
        highest: the frequency, in cycles per unit length; what a good M leaves over goes beyond it.
        period: 1/h, in units of length.
        most: bound of M.
    """
    intervals = most if 2 * highest * period > most else min(good_intervals(2 * highest * period), most)
    return Lattice(intervals / (2 * period), intervals)


def refined(
    lattice: Lattice, sums: Sums, orders: Sequence[float], accuracy: Accuracy, *, areas: Reals, widths: Reals, what: str
) -> Lattice:
    """The lattice that distances need, from their sums on a smaller one.

    Args:
        lattice: on which the sums were taken.
        sums: of the difference of a pair of surfaces, or of several pairs.
        orders: s, each.
        accuracy: what is asked for.
        areas: (...) of both surfaces of a pair together.
        widths: extents (13,) of all surfaces together.
        what: names the pair in the message.

    Returns:
        A lattice at least as fine and as large as the given one.

    Raises:
        AccuracyError: it does not fit into the memory; says what does.
    """
    totals: Reals = sums.squares.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        images = np.nan_to_num(aliased(sums, lattice, orders, widths) / (2 * totals), posinf=0.0)
    images = images.reshape(len(orders), -1).max(axis=1)
    period = 1 / lattice.spacing
    before = np.array([image_weight(1 / period, order, widths) for order in orders])
    while period < 1 / lattice.spacing + 8 and any(
        image * image_weight(1 / period, order, widths) / weight > accuracy.aliasing_part
        for image, order, weight in zip(images, orders, before, strict=True)
    ):
        period += 0.02 / lattice.spacing

    def tail(highest: float) -> Reals:
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = np.nan_to_num(truncated(sums, lattice, orders, areas, widths, highest) / (2 * totals), posinf=0.0)
        return np.asarray(parts.reshape(len(orders), -1).max(axis=1))

    most = accuracy.largest_intervals
    highest = lattice.xi_max
    allowed = np.array([accuracy.truncation_part(order) for order in orders])
    while np.any(tail(highest) > allowed):
        highest *= _STEP
        if 2 * highest * period > most:
            parts = tail(max(most / (2 * period), lattice.xi_max)) / allowed
            worst = int(np.argmax(parts))
            reachable = _rounded_up(_PROMISE * float(parts[worst]) * accuracy.rtol)
            within = f"within {accuracy.memory / 1e9:.3g} GB (M <= {most})"
            instead = f"{within} about {reachable:g} can be reached; ask for that, allow more memory, or take"
            if reachable >= 1:
                instead = f"{within} not even one digit can be had; allow more memory or take"
            raise AccuracyError(
                f"{what}: rtol {accuracy.rtol:g} is out of reach at order {orders[worst]:g}: {instead} "
                "a more negative order",
                accuracy.rtol,
                reachable,
            )
    return lattice_of(highest, period, most)


def good_intervals(least: float) -> int:
    """An even M of at least so much for which the FFT of the fine grid is quick and wasted on nothing."""
    smallest = 2 * math.ceil(least / 2)
    choices = range(smallest, smallest + max(8, smallest // 8), 2)
    return min(choices, key=lambda M: (_grid(M + 1) ** 2 * _grid(M // 2 + 1), -M))


def _grid(modes: int) -> int:
    """The even number of grid points without prime factors above 5 that a doubled axis of modes gets."""
    count = 2 * modes
    while True:
        rest = count
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return count
        count += 2


def _first_period(widths: Reals, orders: Sequence[float], accuracy: Accuracy) -> float:
    period = float(widths.max())
    allowed = accuracy.aliasing_part / (ALIASING_CAUTION * _IMAGE_MARGIN / 2)
    while any(image_weight(1 / period, order, widths) > allowed for order in orders):
        period *= 1.01
    return period


def _rounded_up(value: float) -> float:
    """Two digits are as many as an estimate has."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit) * unit
