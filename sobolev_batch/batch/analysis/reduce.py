"""Tables from stored fields: the reduction as tasks of the cluster, and its results in the store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.datasets import (
    DistancesToReference,
    TableOrder,
    convergence_dataset,
    distances_dataset,
    meshes_dataset,
    norms_dataset,
)
from sobolev_batch.batch.analysis.tails import TailReducer
from sobolev_batch.batch.analysis.tiles import Reducer
from sobolev_batch.batch.cluster.execution import Cluster, Task
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import QUALITY, Store
from sobolev_batch.batch.store.tables import hide_tables, table_attributes, write_table
from sobolev_batch.batch.workspace import Workspace, complete_records
from sobolev_batch.errors import DamageError
from sobolev_batch.spectral.budget import NormEstimate
from sobolev_batch.spectral.fields import Quality
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.shapes.surface import DIRECTIONS, Extent

# Raise it whenever tables hold something that those of older versions lack: they are then made again.
TABLES_VERSION = 5

Reals = NDArray[np.float64]


def tabulate_fields(cluster: Cluster, workspace: Workspace) -> NormEstimate | None:
    """Write the tables, and return the distances to the reference, or None where the tables were there.

    Raises:
        DamageError: A field is not what was stored; it names its row.
        StoreError: The store cannot be read or written.
        ClusterError: The scheduler was lost, or no worker survives a task.
    """
    if are_tabulated(workspace):
        return None
    order, every_pair = TableOrder.from_workspace(workspace), workspace.plan.study.pairs == "all"
    complete = list(workspace.complete)
    reducer, threads = make_reducer(workspace), cluster.workers.threads
    # A larger task is tried all the same, with nothing beside it.
    projected_bytes = min(reducer.task_bytes, cluster.workers.largest_allowed_bytes)
    tasks = [Task(reducer.norms, (rows,), projected_bytes) for rows in reducer.row_batches(complete, threads)]
    if every_pair:
        tasks += [Task(reducer.tile, tile, projected_bytes) for tile in reducer.tiles(complete, threads)]
    advance = cluster.count_steps("reduction", len(tasks))
    results = Results.empty(len(workspace.plan.study.orders), order.rows, every_pair=every_pair)
    for task, outcome in cluster.results(tasks, projected_bytes):
        if task.function == reducer.norms:
            results.enter_norms(outcome, *task.arguments)
        else:
            results.enter_tile(outcome, *task.arguments)
        advance("", None)
    results.enter_reference(workspace.reference)
    _write_tables(workspace, order, results)
    return NormEstimate(*results.to_reference)


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a reduction in the order of tables, NaN where there are none.

    The distances of all pairs are much of the memory that a run takes: no copy of them is made.

    Attributes:
        places: Place of each row of the store in the tables.
        norms: (5, orders, rows), norms and their errors; see `NormEstimate`.
        to_reference: (5, orders, rows), distances to the reference.
        proportions: (3, orders, rows), decomposition of these distances.
        distances: (5, orders, rows, others), distances of all pairs, or to the reference alone.
    """

    places: Mapping[int, int]
    norms: Reals
    to_reference: Reals
    proportions: Reals
    distances: Reals

    @classmethod
    def empty(cls, orders: int, rows: Sequence[int], *, every_pair: bool) -> Self:
        """Return the results before any task.

        Args:
            orders: Number of orders.
            rows: Rows of the store, in the order of tables.
            every_pair: True for the distances of all pairs, False for those to the reference alone.
        """
        count, others = len(rows), len(rows) if every_pair else 1
        shapes = (5, orders, count), (5, orders, count), (3, orders, count), (5, orders, count, others)
        return cls({row: place for place, row in enumerate(rows)}, *(np.full(shape, np.nan) for shape in shapes))

    def enter_norms(self, outcome: tuple[NormEstimate, NormEstimate, Reals], rows: Sequence[int]) -> None:
        """Enter the outcome of `Reducer.norms` for some rows."""
        norms, to_reference, proportions = outcome
        places = [self.places[row] for row in rows]
        self.norms[..., places] = np.stack(list(norms))
        self.to_reference[..., places] = np.stack(list(to_reference))
        self.proportions[..., places] = proportions

    def enter_tile(self, outcome: NormEstimate, rows: Sequence[int], others: Sequence[int]) -> None:
        """Enter the outcome of `Reducer.tile` for pairs of rows and others."""
        pairs = np.stack(list(outcome))
        i, j = (np.array([self.places[row] for row in side]) for side in (rows, others))
        self.distances[..., i[:, None], j] = pairs
        self.distances[..., j[:, None], i] = np.swapaxes(pairs, -1, -2)

    def enter_reference(self, reference: int) -> None:
        """Enter the distances to the row of the reference, once all norms are entered."""
        if self.distances.shape[-1] == self.distances.shape[-2]:
            # The direct sums are the more exact ones, and the same numbers in both tables.
            place = self.places[reference]
            self.distances[..., place] = self.distances[..., place, :] = self.to_reference
        else:
            self.distances[..., 0] = self.to_reference


@dataclass(frozen=True, eq=False)
class StoredFields:
    """Fields in a store, and what their norms follow from.

    Attributes:
        store: Store of the fields.
        records: Record of each row; None without one.
        lattice: Lattice of the fields.
        tail: Sampling of the octaves beside them, if there are any.
        reference: Row of the study's reference.
    """

    store: Store
    records: Sequence[Record | None]
    lattice: Lattice
    tail: TailSampling | None
    reference: int

    def results(self, orders: tuple[float, ...], rows: Sequence[int], *, every_pair: bool) -> Results:
        """Compute norms and distances in this process, with the memory of one task.

        Args:
            orders: Sobolev orders s.
            rows: Rows of the store, in the order of tables.
            every_pair: True for the distances of all pairs, False for those to the reference alone.

        Raises:
            DamageError: A field is not what was stored.
        """
        reducer, results = self.reducer(orders), Results.empty(len(orders), rows, every_pair=every_pair)
        complete = [row for row in complete_records(self.records) if row in results.places]
        for batch in reducer.row_batches(complete, 1):
            results.enter_norms(reducer.norms(batch), batch)
        for tile in reducer.tiles(complete, 1) if every_pair else ():
            results.enter_tile(reducer.tile(*tile), *tile)
        results.enter_reference(self.reference)
        return results

    def reducer(self, orders: tuple[float, ...], compared_with: int | None = None) -> Reducer:
        """Return the reducer for some orders.

        Args:
            orders: Sobolev orders s.
            compared_with: Row to which distances are measured; by default the reference.
        """
        complete = complete_records(self.records)
        areas, errors = np.full(len(self.records), np.nan), np.full((len(orders), len(self.records)), np.nan)
        weights = SobolevWeights(self.lattice, orders, None if self.tail is None else self.tail.cutoff)
        extents, qualities = [], {}
        for i, record in complete.items():
            quality = Quality.from_json(record.quality)
            areas[i], errors[:, i] = quality.area, quality.error_norms(weights)
            extents.append(quality.extent)
            if quality.tail is not None:
                qualities[i] = quality.tail
        reference = self.reference if self.reference in complete else None
        tails = None
        if self.tail is not None:
            checksums = {i: record.checksums[-1] for i, record in complete.items()}
            tails = TailReducer(self.store, self.tail, orders, reference, qualities, checksums)
        return Reducer(
            store=self.store,
            lattice=self.lattice,
            blocks=self.store.blocks_of(self.lattice),
            orders=orders,
            reference=reference if compared_with is None else compared_with,
            areas=areas,
            errors=errors,
            widths=Extent.union(extents).widths if extents else np.zeros(len(DIRECTIONS)),
            checksums={i: record.checksums for i, record in complete.items()},
            tails=tails,
        )


def make_reducer(workspace: Workspace) -> Reducer:
    """Return the reducer of a workspace."""
    plan = workspace.plan
    records = [record if i in workspace.rows else None for i, record in enumerate(workspace.records)]
    fields = StoredFields(workspace.store, records, plan.lattice, plan.tail, workspace.reference)
    return fields.reducer(plan.study.orders)


def _write_tables(workspace: Workspace, order: TableOrder, results: Results) -> None:
    plan, store = workspace.plan, workspace.store
    orders, reference = plan.study.orders, workspace.reference
    rows = [workspace.rows[i] for i in order.rows]
    meshes = meshes_dataset(rows, [workspace.records[i] for i in order.rows], order)
    to_reference = DistancesToReference(
        plan.reference,
        NormEstimate(*results.to_reference),
        results.proportions,
        NormEstimate(*results.norms[..., results.places[reference]]),
    )
    sizes, families = meshes["edge_length_mean"].to_numpy(), order.families_with_rates(workspace.rows)
    convergence = convergence_dataset(
        meshes.coords, orders, to_reference, sizes, families.values(), plan.study.accuracy
    )
    replaced = hide_tables(store)
    store.write(QUALITY, ..., np.array(_qualities(workspace), dtype=object))
    write_table(store, "meshes", meshes, instead_of=replaced)
    norms = norms_dataset(meshes.coords, orders, NormEstimate(*results.norms))
    write_table(store, "norms", norms, instead_of=replaced)
    others = [row.label for row in (rows if plan.study.pairs == "all" else [workspace.rows[reference]])]
    pairs = distances_dataset(meshes.coords, others, orders, NormEstimate(*results.distances))
    write_table(store, "distances", pairs, instead_of=replaced)
    # Written last: its digest says that all tables belong to the fields that are stored.
    write_table(store, "convergence", convergence.assign_attrs(digest=_digest(workspace)), instead_of=replaced)
    store.consolidate()


def are_tabulated(workspace: Workspace) -> bool:
    """Return True where the tables of a store belong to its fields and to the plan."""
    attributes = table_attributes(workspace.store, "convergence")
    if attributes is None or attributes.get("digest") != _digest(workspace):
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
    shown = [(workspace.rows[i], workspace.records[i]) for i in TableOrder.from_workspace(workspace).rows]
    rows = [
        [row.label, row.family, *((record.key, record.status, record.reason) if record else ("", "", ""))]
        for row, record in shown
    ]
    times, metadata = ([getattr(row.member, name) for row, _ in shown] for name in ("time", "metadata"))
    inputs = {
        "version": TABLES_VERSION,
        "rows": rows,
        "orders": plan.study.orders,
        "pairs": plan.study.pairs,
        "reference": plan.reference,
        "order_by": {family.name: family.order_by for family in plan.study.families},
        # Left out where there are none, as in stores that know none.
        **({} if all(time is None for time in times) else {"times": times}),
        **({"metadata": metadata} if any(metadata) else {}),
    }
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()
