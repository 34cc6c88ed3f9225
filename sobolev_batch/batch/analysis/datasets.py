"""The tables of a store as datasets, from records and reduced distances.

Families are in the order of the study, and the meshes of each from coarse to fine.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.study.plan import Row
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import NormEstimate
from sobolev_batch.spectral.metrics.datasets import describe, observed_rates
from sobolev_batch.surfaces.sources.names import natural_key

Reals = NDArray[np.float64]
# Labels, times and other metadata of meshes, as xarray takes coordinates.
Coordinates = Mapping[Any, Any]
Criterion = Literal["level", "triangles", "names", "time"]

# Between numbers of triangles of a family that goes from coarse to fine: then edges differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10


@dataclass(frozen=True)
class TableOrder:
    """The order of the rows of a store in its tables.

    Attributes:
        rows: Numbers of the rows, in this order.
        ranks: Place of each of them in its family, from 0.
        criteria: What orders the family of each of them.
    """

    rows: tuple[int, ...]
    ranks: tuple[int, ...]
    criteria: tuple[Criterion, ...]

    @classmethod
    def from_workspace(cls, workspace: Workspace) -> Self:
        """Return the order of the meshes that the study of a workspace has."""
        families: dict[str, list[int]] = {row.family: [] for row in workspace.plan.rows}
        for i, row in workspace.rows.items():
            families[row.family].append(i)
        placed: list[tuple[int, int, Criterion]] = []
        for family, numbers in families.items():
            rows = {i: workspace.rows[i] for i in numbers}
            records = [workspace.records[i] for i in numbers]
            criterion = _criterion(workspace.plan.study, family, list(rows.values()), records)
            keys = {i: _key(criterion, row, workspace.records[i]) for i, row in rows.items()}
            placed += ((i, rank, criterion) for rank, i in enumerate(sorted(keys, key=keys.__getitem__)))
        return cls(
            tuple(i for i, _, _ in placed),
            tuple(rank for _, rank, _ in placed),
            tuple(criterion for _, _, criterion in placed),
        )

    def families_with_rates(self, rows: Mapping[int, Row]) -> dict[str, list[int]]:
        """Return the places in this order of the meshes of each family that goes from coarse to fine."""
        families: dict[str, list[int]] = {}
        for place, (i, criterion) in enumerate(zip(self.rows, self.criteria, strict=True)):
            if criterion in ("level", "triangles"):
                families.setdefault(rows[i].family, []).append(place)
        return families


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
        proportion: Parts of these distances: see `area_and_shape`.
        norms: Norms of the reference over (orders,).
    """

    reference: str
    distances: NormEstimate
    proportion: Reals
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
        accuracy: Accuracy that the study requests, if any.
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
        "area_part": proportion[0],
        "shape_part": proportion[1],
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


def _criterion(study: Study, family: str, rows: Sequence[Row], records: Sequence[Record | None]) -> Criterion:
    chosen = next((one.order_by for one in study.families if one.name == family), None)
    if chosen is not None:
        return chosen
    if any(row.member.time is not None for row in rows):
        return "time"
    if all(row.member.level >= 0 for row in rows):
        return "level"
    counts = [one.facts.triangles for one in records if one is not None and one.status == "complete"]
    return "names" if len(counts) > 1 and not _are_graded(counts) else "triangles"


def _are_graded(counts: Sequence[int]) -> bool:
    """Tell whether meshes go from coarse to fine: scans of one object, or copies with noise, do not."""
    steps, largest = 0, 0.0
    for count in sorted(counts):
        if count > _SMALLEST_STEP * largest:
            steps, largest = steps + 1, float(count)
    # A few of other sizes may be parts of the object.
    return steps > 1 and _MOST_OF_ONE_SIZE * steps >= len(counts)


def _key(criterion: Criterion, row: Row, record: Record | None) -> tuple[Any, ...]:
    """Return what a row is sorted by; where it is equal, names decide."""
    name = natural_key(row.member.name)
    if criterion == "time":
        return math.inf if row.member.time is None else row.member.time, name
    if criterion == "level":
        return row.member.level, name
    if criterion == "triangles":
        # A mesh that failed has no triangles that are known.
        is_known = record is not None and record.status == "complete"
        return record.facts.triangles if record is not None and is_known else math.inf, name
    return (name,)
