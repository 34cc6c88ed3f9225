"""Accuracy that a user requests, and its division among the sources of error."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import AccuracyError, InputError
from sobolev_batch.spectral.budget import NormEstimate
from sobolev_batch.spectral.lattice import LARGEST_M, Lattice
from sobolev_batch.spectral.transform.settings import FINEST_EPS, TransformSettings
from sobolev_batch.spectral.transform.transform import projected_bytes

# Fraction of the accuracy for aliasing; the rest is for truncation and the fields' own errors.
_ALIASING_FRACTION = 0.1
# At orders below this one the tail falls so fast that a small fraction for truncation costs little.
_TRUNCATION_FRACTION, _HIGH_ORDER = 0.7, 2.0
_DEFAULT_BYTES = 2e9
# A relative distance below this one tells of rounding, of coordinates in files too, and not of the surfaces.
NEXT_TO_EQUAL = 1e-5


@dataclass(frozen=True)
class Accuracy:
    """Relative accuracy of distances, requested in place of a lattice and settings.

    Args:
        rtol: Largest error of a distance, relative to it.
        allowed_bytes: Memory that the computation of one field may take, in bytes.
        best_effort: True if the nearest that can be reached will do where the accuracy is out of reach.
        floor: Distance below which errors are relative to it, and no longer to the distance itself.

    Raises:
        InputError: rtol does not lie between 0 and 1, or the memory is not positive.
    """

    rtol: float
    allowed_bytes: float = _DEFAULT_BYTES
    best_effort: bool = False
    floor: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("rtol", self.rtol), ("memory", self.allowed_bytes)):
            if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
                raise InputError(f"{name} must be a number, found {value!r}")
        if not 0 < self.rtol < 1:
            raise InputError(f"rtol must lie between 0 and 1, found {self.rtol!r}")
        if not (math.isfinite(self.allowed_bytes) and self.allowed_bytes > 0):
            raise InputError(f"memory must be a positive number of bytes, found {self.allowed_bytes!r}")

    def met(self, estimate: NormEstimate) -> NDArray[np.bool_]:
        """Tell which numbers have an error within rtol of them, or of the floor.

        Without a floor, a zero does only if its error is zero.
        """
        return np.asarray(estimate.errors <= self.rtol * self.scale(estimate.values))

    def scale(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def truncation_part(self, order: float) -> float:
        """Return the largest relative error by truncation at an order; a small one is cheaper at lower orders."""
        return _TRUNCATION_FRACTION * min(1.0, _HIGH_ORDER / -order) * self.rtol

    def discretisation_part(self, order: float) -> float:
        """Return the largest relative error of both fields together at an order."""
        return self.rtol - self.aliasing_part - self.truncation_part(order)

    @property
    def largest_intervals(self) -> int:
        """Largest M for which two fields and the transform of one fit into the memory.

        Raises:
            InputError: Not even the smallest lattice fits.
        """
        candidates = range(2, LARGEST_M + 1, 2)
        fitting = bisect_right(candidates, self.allowed_bytes, key=_projected_bytes)
        if not fitting:
            raise InputError(
                f"{self.allowed_bytes / 1e9:.3g} GB of memory are too little; the smallest lattice takes "
                f"{_projected_bytes(2) / 1e9:.3g} GB"
            )
        return candidates[fitting - 1]


def unreachable(problem: str, rtol: float, reachable: float) -> AccuracyError:
    """Return the error for an accuracy that is out of reach, with advice.

    Args:
        problem: What cannot be reached, and why.
        rtol: Requested accuracy.
        reachable: Smallest rtol that is expected to be met.
    """
    if not reachable < 1:
        advice = "not even one digit can be reached; take a more negative order, or a best effort"
        return AccuracyError(f"{problem}; {advice}", rtol, reachable)
    # An estimate has two digits; up, so that it is met.
    unit = 10.0 ** (math.floor(math.log10(reachable)) - 1)
    reachable = min(math.ceil(reachable / unit) * unit, 1.0)
    advice = f"about {reachable:.2g} can be reached; ask for that or for a best effort, or take a more negative order"
    return AccuracyError(f"{problem}; {advice}", rtol, reachable)


def _projected_bytes(intervals: int) -> float:
    half = Lattice(1.0, intervals).half
    # An accuracy may lead to any eps, and the finest eps takes the finest grid.
    return projected_bytes(half, TransformSettings(FINEST_EPS["complex128"])) + 2 * 16 * half.size
