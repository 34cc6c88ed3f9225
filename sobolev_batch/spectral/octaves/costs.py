"""Processor time of transforms in octaves, predicted: measured on one machine, and rough on others."""

from __future__ import annotations

import math

from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.surface import Surface

# Seconds for a quadrature point, for a sample of a lattice's block, and for a pair of a triangle and a frequency.
_POINT_SECONDS, _SAMPLE_SECONDS, _PAIR_SECONDS = 3.5e-7, 1e-6, 2.5e-8
# Quadrature points for each square of half a wavelength, and for each triangle at least.
POINTS_PER_SQUARE, _POINTS_PER_TRIANGLE = 4.0, 1.5
# What a frequency costs beside its triangles, in triangles.
_OVERHEAD_TRIANGLES = 50


def draw_seconds(surface: Surface) -> float:
    """Return the time of the exact transform at one frequency."""
    triangles = len(surface.triangles) if isinstance(surface, Mesh) else 0
    return _PAIR_SECONDS * (triangles + _OVERHEAD_TRIANGLES)


def lattice_seconds(surface: Surface, lattice: OctaveLattice) -> float:
    """Return the time of a transform on a lattice, in the cheaper of both ways."""
    return min(nufft_seconds(surface, lattice), exact_seconds(surface, lattice))


def nufft_seconds(surface: Surface, lattice: OctaveLattice) -> float:
    """Return the time of a nonuniform FFT on a lattice."""
    if not isinstance(surface, Mesh | Smooth):
        return _SAMPLE_SECONDS * lattice.half.size
    triangles = len(surface.triangles) if isinstance(surface, Mesh) else 0
    per_area = POINTS_PER_SQUARE * (2 * lattice.highest) ** 2
    points = max(_POINTS_PER_TRIANGLE * triangles, per_area * surface.area)
    return _POINT_SECONDS * points + _SAMPLE_SECONDS * lattice.half.size


def exact_seconds(surface: Surface, lattice: OctaveLattice) -> float:
    """Return the time of the exact transform at all samples of a lattice; endless where there is none."""
    if not isinstance(surface, Mesh):
        return math.inf
    samples = math.pi / 12 * lattice.M**3
    return samples * draw_seconds(surface)


def sampling_seconds(surface: Surface, sampling: OctaveSampling) -> float:
    """Return the time of the transforms at all samples of an octave."""
    lattices = sum(lattice_seconds(surface, lattice) for lattice in sampling.lattices)
    return lattices + len(sampling.drawn) * draw_seconds(surface)
