"""Accuracy that a user asks for, and its division among the sources of error."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.lattice import LARGEST_M, Lattice
from sobolev_batch.spectral.transform.settings import FINEST_EPS, TransformSettings
from sobolev_batch.spectral.transform.transform import projected_bytes

# Fraction of the accuracy for aliasing; the rest is for truncation and the fields' own errors.
_ALIASING_FRACTION = 0.1
# At orders below this one the tail falls so fast that a small fraction for truncation costs little.
_TRUNCATION_FRACTION, _HIGH_ORDER = 0.7, 2.0
_DEFAULT_BYTES = 2e9


@dataclass(frozen=True)
class Accuracy:
    """Relative accuracy of distances, asked for in place of a lattice and settings.

    Args:
        rtol: Largest error of a distance, relative to it.
        allowed_bytes: Memory that the computation of one field may take, in bytes.

    Raises:
        InputError: rtol does not lie between 0 and 1, or the memory is not positive.
    """

    rtol: float
    allowed_bytes: float = _DEFAULT_BYTES

    def __post_init__(self) -> None:
        for name, value in (("rtol", self.rtol), ("memory", self.allowed_bytes)):
            if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
                raise InputError(f"{name} must be a number, found {value!r}")
        if not 0 < self.rtol < 1:
            raise InputError(f"rtol must lie between 0 and 1, found {self.rtol!r}")
        if not (math.isfinite(self.allowed_bytes) and self.allowed_bytes > 0):
            raise InputError(f"memory must be a positive number of bytes, found {self.allowed_bytes!r}")

    def met(self, estimate: NormEstimate) -> NDArray[np.bool_]:
        """Tell which numbers have an error within rtol of them. A zero does only if its error is zero."""
        return np.asarray(estimate.errors <= self.rtol * estimate.values)

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


def _projected_bytes(intervals: int) -> float:
    half = Lattice(1.0, intervals).half
    # An accuracy may lead to any eps, and the finest eps takes the finest grid.
    return projected_bytes(half, TransformSettings(FINEST_EPS["complex128"])) + 2 * 16 * half.size
