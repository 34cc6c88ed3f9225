"""Processor time of transforms in octaves, predicted: measured on one machine, and rough on others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.surfaces.shapes.surface import Surface

# Seconds for a quadrature point, for a sample of a lattice's block, and for a pair of a triangle and a frequency.
_POINT_SECONDS, _SAMPLE_SECONDS, _PAIR_SECONDS = 2.5e-7, 3e-7, 6e-8
# Quadrature points for each square of half a wavelength, and for each triangle at least.
POINTS_PER_SQUARE, _POINTS_PER_TRIANGLE = 4.0, 1.5
# What a frequency costs beside its triangles, in triangles.
_OVERHEAD_TRIANGLES = 50


@dataclass(frozen=True)
class SurfaceSize:
    """Size of a surface, on which the time of its transforms depends.

    Attributes:
        triangles: Number of triangles; zero for a surface that is no mesh.
        area: Area, in squared units of length.
        is_closed_form: True for a surface whose transform is a formula.
    """

    triangles: int
    area: float
    is_closed_form: bool = False

    @classmethod
    def from_surface(cls, surface: Surface) -> Self:
        """Return the size of a surface."""
        kind = kind_of(surface)
        return cls(kind.triangles, surface.area, kind.is_closed_form)

    @property
    def draw_seconds(self) -> float:
        """Time of the exact transform at one frequency."""
        return _PAIR_SECONDS * (self.triangles + _OVERHEAD_TRIANGLES)

    def lattice_seconds(self, lattice: OctaveLattice) -> float:
        """Return the time of a transform on a lattice, in the cheaper of both ways."""
        return min(self._nufft_seconds(lattice), self._exact_seconds(lattice))

    def prefers_exact(self, lattice: OctaveLattice) -> bool:
        """Tell whether the exact transform at all samples of a lattice is cheaper than a nonuniform FFT."""
        return self._exact_seconds(lattice) < self._nufft_seconds(lattice)

    def sampling_seconds(self, sampling: OctaveSampling, known: OctaveSampling | None = None) -> float:
        """Return the time of the transforms at the samples of an octave, without those of a known sampling.

        The known one has some of the same lattices, from the first on, and maybe the same drawn frequencies.
        """
        lattices, draws = sampling.lattices, len(sampling.drawn)
        if known is not None:
            lattices = lattices[len(known.lattices) :]
            draws = 0 if known.drawn is sampling.drawn else draws
        return sum(map(self.lattice_seconds, lattices)) + draws * self.draw_seconds

    def _nufft_seconds(self, lattice: OctaveLattice) -> float:
        seconds = _SAMPLE_SECONDS * lattice.half.size
        if self.is_closed_form:
            return seconds
        of_area = POINTS_PER_SQUARE * self.area * (2 * lattice.highest) ** 2
        return seconds + _POINT_SECONDS * max(_POINTS_PER_TRIANGLE * self.triangles, of_area)

    def _exact_seconds(self, lattice: OctaveLattice) -> float:
        return math.pi / 12 * lattice.M**3 * self.draw_seconds if self.triangles else math.inf
