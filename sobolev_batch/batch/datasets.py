"""The small arrays of a store, put together from records and reduced distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.plan import Row
from sobolev_batch.batch.records import Facts, Record
from sobolev_batch.spectral.convergence import observed_rates

Reals = NDArray[np.float64]

_UNITS = {
    "area": "unit length squared",
    "edge_length_mean": "unit length",
    "edge_length_max": "unit length",
    "seconds": "s",
}


def meshes_dataset(rows: Sequence[Row], records: Sequence[Record | None]) -> xr.Dataset:
    """Per mesh: family, level, status, reason, counts, sizes, digests, seconds, worker, backend."""
    known = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
        "level": np.array([row.member.level for row in rows], dtype=np.int64),
        "status": _strings(["missing" if record is None else record.status for record in records]),
        "reason": _strings([record.reason for record in known]),
    }
    for item in fields(Facts):
        values = [getattr(record.facts, item.name) for record in known]
        columns[item.name] = _strings(values) if isinstance(item.default, str) else np.array(values)
    columns["seconds"] = np.array([record.seconds for record in known])
    for name in ("worker", "backend", "key"):
        columns[name] = _strings([getattr(record, name) for record in known])
    return xr.Dataset(
        {name: ("mesh", values, {"units": _UNITS[name]} if name in _UNITS else {}) for name, values in columns.items()},
        coords={"mesh": _labels(rows)},
    )


def norms_dataset(rows: Sequence[Row], orders: Sequence[float], norms: Reals) -> xr.Dataset:
    """`norm` (mesh, order) from an array (orders, meshes)."""
    return xr.Dataset({"norm": (("mesh", "order"), norms.T)}, coords=_coordinates(rows, orders))


def distances_dataset(
    rows: Sequence[Row], others: Sequence[Row], orders: Sequence[float], distances: Reals
) -> xr.Dataset:
    """`distance` (mesh, other, order) from an array (orders, meshes, others)."""
    return xr.Dataset(
        {"distance": (("mesh", "other", "order"), np.moveaxis(distances, 0, -1))},
        coords={**_coordinates(rows, orders), "other": ("other", _strings([row.label for row in others]))},
    )


def convergence_dataset(
    rows: Sequence[Row],
    orders: Sequence[float],
    to_reference: Reals,
    reference_norms: Reals,
    sizes: Reals,
    reference: str,
) -> xr.Dataset:
    """Distances to the reference, relative ones, and observed rates within each family.

    Args:
        rows: the meshes.
        orders: s, each.
        to_reference: (orders, meshes), NaN where missing.
        reference_norms: (orders,).
        sizes: (meshes,) mean edge lengths.
        reference: label of the reference's row.
    """
    rates = np.full_like(to_reference, np.nan)
    for family in dict.fromkeys(row.family for row in rows):
        # Only levels form a sequence; files of one family may be unrelated shapes.
        members = [
            i for i, row in enumerate(rows) if row.family == family and row.member.level >= 0 and row.label != reference
        ]
        for k in range(len(orders)):
            rates[k, members] = observed_rates(to_reference[k, members], sizes[members])
    return xr.Dataset(
        {
            "distance": (("mesh", "order"), to_reference.T),
            "relative": (("mesh", "order"), (to_reference / reference_norms[:, None]).T),
            "rate": (("mesh", "order"), rates.T),
            "edge_length": ("mesh", sizes, {"units": "unit length"}),
        },
        coords=_coordinates(rows, orders),
        attrs={"reference": reference},
    )


def _coordinates(rows: Sequence[Row], orders: Sequence[float]) -> dict[str, tuple[str, NDArray[np.generic]]]:
    return {"mesh": _labels(rows), "order": ("order", np.array(orders, dtype=np.float64))}


def _labels(rows: Sequence[Row]) -> tuple[str, NDArray[np.generic]]:
    return "mesh", _strings([row.label for row in rows])


def _strings(values: Sequence[str]) -> NDArray[np.generic]:
    # Object arrays become variable-length strings in zarr; fixed-length ones are outside its format.
    return np.array(values, dtype=object)
