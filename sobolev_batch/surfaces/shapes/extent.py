"""Extents of surfaces along fixed directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

_NEIGHBOURS = np.array([n for n in product((-1, 0, 1), repeat=3) if n > (0, 0, 0)], dtype=np.float64)
# The axes, the diagonals of the faces and those of the cube: unit vectors (13, 3).
DIRECTIONS: Reals = _NEIGHBOURS / np.linalg.norm(_NEIGHBOURS, axis=1, keepdims=True)
# Points that are measured at a time: their temporaries stay in cache.
_BATCH = 1 << 14
_AXES = [int(np.argmax(np.abs(DIRECTIONS[:, axis]))) for axis in range(3)]


@dataclass(frozen=True)
class Extent:
    """The least and the greatest x · direction over a surface, for each of `DIRECTIONS`.

    Attributes:
        lowest: Least values (13,), in units of length.
        highest: Greatest values (13,), in units of length.
    """

    lowest: tuple[float, ...]
    highest: tuple[float, ...]

    @classmethod
    def union(cls, extents: Sequence[Extent]) -> Self:
        """Return the extent of several surfaces together."""
        lowest = np.min([extent.lowest for extent in extents], axis=0)
        highest = np.max([extent.highest for extent in extents], axis=0)
        return cls(tuple(lowest.tolist()), tuple(highest.tolist()))

    @classmethod
    def of_points(cls, coordinates: Reals) -> Self:
        """Return the extent of points (3, n), n > 0, one contiguous row an axis."""
        lowest, highest = np.full(len(DIRECTIONS), np.inf), np.full(len(DIRECTIONS), -np.inf)
        for start in range(0, coordinates.shape[1], _BATCH):
            along = DIRECTIONS @ coordinates[:, start : start + _BATCH]
            np.minimum(lowest, along.min(axis=1), out=lowest)
            np.maximum(highest, along.max(axis=1), out=highest)
        return cls(tuple(lowest.tolist()), tuple(highest.tolist()))

    @property
    def widths(self) -> Reals:
        """Width along each direction (13,), in units of length."""
        return np.subtract(self.highest, self.lowest)

    @property
    def box(self) -> tuple[Reals, Reals]:
        """Lower and upper corner of the bounding box, (3,) each, in units of length."""
        return np.array(self.lowest)[_AXES], np.array(self.highest)[_AXES]

    @property
    def reach(self) -> float:
        """Largest |coordinate|, in units of length."""
        return float(np.abs(self.box).max())
