"""Tables from stored fields: the reduction as tasks of the cluster, and its results in the store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.datasets import (
    DistancesToReference,
    convergence_dataset,
    distances_dataset,
    meshes_dataset,
    norms_dataset,
)
from sobolev_batch.batch.analysis.tails import TailReducer
from sobolev_batch.batch.analysis.tiles import Reducer
from sobolev_batch.batch.cluster.execution import Cluster, Task
from sobolev_batch.batch.cluster.progress import Steps
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.workspace import Workspace, complete_records
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.metrics.decomposition import Proportion
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent

# Raise it whenever tables hold something that those of older versions lack: they are then made again.
TABLES_VERSION = 3

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
    complete, every_pair = list(workspace.complete), workspace.plan.study.pairs == "all"
    reducer, threads = make_reducer(workspace), cluster.workers.threads
    # A larger task is tried all the same, with nothing beside it.
    projected_bytes = min(reducer.task_bytes, cluster.workers.largest_allowed_bytes)
    tasks = [Task(reducer.norms, (rows,), projected_bytes) for rows in reducer.row_batches(complete, threads)]
    if every_pair:
        tasks += [Task(reducer.tile, tile, projected_bytes) for tile in reducer.tiles(complete, threads)]
    steps = Steps(cluster.notify, "reduction", len(tasks))
    results = _Results.empty(workspace)
    for task, outcome in cluster.results(tasks, projected_bytes):
        if task.function == reducer.norms:
            results.enter_norms(outcome, *task.arguments)
        else:
            results.enter_tile(outcome, *task.arguments)
        steps.advance()
    reference = workspace.reference
    if every_pair:
        # The direct sums are the more exact ones, and the same numbers in both tables.
        results.distances[..., reference] = results.distances[..., reference, :] = results.to_reference
    else:
        results.distances[..., 0] = results.to_reference
    _write_tables(workspace, results)
    return NormEstimate(*results.to_reference)


@dataclass(frozen=True, eq=False)
class _Results:
    """The results of a reduction, NaN where there are none.

    Attributes:
        norms: (5, orders, rows), norms and their errors; see `NormEstimate`.
        to_reference: (5, orders, rows), distances to the reference.
        proportions: (3, orders, rows), decomposition of these distances.
        distances: (5, orders, rows, others), distances of all pairs, or to the reference alone.
    """

    norms: Reals
    to_reference: Reals
    proportions: Reals
    distances: Reals

    @classmethod
    def empty(cls, workspace: Workspace) -> Self:
        """Return the results before any task."""
        orders, rows = len(workspace.plan.study.orders), len(workspace.rows)
        others = rows if workspace.plan.study.pairs == "all" else 1
        shapes = (5, orders, rows), (5, orders, rows), (3, orders, rows), (5, orders, rows, others)
        return cls(*(np.full(shape, np.nan) for shape in shapes))

    def enter_norms(self, outcome: tuple[NormEstimate, NormEstimate, Proportion], rows: Sequence[int]) -> None:
        """Enter the outcome of `Reducer.norms` for some rows."""
        norms, to_reference, proportions = outcome
        self.norms[..., rows] = np.stack(list(norms))
        self.to_reference[..., rows] = np.stack(list(to_reference))
        self.proportions[..., rows] = np.stack(list(proportions))

    def enter_tile(self, outcome: NormEstimate, rows: Sequence[int], others: Sequence[int]) -> None:
        """Enter the outcome of `Reducer.tile` for pairs of rows and others."""
        pairs, i, j = np.stack(list(outcome)), np.array(rows), np.array(others)
        self.distances[..., i[:, None], j] = pairs
        self.distances[..., j[:, None], i] = np.swapaxes(pairs, -1, -2)


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
    fields = StoredFields(workspace.store, workspace.records, plan.lattice, plan.tail, workspace.reference)
    return fields.reducer(plan.study.orders)


def _write_tables(workspace: Workspace, results: _Results) -> None:
    plan, rows, store = workspace.plan, workspace.rows, workspace.store
    orders, reference = plan.study.orders, workspace.reference
    others = rows if plan.study.pairs == "all" else (rows[reference],)
    meshes = meshes_dataset(rows, workspace.records)
    to_reference = DistancesToReference(
        plan.reference,
        NormEstimate(*results.to_reference),
        Proportion(*results.proportions),
        NormEstimate(*results.norms[..., reference]),
    )
    sizes = meshes["edge_length_mean"].to_numpy()
    convergence = convergence_dataset(rows, orders, to_reference, sizes, plan.study.accuracy)
    tables = Tables(store)
    replaced = tables.invalidate()
    store.write_qualities([record.quality if record else "" for record in workspace.records])
    tables.write("meshes", meshes, instead_of=replaced)
    tables.write("norms", norms_dataset(rows, orders, NormEstimate(*results.norms)), instead_of=replaced)
    pairs = distances_dataset(rows, others, orders, NormEstimate(*results.distances))
    tables.write("distances", pairs, instead_of=replaced)
    # Written last: its digest says that all tables belong to the fields that are stored.
    tables.write("convergence", convergence.assign_attrs(digest=_digest(workspace)), instead_of=replaced)
    store.consolidate()


def are_tabulated(workspace: Workspace) -> bool:
    """Return True where the tables of a store belong to its fields and to the plan."""
    tables = Tables(workspace.store)
    attributes = tables.attributes("convergence")
    current = attributes is not None and attributes.get("digest") == _digest(workspace)
    return current and not tables.lost()


def _digest(workspace: Workspace) -> str:
    """Return the SHA-256 of all that the tables depend on."""
    plan = workspace.plan
    rows = [
        [row.label, row.family, *((record.key, record.status, record.reason) if record else ("", "", ""))]
        for row, record in zip(workspace.rows, workspace.records, strict=True)
    ]
    times = [row.member.time for row in workspace.rows]
    inputs = {
        "version": TABLES_VERSION,
        "rows": rows,
        "orders": plan.study.orders,
        "pairs": plan.study.pairs,
        "reference": plan.reference,
        # Left out where there are none, as in stores that know no times.
        **({} if all(time is None for time in times) else {"times": times}),
    }
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()
