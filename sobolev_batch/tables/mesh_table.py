"""The table of a store's meshes: families in the order of the study, and the meshes of each from coarse to fine."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.norms.columns import VARIABLES, describe
from sobolev_batch.sources.names import natural_key
from sobolev_batch.sources.programs import Cost
from sobolev_batch.store.layout import NUMERICS
from sobolev_batch.store.records import Facts, Record
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Row
from sobolev_batch.study.study import Study
from sobolev_batch.tables.results import COORDINATES, SOME_COORDINATES

Criterion = Literal["level", "triangles", "names", "time"]
# A row, its place in its family, and what orders that.
Placed = tuple[int, int, Criterion]

# Between numbers of triangles of a family that goes from coarse to fine: then edges differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10


def table_order(workspace: Workspace) -> list[Placed]:
    """Return the rows of the study in the order of tables, each with its place in its family and what orders that."""
    complete, families = workspace.complete, {row.family: list[int]() for row in workspace.plan.rows}
    for i, row in workspace.rows.items():
        families[row.family].append(i)
    placed: list[Placed] = []
    for family, numbers in families.items():
        rows = [workspace.rows[i] for i in numbers]
        counts = {i: complete[i].facts.triangles for i in numbers if i in complete}
        criterion = _criterion(workspace.plan.study, family, rows, list(counts.values()))
        keys = {i: _key(criterion, workspace.rows[i], counts.get(i)) for i in numbers}
        placed += ((i, rank, criterion) for rank, i in enumerate(sorted(keys, key=keys.__getitem__)))
    return placed


def meshes_table(workspace: Workspace, placed: Sequence[Placed]) -> xr.Dataset:
    """Return for each mesh family, level, rank, status, reason, counts, sizes, digests, seconds, worker, backend."""
    numbers, ranks, criteria = zip(*placed, strict=True)
    rows, records = [workspace.rows[i] for i in numbers], [workspace.records[i] for i in numbers]
    filled = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
        "is_reference": np.array([row.label == workspace.plan.reference for row in rows]),
        "level": np.array([row.member.level for row in rows], dtype=np.int64),
        "rank": np.array(ranks, dtype=np.int64),
        "ordered_by": _strings(criteria),
        "row": np.array(numbers, dtype=np.int64),
        "status": _strings(["missing" if record is None else record.status for record in records]),
        "reason": _strings([record.reason for record in filled]),
    }
    is_complete = np.array([record.status == "complete" for record in filled])
    for item in fields(Facts):
        values = [getattr(record.facts, item.name) for record in filled]
        # Nothing is known of a mesh that failed, which is not zero.
        unknown = -1 if "valid_min" in VARIABLES[item.name] else np.nan
        is_text = isinstance(item.default, str)
        columns[item.name] = _strings(values) if is_text else np.where(is_complete, values, unknown)
    if any(record.cost for record in filled):
        costs = [record.cost or Cost() for record in filled]
        columns |= {item.name: np.array([getattr(cost, item.name) for cost in costs]) for item in fields(Cost)}
    columns["seconds"] = np.array([record.seconds for record in filled])
    # numpy's times are in UTC, and know no zone.
    times_of_end = [record.finished.removesuffix("Z") or "NaT" for record in filled]
    columns["finished"] = np.array(times_of_end, dtype="datetime64[s]")
    columns[NUMERICS] = np.array([record.numerics for record in filled], dtype=np.int64)
    for name in ("worker", "backend", "key"):
        columns[name] = _strings([getattr(record, name) for record in filled])
    columns["mesh"], metadata = _strings([row.label for row in rows]), _metadata(rows)
    times = [row.member.time for row in rows]
    if any(time is not None for time in times):
        columns["time"] = np.array([np.nan if time is None else time for time in times])
    variables = {name: ("mesh", values) for name, values in {**columns, **metadata}.items()}
    table = xr.Dataset(variables, attrs={"metadata": list(metadata)})
    # Else xarray counts from the first of them, and no two tables have the same metadata.
    table["finished"].encoding = {"units": "seconds since 1970-01-01", "dtype": "int64"}
    # Texts have no missing value, which `where` needs of variables that are no coordinates.
    texts = [name for name, values in columns.items() if values.dtype == object]
    return describe(table.set_coords([*texts, *COORDINATES, *sorted(SOME_COORDINATES & columns.keys()), *metadata]))


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


def _criterion(study: Study, family: str, rows: Sequence[Row], counts: Sequence[int]) -> Criterion:
    """Return what orders a family, of whose complete meshes the numbers of triangles are given."""
    chosen = next((one.order_by for one in study.object.families if one.name == family), None)
    if chosen is not None:
        return chosen
    if any(row.member.time is not None for row in rows):
        return "time"
    if all(row.member.level >= 0 for row in rows):
        return "level"
    return "names" if len(counts) > 1 and not _are_graded(counts) else "triangles"


def _are_graded(counts: Sequence[int]) -> bool:
    """Tell whether meshes go from coarse to fine: scans of one object, or copies with noise, do not."""
    steps, largest = 0, 0.0
    for count in sorted(counts):
        if count > _SMALLEST_STEP * largest:
            steps, largest = steps + 1, float(count)
    # A few of other sizes may be parts of the object.
    return steps > 1 and _MOST_OF_ONE_SIZE * steps >= len(counts)


def _key(criterion: Criterion, row: Row, triangles: int | None) -> tuple[Any, ...]:
    """Return what a row is sorted by; where it is equal, names decide. A mesh that failed has no known triangles."""
    name = natural_key(row.member.name)
    if criterion == "time":
        return math.inf if row.member.time is None else row.member.time, name
    if criterion == "level":
        return row.member.level, name
    if criterion == "triangles":
        return math.inf if triangles is None else triangles, name
    return (name,)
