"""Verification: everything that is stored read back, against its checksums and records."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from sobolev_batch.errors import DamageError, ForeignError, LockError, StoreError
from sobolev_batch.machine import available_cores
from sobolev_batch.parameters import callback
from sobolev_batch.shown import Shown
from sobolev_batch.store import layout
from sobolev_batch.store.encoding import ROOT
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.latest_run import RunRecord
from sobolev_batch.store.layout import Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import Lock, acquire, release
from sobolev_batch.store.objects import Objects, labelled, root_of
from sobolev_batch.store.records import Record, Records
from sobolev_batch.store.sealed_chunks import Index, damaged_chunks, withdraw_chunk
from sobolev_batch.store.workspace import Contents
from sobolev_batch.tables.pairs import Pairs
from sobolev_batch.tables.stored_spectra import spectrum_keys, stale_chunks
from sobolev_batch.visible import visible

_log = logging.getLogger(__name__)

# Reading waits for a disk or a network most of the time.
_THREADS_PER_CORE = 2


@dataclass(frozen=True)
class Verification(Shown):
    """The result of a verification.

    Attributes:
        store: Path or URL of the store.
        complete: Number of surfaces of the study with a completion record; their fields were read.
        total: Number of surfaces of the study.
        fields: Damage of fields and their records, by the label of the surface.
        tables: Damage of tables and coordinates, by the name of the array.
        withdrawn: True if the records of damaged fields were withdrawn, so that the next run makes them again, as it
            does damaged tables.
        objects: Verification of each object by its name, where the study names them. The total of an object without a
            store is 0.
        removed: Number of surfaces that the study has no longer, and whose fields stay until `prune`; they were read.

    >>> import sobolev_batch as sb
    >>> sb.result_types.Verification("results.zarr", 5, 5, {}, {}, withdrawn=False).is_sound
    True
    """

    store: str
    complete: int
    total: int
    fields: Mapping[str, str]
    tables: Mapping[str, str]
    withdrawn: bool
    objects: Mapping[str, Verification] = field(default_factory=dict)
    removed: int = 0

    def __str__(self) -> str:
        lines = []
        for name, one in (self.objects or {self.store: self}).items():
            counts = f"{one.complete} of {one.total} surfaces complete, their fields read back"
            counts += f", with {one.removed} that the study has no longer" * (one.removed > 0)
            nothing = "its store cannot be read" if one.tables else "it has no results yet"
            lines.append(f"{name}: {counts if one.total else nothing}")
        damage = {**self.fields, **{f"table {name}": what for name, what in self.tables.items()}}
        lines += [f"{name}: {what}" for name, what in damage.items()]
        remedy = "run the study again to repair it"
        if not self.withdrawn:
            remedy = "the store cannot be written from here, so nothing was withdrawn"
        surfaces = f"{len(self.fields)} surface{'s' * (len(self.fields) != 1)}"
        arrays = f"{len(self.tables)} array{'s' * (len(self.tables) != 1)} of tables"
        found = f"damaged: {surfaces} and {arrays}; {remedy}"
        return "\n".join(map(visible, [*lines, "nothing is damaged" if self.is_sound else found]))

    @property
    def is_sound(self) -> bool:
        """True where nothing is damaged."""
        return not self.fields and not self.tables


def verify(store: str | Path | Location, on_progress: Callable[[int, int], None] | None = None) -> Verification:
    """Read everything that a store holds, and withdraw what is damaged so that a run computes it again.

    Args:
        store: Path or URL of the store, whose objects are verified one after the other, or that of one object. If it
            cannot be written, nothing is withdrawn.
        on_progress: Callback with the number of fields of a store that were read, and the number of all.

    Raises:
        StoreError: The store does not exist, or cannot be read at all.
        LockError: A run is going on in it.

    >>> import sobolev_batch as sb
    >>> found = sb.verify("storage/icosphere.zarr")
    >>> found.is_sound, found.complete, found.total
    (True, 5, 5)
    """
    location, notify = Location.parse(store), callback(on_progress)
    root, lock = root_of(location), Lock.of_this_process()
    if (objects := Objects.read(location, is_thorough=True)) is None:
        # Where there is no store, this says so.
        Store.open(location)
    try:
        acquire(root, lock)
    except LockError:
        raise
    except StoreError as error:
        _log.info("%s: read without the right to write (%s)", location, error)
        return _verify_all(location, objects, notify, may_write=False)
    try:
        # It is opened again: the last run may have ended since. Whoever unlocks it may change it.
        own = replace(location, fence=lock.fenced(root, "holder").fence)
        objects = objects and Objects.read(own, is_thorough=True)
        found = _verify_all(own, objects, notify, may_write=True)
        # A damaged root loses all records when a run makes it again.
        with suppress(DamageError):
            if root != location and not found.is_sound and (above := Objects.read(replace(own, name=root.name))):
                # Runs pass over objects whose records there say that nothing is missing.
                above.records.write(above.rows[location.name.rpartition("/")[2]], None)
        return found
    finally:
        release(root, lock)


def _verify_all(
    location: Location, objects: Objects | None, notify: Callable[[int, int], None], *, may_write: bool
) -> Verification:
    """Verify the only object of a store, or all of them."""
    if objects is None:
        return _verify(Store.open(location), notify, may_write=may_write)
    verified: dict[str, Verification] = {}
    for name in objects.names:
        verified[name] = Verification(f"{objects.location}/{name}", 0, 0, {}, {}, withdrawn=False)
        try:
            if place := objects.existing_store(name):
                verified[name] = _verify(Store.open(place), notify, may_write=may_write)
        except (DamageError, ForeignError) as error:
            what = error.what if isinstance(error, DamageError) else str(error)
            verified[name] = replace(verified[name], tables={ROOT: what}, withdrawn=may_write)
        if may_write and not verified[name].is_sound:
            objects.records.write(objects.rows[name], None)
    damaged = [one for one in verified.values() if not one.is_sound]
    return Verification(
        store=str(objects.location),
        complete=sum(one.complete for one in verified.values()),
        total=sum(one.total for one in verified.values()),
        fields=labelled({name: one.fields for name, one in verified.items()}),
        tables=labelled({name: one.tables for name, one in verified.items()}),
        withdrawn=bool(damaged) and all(one.withdrawn for one in damaged),
        objects=verified,
        removed=sum(one.removed for one in verified.values()),
    )


def _verify(store: Store, notify: Callable[[int, int], None], *, may_write: bool) -> Verification:
    records, unread = Records(store).examine()
    damaged = {row: f"its completion record is damaged ({what})" for row, what in unread.items()}
    tables, chunks = _damaged_tables(store), dict[tuple[str, Index], str]()
    labels = store.labels() if layout.LABELS not in tables else tuple(f"row {row}" for row in range(len(records)))
    removed = store.removed
    rows = dict.fromkeys(i for i, label in enumerate(labels) if label not in removed or records[i] is not None)
    contents = Contents(store, labels, rows, records)
    if contents.has_tables:
        if not {"meshes/row", "meshes/status", "meshes/key"} & tables.keys():
            damaged = contents.unlike_tables | damaged
        if layout.QUALITY not in tables:
            stored = zip(records, store.read_strings(layout.QUALITY), strict=True)
            # A run may have ended between a field and the tables.
            if any(record is not None and quality not in ("", record.quality) for record, quality in stored):
                tables[layout.QUALITY] = "it is not what records have"
        if tables.keys().isdisjoint(store.keyed_arrays()):
            chunks = _damaged_chunks(store, are_tables_sound=not tables)
    planned = store.attributes().get("versions", {}).get(layout.NUMERICS)
    for row, record in contents.complete.items():
        if planned is not None and record.numerics != planned and labels[row] not in removed:
            damaged[row] = f"it was computed by numerics of version {record.numerics}, and the study by {planned}"
    damaged |= _damaged_fields(store, contents.complete, notify)
    if may_write:
        for row in damaged:
            Records(store).write(row, None)
        for place in chunks:
            withdraw_chunk(store, *place)
        if tables:
            # The next run reads all of them.
            store.location.discard(layout.TAGS)
    for (keys, index), what in chunks.items():
        tables[f"chunk {'/'.join(map(str, index))} of {keys.split('/')[0]}"] = what
    return Verification(
        store=store.path,
        complete=sum(labels[row] not in removed for row in contents.complete),
        total=sum(labels[row] not in removed for row in rows),
        fields={labels[row]: damaged[row] for row in sorted(damaged)},
        tables=tables,
        withdrawn=may_write and bool(damaged or tables),
        removed=sum(labels[row] in removed for row in contents.complete),
    )


def _damaged_chunks(store: Store, *, are_tables_sound: bool) -> dict[tuple[str, Index], str]:
    """Return the damage of each chunk of spectra and distances; by sound tables, some are not those of the fields."""
    chunks = dict(damaged_chunks(store))
    if not are_tables_sound:
        return chunks
    pairs = Pairs.tabulated(store)
    spectra = stale_chunks(store, spectrum_keys(pairs.keys, pairs.reference))
    stale: list[tuple[str, Index]] = [(layout.SPECTRA_KEYS, (number,)) for number in spectra]
    stale += [(layout.PAIRS_KEYS, tile) for tile in (pairs.stale() if layout.PAIRS_KEYS in store.documents else ())]
    return dict.fromkeys(stale, "it is not that of the stored fields") | chunks


def _damaged_fields(store: Store, complete: Mapping[int, Record], notify: Callable[[int, int], None]) -> dict[int, str]:
    whole = Fields(store).complete_rows() if complete else set()

    def damage_of(row: int) -> str:
        return Fields(store).damage(row, complete[row]) if row in whole else "it is not there, or of another length"

    damaged = {}
    with ThreadPoolExecutor(_THREADS_PER_CORE * available_cores()) as pool:
        for done, (row, damage) in enumerate(zip(complete, pool.map(damage_of, complete), strict=True), 1):
            if damage:
                damaged[row] = damage
            notify(done, len(complete))
    return damaged


def _damaged_tables(store: Store) -> dict[str, str]:
    """Return the damage of each small array, of tables and coordinates, of what they say together, and of the run."""
    keyed, names = store.keyed_arrays(), store.whole_arrays()
    expected = [*names, layout.QUALITY, *keyed] if layout.table_names(store) else names
    # Groups of tasks have the fields besides, which are many.
    prefixes = {name if (group := name.split("/")[0]) in layout.GROUPS_OF_TASKS else group for name in expected}
    sizes = {key: size for prefix in prefixes for key, size in store.location.sizes(prefix).items()}
    incomplete = (name for name in expected if store.incomplete_chunks(name, sizes))
    damage = dict.fromkeys(incomplete, "it is not there, or not all of it")
    for name in expected:
        if name not in damage and name not in keyed:
            try:
                store.read(name)
            except DamageError as error:
                damage[name] = error.what
    if not damage and not store.has_digest(is_thorough=True):
        damage[ROOT] = "tables, coordinates or metadata are not what was written together"
    try:
        RunRecord.read(store)
    except StoreError as error:
        damage[layout.RECORDS] = error.what if isinstance(error, DamageError) else str(error)
    return damage
