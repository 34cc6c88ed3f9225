"""Verification: everything that is stored read back, against its checksums and records."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from distributed import Client, wait

from sobolev_batch.batch.cluster.clients import available_cores
from sobolev_batch.batch.cluster.outcomes import outcomes
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock, acquire, release
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecords, Kind
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.store.witness_array import Witnesses
from sobolev_batch.errors import DamageError, LockError, StoreError

_log = logging.getLogger(__name__)

# Reading waits for a disk or a network most of the time.
_THREADS_PER_CORE = 2


@dataclass(frozen=True)
class Verification:
    """What was found of a store.

    Attributes:
        store: its path or URL.
        complete: surfaces with a completion record; their fields were read.
        total: surfaces of the study.
        fields: what is wrong with the field or the record of each surface that is damaged.
        comparisons: likewise for the witness function, or the note of it or of Hausdorff and Chamfer distances, of
            each surface where it is damaged.
        tables: likewise for arrays of tables and coordinates.
        withdrawn: whether the records of these fields, the notes of these comparisons, and the tables if anything
            is damaged, were taken away, so that the next run makes them anew.
    """

    store: str
    complete: int
    total: int
    fields: Mapping[str, str]
    comparisons: Mapping[str, str]
    tables: Mapping[str, str]
    withdrawn: bool

    @property
    def is_sound(self) -> bool:
        """Whether nothing is damaged."""
        return not self.fields and not self.comparisons and not self.tables


def verify(place: str | Path | Location, on_progress: Callable[[int, int], None] | None = None) -> Verification:
    """Read everything that a store holds, and withdraw what is damaged so that a run computes it again.

    Args:
        place: path or URL of the store. If it cannot be written, nothing is withdrawn.
        on_progress: called with the number of fields that were read, and of all.

    Raises:
        StoreError: no store is there, or it cannot be read at all.
        LockError: a run is going on in it.
    """
    store = Store.open(place)
    lock = Lock.of_this_process()
    try:
        acquire(store.location, lock)
    except LockError:
        raise
    except StoreError as error:
        _log.info("%s: read without the right to write (%s)", store.path, error)
        return _verify(store, on_progress, None)
    try:
        # Anew: the last run may have ended since.
        return _verify(Store.open(place), on_progress, lock)
    finally:
        release(store.location, lock)


def damaged_rows(client: Client, store: Store, records: Sequence[Record | None]) -> list[int]:
    """The rows whose fields are not what their records say, found by the workers of a cluster."""
    rows = _complete(records)
    futures = [client.submit(_damage_of, store, row, record, pure=False) for row, record in rows.items()]
    wait(futures)
    found = outcomes(client, futures)
    for outcome in found:
        if isinstance(outcome, BaseException):
            raise outcome
    return [row for row, what in zip(rows, found, strict=True) if what]


def _verify(store: Store, on_progress: Callable[[int, int], None] | None, lock: Lock | None) -> Verification:
    labels, records = store.labels(), store.records()
    complete = _complete(records)
    damaged = {row: f"its completion record is damaged ({what})" for row, what in store.record_table.damaged().items()}
    whole = store.rows_with_complete_fields() if complete else set()

    def damage_of(row: int) -> str:
        return _damage_of(store, row, complete[row]) if row in whole else "it is not there, or of another length"

    with ThreadPoolExecutor(_THREADS_PER_CORE * available_cores()) as pool:
        found = pool.map(damage_of, complete)
        for done, (row, what) in enumerate(zip(complete, found, strict=True), 1):
            if what:
                damaged[row] = what
            if on_progress is not None:
                on_progress(done, len(complete))
    tables = Tables(store).damaged()
    notes = {kind: _damaged_notes(store, kind, complete) for kind in KINDS}
    withdraw = lock is not None and bool(damaged or tables or any(notes.values()))
    if lock is not None and withdraw:
        # Whoever has released the store may have changed it since.
        lock.require(store.location)
        # From a table, as long as there are some.
        store.repair_labels()
        Tables(store).invalidate()
        for row in damaged:
            store.write_record(row, None)
        for kind, rows in notes.items():
            for row in rows:
                ComparisonRecords(store, kind).write(row, None)
    fields = {labels[row]: damaged[row] for row in sorted(damaged)}
    comparisons = {labels[row]: what for rows in notes.values() for row, what in sorted(rows.items())}
    return Verification(store.path, len(complete), len(labels), fields, comparisons, tables, withdraw)


def _complete(records: Sequence[Record | None]) -> dict[int, Record]:
    return {row: record for row, record in enumerate(records) if record is not None and record.status == "complete"}


def _damaged_notes(store: Store, kind: Kind, complete: Mapping[int, Record]) -> dict[int, str]:
    """What is wrong with the comparison of each row, of one kind."""
    found = ComparisonRecords(store, kind)
    damaged = {row: f"the note of its {kind} is damaged ({what})" for row, what in found.damaged().items()}
    # Those that readers do not find are still to be made.
    if kind == "witness" and Witnesses(store).are_listed():
        for row, note in enumerate(found.read()):
            if note is not None and note.status == "complete" and row in complete:
                try:
                    Witnesses(store).read(row, complete[row].facts.vertices, note.checksum)
                except DamageError as error:
                    damaged[row] = f"its witness function is damaged ({error.what})"
    return damaged


def _damage_of(store: Store, row: int, record: Record) -> str:
    """What is wrong with the field of a row; empty if nothing is."""
    places = store.block_slices()
    if len(record.checksums) != len(places):
        return f"its record knows of {len(record.checksums)} blocks, and the store has {len(places)}"
    for place, checksum in zip(places, record.checksums, strict=True):
        try:
            store.read_fields([row], place, [checksum])
        except DamageError as error:
            return error.what
    return ""
