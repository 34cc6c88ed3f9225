"""Tables from stored fields: their order, the reduction as tasks of the cluster, and its results in the store.

Families are in the order of the study, and the meshes of each from coarse to fine.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.reducer import Reducer
from sobolev_batch.batch.analysis.spectra import (
    chunks_of_spectra,
    fill_chunk,
    read_spectra,
    spectrum_keys,
    stale_chunks,
)
from sobolev_batch.batch.cluster.execution import Cluster, Task
from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.store.store import QUALITY
from sobolev_batch.batch.store.tables import hide_tables, table_attributes, write_table
from sobolev_batch.batch.study.plan import Row
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import NormEstimate
from sobolev_batch.spectral.fields import Quality
from sobolev_batch.spectral.metrics.datasets import describe, observed_rates
from sobolev_batch.surfaces.sources.mesh_cache import Cost
from sobolev_batch.surfaces.sources.names import natural_key

# Raise it whenever tables hold something that those of older versions lack: they are then made again.
TABLES_VERSION = 7

# Columns of the table of meshes that all tables have as coordinates, besides times and other metadata.
_COORDINATES = ("family", "name", "level", "status", "vertices", "triangles", "edge_length_mean", "seconds")
# Those that only some studies have.
_SOME = {"time", *(item.name for item in fields(Cost))}
# Numbers in the driver's memory for each pair and order, as measured: results, and copies of a table that is written.
_NUMBERS_OF_A_PAIR = 10

Reals = NDArray[np.float64]
Criterion = Literal["level", "triangles", "names", "time"]

# Criteria of families that go from coarse to fine.
_FROM_COARSE_TO_FINE = ("level", "triangles")
# Between numbers of triangles of a family that goes from coarse to fine: then edges differ by a tenth.
_SMALLEST_STEP = 1.2
# Meshes of about one size in such a family, on average.
_MOST_OF_ONE_SIZE = 10


def tabulate_fields(cluster: Cluster, workspace: Workspace) -> NormEstimate | None:
    """Write the tables, and return the distances to the reference, or None where the tables were there."""
    if are_tabulated(workspace):
        return None
    plan, threads, complete = workspace.plan, cluster.workers.threads, workspace.complete
    qualities = {row: Quality.from_json(record.quality) for row, record in complete.items()}
    checksums = {row: record.checksums for row, record in complete.items()}
    reducer = Reducer.for_fields(
        workspace.store, plan.choice, plan.study.orders, qualities, checksums, workspace.reference
    )
    # A larger task is tried all the same, with nothing beside it.
    projected_bytes = min(reducer.task_bytes, cluster.workers.largest_allowed_bytes)
    keys = _spectrum_keys(workspace)
    tasks = [
        Task(
            fill_chunk,
            (reducer.for_spectra(rows), rows, {row: keys[row] for row in rows if row in keys}),
            projected_bytes,
        )
        for rows in stale_chunks(workspace.store, keys)
    ]
    every_pair = plan.study.pairs == "all"
    if every_pair:
        tasks += [Task(reducer.tile, tile, projected_bytes) for tile in reducer.tiles(list(complete), threads)]
    advance = cluster.count_steps("reduction", len(tasks))
    results = Results.empty(_meshes_table(workspace), plan.reference, plan.study.orders, every_pair)
    for task, outcome in cluster.results(tasks, projected_bytes):
        if task.function == reducer.tile:
            results.enter_tile(outcome, *task.arguments)
        advance("", None)
    results.enter_spectra(reducer, complete)
    _write_tables(workspace, results)
    return NormEstimate(*results.to_reference)


def _spectrum_keys(workspace: Workspace) -> dict[int, str]:
    return spectrum_keys({row: record.key for row, record in workspace.complete.items()}, workspace.reference)


def pairs_bytes(meshes: int, orders: int) -> float:
    """Return the memory that the distances of all pairs take in the driver."""
    return 8.0 * _NUMBERS_OF_A_PAIR * orders * meshes**2


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a reduction in the order of tables, NaN where there are none.

    The distances of all pairs are much of the memory that a run takes: no copy of them is made.

    Attributes:
        meshes: Table of the meshes.
        reference: Label of the reference.
        orders: Sobolev orders s.
        norms: (5, orders, meshes), norms and their errors; see `NormEstimate`.
        to_reference: (5, orders, meshes), distances to the reference.
        parts: (4, orders, meshes), see `Reducer.norms`.
        distances: (5, orders, meshes, others), distances of all pairs, or to the reference alone.
    """

    meshes: xr.Dataset
    reference: str
    orders: tuple[float, ...]
    norms: Reals
    to_reference: Reals
    parts: Reals
    distances: Reals

    @classmethod
    def empty(cls, meshes: xr.Dataset, reference: str, orders: tuple[float, ...], every_pair: bool) -> Self:
        """Return the results before any task."""
        count = meshes.sizes["mesh"]
        others = count if every_pair else 1
        shapes = [(parts, len(orders), count) for parts in (5, 5, 4)]
        arrays = [np.full(shape, np.nan) for shape in (*shapes, (5, len(orders), count, others))]
        return cls(meshes, reference, orders, *arrays)

    @classmethod
    def computed(cls, reducer: Reducer, meshes: xr.Dataset, reference: str, every_pair: bool) -> Self:
        """Compute norms and distances in this process: from spectra, and those of all pairs from fields."""
        results = cls.empty(meshes, reference, reducer.orders, every_pair)
        complete = [row for row in reducer.complete if row in results._places]
        for tile in reducer.tiles(complete, 1) if every_pair else ():
            results.enter_tile(reducer.tile(*tile), *tile)
        results.enter_spectra(reducer, complete)
        return results

    @property
    def has_every_pair(self) -> bool:
        """True for the distances of all pairs, False for those to the reference alone."""
        return bool(self.distances.shape[-1] == self.distances.shape[-2])

    @cached_property
    def _places(self) -> dict[int, int]:
        """Place in the tables of each row of the store."""
        return {row: place for place, row in enumerate(self.meshes["row"].values.tolist())}

    @property
    def _reference_place(self) -> int:
        return int(self.meshes.indexes["mesh"].get_loc(self.reference))

    def enter_spectra(self, reducer: Reducer, rows: Collection[int]) -> None:
        """Enter norms of rows, and distances to the reference, from the spectra that the reducer's store holds."""
        reference = None if reducer.reference is None else read_spectra(reducer.store, [reducer.reference]).norm
        for chunk in chunks_of_spectra(reducer.store):
            of_chunk = [row for row in chunk if row in rows]
            if of_chunk:
                spectra = read_spectra(reducer.store, of_chunk)
                norms, to_reference, parts = reducer.norms_of(of_chunk, spectra, reference)
                places = [self._places[row] for row in of_chunk]
                self.norms[..., places] = np.stack(list(norms))
                self.to_reference[..., places] = np.stack(list(to_reference))
                self.parts[..., places] = parts
        if self.has_every_pair:
            # The direct sums are the more exact ones, and the same numbers in both tables.
            place = self._reference_place
            self.distances[..., place] = self.distances[..., place, :] = self.to_reference
        else:
            self.distances[..., 0] = self.to_reference

    def enter_tile(self, outcome: NormEstimate, rows: Sequence[int], others: Sequence[int]) -> None:
        """Enter the outcome of `Reducer.tile` for pairs of rows and others."""
        pairs = np.stack(list(outcome))
        i, j = (np.array([self._places[row] for row in side]) for side in (rows, others))
        self.distances[..., i[:, None], j] = pairs
        self.distances[..., j[:, None], i] = np.swapaxes(pairs, -1, -2)

    def norms_table(self) -> xr.Dataset:
        """Return `norm` (mesh, order) with its error."""
        return self._table({**NormEstimate(*self.norms).named("norm"), "beyond": self.parts[2]}, "mesh")

    def distances_table(self) -> xr.Dataset:
        """Return `distance` (mesh, other, order) with its error."""
        others = self.meshes["mesh"].values if self.has_every_pair else np.array([self.reference], dtype=object)
        table = self._table(NormEstimate(*self.distances).named("distance"), "mesh", "other")
        return describe(table.assign_coords(other=("other", others)))

    def convergence_table(self, accuracy: Accuracy | None) -> xr.Dataset:
        """Return distances to the reference, relative ones and their parts, and observed orders of convergence."""
        to_reference = NormEstimate(*self.to_reference)
        sizes, reference = self.meshes["edge_length_mean"].to_numpy(), self._reference_place
        distances, errors = to_reference.values, to_reference.errors
        rates, rate_errors = (np.full_like(distances, np.nan) for _ in range(2))
        for family in self._sequences():
            members = [place for place in family if place != reference]
            for k in range(len(self.orders)):
                rates[k, members], rate_errors[k, members] = observed_rates(
                    distances[k, members], errors[k, members], sizes[members]
                )
        relative, relative_errors = to_reference.relative_to(NormEstimate(*self.norms[..., [reference]]))
        columns = {
            **to_reference.named("distance"),
            "relative": relative,
            "relative_error": relative_errors,
            "area_part": self.parts[0],
            "shape_part": self.parts[1],
            "beyond": self.parts[3],
            "rate": rates,
            "rate_error": rate_errors,
            "resolved": errors < distances,
            "within": np.ones_like(distances, dtype=bool) if accuracy is None else accuracy.met(to_reference),
        }
        attributes = {"reference": self.reference, **({} if accuracy is None else {"rtol": accuracy.rtol})}
        return self._table(columns, "mesh").assign_attrs(attributes)

    def _sequences(self) -> list[list[int]]:
        """Return the places of the meshes of each family that goes from coarse to fine."""
        families: dict[str, list[int]] = {}
        criteria = self.meshes["ordered_by"].values.tolist()
        for place, (family, criterion) in enumerate(zip(self.meshes["family"].values.tolist(), criteria, strict=True)):
            if criterion in _FROM_COARSE_TO_FINE:
                families.setdefault(family, []).append(place)
        return list(families.values())

    def _table(self, columns: Mapping[str, NDArray[Any]], *dimensions: str) -> xr.Dataset:
        """Return values (orders, ...) as variables whose last dimension is the order."""
        variables = {name: ((*dimensions, "order"), np.moveaxis(values, 0, -1)) for name, values in columns.items()}
        names = [*_COORDINATES, *(_SOME & self.meshes.coords.keys()), *self.meshes.attrs.get("metadata", ())]
        coordinates = self.meshes.reset_coords()[names].rename(edge_length_mean="edge_length")
        orders = np.array(self.orders, dtype=np.float64)
        return describe(xr.Dataset(variables, coords={**coordinates.variables, "order": ("order", orders)}))


def _write_tables(workspace: Workspace, results: Results) -> None:
    store = workspace.store
    replaced = hide_tables(store)
    store.write(QUALITY, ..., np.array(_qualities(workspace), dtype=object))
    write_table(store, "meshes", results.meshes)
    write_table(store, "norms", results.norms_table())
    write_table(store, "distances", results.distances_table())
    # Written last: its digest says that all tables belong to the fields that are stored.
    convergence = results.convergence_table(workspace.plan.study.accuracy).assign_attrs(digest=_digest(workspace))
    write_table(store, "convergence", convergence)
    for name in set(replaced) - store.documents.keys():
        store.location.remove(name)
    store.consolidate()


def are_tabulated(workspace: Workspace) -> bool:
    """Return True where the tables of a store belong to its fields and to the plan."""
    attributes = table_attributes(workspace.store, "convergence")
    if attributes is None or attributes.get("digest") != _digest(workspace):
        return False
    if stale_chunks(workspace.store, _spectrum_keys(workspace)):
        return False
    try:
        return list(workspace.store.read_strings(QUALITY)) == _qualities(workspace)
    except DamageError:
        return False


def _qualities(workspace: Workspace) -> list[str]:
    return [record.quality if record else "" for record in workspace.records]


def _digest(workspace: Workspace) -> str:
    """Return the SHA-256 of all that the tables depend on."""
    plan = workspace.plan
    shown = [(workspace.rows[i], workspace.records[i]) for i, _, _ in table_order(workspace)]
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
        "order_by": {family.name: family.order_by for family in plan.study.families},
    }
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()


def table_order(workspace: Workspace) -> list[tuple[int, int, Criterion]]:
    """Return the rows of the study in the order of tables, each with its place in its family and what orders that."""
    families: dict[str, list[int]] = {row.family: [] for row in workspace.plan.rows}
    for i, row in workspace.rows.items():
        families[row.family].append(i)
    placed: list[tuple[int, int, Criterion]] = []
    for family, numbers in families.items():
        rows, records = [workspace.rows[i] for i in numbers], [workspace.records[i] for i in numbers]
        criterion = _criterion(workspace.plan.study, family, rows, records)
        keys = {i: _key(criterion, row, record) for i, row, record in zip(numbers, rows, records, strict=True)}
        placed += ((i, rank, criterion) for rank, i in enumerate(sorted(keys, key=keys.__getitem__)))
    return placed


def _meshes_table(workspace: Workspace) -> xr.Dataset:
    """Return for each mesh family, level, rank, status, reason, counts, sizes, digests, seconds, worker, backend."""
    numbers, ranks, criteria = zip(*table_order(workspace), strict=True)
    rows, records = [workspace.rows[i] for i in numbers], [workspace.records[i] for i in numbers]
    filled = [record or Record(key="", status="failed", reason="not computed") for record in records]
    columns: dict[str, NDArray[np.generic]] = {
        "family": _strings([row.family for row in rows]),
        "name": _strings([row.member.name for row in rows]),
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
        numbers_or_texts = _strings(values) if isinstance(item.default, str) else np.where(is_complete, values, np.nan)
        columns[item.name] = numbers_or_texts
    if any(record.cost for record in filled):
        costs = [record.cost or Cost() for record in filled]
        columns |= {item.name: np.array([getattr(cost, item.name) for cost in costs]) for item in fields(Cost)}
    columns["seconds"] = np.array([record.seconds for record in filled])
    for name in ("worker", "backend", "finished", "key"):
        columns[name] = _strings([getattr(record, name) for record in filled])
    columns["mesh"], metadata = _strings([row.label for row in rows]), _metadata(rows)
    times = [row.member.time for row in rows]
    if any(time is not None for time in times):
        columns["time"] = np.array([np.nan if time is None else time for time in times])
    variables = {name: ("mesh", values) for name, values in {**columns, **metadata}.items()}
    table = xr.Dataset(variables, attrs={"metadata": list(metadata)})
    # Texts have no missing value, which `where` needs of variables that are no coordinates.
    texts = [name for name, values in columns.items() if values.dtype == object]
    return describe(table.set_coords([*texts, *_COORDINATES, *(_SOME & columns.keys()), *metadata]))


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
