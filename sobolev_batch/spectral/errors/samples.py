"""Exact values of a surface's transform at a few random frequencies, to check fields against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.dtypes import Complexes
from sobolev_batch.spectral.errors.probe import Draws, Probe, draw, draw_count, join, measure, uniform_probe
from sobolev_batch.spectral.exact.spheres import sphere_transform
from sobolev_batch.spectral.exact.triangles import exact_transform
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.quadrature.smooth import exact_values, resolution_of
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.smooth.smooth import Smooth

Reals = NDArray[np.float64]


@singledispatch
def exact_transform_of(surface: Surface, frequencies: Reals) -> NDArray[np.complex128]:
    """Return the exact transform of a surface at frequencies (P, 3), complex128 (P,).

    Each kind of surface registers its own function.

    Raises:
        InputError: The surface is of an unknown kind.
    """
    kinds = ", ".join(sorted(kind.__name__ for kind in exact_transform_of.registry if kind is not object))
    raise InputError(f"the kinds of surfaces with an exact transform are {kinds}; found {type(surface).__name__}")


@exact_transform_of.register
def _(surface: Mesh, frequencies: Reals) -> NDArray[np.complex128]:
    return exact_transform(surface, frequencies)


@exact_transform_of.register
def _(surface: Sphere, frequencies: Reals) -> NDArray[np.complex128]:
    return sphere_transform(surface, frequencies)


@exact_transform_of.register
def _(surface: Smooth, frequencies: Reals) -> NDArray[np.complex128]:
    return exact_values(surface, frequencies)


def term_count(surface: Surface) -> int:
    """Return the number of triangles that an exact transform adds up; 1 for other surfaces."""
    return len(surface.triangles) if isinstance(surface, Mesh) else 1


@dataclass(frozen=True, eq=False)
class Sample:
    """Exact transform of a surface at drawn frequencies.

    Attributes:
        draws: Frequencies of the sample.
        exact: Exact values, complex128 (P,).
    """

    draws: Draws
    exact: NDArray[np.complex128]

    @classmethod
    def of(cls, surface: Surface, draws: Draws) -> Sample:
        """Return the sample of a surface at given draws."""
        return cls(draws, exact_transform_of(surface, draws.frequencies))


def draws_for(surfaces: Sequence[Surface], lattice: Lattice, orders: Sequence[float], degree: int) -> Draws:
    """Draw the frequencies to probe fields at; the same surfaces get the same ones.

    Args:
        surfaces: Surfaces of the fields.
        lattice: Lattice of the fields.
        orders: Orders s.
        degree: Lowest degree of the triangle rules in use.
    """
    terms = max(map(term_count, surfaces))
    seed = int(np.float64(sum(surface.area for surface in surfaces)).view(np.uint64))
    return draw(lattice, orders, degree, draw_count(terms), seed)


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

    Closed forms in double precision are exact and have an empty probe. The exact values of a parametrised
    surface come from twice its nodes. Its probe therefore also holds the change that the last doubling made.
    """
    if not needs_probe(surface, settings):
        return Probe()
    if draws is None:
        draws = draws_for([surface], lattice, orders, settings.lowest_degree(surface, lattice))
    draws = draws.within(block)
    probe = measure(draws, values[draws.places(block)], Sample.of(surface, draws).exact)
    # Once for the whole field.
    if isinstance(surface, Smooth) and block.start == lattice.half.start:
        change = resolution_of(surface, lattice.highest_frequency, settings.tolerance).change
        return join([probe, uniform_probe(lattice, change * surface.area)])
    return probe


@singledispatch
def needs_probe(surface: Surface, settings: TransformSettings) -> bool:
    """Tell whether a field computed with these settings can differ noticeably from the exact transform."""
    return True


@needs_probe.register
def _(surface: Sphere, settings: TransformSettings) -> bool:
    return settings.dtype == "complex64"


def estimate(samples: Sequence[Sample], orders: Sequence[float]) -> Reals:
    """Estimate the norm of a surface, or the distance of two, without bias from samples (orders,).

    Args:
        samples: One or two samples of the same draws.
        orders: Orders s.
    """
    draws = samples[0].draws
    difference = samples[0].exact - (samples[1].exact if len(samples) > 1 else 0.0)
    squares = draws.scales * np.abs(difference) ** 2
    lengths = 1 + np.sum(draws.frequencies**2, axis=1)
    return np.asarray(np.sqrt([np.sum(squares * lengths**order) for order in orders]))
