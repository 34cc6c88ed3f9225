"""Quality of a computed field, in a form that is stored and sent with it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Self

from sobolev_batch.spectral.errors.probe import Probe
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.surface import Surface


@dataclass(frozen=True)
class Quality:
    """Properties of a field that the errors of norms and distances follow from.

    Attributes:
        area: Area of the surface, in squared units of length.
        extent: Extent of the surface.
        probe: Measured error of the field itself; empty for a closed form.
    """

    area: float
    extent: Extent
    probe: Probe

    @classmethod
    def of_surface(cls, surface: Surface, probe: Probe) -> Self:
        """Return the quality of the field of a surface."""
        return cls(surface.area, surface.extent, probe)

    def to_json(self) -> str:
        """Return the quality as one line of JSON."""
        return json.dumps([self.area, self.extent.lowest, self.extent.highest, self.probe.shells, self.probe.sums])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a quality from a line of `to_json`."""
        area, lowest, highest, shells, sums = json.loads(text)
        return cls(area, Extent(tuple(lowest), tuple(highest)), Probe(tuple(shells), tuple(sums)))
