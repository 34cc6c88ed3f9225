"""A smooth partition of frequency space: an innermost ball, and octaves of |ξ| around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

Reals = NDArray[np.float64]

# The step falls from one to zero between this fraction of the cutoff and the cutoff.
_FLAT_FRACTION = 0.5
# At the ends of the fall it is off by erfc(3)/2 = 1e-5, on both sides of the cut: the partition stays one.
_STEEPNESS = 3.0


def smooth_step(radii: Reals, cutoff: float) -> Reals:
    """Return a smooth function of |ξ| that is 1 up to half the cutoff and 0 from the cutoff on.

    Where a sharp cut would spoil it, the trapezoidal rule stays spectrally accurate.
    """
    middle, width = (1 + _FLAT_FRACTION) / 2, (1 - _FLAT_FRACTION) / 2
    fractions = np.asarray(radii, dtype=np.float64) / cutoff
    steps = 0.5 * erfc(_STEEPNESS * (fractions - middle) / width)
    return np.where(fractions <= _FLAT_FRACTION, 1.0, np.where(fractions >= 1, 0.0, steps))


@dataclass(frozen=True)
class Octave:
    """A smooth shell of frequencies around an innermost ball.

    Attributes:
        cutoff: Radius at which the ball's `smooth_step` ends, in cycles per unit length.
        index: Number of the octave, from 1.
    """

    cutoff: float
    index: int

    @property
    def lowest(self) -> float:
        """Least |ξ| of the octave, in cycles per unit length."""
        return _FLAT_FRACTION * self.highest / 2

    @property
    def highest(self) -> float:
        """Largest |ξ| of the octave."""
        return self.cutoff * 2.0**self.index

    def window(self, radii: Reals) -> Reals:
        """Return the weight of this octave at some |ξ|; the ball and all octaves add up to one."""
        return smooth_step(radii, self.highest) - smooth_step(radii, self.highest / 2)
