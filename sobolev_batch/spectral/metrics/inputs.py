"""Arguments of metrics: fields, or surfaces that become fields."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.fields import fourier_transform
from sobolev_batch.spectral.lattice import AXES, Block, Lattice
from sobolev_batch.spectral.quality import Quality
from sobolev_batch.spectral.shells import Complexes, Reals, shell_sums
from sobolev_batch.surfaces.formats.readers import SurfaceLike, as_surface
from sobolev_batch.surfaces.shapes.surface import Surface

Operand = Surface | xr.DataArray
# What people pass as an operand: see `as_mesh`.
OperandLike = SurfaceLike | xr.DataArray

# Samples of a field held at a time when it is read from elsewhere: 64 MB of complex128.
BLOCK_SAMPLES = 1 << 22


def as_operand(a: OperandLike) -> Operand:
    """Return a field as it is, and anything else as a surface.

    Raises:
        InputError: It is neither; or see `as_mesh`.
    """
    return a if isinstance(a, xr.DataArray) else as_surface(a)


def field_of(a: OperandLike, lattice: Lattice | None, orders: Sequence[float]) -> xr.DataArray:
    """Return a field as it is, or transform a surface on a lattice.

    Raises:
        LatticeError: The field has other dimensions, or the surface does not fit into the lattice.
        InputError: The argument is neither a field nor a surface, a field is not complex, or a surface comes without a
            lattice.
    """
    if isinstance(a, xr.DataArray):
        if a.dtype.kind != "c":
            raise InputError(f"a Fourier field has complex values, found {a.dtype}")
        if set(a.dims) != set(AXES):
            raise LatticeError(
                f"a field must have the dimensions {', '.join(AXES)} and no others, found {a.dims}: select one mesh"
            )
        return a
    surface = as_surface(a)
    if lattice is None:
        raise InputError(
            f"a surface such as this {type(surface).__name__} needs a lattice or an accuracy: "
            "pass lattice=Lattice(xi_max=..., M=...) or rtol=..."
        )
    return fourier_transform(surface, lattice, order=orders)


def field_values(field: xr.DataArray) -> Complexes:
    """Return all samples of a field, complex128 on the half lattice.

    Raises:
        InputError: Some are not finite.
    """
    values = np.asarray(field.transpose(*AXES).to_numpy(), dtype=np.complex128)
    if not np.isfinite(values).all():
        raise InputError(f"the field has {np.count_nonzero(~np.isfinite(values)):,} values that are NaN or infinite")
    return values


def pair_of(
    a: OperandLike, b: OperandLike, lattice: Lattice | None, orders: Sequence[float]
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return both as fields on one lattice; a surface beside a field is transformed on the field's lattice.

    Raises:
        LatticeError: As for `field_of`, or the fields lie on different lattices.
        InputError: As for `field_of`.
    """
    common = common_lattice((a, b), lattice)
    return field_of(a, common, orders), field_of(b, common, orders)


def common_lattice(operands: Sequence[OperandLike], lattice: Lattice | None) -> Lattice | None:
    """Return the lattice of the fields among some operands, or the given one; None if there is neither.

    Raises:
        LatticeError: They differ.
    """
    lattices = [Lattice.from_field(x) for x in operands if isinstance(x, xr.DataArray)]
    if lattice is not None:
        lattices.append(lattice)
    for other in lattices[1:]:
        if other.M != lattices[0].M or not np.isclose(other.xi_max, lattices[0].xi_max, rtol=1e-12, atol=0):
            raise LatticeError(f"fields on different lattices cannot be compared: {lattices[0]} and {other}")
    return lattices[0] if lattices else None


def point_array(values: ArrayLike, name: str) -> Reals:
    """Return values as float64 (n, 3); they may be infinite or NaN.

    Raises:
        InputError: The values are not real, or not of that shape; the message calls them ``name``.
    """
    try:
        points = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be real numbers (n, 3): {error}") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} must have the shape (n, 3), found {points.shape}")
    return points


def quality_of(field: xr.DataArray) -> Quality | None:
    """Return the quality of a field: an attribute of computed fields, a coordinate of stored ones."""
    text = field.coords["quality"].item() if "quality" in field.coords else field.attrs.get("quality")
    return Quality.from_json(text) if text else None


def read_blocks(
    lattice: Lattice, *fields: xr.DataArray, largest: int = BLOCK_SAMPLES
) -> Iterator[tuple[Block, list[Complexes]]]:
    """Read fields block by block of their half lattice, so that they need not fit into memory."""
    for block in lattice.split(largest):
        places = dict(zip(AXES, lattice.place(block), strict=True))
        yield block, [np.asarray(field.isel(places).transpose(*AXES).values) for field in fields]


def shells_against(a: xr.DataArray, b: xr.DataArray, lattice: Lattice) -> Reals:
    """Return the shell sums of |a - b|², Re((a - b) conj b) and |b|², (3, lattice.shell_count)."""
    sums = np.zeros((3, lattice.shell_count))
    for block, (values, others) in read_blocks(lattice, a, b):
        difference = values - others
        sums += [
            shell_sums(difference, None, lattice, block),
            shell_sums(difference, others, lattice, block),
            shell_sums(others, None, lattice, block),
        ]
    return sums


def shells_of(a: xr.DataArray, b: xr.DataArray | None, lattice: Lattice) -> Reals:
    """Return the shell sums of |a|², or of |a - b|²."""
    sums = np.zeros(lattice.shell_count)
    for block, (values, *others) in read_blocks(lattice, *((a,) if b is None else (a, b))):
        sums += shell_sums(values - others[0] if others else values, None, lattice, block)
    return sums
