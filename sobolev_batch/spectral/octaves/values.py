"""Transforms of surfaces at the samples of an octave, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.errors.a_priori import ErrorTarget, choose_settings, permits_single
from sobolev_batch.spectral.errors.probe import norms_of_draws
from sobolev_batch.spectral.errors.samples import exact_transform_of
from sobolev_batch.spectral.exact.sampled import sampled_transform
from sobolev_batch.spectral.lattice import OctaveLattice
from sobolev_batch.spectral.octaves.sampling import OctaveSampling, SamplePart
from sobolev_batch.spectral.transform.settings import ON_CPU, Execution, TransformSettings
from sobolev_batch.spectral.transform.transform import transform_block
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Draws at which the values on a lattice are checked: of a small mesh, of a huge one, and pairs of a triangle and a
# frequency in between.
_MOST_CHECKS, _FEWEST_CHECKS, _PAIRS = 16, 4, 100_000


@dataclass(frozen=True, eq=False)
class OctaveValues:
    """The transform of a surface at the samples of an octave.

    Attributes:
        sampling: The samples.
        values: Values at each part of the sampling, complex (n,) each.
        check_radii: |ξ| at which the values on lattices were compared with exact ones, float64 (P,).
        check_squares: Contribution of each comparison to the squared norm of the error, without the weight of an
            order, float64 (P,).
    """

    sampling: OctaveSampling
    values: tuple[NDArray[np.complexfloating], ...]
    check_radii: Reals
    check_squares: Reals

    def error_norms(self, orders: Sequence[float]) -> Reals:
        """Return the norm of the values' own error for each order (orders,), raised for the small sample."""
        weights = np.array([(1 + self.check_radii**2) ** order for order in orders])
        return norms_of_draws(weights * self.check_squares)


def octave_values(
    surface: Surface,
    sampling: OctaveSampling,
    target: ErrorTarget,
    execution: Execution = ON_CPU,
    known: OctaveValues | None = None,
) -> OctaveValues:
    """Return the transform of a surface at the samples of an octave.

    Args:
        surface: Surface in units of length.
        sampling: Frequencies.
        target: Largest error of the values on lattices, for the orders that they serve. Drawn values are exact.
        execution: Backend, threads and memory.
        known: Values at some of the samples: on the first lattices, and maybe at the same drawn frequencies. They are
            not computed again.

    Raises:
        InputError: The quadrature of a parametrised surface does not converge.
    """
    values: list[NDArray[np.complexfloating]] = []
    radii: list[Reals] = []
    squares: list[Reals] = []
    finished = 0
    if known is not None:
        finished = len(known.sampling.lattices)
        values, radii, squares = list(known.values[:finished]), [known.check_radii], [known.check_squares]
    for number, part in enumerate(sampling.parts()):
        if number < finished:
            continue
        if number == len(sampling.lattices):
            same = known is not None and known.sampling.drawn is sampling.drawn
            values.append(known.values[-1] if known and same else _at_frequencies(surface, part.frequencies))
            continue
        values.append(_on_lattice(surface, sampling.lattices[number], target, execution)[part.places])
        if not isinstance(surface, Sphere):
            at, contributions = _checks(surface, part, values[-1], target.orders, number)
            radii.append(at)
            squares.append(contributions)
    return OctaveValues(sampling, tuple(values), np.concatenate([[], *radii]), np.concatenate([[], *squares]))


def _on_lattice(
    surface: Surface, lattice: OctaveLattice, target: ErrorTarget, execution: Execution
) -> NDArray[np.complexfloating]:
    settings = TransformSettings()
    if not isinstance(surface, Sphere):
        single = permits_single(surface, lattice, target)
        settings = TransformSettings(dtype="complex64" if single else "complex128")
        settings = choose_settings(surface, lattice, target, settings)
    return transform_block(surface, lattice, lattice.half, settings, execution).values


def _at_frequencies(surface: Surface, frequencies: Reals) -> Complexes:
    return (
        sampled_transform(surface, frequencies)
        if isinstance(surface, Mesh)
        else exact_transform_of(surface, frequencies)
    )


def _checks(
    surface: Surface, part: SamplePart, values: NDArray[np.complexfloating], orders: Sequence[float], seed: int
) -> tuple[Reals, Reals]:
    """Compare values on a lattice with exact ones at a few samples, drawn by their weights for all orders."""
    triangles = len(surface.triangles) if isinstance(surface, Mesh) else 1
    count = int(np.clip(_PAIRS // triangles, _FEWEST_CHECKS, _MOST_CHECKS))
    by_order = part.weights * [(1 + part.radii**2) ** order for order in orders]
    chances = (by_order / by_order.sum(axis=1, keepdims=True)).mean(axis=0)
    chosen = np.random.default_rng(seed).choice(len(chances), count, p=chances)
    differences = values[chosen] - _at_frequencies(surface, part.frequencies[chosen])
    return part.radii[chosen], part.weights[chosen] * np.abs(differences) ** 2 / (count * chances[chosen])
