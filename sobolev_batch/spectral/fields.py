"""Fourier fields of surfaces on the half lattice, each with an estimate of its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from sobolev_batch.spectral.backends import ComplexDtype, Complexes, backend_named
from sobolev_batch.spectral.lattice import AXES, Lattice
from sobolev_batch.spectral.probe import Probe, Sample, draws_for, measure, needs_probe, probe_block
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.quality import Quality
from sobolev_batch.spectral.shells import Orders, SobolevWeights, check_orders
from sobolev_batch.spectral.transform.settings import (
    ON_CPU,
    ErrorTarget,
    Execution,
    TransformSettings,
    choose_settings,
    thread_count,
)
from sobolev_batch.spectral.transform.transform import transform_block
from sobolev_batch.surfaces.formats.readers import SurfaceLike, as_surface
from sobolev_batch.surfaces.shapes.surface import Surface

# The orders that a field is probed for if none are named.
PROBED_ORDERS = (-2.0, -5.0, -10.0)
# The degree of the rule that most triangles get: samples drawn for it serve coarser and equal ones.
USUAL_DEGREE = 2
_ATTEMPTS = 3


@dataclass(frozen=True, eq=False)
class Field:
    """A computed field.

    Attributes:
        values: Complex array on the half lattice.
        quality: Area, extent and probe, from which errors follow.
        settings: Settings that it was computed with.
        points: Number of quadrature points.
        backend: Library that computed it: see `Transformed`.
    """

    values: Complexes
    quality: Quality
    settings: TransformSettings
    points: int
    backend: str


def fourier_transform(
    surface: SurfaceLike,
    lattice: Lattice,
    eps: float | None = None,
    *,
    dtype: ComplexDtype = "complex128",
    quadrature: str | int = "auto",
    backend: Literal["cpu", "gpu", "auto"] = "cpu",
    threads: int | None = None,
    order: Orders = PROBED_ORDERS,
) -> xr.DataArray:
    """Return the Fourier transform of a surface's area measure, ∫ exp(-2πi ξ·x) dμ(x), on a lattice.

    Args:
        surface: `Mesh`, `Sphere`, `Ellipsoid`, `Torus` or `ParametrisedSurface`, in units of length; or what `as_mesh`
            makes a mesh of, such as the path of a file.
        lattice: Frequencies ξ, in cycles per unit length.
        eps: Accuracy relative to the surface's area; the error is a small multiple of it. Default 1e-9, or 1e-6 in
            single precision.
        dtype: "complex128" or "complex64".
        quadrature: Rules for the triangles of a mesh: "auto", a degree from 1 to 50, or "gauss8".
        backend: "cpu", "gpu", or "auto" for a GPU if one is usable. If a GPU fails, the processor takes over, with a
            warning in the log.
        threads: Threads of the NUFFT on the processor; one per core by default.
        order: Sobolev orders for which the error of the field is probed. Errors at other orders follow too, with
            more uncertainty.

    Returns:
        Complex array (M+1, M+1, M/2+1), in squared units of length, on the half xi_z >= 0 with the coordinates xi_x,
        xi_y, xi_z; the other half is its complex conjugate. The attributes hold the lattice, the convention, the
        settings, the `backend` (the library that computed it), and as `quality` what the errors of norms and
        distances follow from.

    Raises:
        LatticeError: The surface extends beyond the lattice's half period 1/(2h).
        InputError: Settings are out of range, or a parametrised surface is not smooth.
        BackendError: "gpu", and no GPU is usable.

    Source: K. Koga, "Computing weak distance between the 2-sphere and its nonsmooth approximations".

    >>> from sobolev_batch import Lattice, Sphere, fourier_transform
    >>> field = fourier_transform(Sphere(radius=1.0), Lattice(xi_max=2.0, M=16))
    >>> field.shape, str(field.dtype)
    ((17, 17, 9), 'complex128')
    >>> round(field.sel(xi_x=0, xi_y=0, xi_z=0).item().real, 4)  # the area of the sphere, 4π
    12.5664
    """
    settings = TransformSettings(eps, dtype, Quadrature(quadrature))
    execution = Execution(backend_named(backend), thread_count(threads))
    field = compute_field(as_surface(surface), lattice, settings, check_orders(order), execution)
    attributes = {
        "long_name": "Fourier transform of the area measure",
        "units": "squared units of length",
        "convention": "integral of exp(-2 pi i xi.x) over the surface",
        "xi_max": lattice.xi_max,
        "M": lattice.M,
        "eps": settings.eps,
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
    execution: Execution = ON_CPU,
    *,
    sample: Sample | None = None,
) -> Field:
    """Return the field of a surface by given settings, with its probe.

    Args:
        surface: Surface in units of length.
        lattice: Lattice of the field.
        settings: Accuracy and dtype.
        orders: Sobolev orders that the field is probed for.
        execution: Backend, threads and memory of the transform; the exact values of the probe are always computed on
            the processor.
        sample: Sample of the surface, drawn for these orders and `USUAL_DEGREE`, if there is one.

    Raises:
        LatticeError: The surface extends beyond the lattice's half period.
        InputError: The allowed memory is too little.
    """
    block = lattice.half
    plan = settings.plan(surface, lattice)
    transformed = transform_block(surface, lattice, block, settings, execution, plan)
    values = transformed.values
    if not needs_probe(surface, settings):
        probe = Probe()
    elif sample is not None and plan.lowest_degree <= USUAL_DEGREE:
        probe = measure(sample.draws, values[sample.draws.places(block)], sample.exact)
    else:
        draws = draws_for([surface], lattice, orders, plan.lowest_degree)
        probe = probe_block(surface, lattice, settings, orders, block, values, draws)
    return Field(values, Quality.from_surface(surface, probe), settings, transformed.points, transformed.backend)


def field_for(
    surface: Surface,
    lattice: Lattice,
    target: ErrorTarget,
    settings: TransformSettings,
    execution: Execution = ON_CPU,
    *,
    sample: Sample | None = None,
) -> Field:
    """Return the field of a surface with an error within a target, by the estimate of its probe.

    Args:
        surface: Surface in units of length.
        lattice: Lattice of the field.
        target: Largest error of the field.
        settings: Settings whose dtype and quadrature are kept.
        execution: See `compute_field`.
        sample: See `compute_field`.

    Returns:
        The first of a few attempts that meets the target, or the last.
    """
    if kind_of(surface).is_closed_form:
        return compute_field(surface, lattice, settings, target.orders, sample=sample)
    for _ in range(_ATTEMPTS):
        chosen = choose_settings(surface, lattice, target, settings)
        field = compute_field(surface, lattice, chosen, target.orders, execution, sample=sample)
        excess = float(np.max(field.quality.probe.norms(SobolevWeights(lattice, target.orders)) / target.norms))
        if excess <= 1:
            break
        target = target.tightened(2 * excess)
    return field
