"""Exact values of a surface's transform at a few random frequencies: what fields are checked against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.spectral.dtypes import Complexes
from sobolev_batch.spectral.errors.probe import Draws, Probe, draw, draw_count, even_probe, join, measure
from sobolev_batch.spectral.exact.spheres import sphere_transform
from sobolev_batch.spectral.exact.triangles import exact_transform
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.quadrature.smooth import exact_values, resolution_of
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

Reals = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """The exact transform of a surface at drawn frequencies.

    Attributes:
        draws: the frequencies.
        exact: complex128 (P,).
    """

    draws: Draws
    exact: NDArray[np.complex128]

    @classmethod
    def of(cls, surface: Surface, draws: Draws) -> Sample:
        """The sample of a surface."""
        if isinstance(surface, Sphere):
            return cls(draws, sphere_transform(surface, draws.frequencies))
        if isinstance(surface, Smooth):
            return cls(draws, exact_values(surface, draws.frequencies))
        return cls(draws, exact_transform(surface, draws.frequencies))


def draws_for(surfaces: Sequence[Surface], lattice: Lattice, orders: Sequence[float], degree: int) -> Draws:
    """The frequencies at which fields are to be probed; the same surfaces give the same ones.

    Args:
        surfaces: whose fields they are, together.
        lattice: of the fields.
        orders: s, each.
        degree: the lowest among those of the triangle rules in use.
    """
    triangles = max(len(surface.triangles) if isinstance(surface, Mesh) else 1 for surface in surfaces)
    seed = int(np.float64(sum(surface.area for surface in surfaces)).view(np.uint64))
    return draw(lattice, orders, degree, draw_count(triangles), seed)


def probe_block(
    surface: Surface,
    lattice: Lattice,
    settings: TransformSettings,
    orders: Sequence[float],
    block: Block,
    values: Complexes,
    draws: Draws | None = None,
) -> Probe:
    """Compare one block of a field with the exact transform, at the draws that fall into the block.

    Closed forms in double precision are exact, and have an empty probe. That of a parametrised surface, whose
    exact values come from twice its nodes, also carries how much doubling them changed when they were chosen.
    """
    if not needs_probe(surface, settings):
        return Probe()
    if draws is None:
        draws = draws_for([surface], lattice, orders, settings.lowest_degree(surface, lattice))
    draws = draws.within(block)
    sample = Sample.of(surface, draws)
    probe = measure(draws, values[draws.places(block)], sample.exact)
    # Once for the whole field.
    if isinstance(surface, Smooth) and block.start == lattice.half.start:
        change = resolution_of(surface, lattice.highest_frequency, settings.tolerance).change
        return join([probe, even_probe(lattice, change * surface.area)])
    return probe


def needs_probe(surface: Surface, settings: TransformSettings) -> bool:
    """Whether a field computed with these settings can have an error worth the name."""
    return not isinstance(surface, Sphere) or settings.dtype == "complex64"


def estimate(samples: Sequence[Sample], orders: Sequence[float]) -> Reals:
    """An unbiased estimate of the norm of a surface, or of the distance of two, from samples (orders,).

    Args:
        samples: one or two, of the same draws.
        orders: s, each.
    """
    draws = samples[0].draws
    difference = samples[0].exact - (samples[1].exact if len(samples) > 1 else 0.0)
    squares = draws.scales * np.abs(difference) ** 2
    lengths = 1 + np.sum(draws.frequencies**2, axis=1)
    return np.asarray(np.sqrt([np.sum(squares * lengths**order) for order in orders]))
