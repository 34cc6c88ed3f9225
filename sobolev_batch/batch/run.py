"""Running a study: what is missing becomes tasks, and what is stored becomes tables."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from distributed import CancelledError, Client, Future, as_completed
from distributed.comm import CommClosedError
from numpy.typing import NDArray

from sobolev_batch.batch.choice import Choice
from sobolev_batch.batch.cluster import local_client, thread_client
from sobolev_batch.batch.crew import MEMORY, Crew
from sobolev_batch.batch.datasets import convergence_dataset, distances_dataset, meshes_dataset, norms_dataset
from sobolev_batch.batch.equipment import enlist, worry_about
from sobolev_batch.batch.journal import Journal
from sobolev_batch.batch.layout import lay_out_rows
from sobolev_batch.batch.location import Location
from sobolev_batch.batch.plan import Plan, Row, make_plan
from sobolev_batch.batch.reach import require_reach
from sobolev_batch.batch.records import Record
from sobolev_batch.batch.reduction import Reducer
from sobolev_batch.batch.store import Store, stored_choice
from sobolev_batch.batch.study import Study
from sobolev_batch.batch.submitter import Submitter
from sobolev_batch.batch.tasks import Job
from sobolev_batch.errors import ClusterError
from sobolev_batch.spectral.budget import DIRECTIONS, Assessed, support_widths
from sobolev_batch.spectral.quality import Quality

_log = logging.getLogger(__name__)

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Progress:
    """One step forward.

    Attributes:
        stage: "cluster" once there is one, "fields" while meshes are transformed, "reduction" while
            tables are made.
        done, total: steps of the stage.
        label: of the mesh that was finished, or the address of the cluster's dashboard; else empty.
        record: of that mesh.
    """

    stage: Literal["cluster", "fields", "reduction"]
    done: int
    total: int
    label: str = ""
    record: Record | None = None


# A study whose distances fall short of the accuracy asked for is computed again on a larger lattice,
# this often in all.
_MOST_ROUNDS = 3

# Rows that the scheduler knows of at a time: enough to deal out well, while each costs it memory.
_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD = 2000, 20

Notify = Callable[[Progress], None]


@dataclass(frozen=True)
class Summary:
    """What a run did.

    Attributes:
        store: the path or URL of the store.
        computed: labels of the meshes whose fields were computed now.
        reused: labels of those that were already there.
        failed: the reason for each mesh that could not be computed.
    """

    store: str
    computed: tuple[str, ...]
    reused: tuple[str, ...]
    failed: Mapping[str, str]


def run(
    study: Study,
    store: str | Path | Location,
    client: Client | None = None,
    *,
    workers: int | None = None,
    memory: str | None = None,
    on_progress: Notify | None = None,
) -> Summary:
    """Compute what a store lacks of a study, then its norms, distances and convergence tables.

    Args:
        study: what to compute.
        store: path or URL of a new or existing store; the workers must reach it under the same name.
        client: of the cluster to compute on. Without one, a cluster of single-threaded processes on
            this machine serves for the time of the call; a script that relies on it must guard its
            main part by ``if __name__ == "__main__"``, as all that starts processes must. Where
            nothing is missing, none is started.
        workers: of the cluster on this machine; default one per core.
        memory: of each of them, such as "4GB"; default an equal part of the machine's.
        on_progress: called in this thread at each step.

    Returns:
        What was computed, what was there, what failed. A mesh that fails does not raise.

    Raises:
        StudyError, MeshError, LatticeError: the study cannot be carried out.
        AccuracyError: the accuracy that the study asks for is out of reach; nothing was computed.
        StoreError: the store cannot be reached or written, or belongs to another study.
        ClusterError: no worker has the GPU that the study asks for, or memory enough for its lattice.
    """
    location = Location.of(store)
    if client is not None:
        location = location.absolute()
    known = stored_choice(location)
    if client is not None:
        require_reach(client, location)
    plan = make_plan(study, known)
    place = Store.prepare(location, plan)
    rows = rows_of(place, plan)
    records = list(place.records())
    notify = on_progress or (lambda progress: None)
    missing = rows_without_field(records, rows)
    with Journal(place) as journal:
        if missing or not _is_reduced(place, plan, rows, records):
            with nullcontext(client) if client is not None else _own_client(location, workers, memory) as active:
                journal.cluster = active.scheduler.address
                journal.write("running")
                notify(Progress("cluster", 0, 0, active.dashboard_link))
                crew = enlist(active, study.libraries)
                # Asked before anything is computed: a GPU that nobody has would be waited for.
                crew.with_backend(study.backend)
                journal.worry = lambda: worry_about(active, study.backend)
                place.scratch.discard()

                def note(progress: Progress) -> None:
                    journal.stage = f"{progress.stage}, {progress.done} of {progress.total}"
                    notify(progress)

                for rounds_left in reversed(range(_MOST_ROUNDS)):
                    _compute_fields(active, crew, place, plan, rows, missing, records, note)
                    found = _reduce(active, crew, place, plan, rows, records, note)
                    choice = _grown(plan, found) if rounds_left else None
                    if choice is None:
                        break
                    plan = plan.on(choice)
                    place = Store.prepare(location, plan)
                    # It has laid out the records anew, that of the run with them.
                    journal.write("running")
                    rows = rows_of(place, plan)
                    records = list(place.records())
                    missing = rows_without_field(records, rows)
    failed = {
        row.label: record.reason if record else "not computed"
        for row, record in zip(rows, records, strict=True)
        if record is None or record.status == "failed"
    }
    todo = set(missing)
    return Summary(
        place.path,
        tuple(rows[i].label for i in missing if rows[i].label not in failed),
        tuple(row.label for i, row in enumerate(rows) if i not in todo),
        failed,
    )


def _own_client(location: Location, workers: int | None, memory: str | None) -> AbstractContextManager[Client]:
    """A cluster on this machine whose workers see the store."""
    return thread_client(workers) if location.is_of_this_process else local_client(workers, memory)


def rows_without_field(records: Sequence[Record | None], rows: Sequence[Row]) -> list[int]:
    """The rows whose fields are to be computed."""
    return [i for i, record in enumerate(records) if record is None or not record.completes(rows[i].key)]


def _grown(plan: Plan, found: Assessed | None) -> Choice | None:
    """A larger lattice where distances to the reference fall short of the accuracy that is asked for."""
    if plan.study.accuracy is None or found is None:
        return None
    known = ~np.isnan(found.values).any(axis=0)
    complete = Assessed(*(part[:, known] for part in found))
    return plan.choice.grown(complete, plan.study.orders, plan.study.accuracy)


def rows_of(store: Store, plan: Plan) -> tuple[Row, ...]:
    """The plan's rows in the order in which the store holds them."""
    by_label = {row.label: row for row in plan.rows}
    return tuple(by_label[label] for label in store.labels())


def _compute_fields(
    client: Client,
    crew: Crew,
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    missing: Sequence[int],
    records: list[Record | None],
    notify: Notify,
) -> None:
    """Compute what is missing; its records, as they are stored, take their places in the list."""
    notify(Progress("fields", 0, len(missing)))
    equipped = crew.with_backend(plan.study.backend)
    layouts, refused = lay_out_rows(plan, [rows[i] for i in missing], equipped)
    submitter = Submitter.of(client, crew, plan.study.backend, layouts.values(), len(plan.blocks))
    done = 0
    for i in missing:
        if rows[i].label in refused:
            done += 1
            records[i] = record = Record(key=rows[i].key, status="failed", reason=refused[rows[i].label])
            store.write_record(i, record)
            notify(Progress("fields", done, len(missing), rows[i].label, record))
    # A mesh in pieces occupies all workers by itself, and its pieces the scratch space.
    cut = any(layout.parts > 1 for layout in layouts.values())
    in_flight = crew.threads + 1 if cut else max(_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD * crew.threads)
    futures: dict[Future, int] = {}
    remaining = enumerate(i for i in missing if rows[i].label in layouts)
    completed = as_completed(loop=client.loop)

    def hand_over(count: int) -> None:
        for rank, i in islice(remaining, count):
            layout = layouts[rows[i].label]
            future = submitter.field(_job(store, plan, i, rows[i], layout.transform_bytes), layout, rank)
            futures[future] = i
            completed.add(future)

    hand_over(in_flight)
    for batch in completed.batches():
        hand_over(len(batch))
        for future, outcome in zip(batch, _outcomes(client, batch), strict=True):
            done += 1
            i = futures.pop(future)
            row = rows[i]
            if isinstance(outcome, Record):
                record = outcome
            else:
                # The task itself reports bad meshes; what arrives here is a worker that died or a store
                # that cannot be written any more.
                record = Record(key=row.key, status="failed", reason=f"{type(outcome).__name__}: {outcome}")
                _log.error("%s: %s", row.label, record.reason)
                store.write_record(i, record)
            if layouts[row.label].parts > 1:
                store.scratch.discard(i)
            records[i] = record
            notify(Progress("fields", done, len(missing), row.label, record))
    if cut:
        store.scratch.discard()


def _outcomes(client: Client, futures: Sequence[Future]) -> list[Any]:
    """The results of futures that have ended, or what they raised, all fetched at once.

    Raises:
        ClusterError: the scheduler is gone, and what became of its tasks is not known.
    """
    lost = f"the scheduler at {client.scheduler.address} was lost; the same command goes on from what is stored"
    if client.status != "running" or any(future.cancelled() for future in futures):
        raise ClusterError(lost)
    try:
        found = iter(client.gather([future for future in futures if future.status == "finished"]))
        return [next(found) if future.status == "finished" else future.exception() for future in futures]
    except (CommClosedError, CancelledError) as error:
        raise ClusterError(lost) from error


def _job(store: Store, plan: Plan, number: int, row: Row, memory: float) -> Job:
    return Job(
        store,
        number,
        row.label,
        row.key,
        row.member,
        plan.similarity,
        plan.lattice,
        plan.transform,
        plan.study.orders,
        plan.aim(row),
        memory,
        plan.study.backend,
    )


def _reduce(
    client: Client,
    crew: Crew,
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    records: Sequence[Record | None],
    notify: Notify,
) -> Assessed | None:
    """Make the tables; the distances to the reference, or None where the tables were there."""
    if _is_reduced(store, plan, rows, records):
        return None
    complete = [i for i, record in enumerate(records) if record is not None and record.status == "complete"]
    reference = next(i for i, row in enumerate(rows) if row.label == plan.reference)
    orders = plan.study.orders
    center = reference if reference in complete else None
    reducer = _reducer(store, plan, records, center)
    norms, to_reference = (np.full((4, len(orders), len(rows)), np.nan) for _ in range(2))
    every_pair = plan.study.pairs == "all"
    others = range(len(rows)) if every_pair else [reference]
    distances = np.full((4, len(orders), len(rows), len(others)), np.nan)

    claims = reducer.task_bytes > crew.share_bytes
    resources = {MEMORY: min(reducer.task_bytes, crew.largest_bytes)} if claims else None

    def submitted(task: Callable[..., Any], *arguments: Sequence[int]) -> Future:
        return client.submit(task, *arguments, pure=False, resources=resources)

    jobs: dict[Future, tuple[Sequence[int], Sequence[int] | None]] = {
        submitted(reducer.norms, tile): (tile, None) for tile in reducer.strips(complete, crew.threads)
    }
    if every_pair:
        for tile, others_of_tile in reducer.tiles(complete, crew.threads):
            jobs[submitted(reducer.tile, tile, others_of_tile)] = (tile, others_of_tile)
    notify(Progress("reduction", 0, len(jobs)))
    for done, future in enumerate(as_completed(list(jobs)), 1):
        tile, other = jobs.pop(future)
        if other is None:
            norms[..., tile], to_reference[..., tile] = (np.stack(list(found)) for found in future.result())
        else:
            found = np.stack(list(future.result()))
            distances[..., np.array(tile)[:, None], np.array(other)] = found
            distances[..., np.array(other)[:, None], np.array(tile)] = np.swapaxes(found, -1, -2)
        notify(Progress("reduction", done, done + len(jobs)))
    if every_pair:
        # The direct sums are the more exact ones, and the same numbers in both tables.
        distances[..., reference] = distances[..., reference, :] = to_reference
    else:
        distances[..., 0] = to_reference
    _write_tables(store, plan, rows, records, norms, to_reference, distances, [rows[j] for j in others])
    return Assessed(*to_reference)


def _reducer(store: Store, plan: Plan, records: Sequence[Record | None], center: int | None) -> Reducer:
    """The reducer of a store, with what the records say of its fields."""
    lattice, orders = plan.lattice, plan.study.orders
    qualities = {
        i: Quality.from_json(record.quality)
        for i, record in enumerate(records)
        if record is not None and record.status == "complete"
    }
    areas, errors = np.full(len(records), np.nan), np.full((len(orders), len(records)), np.nan)
    for i, quality in qualities.items():
        areas[i], errors[:, i] = quality.area, quality.probe.norms(lattice, orders)
    widths = support_widths(list(qualities.values())) if qualities else np.zeros(len(DIRECTIONS))
    return Reducer(store, lattice, plan.blocks, orders, center, areas, errors, widths)


def _write_tables(
    store: Store,
    plan: Plan,
    rows: Sequence[Row],
    records: Sequence[Record | None],
    norms: Reals,
    to_reference: Reals,
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
        Assessed(*to_reference),
        Assessed(*norms[..., reference]),
        sizes,
        plan.reference,
        plan.study.accuracy,
    )
    store.write_qualities([record.quality if record else "" for record in records])
    store.write_table("meshes", meshes)
    store.write_table("norms", norms_dataset(rows, orders, Assessed(*norms)))
    store.write_table("distances", distances_dataset(rows, others, orders, Assessed(*distances)))
    # Written last: its digest says that all tables belong to the fields that are there.
    digest = _reduction_digest(plan, rows, records)
    store.write_table("convergence", convergence.assign_attrs(digest=digest))
    store.consolidate()


def _is_reduced(store: Store, plan: Plan, rows: Sequence[Row], records: Sequence[Record | None]) -> bool:
    attributes = store.table_attributes("convergence")
    return attributes is not None and attributes.get("digest") == _reduction_digest(plan, rows, records)


def _reduction_digest(plan: Plan, rows: Sequence[Row], records: Sequence[Record | None]) -> str:
    parts = {
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
