"""`field.sobolev`: norms, distances and more as methods of the fields themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import xarray as xr
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, LatticeError
from sobolev_batch.spectral.lattice import AXES, Lattice
from sobolev_batch.spectral.metrics.decomposition import proportion
from sobolev_batch.spectral.metrics.inputs import Operand, pair_of
from sobolev_batch.spectral.metrics.interpolation import full_lattice, interpolate
from sobolev_batch.spectral.metrics.norms import distance, inner_product, norm
from sobolev_batch.spectral.metrics.spectrum import spectrum
from sobolev_batch.spectral.metrics.witness import witness
from sobolev_batch.spectral.shells import Orders, check_orders
from sobolev_batch.surfaces.shapes.similarity import Similarity


@xr.register_dataarray_accessor("sobolev")  # type: ignore[no-untyped-call]
class SobolevAccessor:
    """What this package computes from fields, on any Fourier field in xarray: ``field.sobolev.norm(-2)``.

    It is there once `fourier_transform` or `open_store` has been taken from the package; of fields that plain
    xarray opens, once this class has: ``from sobolev_batch import SobolevAccessor``.

    A field lies over xi_x, xi_y and xi_z >= 0, is the transform ∫ exp(-2πi ξ·x) dμ(x) with ξ in cycles per
    unit length, and may be lazy. `norm`, `inner_product`, `distance`, `proportion` and `spectrum` also take a
    stack of fields along one more dimension, such as mesh: one of them is read at a time, and the results
    lie along that dimension.

    Raises, in all methods:
        LatticeError: an array that is no field, or no single one where one is needed.
    """

    def __init__(self, field: xr.DataArray) -> None:
        self._field = field

    @property
    def lattice(self) -> Lattice:
        """The lattice on whose half the field is sampled."""
        return Lattice.of(self._field)

    def norm(self, order: Orders) -> xr.Dataset:
        """The norm ||a||_s of one order or several, with its error: see `sobolev_batch.norm`."""
        return self._each(lambda field: norm(field, order))

    def inner_product(self, other: Operand, order: Orders) -> xr.Dataset:
        """The inner product with another field or a surface: see `sobolev_batch.inner_product`."""
        return self._each_with(other, order, lambda field, common: inner_product(field, common, order))

    def distance(self, other: Operand, order: Orders) -> xr.Dataset:
        """The distance from another field or a surface, with its error: see `sobolev_batch.distance`."""
        return self._each_with(other, order, lambda field, common: distance(field, common, order))

    def proportion(self, other: Operand, order: Orders) -> xr.Dataset:
        """What a pure change of the other's area explains of the distance: see `sobolev_batch.proportion`."""
        return self._each_with(other, order, lambda field, common: proportion(field, common, order))

    def spectrum(
        self,
        other: Operand | None,
        order: Orders,
        *,
        bands: int | Sequence[float] | None = None,
        similarity: Similarity | None = None,
    ) -> xr.Dataset:
        """The squared distance, or without another the squared norm, by wavelength: see `sobolev_batch.spectrum`."""

        def one(field: xr.DataArray, common: Operand | None) -> xr.Dataset:
            return spectrum(field, common, order, bands=bands, similarity=similarity)

        if other is None:
            return self._each(lambda field: one(field, None))
        return self._each_with(other, order, one)

    def witness(
        self, other: Operand, order: Orders, points: ArrayLike, *, eps: float | None = None, memory: float | None = None
    ) -> xr.DataArray:
        """The witness function at points (n, 3), positive where this surface has more: see `sobolev_batch.witness`."""
        return witness(self._field, other, order, points, eps=eps, memory=memory)

    def at(self, frequencies: ArrayLike, *, reach: float | None = None) -> xr.DataArray:
        """The field at any frequencies ξ within the cube of its lattice, by band-limited interpolation.

        Args:
            frequencies: real (n, 3), in cycles per unit length, |ξ_i| <= ξ_max.
            reach: the surface lies in |x_i| <= reach, in units of length. Computed and stored fields know
                their surface's bounding box; other ones need it.

        Returns:
            complex128 (frequency,), with the coordinates xi_x, xi_y, xi_z, `error` (a bound on what
            interpolation adds) and `amplification` (of the field's own error, at most). Where the box fills a
            third of the period, `error` is 2e-10 of the area, and 1e-7 beside the faces of the cube.
            The whole field is read.

        Raises:
            LatticeError: frequencies beyond the cube.
            InputError: frequencies that are not finite or not (n, 3); no reach where one is needed.
        """
        return interpolate(self._field, frequencies, reach=reach)

    def full(self) -> xr.DataArray:
        """The field on the whole lattice, (M+1, M+1, M+1): at -ξ it is the conjugate of that at ξ.

        Lazy where the field is a Dask array; other dimensions stay.
        """
        return full_lattice(self._field)

    def _each_with(
        self, other: Operand, order: Orders, one: Callable[[xr.DataArray, xr.DataArray], xr.Dataset]
    ) -> xr.Dataset:
        """Over each field with one other, which is transformed once if it is a surface."""
        stacked = self._stacked()
        first = self._field if stacked is None else self._field.isel({stacked: 0})
        _, common = pair_of(first, other, None, check_orders(order))
        return self._each(lambda field: one(field, common))

    def _each(self, one: Callable[[xr.DataArray], xr.Dataset]) -> xr.Dataset:
        """What is found of each field, one after the other, along the dimension that they are stacked in."""
        stacked = self._stacked()
        if stacked is None:
            return one(self._field)
        found = [one(self._field.isel({stacked: i})) for i in range(self._field.sizes[stacked])]
        joined = xr.concat(found, dim=stacked, coords="minimal", compat="equals", join="exact", data_vars="all")
        return joined.assign_coords({stacked: self._field[stacked]} if stacked in self._field.coords else {})

    def _stacked(self) -> str | None:
        """The one dimension besides those of a field."""
        others = [str(name) for name in self._field.dims if name not in AXES]
        if len(others) > 1:
            raise LatticeError(f"fields may be stacked along one dimension, found {', '.join(others)}")
        if others and not self._field.sizes[others[0]]:
            raise InputError(f"the stack has no fields along {others[0]}")
        return others[0] if others else None
