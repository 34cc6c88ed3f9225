"""Quality of a computed field, in a form that is stored and sent with it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.octaves.remainder import Remainder
from sobolev_batch.spectral.probe import Probe, norms_of_checks
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.shapes.surface import Extent, Surface


@dataclass(frozen=True)
class TailQuality:
    """Properties of a surface's values in octaves that errors follow from.

    Attributes:
        radii: |ξ| at which values were compared with exact ones.
        squares: Contribution of each comparison to the squared norm of the error, without the weight of an order.
        own: What lies beyond the octaves in the surface's own norm.
        difference: The same in its distance from the study's reference; None if unknown.
    """

    radii: tuple[float, ...]
    squares: tuple[float, ...]
    own: Remainder
    difference: Remainder | None = None

    def to_table(self) -> dict[str, Any]:
        """Return the quality as a table, from which `from_table` makes it again."""
        return asdict(self)

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> Self:
        """Return the quality that a table holds."""
        own, difference = (part and Remainder.from_table(part) for part in (table["own"], table["difference"]))
        return cls(tuple(table["radii"]), tuple(table["squares"]), own, difference)


@dataclass(frozen=True)
class Quality:
    """Properties of a field that the errors of norms and distances follow from.

    Attributes:
        area: Area of the surface, in squared units of length.
        extent: Extent of the surface.
        probe: Measured error of the field itself; empty for a closed form.
        tail: Quality of the values in octaves; None without octaves.
    """

    area: float
    extent: Extent
    probe: Probe
    tail: TailQuality | None = None

    @classmethod
    def from_surface(cls, surface: Surface, probe: Probe) -> Self:
        """Return the quality of the field of a surface."""
        return cls(surface.area, surface.extent, probe)

    def error_norms(self, weights: SobolevWeights) -> NDArray[np.float64]:
        """Return the norm of all values' own error for each order (orders,), raised for the small samples."""
        norms = self.probe.norms(weights)
        if self.tail is None or not self.tail.radii:
            return norms
        tails = norms_of_checks(np.array(self.tail.radii), np.array(self.tail.squares), weights.orders)
        return np.asarray(np.hypot(norms, tails))

    def to_json(self) -> str:
        """Return the quality as one line of JSON."""
        parts = [self.area, self.extent.lowest, self.extent.highest, self.probe.shells, self.probe.sums]
        return json.dumps(parts if self.tail is None else [*parts, self.tail.to_table()])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a quality from a line of `to_json`."""
        area, lowest, highest, shells, sums, *tail = json.loads(text)
        extent, probe = Extent(tuple(lowest), tuple(highest)), Probe(tuple(shells), tuple(sums))
        return cls(area, extent, probe, TailQuality.from_table(*tail) if tail else None)
