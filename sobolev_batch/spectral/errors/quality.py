"""Quality of a computed field, in a form that is stored and sent with it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.point_spectrum import PointSpectrum
from sobolev_batch.spectral.errors.probe import Probe, norms_of_checks
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.point_cloud import clouds_among
from sobolev_batch.surfaces.shapes.surface import Surface


@dataclass(frozen=True)
class TailQuality:
    """Properties of a surface's values in octaves that errors follow from.

    Attributes:
        radii: |ξ| at which values were compared with exact ones.
        squares: Contribution of each comparison to the squared norm of the error, without the weight of an order.
        own_limit: Limit of the surface's own energy for large |ξ|, and its standard error.
        difference_limit: Limit of the energy of its difference from the study's reference, likewise; None if unknown.
        own_points: Spectrum of a point cloud beyond the octaves; None for other surfaces.
        difference_points: Spectrum of the points in the difference from the reference; None if there are none.
    """

    radii: tuple[float, ...]
    squares: tuple[float, ...]
    own_limit: tuple[float, float]
    difference_limit: tuple[float, float] | None = None
    own_points: PointSpectrum | None = None
    difference_points: PointSpectrum | None = None

    def to_table(self) -> dict[str, Any]:
        """Return the quality as a table, from which `from_table` makes it again."""
        points = {"own_points": self.own_points, "difference_points": self.difference_points}
        return {
            "radii": self.radii,
            "squares": self.squares,
            "own_limit": self.own_limit,
            "difference_limit": self.difference_limit,
            **{name: spectrum.to_table() for name, spectrum in points.items() if spectrum is not None},
        }

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> Self:
        """Return the quality that a table holds."""
        numbers = {name: _tuple(table[name]) for name in ("radii", "squares", "own_limit", "difference_limit")}
        points = (PointSpectrum.from_table(table.get(name)) for name in ("own_points", "difference_points"))
        return cls(*numbers.values(), *points)


@dataclass(frozen=True)
class Quality:
    """Properties of a field that the errors of norms and distances follow from.

    Attributes:
        area: Area of the surface, in squared units of length.
        extent: Extent of the surface.
        probe: Measured error of the field itself; empty for a closed form.
        tail: Quality of the values in octaves; None without octaves.
        points: Spectrum of a point cloud beyond the lattice; None for other surfaces.
    """

    area: float
    extent: Extent
    probe: Probe
    tail: TailQuality | None = None
    points: PointSpectrum | None = None

    @classmethod
    def of_surface(cls, surface: Surface, probe: Probe, lattice: Lattice) -> Self:
        """Return the quality of the field of a surface on a lattice."""
        points = PointSpectrum.of(clouds_among([surface]), lattice.xi_max)
        return cls(surface.area, surface.extent, probe, points=points)

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
        # Neither is there in most cases, nor was the second one in earlier versions.
        further = [None if part is None else part.to_table() for part in (self.tail, self.points)]
        while further and further[-1] is None:
            further.pop()
        return json.dumps([*parts, *further])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a quality from a line of `to_json`."""
        area, lowest, highest, shells, sums, *further = json.loads(text)
        probe = Probe(tuple(shells), tuple(sums))
        tail, points = (*further, None, None)[:2]
        return cls(
            area,
            Extent(tuple(lowest), tuple(highest)),
            probe,
            None if tail is None else TailQuality.from_table(tail),
            PointSpectrum.from_table(points),
        )


def _tuple(value: Any) -> Any:
    return value if value is None else tuple(value)
