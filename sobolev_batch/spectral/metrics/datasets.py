"""Datasets of metrics, with units, long names, and the lattice and kernel that they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import Orders, Reals

KERNEL = "weight (1 + |xi|^2)^s, xi in cycles per unit length"
LENGTH, AREA, FREQUENCY, NUMBER = "unit length", "unit length squared", "cycles per unit length", "1"
# ||a||_s² = ∫ (1 + |ξ|²)^s |a^|² dξ is an area squared per volume.
NORM = "unit length^(1/2)"

Labels = Mapping[str, tuple[str, str]]

_ORDER = {"long_name": "Sobolev order s", "units": NUMBER}


def order_axis(order: Orders) -> tuple[tuple[str, ...], Reals, dict[str, str]]:
    """Return the coordinate `order`: a dimension for several orders, a scalar for one."""
    orders = np.asarray(order, dtype=np.float64)
    return ("order",) * orders.ndim, orders, _ORDER


def labelled(order: Orders, values: Mapping[str, Reals], labels: Labels, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return values over the dimension `order`, or without dimensions for a single order.

    Args:
        order: Order or orders, as the user gave them.
        values: Variables by name, (orders,) each.
        labels: Long name and unit of each variable.
        attributes: Attributes of the dataset besides the kernel.
    """
    axis = order_axis(order)
    variables = {
        name: (axis[0], np.asarray(value).reshape(axis[1].shape), described(*labels[name]))
        for name, value in values.items()
    }
    return xr.Dataset(variables, coords={"order": axis}, attrs={"kernel": KERNEL, **attributes})


def described(long_name: str, units: str) -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def lattice_attributes(lattice: Lattice, *fields: xr.DataArray) -> dict[str, Any]:
    """Return the attributes of a dataset that was computed from fields on a lattice."""
    dtypes = dict.fromkeys(str(field.dtype) for field in fields)
    return {"xi_max": lattice.xi_max, "M": lattice.M, "dtype": ", ".join(dtypes)}
