"""The tables of a store as datasets, from records and reduced distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.study.plan import Row
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.metrics.datasets import describe
from sobolev_batch.spectral.metrics.decomposition import Proportion
from sobolev_batch.spectral.metrics.rates import observed_rates

Reals = NDArray[np.float64]


def meshes_dataset(rows: Sequence[Row], records: Sequence[Record | None]) -> xr.Dataset:
    """Return for each mesh family, level, status, reason, counts, sizes, digests, seconds, worker, backend."""
    filled = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
        "level": np.array([row.member.level for row in rows], dtype=np.int64),
        "status": _strings(["missing" if record is None else record.status for record in records]),
        "reason": _strings([record.reason for record in filled]),
    }
    for item in fields(Facts):
        values = [getattr(record.facts, item.name) for record in filled]
        columns[item.name] = _strings(values) if isinstance(item.default, str) else np.array(values)
    columns["seconds"] = np.array([record.seconds for record in filled])
    for name in ("worker", "backend", "finished", "key"):
        columns[name] = _strings([getattr(record, name) for record in filled])
    variables = {name: ("mesh", values) for name, values in columns.items()}
    return describe(xr.Dataset(variables, coords=_meshes(rows)))


def norms_dataset(rows: Sequence[Row], orders: Sequence[float], norms: NormEstimate) -> xr.Dataset:
    """Return `norm` (mesh, order) with its error, from values over (orders, meshes)."""
    return describe(xr.Dataset(_variables(norms.named("norm"), "mesh"), coords=_coordinates(rows, orders)))


def distances_dataset(
    rows: Sequence[Row], others: Sequence[Row], orders: Sequence[float], distances: NormEstimate
) -> xr.Dataset:
    """Return `distance` (mesh, other, order) with its error, from values over (orders, meshes, others)."""
    coordinates = {**_coordinates(rows, orders), "other": ("other", _strings([row.label for row in others]))}
    return describe(xr.Dataset(_variables(distances.named("distance"), "mesh", "other"), coords=coordinates))


@dataclass(frozen=True, eq=False)
class DistancesToReference:
    """The distances of meshes to the reference.

    Attributes:
        reference: Label of the reference.
        distances: Distances over (orders, meshes), NaN where missing.
        proportion: Decomposition of these distances.
        norms: Norms of the reference over (orders,).
    """

    reference: str
    distances: NormEstimate
    proportion: Proportion
    norms: NormEstimate


def convergence_dataset(
    rows: Sequence[Row],
    orders: Sequence[float],
    to_reference: DistancesToReference,
    sizes: Reals,
    accuracy: Accuracy | None,
) -> xr.Dataset:
    """Return distances to the reference, relative ones and their decomposition, and observed orders of convergence.

    Args:
        rows: Rows of the meshes.
        orders: Sobolev orders s.
        to_reference: Distances to the reference.
        sizes: Mean edge lengths (meshes,).
        accuracy: Accuracy that the study asks for, if any.
    """
    reference, proportion = to_reference.reference, to_reference.proportion
    distances, errors = to_reference.distances.values, to_reference.distances.errors
    rates, rate_errors = (np.full_like(distances, np.nan) for _ in range(2))
    for family in dict.fromkeys(row.family for row in rows):
        # Only levels form a sequence; files of one family may be unrelated shapes.
        members = [
            i for i, row in enumerate(rows) if row.family == family and row.member.level >= 0 and row.label != reference
        ]
        for k in range(len(orders)):
            rates[k, members], rate_errors[k, members] = observed_rates(
                distances[k, members], errors[k, members], sizes[members]
            )
    norms, norm_errors = to_reference.norms.values[:, None], to_reference.norms.errors[:, None]
    relative = distances / norms
    within = np.ones_like(distances, dtype=bool) if accuracy is None else accuracy.met(to_reference.distances)
    columns = {
        **to_reference.distances.named("distance"),
        "relative": relative,
        "relative_error": errors / norms + relative * norm_errors / norms,
        "area_part": proportion.area,
        "shape_part": proportion.shape,
        "rate": rates,
        "rate_error": rate_errors,
        "resolved": errors < distances,
        "within": within,
    }
    dataset = xr.Dataset(
        {**_variables(columns, "mesh"), "edge_length": ("mesh", sizes)},
        coords=_coordinates(rows, orders),
        attrs={"reference": reference, **({} if accuracy is None else {"rtol": accuracy.rtol})},
    )
    return describe(dataset)


def _variables(values: Mapping[str, NDArray[Any]], *dimensions: str) -> dict[str, Any]:
    """Return values (orders, ...) as variables whose last dimension is the order."""
    return {name: ((*dimensions, "order"), np.moveaxis(array, 0, -1)) for name, array in values.items()}


def _coordinates(rows: Sequence[Row], orders: Sequence[float]) -> dict[str, tuple[str, NDArray[np.generic]]]:
    return {**_meshes(rows), "order": ("order", np.array(orders, dtype=np.float64))}


def _meshes(rows: Sequence[Row]) -> dict[str, tuple[str, NDArray[np.generic]]]:
    """Return labels, and times where any mesh has one."""
    labels = {"mesh": ("mesh", _strings([row.label for row in rows]))}
    times = [row.member.time for row in rows]
    if all(time is None for time in times):
        return labels
    return {**labels, "time": ("mesh", np.array([np.nan if time is None else time for time in times]))}


def _strings(values: Sequence[str]) -> NDArray[np.generic]:
    # Object arrays become variable-length strings in zarr; fixed-length ones are outside its format.
    return np.array(values, dtype=object)
