"""Extents of surfaces along fixed directions: how far they reach, and how far apart they are at least."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

_NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)], dtype=np.float64)
DIRECTIONS: Reals = _NEIGHBOURS / np.linalg.norm(_NEIGHBOURS, axis=1, keepdims=True)
# Which of them are the axes x, y, z.
AXIS_DIRECTIONS = tuple(int(np.argmax(np.abs(DIRECTIONS[:, axis]))) for axis in range(3))


class Extent(Protocol):
    """Anything that knows its lowest and highest x · direction for each of `DIRECTIONS`."""

    @property
    def lowest(self) -> Sequence[float]:
        """In units of length, (13,)."""

    @property
    def highest(self) -> Sequence[float]:
        """In units of length, (13,)."""


def support_widths(extents: Sequence[Extent]) -> Reals:
    """Extents (13,) of several surfaces together along `DIRECTIONS`, in units of length."""
    lowest = np.min([extent.lowest for extent in extents], axis=0)
    highest = np.max([extent.highest for extent in extents], axis=0)
    return np.asarray(highest - lowest)
