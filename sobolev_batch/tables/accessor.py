"""`field.sobolev`: norms, distances and more as methods of the fields themselves."""

from collections.abc import Callable, Sequence
from functools import partial

import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.causes import spectrum, witness
from sobolev_batch.norms.distances import distance, norm
from sobolev_batch.norms.fields import OperandLike, pair_of
from sobolev_batch.transform.lattice import AXES, Lattice, Orders, check_orders


@xr.register_dataarray_accessor("sobolev")  # type: ignore[no-untyped-call]
class SobolevAccessor:
    """Norms, distances and more as methods of any Fourier field in xarray: ``field.sobolev.norm(-2)``.

    Fields have the accessor once you import `fourier_transform` or `open_store` from the package. For fields that
    you open with plain xarray, import this class: ``from sobolev_batch.result_types import SobolevAccessor``.

    A field lies over xi_x, xi_y and xi_z >= 0, is the transform ∫ exp(-2πi ξ·x) dμ(x) with ξ in cycles per
    unit length, and may be lazy. `norm`, `distance` and `spectrum` also take a stack of fields
    along one more dimension, such as mesh. They read one field at a time, and their results have that dimension.

    Raises:
        LatticeError: In all methods: the array is no field, or several fields where one is needed.

    >>> import sobolev_batch as sb
    >>> fields = sb.open_store("storage/icosphere.zarr")["fourier"]["fourier"]
    >>> coarse, reference = fields.sel(mesh="icosphere/1"), fields.sel(mesh="reference")
    >>> coarse.sobolev.lattice
    Lattice(xi_max=5.0, M=48)
    >>> coarse.sobolev.norm(-4)["norm"].item() < reference.sobolev.norm(-4)["norm"].item()
    True
    >>> coarse.sobolev.distance(reference, [-10, -4])["distance"].dims
    ('order',)
    >>> fields.sel(mesh=["icosphere/0", "icosphere/1"]).sobolev.distance(reference, -4)["distance"].dims
    ('mesh',)
    """

    def __init__(self, field: xr.DataArray) -> None:
        self._field = field

    @property
    def lattice(self) -> Lattice:
        """Lattice on whose Hermitian half the field is sampled."""
        return Lattice.from_field(self._field)

    def norm(self, order: Orders = DEFAULT_ORDER) -> xr.Dataset:
        """Return the norm ||a||_s of one order or several, with its error; see `sobolev_batch.norm`."""
        return self._each(partial(norm, order=order))

    def distance(self, other: OperandLike, order: Orders = DEFAULT_ORDER) -> xr.Dataset:
        """Return the distance from another field or a surface, with its error; see `sobolev_batch.distance`."""
        return self._each(partial(distance, order=order), self._transformed(other, order))

    def spectrum(
        self,
        other: OperandLike | None,
        order: Orders = DEFAULT_ORDER,
        *,
        bands: int | Sequence[float] | None = None,
        similarity: Similarity | None = None,
    ) -> xr.Dataset:
        """Return the squared distance, or squared norm if other is None, by wavelength (`sobolev_batch.spectrum`)."""
        common = None if other is None else self._transformed(other, order)
        return self._each(partial(spectrum, order=order, bands=bands, similarity=similarity), common)

    def witness(
        self, other: OperandLike, order: Orders, points: ArrayLike, *, eps: float | None = None
    ) -> xr.DataArray:
        """Return the witness function (`sobolev_batch.witness`) at points (n, 3), positive where this has more area."""
        return witness(self._field, other, order, points, eps=eps)

    def _transformed(self, other: OperandLike, order: Orders) -> xr.DataArray:
        """Return the field of another surface on the same lattice."""
        stacked = self._stacked()
        first = self._field if stacked is None else self._field.isel({stacked: 0})
        return pair_of(first, other, None, check_orders(order))[1]

    def _each(self, one: Callable[..., xr.Dataset], *others: xr.DataArray | None) -> xr.Dataset:
        """Apply a function to each field, and the same others, and join results along the dimension of the stack."""
        if (stacked := self._stacked()) is None:
            return one(self._field, *others)
        results = [one(self._field.isel({stacked: i}), *others) for i in range(self._field.sizes[stacked])]
        joined = xr.concat(results, dim=stacked, coords="minimal", compat="equals", join="exact", data_vars="all")
        return joined.assign_coords({stacked: self._field[stacked]} if stacked in self._field.coords else {})

    def _stacked(self) -> str | None:
        """Return the dimension of the stack, or None for a single field."""
        if len(others := [str(name) for name in self._field.dims if name not in AXES]) > 1:
            raise LatticeError(f"fields may be stacked along one dimension, found {', '.join(others)}")
        if others and not self._field.sizes[others[0]]:
            raise InputError(f"the stack has no fields along {others[0]}")
        return others[0] if others else None
