"""Transforms of surfaces at the samples of an octave, and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.backends import ComplexDtype
from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.costs import SurfaceSize
from sobolev_batch.spectral.octaves.quadrature import OctaveQuadrature
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.spectral.probe import norms_of_checks
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.transform.settings import (
    ON_CPU,
    ErrorTarget,
    Execution,
    TransformSettings,
    choose_settings,
    permits_single,
)
from sobolev_batch.spectral.transform.transform import transform_block
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Settings of the transform of a surface on a lattice.
Settings = Callable[[Surface, OctaveLattice], TransformSettings]

# Samples at which values on a lattice are checked: for small meshes, for huge ones, and in between as many as make this
# number of pairs of a triangle (or point) and a frequency.
_MOST_CHECKS, _FEWEST_CHECKS, _PAIRS = 16, 4, 100_000


@dataclass(frozen=True)
class SampledOctave:
    """An octave, how it is sampled, and the samples with their weights."""

    sampling: OctaveSampling
    quadrature: OctaveQuadrature

    @classmethod
    def from_sampling(cls, sampling: OctaveSampling) -> SampledOctave:
        """Return an octave with the quadrature of its sampling."""
        return cls(sampling, OctaveQuadrature.from_sampling(sampling))


@dataclass(frozen=True, eq=False)
class Checks:
    """Comparisons of values on lattices with exact ones, at a few samples.

    Attributes:
        radii: |ξ| of each comparison, float64 (P,).
        scales: Factor of its squared error in the squared norm of the error, without the weight of an order,
            float64 (P,).
        differences: Computed values less exact ones, complex128 (P,).
    """

    radii: Reals
    scales: Reals
    differences: Complexes

    @property
    def squares(self) -> Reals:
        """Contribution of each comparison to the squared norm of the error, without the weight of an order."""
        return np.asarray(self.scales * np.abs(self.differences) ** 2)


@dataclass(frozen=True, eq=False)
class OctaveValues:
    """The transform of a surface at the samples of an octave.

    Attributes:
        octave: The octave and its samples.
        values: Values at all samples, complex (n,).
        checks: Comparisons with exact values.
    """

    octave: SampledOctave
    values: NDArray[np.complexfloating]
    checks: Checks

    def error_norms(self, orders: Sequence[float]) -> Reals:
        """Return the norm of the values' own error for each order (orders,), raised for the small sample."""
        return norms_of_checks(self.checks.radii, self.checks.squares, orders)


def settings_for(target: ErrorTarget, dtype: ComplexDtype | None = None) -> Settings:
    """Return a function that gives the cheapest settings for a target; the dtype may be given."""

    def settings(surface: Surface, lattice: OctaveLattice) -> TransformSettings:
        if kind_of(surface).is_closed_form:
            return TransformSettings(dtype=dtype or "complex128")
        cheapest: ComplexDtype = "complex64" if permits_single(surface, lattice, target) else "complex128"
        return choose_settings(surface, lattice, target, TransformSettings(dtype=dtype or cheapest))

    return settings


def octave_values(
    surface: Surface,
    octave: SampledOctave,
    orders: Sequence[float],
    settings: Settings,
    execution: Execution = ON_CPU,
    *,
    known: OctaveValues | None = None,
) -> OctaveValues:
    """Return the transform of a surface at the samples of an octave.

    Args:
        surface: Surface in units of length.
        octave: The octave and its samples.
        orders: Orders that errors are measured for.
        settings: Settings of nonuniform FFTs. Values at drawn frequencies, and on lattices where large triangles would
            take many points, are exact.
        execution: Backend, threads and memory.
        known: Values at some of the samples: on the first lattices, and maybe at the same drawn frequencies. They are
            not computed again.

    Raises:
        InputError: The quadrature of a parametrised surface does not converge.
    """
    sampling, quadrature = octave.sampling, octave.quadrature
    values: list[NDArray[np.complexfloating]] = []
    finished = 0 if known is None else len(known.octave.sampling.lattices)
    for number, part in enumerate(quadrature.parts):
        if known is not None and number < finished:
            values.append(known.values[known.octave.quadrature.parts[number].samples])
        elif not part.is_drawn:
            lattice = sampling.lattices[number]
            if SurfaceSize.from_surface(surface).prefers_exact(lattice):
                values.append(_at_frequencies(surface, quadrature.frequencies[part.samples], execution))
                continue
            block = transform_block(surface, lattice, lattice.half, settings(surface, lattice), execution).values
            values.append(block.ravel()[part.places])
        elif known is not None and known.octave.sampling.drawn is sampling.drawn:
            values.append(known.values[known.octave.quadrature.parts[-1].samples])
        else:
            values.append(_at_frequencies(surface, quadrature.frequencies[part.samples], execution))
    joined = np.concatenate(values)
    return OctaveValues(octave, joined, _compared(surface, quadrature, joined, orders, check_count(surface)))


def check_count(surface: Surface) -> int:
    """Return the number of comparisons on each lattice: fewer where each costs more; none for closed forms."""
    kind = kind_of(surface)
    return 0 if kind.is_closed_form else int(np.clip(_PAIRS // max(kind.triangles, 1), _FEWEST_CHECKS, _MOST_CHECKS))


def _at_frequencies(surface: Surface, frequencies: Reals, execution: Execution = ON_CPU) -> Complexes:
    return kind_of(surface).sampled_values(frequencies, execution.threads)


def _compared(
    surface: Surface,
    quadrature: OctaveQuadrature,
    values: NDArray[np.complexfloating],
    orders: Sequence[float],
    count: int,
) -> Checks:
    """Compare values on lattices with exact ones at a few samples, drawn by their weights for all orders."""
    chosen, scales = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for number, part in enumerate(quadrature.parts):
        if part.is_drawn or not count:
            continue
        weights = quadrature.weights[part.samples]
        # Relative to the lowest frequency, so that high powers do not all underflow.
        lengths = 1 + quadrature.radii[part.samples] ** 2
        by_order = weights * [(lengths / lengths[weights > 0].min()) ** order for order in orders]
        chances = (by_order / by_order.sum(axis=1, keepdims=True)).mean(axis=0)
        drawn = np.random.default_rng(number).choice(len(chances), count, p=chances)
        chosen.append(part.samples.start + drawn)
        scales.append(weights[drawn] / (count * chances[drawn]))
    places = np.concatenate(chosen)
    differences = values[places] - _at_frequencies(surface, quadrature.frequencies[places])
    return Checks(quadrature.radii[places], np.concatenate(scales), np.asarray(differences, np.complex128))
