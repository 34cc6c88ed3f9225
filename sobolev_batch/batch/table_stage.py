"""Tables from stored fields: their order, the reduction as tasks of the cluster, and its results in the store.

Families are in the order of the study, and the meshes of each from coarse to fine.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, Wave, result_from, result_of
from sobolev_batch.errors import DamageError
from sobolev_batch.norms.columns import VARIABLES, describe
from sobolev_batch.norms.estimate import NormEstimate
from sobolev_batch.norms.fields import Quality
from sobolev_batch.sources.names import natural_key
from sobolev_batch.sources.programs import Cost
from sobolev_batch.store.layout import (
    DISTANCES,
    NUMERICS,
    PAIRS_KEYS,
    QUALITY,
    Metadata,
    hide_tables,
    table_attributes,
    write_table,
)
from sobolev_batch.store.records import Facts, Record
from sobolev_batch.store.workspace import Workspace
from sobolev_batch.study.plan import Row
from sobolev_batch.study.study import Study
from sobolev_batch.tables.all_objects import Tables
from sobolev_batch.tables.pairs import Pairs, fill_tile
from sobolev_batch.tables.reducer import Reducer
from sobolev_batch.tables.results import COORDINATES, SOME_COORDINATES, Results, coordinates_of
from sobolev_batch.tables.shells import fill_chunk, spectrum_keys, stale_chunks

# Raise it whenever tables hold something that those of older versions lack: they are then made again.
TABLES_VERSION = 14

Criterion = Literal["level", "triangles", "names", "time"]
# A row, its place in its family, and what orders that.
Placed = tuple[int, int, Criterion]

# Between numbers of triangles of a family that goes from coarse to fine: then edges differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10


@dataclass(frozen=True)
class Tabulated:
    """Content of new tables: distances to the reference, and the tables that the root of a study repeats."""

    distances: NormEstimate
    tables: Tables


def tabulate_fields(cluster: Cluster, workspace: Workspace) -> Stages[Tabulated | None]:
    """Write the tables, and return what they hold, or None where the tables were there."""
    placed = table_order(workspace)
    digest = _digest(workspace, placed)
    if are_tabulated(workspace, digest):
        return None
    plan, complete = workspace.plan, workspace.complete
    qualities = {row: Quality.from_json(record.quality) for row, record in complete.items()}
    checksums = {row: record.checksums for row, record in complete.items()}
    reducer = Reducer.for_fields(
        workspace.store, plan.choice, plan.study.orders, qualities, checksums, workspace.reference
    )
    # A larger task is tried all the same, with nothing beside it.
    projected_bytes = min(reducer.task_bytes, cluster.workers.largest_allowed_bytes)
    keys, meshes = _spectrum_keys(workspace), _meshes_table(workspace, placed)
    chunks = stale_chunks(workspace.store, keys)
    pairs, tiles, replaced = _pairs(workspace), list[tuple[int, int]](), list[str]()
    if pairs is not None:
        # Readers find all tables of one state, or none.
        replaced = hide_tables(workspace.store)
        pairs.lay_out(coordinates_of(meshes, plan.study.orders))
        tiles = pairs.stale()
    advance = cluster.count_steps("reduction", len(chunks) + len(tiles))
    of_spectra = (
        Task(
            fill_chunk,
            (reducer.only(rows), number, {row: keys[row] for row in rows if row in keys}),
            projected_bytes,
            stage="spectra",
        )
        for number, rows in chunks.items()
    )

    def take(task: Task, outcome: Any) -> None:
        result_of(outcome)
        advance("", None)

    yield Wave(cluster, of_spectra, take, projected_bytes)
    if pairs is not None:
        # After all spectra, where their row of the reference comes from.
        parts = ((pairs.only(tile), tile) for tile in tiles)
        of_pairs = (
            Task(fill_tile, (reducer.only(part.keys), part, tile), projected_bytes, stage="pairs")
            for part, tile in parts
        )
        yield Wave(cluster, of_pairs, take, projected_bytes)
    last = Task(write_results, (workspace, reducer, meshes, digest, replaced), projected_bytes, stage="tables")
    tabulated: Tabulated
    tabulated, workspace.store.metadata = yield from result_from(cluster, last)
    return tabulated


def write_results(
    workspace: Workspace, reducer: Reducer, meshes: xr.Dataset, digest: str, replaced: Sequence[str]
) -> tuple[Tabulated, Metadata]:
    """Write the tables that follow from stored spectra, on a worker, and return also the metadata of the store then.

    Done again, the task writes the same.
    """
    store, results = workspace.store, Results.from_spectra(reducer, meshes, workspace.plan.reference)
    numerics = sorted({record.numerics for record in workspace.complete.values()})
    convergence = results.convergence_table(workspace.plan.study.accuracy)
    convergence.attrs |= {"digest": digest, NUMERICS: numerics}
    replaced = [*replaced, *(hide_tables(store) if _pairs(workspace) is None else ())]
    store.write(QUALITY, [0], _qualities(workspace))
    write_table(store, "meshes", results.meshes)
    write_table(store, "norms", results.norms_table())
    if PAIRS_KEYS not in store.documents:
        if store.stored_document(PAIRS_KEYS) is not None:
            store.location.remove(DISTANCES)
        write_table(store, DISTANCES, results.distances_table())
    # Written last: its digest says that all tables belong to the fields that are stored.
    write_table(store, "convergence", convergence)
    for name in set(replaced) - store.documents.keys():
        store.location.remove(name)
    store.consolidate()
    tables = {"meshes": results.meshes, "convergence": convergence}
    return Tabulated(NormEstimate(*results.to_reference), tables), store.metadata


def _pairs(workspace: Workspace) -> Pairs | None:
    """Return the distances of all pairs, if the study requests them: of the meshes in the order of their rows."""
    study = workspace.plan.study
    if study.pairs != "all":
        return None
    rows = tuple(sorted(workspace.rows))
    return Pairs(workspace.store, rows, _record_keys(workspace), study.orders, workspace.reference)


def _record_keys(workspace: Workspace) -> dict[int, str]:
    return {row: record.key for row, record in workspace.complete.items()}


def _spectrum_keys(workspace: Workspace) -> dict[int, str]:
    return spectrum_keys(_record_keys(workspace), workspace.reference)


def are_tabulated(workspace: Workspace, digest: str = "") -> bool:
    """Return True where the tables of a store belong to its fields and to the plan, by their digest if it is known."""
    attributes = table_attributes(workspace.store, "convergence")
    if attributes is None or attributes.get("digest") != (digest or _digest(workspace, table_order(workspace))):
        return False
    if stale_chunks(workspace.store, _spectrum_keys(workspace)):
        return False
    pairs = _pairs(workspace)
    if pairs is not None and (PAIRS_KEYS not in workspace.store.documents or pairs.stale()):
        return False
    try:
        return list(workspace.store.read_strings(QUALITY)) == _qualities(workspace)
    except DamageError:
        return False


def _qualities(workspace: Workspace) -> list[str]:
    return [record.quality if record else "" for record in workspace.records]


def _digest(workspace: Workspace, placed: Sequence[Placed]) -> str:
    """Return the SHA-256 of all that the tables depend on."""
    plan = workspace.plan
    shown = [(workspace.rows[i], workspace.records[i]) for i, _, _ in placed]
    rows = [
        [
            *(row.label, row.family, row.member.time, row.member.metadata),
            *((record.key, record.status, record.reason) if record else ("", "", "")),
        ]
        for row, record in shown
    ]
    inputs = {
        "version": TABLES_VERSION,
        "rows": rows,
        "orders": plan.study.orders,
        "pairs": plan.study.pairs,
        "reference": plan.reference,
        "order_by": {family.name: family.order_by for family in plan.study.object.families},
    }
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()


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


def _meshes_table(workspace: Workspace, placed: Sequence[Placed]) -> xr.Dataset:
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
