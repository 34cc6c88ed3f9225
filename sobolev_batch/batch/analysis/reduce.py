"""Tables from stored fields: the reduction dealt out to the cluster, and what it finds written down."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from distributed import Client, Future
from numpy.typing import NDArray

from sobolev_batch.batch.analysis.datasets import convergence_dataset, distances_dataset, meshes_dataset, norms_dataset
from sobolev_batch.batch.analysis.tiles import Reducer
from sobolev_batch.batch.cluster.execution import deal
from sobolev_batch.batch.cluster.outcomes import is_suspect
from sobolev_batch.batch.cluster.progress import Notify, Progress
from sobolev_batch.batch.cluster.workers import MEMORY, Workers
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.errors import ClusterError
from sobolev_batch.spectral.errors.budget import NormEstimate
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.metrics.decomposition import Proportion
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.surfaces.shapes.extent import DIRECTIONS, Extent

# Raise it whenever tables hold something that those of older versions lack: they are then made anew.
TABLES_VERSION = 2

Reals = NDArray[np.float64]
_Call = tuple[Callable[..., Any], tuple[Sequence[int], ...]]


def tabulate_fields(
    client: Client,
    crew: Workers,
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    records: Sequence[Record | None],
    notify: Notify,
) -> NormEstimate | None:
    """Make the tables; the distances to the reference, or None where the tables were there.

    Raises:
        DamageError: a field is not what was stored; it names its row.
        StoreError: the store cannot be read or written.
        ClusterError: the scheduler was lost, or no worker survives a task.
    """
    if are_tabulated(store, plan, rows, records):
        return None
    complete = [i for i, record in enumerate(records) if record is not None and record.status == "complete"]
    reference = next(i for i, row in enumerate(rows) if row.label == plan.reference)
    orders = plan.study.orders
    center = reference if reference in complete else None
    reducer = _reducer(store, plan, records, center)
    norms, to_reference = (np.full((4, len(orders), len(rows)), np.nan) for _ in range(2))
    proportions = np.full((3, len(orders), len(rows)), np.nan)
    every_pair = plan.study.pairs == "all"
    others = range(len(rows)) if every_pair else [reference]
    distances = np.full((4, len(orders), len(rows), len(others)), np.nan)

    calls: list[_Call] = [(reducer.norms, (strip,)) for strip in reducer.strips(complete, crew.threads)]
    if every_pair:
        calls += [(reducer.tile, tile) for tile in reducer.tiles(complete, crew.threads)]
    notify(Progress("reduction", 0, len(calls)))
    claims = reducer.task_bytes > crew.share_bytes
    resources = {MEMORY: min(reducer.task_bytes, crew.largest_bytes)} if claims else None
    done = 0

    def enter(call: _Call, outcome: Any) -> None:
        nonlocal done
        done += 1
        if isinstance(outcome, BaseException):
            raise outcome
        tile, *other = call[1]
        if not other:
            for table, found in zip((norms, to_reference, proportions), outcome, strict=True):
                table[..., tile] = np.stack(list(found))
        else:
            pairs = np.stack(list(outcome))
            distances[..., np.array(tile)[:, None], np.array(other[0])] = pairs
            distances[..., np.array(other[0])[:, None], np.array(tile)] = np.swapaxes(pairs, -1, -2)
        notify(Progress("reduction", done, len(calls)))

    def submit(number: int, rank: int) -> Future:
        task, arguments = calls[number]
        return client.submit(task, *arguments, pure=False, resources=resources)

    for number, outcome in deal(client, submit, range(len(calls)), len(calls)):
        if is_suspect(outcome):
            raise ClusterError(
                "a task of the reduction ended the worker that it ran on again and again, at last with nothing else "
                "beside it, as happens for want of memory; start workers with more memory"
            )
        enter(calls[number], outcome)
    if every_pair:
        # The direct sums are the more exact ones, and the same numbers in both tables.
        distances[..., reference] = distances[..., reference, :] = to_reference
    else:
        distances[..., 0] = to_reference
    _write_tables(store, plan, rows, records, norms, to_reference, proportions, distances, [rows[j] for j in others])
    return NormEstimate(*to_reference)


def _reducer(store: Store, plan: Plan, records: Sequence[Record | None], center: int | None) -> Reducer:
    """The reducer of a store, with what the records say of its fields."""
    lattice, orders = plan.lattice, plan.study.orders
    weights = SobolevWeights(lattice, orders)
    qualities = {
        i: Quality.from_json(record.quality)
        for i, record in enumerate(records)
        if record is not None and record.status == "complete"
    }
    areas, errors = np.full(len(records), np.nan), np.full((len(orders), len(records)), np.nan)
    for i, quality in qualities.items():
        areas[i], errors[:, i] = quality.area, quality.probe.norms(weights)
    extents = [quality.extent for quality in qualities.values()]
    widths = Extent.union(extents).widths if extents else np.zeros(len(DIRECTIONS))
    checksums = {i: record.checksums for i, record in enumerate(records) if record is not None}
    return Reducer(store, lattice, plan.blocks, orders, center, areas, errors, widths, checksums)


def _write_tables(
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    records: Sequence[Record | None],
    norms: Reals,
    to_reference: Reals,
    proportions: Reals,
    distances: Reals,
    others: Sequence[Row],
) -> None:
    orders = plan.study.orders
    reference = [row.label for row in rows].index(plan.reference)
    meshes = meshes_dataset(rows, records)
    sizes = meshes["edge_length_mean"].to_numpy()
    convergence = convergence_dataset(
        rows,
        orders,
        NormEstimate(*to_reference),
        Proportion(*proportions),
        NormEstimate(*norms[..., reference]),
        sizes,
        plan.reference,
        plan.study.accuracy,
    )
    tables = Tables(store)
    replaced = tables.invalidate()
    store.write_qualities([record.quality if record else "" for record in records])
    tables.write("meshes", meshes, instead_of=replaced)
    tables.write("norms", norms_dataset(rows, orders, NormEstimate(*norms)), instead_of=replaced)
    pairs = distances_dataset(rows, others, orders, NormEstimate(*distances))
    tables.write("distances", pairs, instead_of=replaced)
    # Written last: its digest says that all tables belong to the fields that are there.
    digest = _reduction_digest(plan, rows, records)
    tables.write("convergence", convergence.assign_attrs(digest=digest), instead_of=replaced)
    store.consolidate()


def are_tabulated(store: Store, plan: Plan, rows: Sequence[Row], records: Sequence[Record | None]) -> bool:
    """Whether the tables of a store are there, and belong to its fields and to the plan."""
    attributes = Tables(store).attributes("convergence")
    current = attributes is not None and attributes.get("digest") == _reduction_digest(plan, rows, records)
    return current and not Tables(store).lost()


def _reduction_digest(plan: Plan, rows: Sequence[Row], records: Sequence[Record | None]) -> str:
    parts = {
        "version": TABLES_VERSION,
        "rows": [
            [
                row.label,
                row.family,
                record.key if record else "",
                record.status if record else "",
                record.reason if record else "",
            ]
            for row, record in zip(rows, records, strict=True)
        ],
        "orders": plan.study.orders,
        "pairs": plan.study.pairs,
        "reference": plan.reference,
    }
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
