"""What is known about the quality of a computed field, in a form that travels and is stored with it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.probe import Probe
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS
from sobolev_batch.surfaces.shapes.similarity import Surface
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere

Reals = NDArray[np.float64]

# Vertices at a time: their products with all directions stay in cache.
_SLICE = 1 << 14


@dataclass(frozen=True)
class Quality:
    """What the error of a norm or distance needs to know of a field.

    Attributes:
        area: of the surface, in squared units of length.
        lowest: the least x · direction over the surface, for each of `DIRECTIONS`, in units of length.
        highest: the greatest, likewise.
        probe: of the field's own error; empty for a closed form.
    """

    area: float
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    probe: Probe

    @classmethod
    def of_surface(cls, surface: Surface, probe: Probe) -> Self:
        """The quality of the field of a surface."""
        if isinstance(surface, Sphere):
            along = DIRECTIONS @ np.asarray(surface.center)
            low, high = along - surface.radius, along + surface.radius
        elif isinstance(surface, Smooth):
            low, high = -surface.highest_along(-DIRECTIONS), surface.highest_along(DIRECTIONS)
        else:
            coordinates = surface.used_coordinates
            low, high = np.full(len(DIRECTIONS), np.inf), np.full(len(DIRECTIONS), -np.inf)
            for first in range(0, coordinates.shape[1], _SLICE):
                along = DIRECTIONS @ coordinates[:, first : first + _SLICE]
                np.minimum(low, along.min(axis=1), out=low)
                np.maximum(high, along.max(axis=1), out=high)
        return cls(surface.area, tuple(low.tolist()), tuple(high.tolist()), probe)

    def to_json(self) -> str:
        """One line of JSON."""
        parts = [self.area, self.lowest, self.highest, self.probe.shells, self.probe.sums]
        return json.dumps(parts)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The quality that a line holds."""
        area, lowest, highest, shells, sums = json.loads(text)
        return cls(area, tuple(lowest), tuple(highest), Probe(tuple(shells), tuple(sums)))
