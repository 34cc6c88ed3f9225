"""Fourier fields of surfaces on the half lattice, each with an estimate of its error; fields as operands of metrics."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, Self

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from sobolev_batch.arrays import ComplexDtype, Complexes, Reals
from sobolev_batch.errors import DamageError, InputError, LatticeError
from sobolev_batch.geometry.formats.conversion import SurfaceLike, as_surface, each
from sobolev_batch.geometry.surface import DIRECTIONS, Extent, Surface
from sobolev_batch.norms.images import NearAxes
from sobolev_batch.norms.tail.remainder import Remainder
from sobolev_batch.transform.backends import backend_named
from sobolev_batch.transform.fourier import (
    ON_CPU,
    ErrorTarget,
    Execution,
    Transformed,
    TransformSettings,
    choose_settings,
    thread_count,
    transform_block,
)
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.lattice import AXES, Block, Lattice, Orders, SobolevWeights, check_orders, shell_sums
from sobolev_batch.transform.nufft_costs import FINEST_EPS
from sobolev_batch.transform.probe import COMMON, Probe, Sample, draws_for, norms_of_checks, probe_block

Operand = Surface | xr.DataArray
# What people pass as an operand: see `as_mesh`.
OperandLike = SurfaceLike | xr.DataArray

# Samples of a field held at a time when it is read from elsewhere: 64 MB of complex128.
BLOCK_SAMPLES = 1 << 22

# The orders that a field is probed for if none are named.
PROBED_ORDERS = (-2.0, -5.0, -10.0)
# The degree of the rule that most triangles get: samples drawn for it serve coarser and equal ones.
USUAL_DEGREE = 2
_ATTEMPTS = 3
# FINUFFT rounds eps to whole widths of its kernel, and errs by up to five times what `choose_settings` expects. A wider
# kernel costs a tenth of a field, but one that misses its target is computed twice.
_EPS_CAUTION = 4.0


@dataclass(frozen=True)
class TailQuality:
    """Properties of a surface's values in octaves that errors follow from.

    Attributes:
        radii: |ξ| at which values were compared with exact ones.
        squares: Contribution of each comparison to the squared norm of the error, without the weight of an order.
        own: What lies beyond the octaves in the surface's own norm.
        difference: The same in its distance from the study's reference; None if unknown.
    """

    radii: tuple[float, ...]
    squares: tuple[float, ...]
    own: Remainder
    difference: Remainder | None = None


@dataclass(frozen=True)
class Quality:
    """Properties of a field that the errors of norms and distances follow from.

    Attributes:
        area: Area of the surface, in squared units of length.
        probe: Measured error of the field itself; empty for a closed form.
        tail: Quality of the values in octaves; None without octaves.
        beyond: What lies beyond a lattice without octaves in the distance from the reference; None if extrapolated.
    """

    area: float
    extent: Extent
    probe: Probe
    tail: TailQuality | None = None
    beyond: Remainder | None = None

    def error_norms(self, weights: SobolevWeights) -> Reals:
        """Return the norm of all values' own error for each order (orders,), raised for the small samples."""
        norms = self.probe.norms(weights)
        if self.tail is None or not self.tail.radii:
            return norms
        tails = norms_of_checks(np.array(self.tail.radii), np.array(self.tail.squares), weights.orders)
        return np.asarray(np.hypot(norms, tails))

    def beyond_at(self, orders: Sequence[float]) -> Reals:
        """Return bounds on the squared distance from the reference beyond the lattice (orders,); NaN if not known."""
        return np.full(len(orders), np.nan) if self.beyond is None else self.beyond.bounds(orders)

    def to_json(self) -> str:
        """Return the quality as one line of JSON."""
        tail, beyond = (None if part is None else asdict(part) for part in (self.tail, self.beyond))
        extent, probe = self.extent, self.probe
        return json.dumps([self.area, extent.lowest, extent.highest, probe.shells, probe.sums, tail, beyond])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a quality from a line of `to_json`; DamageError where it is none."""
        try:
            area, lowest, highest, shells, sums, tail, beyond = _STORED.validate_python(json.loads(text))
            if {len(lowest), len(highest)} != {len(DIRECTIONS)}:
                raise ValueError("some of its lists have another length")
        except (ValueError, RecursionError) as error:
            problem = "its quality cannot be read"
            raise DamageError(f"a field is damaged ({problem}): {text[:80]!r}; compute it again", problem) from error
        return cls(area, Extent(lowest, highest), Probe(shells, sums), tail, beyond)


_Numbers = tuple[float, ...]
_STORED = TypeAdapter(tuple[float, _Numbers, _Numbers, tuple[int, ...], _Numbers, TailQuality | None, Remainder | None])


@dataclass(frozen=True, eq=False)
class Field(Transformed):
    """The whole field of a surface, with the quality that errors follow from, and the settings it was computed with."""

    quality: Quality
    settings: TransformSettings


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
        surface: `Mesh`, `Sphere`, `Ellipsoid`, `Torus` or `ParametrisedSurface`, in units of length; or see `as_mesh`.
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

    >>> from sobolev_batch import Lattice, fourier_transform
    >>> from sobolev_batch.shapes import Sphere
    >>> field = fourier_transform(Sphere(radius=1.0), Lattice(xi_max=2.0, M=16))
    >>> field.shape, str(field.dtype)
    ((17, 17, 9), 'complex128')
    >>> round(field.sel(xi_x=0, xi_y=0, xi_z=0).item().real, 4)  # the area of the sphere, 4π
    12.5664
    """
    execution = Execution(backend_named(backend), thread_count(threads))
    return _transformed(surface, lattice, TransformSettings(eps, dtype, quadrature), order, execution, lasting=True)


def _transformed(
    surface: SurfaceLike,
    lattice: Lattice,
    settings: TransformSettings,
    order: Orders,
    execution: Execution,
    *,
    lasting: bool = False,
) -> xr.DataArray:
    """Return the field of a surface with its attributes; see `fourier_transform`."""
    lattice = check_lattice(lattice)
    field = compute_field(as_surface(surface), lattice, settings, check_orders(order), execution, lasting=lasting)
    attributes = {
        "long_name": "Fourier transform of the area measure",
        "units": "squared units of length",
        "convention": "integral of exp(-2 pi i xi.x) over the surface",
        "xi_max": lattice.xi_max,
        "M": lattice.M,
        "eps": settings.eps,
        "quadrature": settings.quadrature,
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
    lasting: bool = False,
) -> Field:
    """Return the field of a surface by given settings, with its probe for some orders; see `transform_block`.

    A sample of the surface, drawn for these orders and `USUAL_DEGREE`, saves time. A lasting field is probed for
    orders far from these too.
    """
    kind = settings.kind_for(surface, lattice)
    transformed = transform_block(surface, lattice, lattice.half, settings, execution, kind)
    values, sample = transformed.values, sample if kind.lowest_degree <= USUAL_DEGREE else None
    if sample is None:
        draws = draws_for([surface], lattice, orders, kind.lowest_degree, COMMON, lasting=lasting)
    else:
        draws = sample.draws
    probe = probe_block(surface, lattice, settings, lattice.half, values, draws, execution, sample)
    quality = Quality(surface.area, surface.extent, probe)
    return Field(values, transformed.points, transformed.backend, quality, settings)


def field_for(
    surface: Surface,
    lattice: Lattice,
    target: ErrorTarget,
    settings: TransformSettings,
    execution: Execution = ON_CPU,
    *,
    sample: Sample | None = None,
    lasting: bool = False,
) -> Field:
    """Return the field of a surface with an error within a target, by the estimate of its probe; see `compute_field`.

    It is the first of a few attempts that meets the target, or the last, in the dtype and quadrature of the settings.
    """
    if kind_of(surface).is_closed_form:
        return compute_field(surface, lattice, settings, target.orders, sample=sample, lasting=lasting)
    for _ in range(_ATTEMPTS):
        chosen = choose_settings(surface, lattice, target, settings)
        chosen = replace(chosen, eps=max(chosen.eps / _EPS_CAUTION, FINEST_EPS[chosen.dtype]))
        field = compute_field(surface, lattice, chosen, target.orders, execution, sample=sample, lasting=lasting)
        excess = float(np.max(field.quality.probe.norms(SobolevWeights(lattice, target.orders)) / target.norms))
        if excess <= 1:
            break
        target = target.tightened(2 * excess)
    return field


def as_operand(a: OperandLike) -> Operand:
    """Return a field as it is, and anything else as a surface; see `as_surface`."""
    return a if isinstance(a, xr.DataArray) else as_surface(a, or_field=True)


def field_of(
    a: OperandLike, lattice: Lattice | None, orders: Sequence[float], eps: float | None = None
) -> xr.DataArray:
    """Return a field as it is, or transform a surface on a lattice; LatticeError or InputError where it is neither."""
    a = as_operand(a)
    if isinstance(a, xr.DataArray):
        if a.dtype.kind != "c":
            raise InputError(f"a Fourier field has complex values, found {a.dtype}")
        if set(a.dims) != set(AXES):
            raise LatticeError(f"a field has the dimensions {', '.join(AXES)} alone, found {a.dims}: select one mesh")
        return a
    if lattice is None:
        found = type(a).__name__
        raise InputError(f"this {found} needs a lattice=Lattice(xi_max=..., M=...) or, in norms and distances, an rtol")
    return _transformed(a, lattice, TransformSettings(eps), orders, Execution(threads=thread_count(None)))


def check_lattice(lattice: object) -> Lattice:
    """Return a lattice as it is; InputError where it is none."""
    if not isinstance(lattice, Lattice):
        raise InputError(f"a lattice is a Lattice(xi_max=..., M=...), found {type(lattice).__name__}")
    return lattice


def pair_of(
    a: OperandLike, b: OperandLike, lattice: Lattice | None, orders: Sequence[float]
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return both as fields on one lattice, that of a field if there is one; see `field_of` and `common_lattice`."""
    a, b = each(as_operand, {"a": a, "b": b})
    common = common_lattice((a, b), lattice)
    return field_of(a, common, orders), field_of(b, common, orders)


def common_lattice(operands: Sequence[OperandLike], lattice: Lattice | None) -> Lattice | None:
    """Return the lattice of the fields among operands, else the given one or None; LatticeError where they differ."""
    lattices = [Lattice.from_field(x) for x in operands if isinstance(x, xr.DataArray)]
    lattices += [] if lattice is None else [check_lattice(lattice)]
    for other in lattices[1:]:
        if other.M != lattices[0].M or not np.isclose(other.xi_max, lattices[0].xi_max, rtol=1e-12, atol=0):
            raise LatticeError(f"fields on different lattices cannot be compared: {lattices[0]} and {other}")
    return lattices[0] if lattices else None


def quality_of(field: xr.DataArray) -> Quality | None:
    """Return the quality of a field: an attribute of computed fields, a coordinate of stored ones."""
    text = field.coords["quality"].item() if "quality" in field.coords else field.attrs.get("quality")
    return Quality.from_json(text) if text else None


def read_blocks(lattice: Lattice, *fields: xr.DataArray) -> Iterator[tuple[Block, list[Complexes]]]:
    """Read fields block by block of their half lattice, so that they need not fit into memory."""
    for block in lattice.half.split(BLOCK_SAMPLES):
        places = dict(zip(AXES, block.place_in(lattice.half), strict=True))
        yield block, [np.asarray(field.isel(places).transpose(*AXES).values) for field in fields]


def shells_against(a: xr.DataArray, b: xr.DataArray, lattice: Lattice) -> tuple[Reals, NearAxes]:
    """Return the shell sums of |a - b|², Re((a - b) conj b) and |b|², (3, shells), and a - b and b near the axes."""
    sums, near_axes = np.zeros((3, lattice.shell_count)), NearAxes(lattice, 2)
    for block, (values, others) in read_blocks(lattice, a, b):
        difference = values - others
        near_axes.take(slice(2), block, np.stack([difference, others]))
        factors = (difference, None), (difference, others), (others, None)
        sums += [shell_sums(one, other, lattice, block) for one, other in factors]
    return sums, near_axes


def shells_of(fields: Sequence[xr.DataArray], lattice: Lattice, near_axes: NearAxes | None = None) -> Reals:
    """Return the shell sums of a field, or of the difference of two, whose values near the axes may be gathered too."""
    sums = np.zeros(lattice.shell_count)
    for block, (values, *others) in read_blocks(lattice, *fields):
        difference = values - others[0] if others else values
        sums += shell_sums(difference, None, lattice, block)
        if near_axes is not None:
            near_axes.take(slice(1), block, difference[None])
    return sums
