"""Transforms of surfaces at the samples of octaves: values with their errors, and the processor time that they take."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.tail.sampling import OctaveSampling
from sobolev_batch.transform.backends import Backend
from sobolev_batch.transform.fourier import ErrorTarget, Execution, TransformSettings, settings_on, transform_block
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.lattice import OctaveLattice
from sobolev_batch.transform.probe import norms_of_checks
from sobolev_batch.transform.quadrature import EQUILATERAL

# Samples at which values on a lattice are checked: for small meshes, for huge ones, and in between as many as make this
# number of pairs of a triangle (or point) and a frequency.
_MOST_CHECKS, _FEWEST_CHECKS, _PAIRS = 16, 4, 100_000
# Seconds for a quadrature point and for a sample of a lattice's block; for a pair of a triangle and a frequency in
# compiled loops and on arrays; and to load the loops, shared by some octaves: measured on one machine, rough on others.
_POINT_SECONDS, _SAMPLE_SECONDS = 2e-7, 1e-7
_LOOP_SECONDS, _ARRAY_SECONDS, _START_SECONDS = 3e-9, 4.5e-8, 0.15
# Quadrature points for each square of half a wavelength, and for each triangle at least.
POINTS_PER_SQUARE, _POINTS_PER_TRIANGLE = 4.0, 1.5
# Points of long triangles, in those of as much area that is not.
_OF_LONG = 2.0
# What a frequency costs beside its triangles, in triangles.
_OVERHEAD_TRIANGLES = 50
# Draws of an octave, for the time that one of them takes.
_USUAL_DRAWS = 20_000


@dataclass(frozen=True, eq=False)
class OctaveValues:
    """The transform of a surface at the samples of an octave, compared with exact values at a few of them.

    Attributes:
        values: Values at all samples, complex (n,).
        radii: |ξ| of each comparison, float64 (P,).
        squares: Contribution of each comparison to the squared norm of the error, without an order's weight (P,).
    """

    sampling: OctaveSampling
    values: Complexes
    radii: Reals
    squares: Reals

    def error_norms(self, orders: Sequence[float]) -> Reals:
        """Return the norm of the values' own error for each order (orders,), raised for the small sample."""
        return norms_of_checks(self.radii, self.squares, orders)


def octave_values(
    surface: Surface,
    sampling: OctaveSampling,
    orders: Sequence[float],
    settings: TransformSettings | ErrorTarget,
    execution: Execution,
    *,
    known: OctaveValues | None = None,
) -> OctaveValues:
    """Return the transform of a surface at the samples of an octave.

    Values on lattices come from nonuniform FFTs, by these settings or by the cheapest ones for a target, and their
    errors are measured for some orders. Those at drawn frequencies, and on lattices where large triangles would take
    many points, are exact. Known values, on the first lattices and maybe at the same draws, are not computed again.
    """
    values: list[Complexes] = []
    finished = 0 if known is None else len(known.sampling.lattices)
    for number, sample_set in enumerate(sampling.sample_sets):
        lattice = None if sample_set.is_drawn else sampling.lattices[number]
        if known and (number < finished if lattice else sampling.drawn_by == known.sampling.drawn_by):
            values.append(known.values[known.sampling.sample_sets[number if lattice else -1].samples])
        elif lattice is None or SurfaceSize.from_surface(surface).prefers_exact(lattice):
            frequencies = sampling.frequencies[sample_set.samples]
            values.append(kind_of(surface).exact_values(frequencies, execution.threads, execution.backend))
        else:
            chosen = settings_on(lattice, surface, settings)
            block = transform_block(surface, lattice, lattice.half, chosen, execution).values
            values.append(block.ravel()[sample_set.places])
    joined = np.concatenate(values)
    return OctaveValues(sampling, joined, *_compared(surface, sampling, joined, orders, execution.backend))


def _compared(
    surface: Surface, sampling: OctaveSampling, values: Complexes, orders: Sequence[float], backend: Backend
) -> tuple[Reals, Reals]:
    """Compare values on lattices with exact ones at a few samples, drawn by weight; fewer where each costs more."""
    kind = kind_of(surface)
    count = 0 if kind.is_closed_form else int(np.clip(_PAIRS // max(kind.triangles, 1), _FEWEST_CHECKS, _MOST_CHECKS))
    chosen, scales = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for number, sample_set in enumerate(sampling.sample_sets[:-1] if count else ()):
        weights = sampling.weights[sample_set.samples]
        # Relative to the lowest frequency, so that high powers do not all underflow.
        lengths = 1 + sampling.radii[sample_set.samples] ** 2
        by_order = weights * [(lengths / lengths[weights > 0].min()) ** order for order in orders]
        chances = (by_order / by_order.sum(axis=1, keepdims=True)).mean(axis=0)
        drawn = np.random.default_rng(number).choice(len(chances), count, p=chances)
        chosen.append(sample_set.samples.start + drawn)
        scales.append(weights[drawn] / (count * chances[drawn]))
    places = np.concatenate(chosen)
    differences = values[places] - kind.exact_values(sampling.frequencies[places], backend=backend)
    return sampling.radii[places], np.concatenate(scales) * np.abs(differences) ** 2


@dataclass(frozen=True)
class SurfaceSize:
    """Size of a surface, on which the processor time of its transforms depends.

    Attributes:
        extent: Area in squared units of length; of triangles, if they were equilateral with the same distance from
            centroid to farthest corner, but at most twice their own.
        is_closed_form: True if transforms take no points.
    """

    triangles: int
    extent: float
    is_closed_form: bool = False

    @classmethod
    def from_surface(cls, surface: Surface) -> Self:
        """Return the size of a surface."""
        kind, extent = kind_of(surface), surface.area
        if isinstance(kind.surface, Mesh):
            whole = EQUILATERAL * np.square(kind.surface.centroid_radii)
            extent = float(np.minimum(whole, _OF_LONG * kind.surface.areas).sum())
        return cls(kind.triangles, extent, kind.is_closed_form)

    @property
    def draw_seconds(self) -> float:
        """Time of the exact transform at one of many drawn frequencies."""
        return self._seconds_at(_USUAL_DRAWS) / _USUAL_DRAWS

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
        lattices = sampling.lattices if known is None else sampling.lattices[len(known.lattices) :]
        draws = 0 if known is not None and sampling.drawn_by == known.drawn_by else sampling.draws
        return sum(map(self.lattice_seconds, lattices)) + draws * self.draw_seconds

    def _nufft_seconds(self, lattice: OctaveLattice) -> float:
        seconds = _SAMPLE_SECONDS * lattice.half.size
        if self.is_closed_form:
            return seconds
        of_extent = POINTS_PER_SQUARE * self.extent * (2 * lattice.highest) ** 2
        return seconds + _POINT_SECONDS * max(_POINTS_PER_TRIANGLE * self.triangles, of_extent)

    def _exact_seconds(self, lattice: OctaveLattice) -> float:
        return self._seconds_at(math.pi / 12 * lattice.M**3) if self.triangles else math.inf

    def _seconds_at(self, frequencies: float) -> float:
        """Return the time of the exact transform, the same whatever the process has done before."""
        pairs = frequencies * (self.triangles + _OVERHEAD_TRIANGLES)
        return min(_ARRAY_SECONDS * pairs, _START_SECONDS + _LOOP_SECONDS * pairs)
