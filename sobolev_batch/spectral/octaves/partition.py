"""A smooth partition of frequency space: an innermost ball, and octaves of |ξ| around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.shells import STEP_START, smooth_step

Reals = NDArray[np.float64]


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
        return STEP_START * self.highest / 2

    @property
    def highest(self) -> float:
        """Largest |ξ| of the octave."""
        return self.cutoff * 2.0**self.index

    def window(self, radii: Reals) -> Reals:
        """Return the weight of this octave at some |ξ|; the ball and all octaves add up to one."""
        return smooth_step(radii, self.highest) - smooth_step(radii, self.highest / 2)
