"""What norms, distances and everything like them are asked about: fields, or surfaces that become fields."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.fields import fourier_transform
from sobolev_batch.spectral.lattice import AXES, Block, Lattice
from sobolev_batch.spectral.shells import Complexes, Orders, Reals, shell_sums
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

Operand = Surface | xr.DataArray

# Samples of a field held at a time when it is read from elsewhere: 64 MB of complex128.
BLOCK_SAMPLES = 1 << 22


def field_of(a: Operand, lattice: Lattice | None, orders: Sequence[float]) -> xr.DataArray:
    """A field as it is, or that of a surface on a lattice.

    Raises:
        LatticeError: a field with other dimensions, or a surface that does not fit into the lattice.
        InputError: neither a field nor a surface, or a surface without a lattice.
    """
    if isinstance(a, xr.DataArray):
        if set(a.dims) != set(AXES):
            raise LatticeError(
                f"a field must have the dimensions {', '.join(AXES)} and no others, found {a.dims}: select one mesh"
            )
        return a
    check_surface(a)
    if lattice is None:
        raise InputError(
            f"a surface such as this {type(a).__name__} needs a lattice or an accuracy: "
            "pass lattice=Lattice(xi_max=..., M=...) or rtol=..."
        )
    return fourier_transform(a, lattice, order=orders)


def pair_of(
    a: Operand, b: Operand, lattice: Lattice | None, orders: Sequence[float]
) -> tuple[xr.DataArray, xr.DataArray]:
    """Both as fields on one lattice; a surface beside a field is transformed on the field's lattice.

    Raises:
        LatticeError: as for `field_of`, or fields on different lattices.
        InputError: as for `field_of`.
    """
    known = [Lattice.of(x) for x in (a, b) if isinstance(x, xr.DataArray)]
    if lattice is not None:
        known.append(lattice)
    for other in known[1:]:
        if other.M != known[0].M or not np.isclose(other.xi_max, known[0].xi_max, rtol=1e-12, atol=0):
            raise LatticeError(f"fields on different lattices cannot be compared: {known[0]} and {other}")
    common = known[0] if known else None
    return field_of(a, common, orders), field_of(b, common, orders)


def triples_of(values: ArrayLike, what: str) -> Reals:
    """Values as float64 (n, 3); they may be infinite or NaN.

    Raises:
        InputError: they are not real, or not of that shape; the message names ``what`` they are.
    """
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be real numbers (n, 3): {error}") from error
    if found.ndim != 2 or found.shape[1] != 3:
        raise InputError(f"{what} must have the shape (n, 3), found {found.shape}")
    return found


def check_surface(a: object) -> None:
    """Refuse what is no surface.

    Raises:
        InputError: it is no mesh, no sphere and not given by a parametrisation.
    """
    if not isinstance(a, Mesh | Sphere | Smooth):
        raise InputError(
            "expected a Mesh, a Sphere, a parametrised surface (Ellipsoid, Torus, ParametrisedSurface) or a Fourier "
            f"field, found {type(a).__name__}"
        )


def quality_of(field: xr.DataArray) -> Quality | None:
    """What a field says of its own quality: an attribute of computed fields, a coordinate of stored ones."""
    text = field.coords["quality"].item() if "quality" in field.coords else field.attrs.get("quality")
    return Quality.from_json(text) if text else None


def read_blocks(
    lattice: Lattice, *fields: xr.DataArray, largest: int = BLOCK_SAMPLES
) -> Iterator[tuple[Block, list[Complexes]]]:
    """The values of fields, one block of their half lattice after the other, so that they need not fit into memory."""
    for block in lattice.split(largest):
        places = dict(zip(AXES, lattice.place(block), strict=True))
        yield block, [np.asarray(field.isel(places).transpose(*AXES).values) for field in fields]


def shells_of(a: xr.DataArray, b: xr.DataArray | None, lattice: Lattice) -> Reals:
    """Shell sums of |a|², or of |a - b|²."""
    sums = np.zeros(lattice.shell_count)
    for block, (values, *others) in read_blocks(lattice, *((a,) if b is None else (a, b))):
        sums += shell_sums(values - others[0] if others else values, None, lattice, block)
    return sums


def over_orders(order: Orders, values: dict[str, Reals]) -> xr.Dataset:
    """Values over the dimension `order`; a single number asked for comes back without dimensions."""
    orders = np.asarray(order, dtype=np.float64)
    dimensions = ("order",) * orders.ndim
    variables = {name: (dimensions, np.asarray(value).reshape(orders.shape)) for name, value in values.items()}
    return xr.Dataset(variables, coords={"order": (dimensions, orders)})
