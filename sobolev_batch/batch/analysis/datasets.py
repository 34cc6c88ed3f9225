"""The tables of a store as datasets, from records and reduced distances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.batch.analysis.ordering import TableOrder
from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.study.plan import Row
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.metrics.datasets import describe, observed_rates
from sobolev_batch.spectral.metrics.norms import Proportion

Reals = NDArray[np.float64]
# Labels, times and other metadata of meshes, as xarray takes coordinates.
Coordinates = Mapping[Any, Any]


def meshes_dataset(rows: Sequence[Row], records: Sequence[Record | None], order: TableOrder) -> xr.Dataset:
    """Return for each mesh family, level, rank, status, reason, counts, sizes, digests, seconds, worker, backend.

    Args:
        rows: Rows of the meshes, in the order of tables.
        records: Their records.
        order: Order of tables.
    """
    filled = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
        "level": np.array([row.member.level for row in rows], dtype=np.int64),
        "rank": np.array(order.ranks, dtype=np.int64),
        "ordered_by": _strings(order.criteria),
        "row": np.array(order.rows, dtype=np.int64),
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
    return describe(xr.Dataset(variables, coords=_meshes(rows), attrs={"metadata": list(_metadata(rows))}))


def norms_dataset(meshes: Coordinates, orders: Sequence[float], norms: NormEstimate) -> xr.Dataset:
    """Return `norm` (mesh, order) with its error, from values over (orders, meshes)."""
    return describe(xr.Dataset(_variables(norms.named("norm"), "mesh"), coords=_with_orders(meshes, orders)))


def distances_dataset(
    meshes: Coordinates, others: ArrayLike, orders: Sequence[float], distances: NormEstimate
) -> xr.Dataset:
    """Return `distance` (mesh, other, order) with its error, from values over (orders, meshes, others)."""
    coordinates = {**_with_orders(meshes, orders), "other": ("other", np.array(others, dtype=object))}
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
    meshes: Coordinates,
    orders: Sequence[float],
    to_reference: DistancesToReference,
    sizes: Reals,
    families: Iterable[Sequence[int]],
    accuracy: Accuracy | None,
) -> xr.Dataset:
    """Return distances to the reference, relative ones and their decomposition, and observed orders of convergence.

    Args:
        meshes: Labels of the meshes, with their times and other metadata: the coordinates of `meshes_dataset`.
        orders: Sobolev orders s.
        to_reference: Distances to the reference.
        sizes: Mean edge lengths (meshes,).
        families: Meshes of each family that goes from coarse to fine.
        accuracy: Accuracy that the study asks for, if any.
    """
    reference, proportion = to_reference.reference, to_reference.proportion
    distances, errors = to_reference.distances.values, to_reference.distances.errors
    labels = xr.Dataset(coords=meshes)["mesh"].values
    rates, rate_errors = (np.full_like(distances, np.nan) for _ in range(2))
    for family in families:
        members = [i for i in family if labels[i] != reference]
        for k in range(len(orders)):
            rates[k, members], rate_errors[k, members] = observed_rates(
                distances[k, members], errors[k, members], sizes[members]
            )
    norms = NormEstimate(*(part[:, None] for part in to_reference.norms))
    relative, relative_errors = to_reference.distances.relative_to(norms)
    within = np.ones_like(distances, dtype=bool) if accuracy is None else accuracy.met(to_reference.distances)
    columns = {
        **to_reference.distances.named("distance"),
        "relative": relative,
        "relative_error": relative_errors,
        "area_part": proportion.area,
        "shape_part": proportion.shape,
        "rate": rates,
        "rate_error": rate_errors,
        "resolved": errors < distances,
        "within": within,
    }
    dataset = xr.Dataset(
        {**_variables(columns, "mesh"), "edge_length": ("mesh", sizes)},
        coords=_with_orders(meshes, orders),
        attrs={"reference": reference, **({} if accuracy is None else {"rtol": accuracy.rtol})},
    )
    return describe(dataset)


def _variables(values: Mapping[str, NDArray[Any]], *dimensions: str) -> dict[str, Any]:
    """Return values (orders, ...) as variables whose last dimension is the order."""
    return {name: ((*dimensions, "order"), np.moveaxis(array, 0, -1)) for name, array in values.items()}


def _with_orders(meshes: Coordinates, orders: Sequence[float]) -> dict[str, Any]:
    return {**meshes, "order": ("order", np.array(orders, dtype=np.float64))}


def _meshes(rows: Sequence[Row]) -> Coordinates:
    """Return labels, and times and other metadata where any mesh has some."""
    coordinates = {"mesh": _strings([row.label for row in rows]), **_metadata(rows)}
    times = [row.member.time for row in rows]
    if any(time is not None for time in times):
        coordinates["time"] = np.array([np.nan if time is None else time for time in times])
    return {name: ("mesh", values) for name, values in coordinates.items()}


def _metadata(rows: Sequence[Row]) -> dict[str, NDArray[np.generic]]:
    """Return the metadata of meshes by name: numbers with NaN, or texts with empty ones, where a mesh has none."""
    given = [dict(row.member.metadata) for row in rows]
    columns: dict[str, NDArray[np.generic]] = {}
    for name in dict.fromkeys(name for metadata in given for name in metadata):
        values = [metadata.get(name) for metadata in given]
        if any(isinstance(value, str) for value in values):
            columns[name] = _strings(["" if value is None else str(value) for value in values])
        else:
            columns[name] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return columns


def _strings(values: Sequence[str]) -> NDArray[np.generic]:
    # Object arrays become variable-length strings in zarr; fixed-length ones are outside its format.
    return np.array(values, dtype=object)
