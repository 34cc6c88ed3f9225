"""Fourier fields of surfaces on the half lattice, each with what is known of its error."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from sobolev_batch.spectral.backends.backends import CPU, Backend, backend_named
from sobolev_batch.spectral.dtypes import ComplexDtype, Complexes
from sobolev_batch.spectral.errors.a_priori import Goal, settle
from sobolev_batch.spectral.errors.probe import measure
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.errors.samples import Sample, needs_probe, probe_block
from sobolev_batch.spectral.lattice import AXES, Lattice
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.shells import SobolevWeights, check_orders
from sobolev_batch.spectral.transform.transform import TransformSettings, transform_block
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

# Where nobody says which orders a field is for.
PROBED_ORDERS = (-2.0, -5.0, -10.0)
# Of the rules that most triangles get: samples drawn for it serve coarser and equal ones.
USUAL_DEGREE = 2
_ATTEMPTS = 3


@dataclass(frozen=True, eq=False)
class Field:
    """A field that was computed for a goal.

    Attributes:
        values: complex, the half lattice.
        quality: what is known of its error.
        settings: that it was computed with.
        points: of the quadrature.
        backend: see `Transformed`.
    """

    values: Complexes
    quality: Quality
    settings: TransformSettings
    points: int
    backend: str


def fourier_transform(
    surface: Surface,
    lattice: Lattice,
    eps: float | None = None,
    *,
    dtype: ComplexDtype = "complex128",
    quadrature: str | int = "auto",
    backend: Literal["cpu", "gpu", "auto"] = "cpu",
    threads: int | None = None,
    orders: Sequence[float] = PROBED_ORDERS,
) -> xr.DataArray:
    """The Fourier transform of a surface's area measure, ∫ exp(-2πi ξ·x) dμ(x), on a lattice.

    Args:
        surface: a `Mesh`, `Sphere`, `Ellipsoid`, `Torus` or `ParametrisedSurface`, in units of length.
        lattice: the frequencies.
        eps: accuracy relative to the surface's area; the error reached is a small multiple of it.
            Default 1e-9, or 1e-6 in single precision.
        dtype: "complex128" or "complex64".
        quadrature: of meshes: "auto", a degree from 1 to 50, or "gauss8".
        backend: "cpu"; "gpu"; or "auto", which is the GPU if there is one that can be used. What a GPU
            fails to do is done on the processor, with a warning in the log.
        threads: of the NUFFT on the processor; default one per core.
        orders: the orders for which the field's own error is probed; it can be had for any other
            order too, with more uncertainty.

    Returns:
        The half xi_z >= 0 of the field, complex (M+1, M+1, M/2+1), with the coordinates xi_x, xi_y,
        xi_z in cycles per unit length. The other half is the conjugate of this one. The attribute
        `quality` holds what the errors of norms and distances need to know of the field, and `backend`
        names the library that computed it.

    Raises:
        LatticeError: a surface reaches beyond the lattice's half period 1/(2h).
        InputError: settings out of range; a parametrised surface that is not smooth.
        BackendError: "gpu", and there is none that can be used.

    Source: K. Koga, "Computing weak distance between the 2-sphere and its nonsmooth approximations".
    """
    settings = TransformSettings(eps, dtype, Quadrature(quadrature))
    field = compute_field(
        surface,
        lattice,
        settings,
        check_orders(orders),
        backend=backend_named(backend),
        threads=threads or os.cpu_count() or 1,
    )
    attributes = {
        "eps": settings.accuracy,
        "quadrature": settings.quadrature.method,
        "quality": field.quality.to_json(),
        "backend": field.backend,
    }
    units = {"units": "cycles per unit length"}
    coordinates = {name: (name, axis, units) for name, axis in zip(AXES, lattice.axes, strict=True)}
    return xr.DataArray(field.values, coords=coordinates, dims=AXES, name="fourier", attrs=attributes)


def compute_field(
    surface: Surface,
    lattice: Lattice,
    settings: TransformSettings,
    orders: Sequence[float],
    *,
    sample: Sample | None = None,
    backend: Backend = CPU,
    threads: int = 1,
    memory: float | None = None,
) -> Field:
    """The field of a surface with given settings, and its probe.

    Args:
        surface: whose field.
        lattice: where.
        settings: how.
        orders: that it is probed for.
        sample: of the surface, drawn for these orders and `USUAL_DEGREE`, where there is one.
        backend: where to compute the transform; the probe's exact side stays on the processor.
        threads: to compute with.
        memory: see `transform_block`.

    Raises:
        LatticeError: a mesh reaches beyond the lattice's half period.
        InputError: the memory is too little.
    """
    block = lattice.half
    made = transform_block(surface, lattice, block, settings, backend=backend, threads=threads, memory=memory)
    probed = needs_probe(surface, settings)
    if probed and sample is not None and settings.lowest_degree(surface, lattice) <= USUAL_DEGREE:
        probe = measure(sample.draws, made.values[sample.draws.places(block)], sample.exact)
    else:
        probe = probe_block(surface, lattice, settings, orders, block, made.values)
    return Field(made.values, Quality.of_surface(surface, probe), settings, made.points, made.backend)


def field_for(
    surface: Surface,
    lattice: Lattice,
    goal: Goal,
    transform: TransformSettings,
    *,
    sample: Sample | None = None,
    backend: Backend = CPU,
    threads: int = 1,
    memory: float | None = None,
) -> Field:
    """The field of a surface with an error that keeps a goal, as far as its probe can tell.

    Args:
        surface: whose field.
        lattice: where.
        goal: what its error may be.
        transform: whose precision and quadrature are kept.
        sample: see `compute_field`.
        backend: likewise.
        threads: to compute with.
        memory: see `transform_block`.

    Returns:
        The first of a few attempts that keeps the goal, or the last.
    """
    if isinstance(surface, Sphere):
        return compute_field(surface, lattice, transform, goal.orders, sample=sample)
    for _ in range(_ATTEMPTS):
        settings = settle(surface, lattice, goal, transform)
        field = compute_field(
            surface,
            lattice,
            settings,
            goal.orders,
            sample=sample,
            backend=backend,
            threads=threads,
            memory=memory,
        )
        excess = float(np.max(field.quality.probe.norms(SobolevWeights(lattice, goal.orders)) / goal.norms))
        if excess <= 1:
            break
        goal = goal.tightened(2 * excess)
    return field
