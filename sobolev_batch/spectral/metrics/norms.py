"""Sobolev norms, inner products and distances of fields, for any list of orders at once.

The weight (1 + |ξ|²)^s depends on the shell |k|² of a lattice point only. A field is therefore
reduced to one number per shell first, whatever the orders; a norm of any order is then a short
weighted sum of those. Fields are read block by block, so they need not fit into memory.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import xarray as xr

from sobolev_batch.errors import InputError
from sobolev_batch.spectral.adaptive.solve import pursue
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.errors.budget import NormEstimate, estimate_norms, sums_of_shells
from sobolev_batch.spectral.exact.spheres import sphere_distance, sphere_inner_product, sphere_norm
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.inputs import (
    check_surface,
    field_of,
    over_orders,
    pair_of,
    quality_of,
    read_blocks,
    shells_of,
)
from sobolev_batch.spectral.shells import Orders, Reals, check_orders, shell_sums, shell_weights
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

# Relative accuracy of the closed forms of spheres.
_CLOSED_FORM_ACCURACY = 1e-13


def norm(
    a: Surface | xr.DataArray,
    order: Orders,
    *,
    lattice: Lattice | None = None,
    rtol: float | None = None,
    memory: float | None = None,
) -> xr.Dataset:
    """The Sobolev norm ||a||_s of a surface's area measure, with its error.

    Args:
        a: a field from `fourier_transform` or a store, or a surface. A sphere without a lattice is
            answered in closed form.
        order: one order s < -1/2, or several.
        lattice: where a surface is to be transformed; a field brings its own.
        rtol: instead of a lattice, the accuracy that is asked for; see `distance`.
        memory: bytes that a transform may take with rtol; default 2e9.

    Returns:
        A dataset over `order` with `norm`, its `error`, and the parts of that: `truncation` (what
        lies beyond xi_max; it can only add to the norm), `aliasing` and `discretisation`. The error
        is NaN for fields that do not say what they were computed from.

    Raises:
        OrderError: an order that is not below -1/2.
        InputError: a mesh without a lattice or an rtol; or both of these.
        AccuracyError: the rtol is out of reach within the memory.
    """
    orders = check_orders(order)
    if rtol is not None:
        return _pursued("norm", (a,), order, lattice, _accuracy(rtol, memory))
    if memory is not None:
        raise InputError("memory limits what an rtol may cost; without an rtol it has no meaning")
    if isinstance(a, Sphere) and lattice is None:
        values = np.array([sphere_norm(a, s) for s in orders])
        return _dataset("norm", order, _closed_form(values, values**2))
    field = field_of(a, lattice, orders)
    known = Lattice.of(field)
    return _dataset("norm", order, _assessed(shells_of(field, None, known), known, orders, [field]))


def inner_product(
    a: Surface | xr.DataArray, b: Surface | xr.DataArray, order: Orders, *, lattice: Lattice | None = None
) -> xr.Dataset:
    """The Sobolev inner product <a, b>_s, with the arguments of `distance`; real, since measures are.

    Returns:
        A dataset over `order` with `inner_product`.
    """
    orders = check_orders(order)
    if isinstance(a, Sphere) and isinstance(b, Sphere) and lattice is None:
        values = np.array([sphere_inner_product(a, b, s) for s in orders])
    else:
        first, second = pair_of(a, b, lattice, orders)
        known = Lattice.of(first)
        sums = np.zeros(known.shell_count)
        for block, (values_a, values_b) in read_blocks(known, first, second):
            sums += shell_sums(values_a, values_b, known, block)
        values = shell_weights(known, orders) @ sums
    return over_orders(order, {"inner_product": values})


def distance(
    a: Surface | xr.DataArray,
    b: Surface | xr.DataArray,
    order: Orders,
    *,
    lattice: Lattice | None = None,
    rtol: float | None = None,
    memory: float | None = None,
) -> xr.Dataset:
    """The Sobolev distance ||a - b||_s of two surfaces' area measures, with its error.

    Args:
        a: a field, or a surface. Two spheres without a lattice are answered in closed form.
        b: a field on the same lattice, or a surface.
        order: one order s < -1/2, or several.
        lattice: where surfaces are to be transformed; a field brings its own.
        rtol: instead of a lattice, the largest error of the distance relative to it. Lattice,
            triangle rules, NUFFT accuracy and precision are then chosen, and chosen again where the
            result's own error falls short; the attributes of what is returned tell what they were.
        memory: bytes that a transform may take with rtol; default 2e9.

    Returns:
        A dataset over `order` with `distance`, its `error`, and the parts of that; see `norm`. With
        rtol, `within` says whether the error is below rtol times the distance.

    Raises:
        OrderError: an order that is not below -1/2.
        LatticeError: fields on different lattices, or a surface that does not fit into the lattice.
        InputError: a mesh, and no lattice from anywhere; or a lattice or a field, and an rtol.
        AccuracyError: the rtol is out of reach within the memory; says what can be reached.
    """
    orders = check_orders(order)
    if rtol is not None:
        return _pursued("distance", (a, b), order, lattice, _accuracy(rtol, memory))
    if memory is not None:
        raise InputError("memory limits what an rtol may cost; without an rtol it has no meaning")
    if isinstance(a, Sphere) and isinstance(b, Sphere) and lattice is None:
        values = np.array([sphere_distance(a, b, s) for s in orders])
        squares = np.array([sphere_norm(a, s) ** 2 + sphere_norm(b, s) ** 2 for s in orders])
        return _dataset("distance", order, _closed_form(values, squares))
    first, second = pair_of(a, b, lattice, orders)
    known = Lattice.of(first)
    return _dataset("distance", order, _assessed(shells_of(first, second, known), known, orders, [first, second]))


def _accuracy(rtol: float, memory: float | None) -> Accuracy:
    return Accuracy(rtol) if memory is None else Accuracy(rtol, memory)


def _pursued(
    name: str, parts: Sequence[Surface | xr.DataArray], order: Orders, lattice: Lattice | None, accuracy: Accuracy
) -> xr.Dataset:
    """A norm or distance to an accuracy, with what was chosen for it in the attributes."""
    surfaces = [part for part in parts if not isinstance(part, xr.DataArray)]
    if lattice is not None or len(surfaces) < len(parts):
        raise InputError("an rtol chooses the lattice: pass surfaces and no lattice, or a lattice and no rtol")
    for surface in surfaces:
        check_surface(surface)
    orders = check_orders(order)
    found = pursue(surfaces, orders, accuracy, threads=os.cpu_count() or 1, what=f"the {name}")
    dataset = _dataset(name, order, found.assessed)
    within = accuracy.met(found.assessed).reshape(np.shape(order))
    settings = [field.settings for field in found.fields]
    return dataset.assign(within=(dataset[name].dims, within)).assign_attrs(
        rtol=accuracy.rtol,
        xi_max=found.lattice.xi_max,
        M=found.lattice.M,
        dtype=settings[0].dtype,
        eps=[setting.eps for setting in settings],
        tolerance=[setting.tolerance for setting in settings],
        points=[field.points for field in found.fields],
    )


def _assessed(sums: Reals, lattice: Lattice, orders: Sequence[float], fields: Sequence[xr.DataArray]) -> NormEstimate:
    """The norm of what the fields add up to, with the error that follows from their qualities."""
    qualities = [quality_of(field) for field in fields]
    known = [quality for quality in qualities if quality is not None]
    complete = len(known) == len(qualities)
    found = estimate_norms(
        sums_of_shells(sums, lattice, orders),
        lattice,
        orders,
        areas=np.array(sum(quality.area for quality in known)),
        widths=Extent.union([quality.extent for quality in known]).widths if complete else np.zeros(len(DIRECTIONS)),
        discretisation=np.sum([quality.probe.norms(lattice, orders) for quality in known], axis=0),
    )
    if complete:
        return found
    unknown = np.full(len(orders), np.nan)
    return NormEstimate(found.values, unknown, unknown, unknown)


def _closed_form(values: Reals, squares: Reals) -> NormEstimate:
    """Values whose squares are exact up to a small part of some squared norms."""
    nothing = np.zeros_like(values)
    rounding = _CLOSED_FORM_ACCURACY * squares
    return NormEstimate(
        values, nothing, nothing, np.sqrt(values**2 + rounding) - values + rounding**0.5 * (values == 0)
    )


def _dataset(name: str, order: Orders, found: NormEstimate) -> xr.Dataset:
    """A number with its error and the parts of that."""
    parts = {
        name: found.values,
        "error": found.errors,
        "truncation": found.truncation,
        "aliasing": found.aliasing,
        "discretisation": found.discretisation,
    }
    return over_orders(order, parts)
