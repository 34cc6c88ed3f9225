"""Fields of other stores, taken over where they are what a study asks for."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store, stored_choice
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.batch.workspace import Workspace, complete_records
from sobolev_batch.errors import DamageError, StoreError

_log = logging.getLogger(__name__)

# Most of the time of a copy is spent waiting for disks or object storage.
_THREADS = 4


def first_choice(locations: Iterable[Location]) -> LatticeChoice | None:
    """Return the lattice that was chosen for the first of some stores that has one; None if none has."""
    return next(filter(None, map(stored_choice, locations)), None)


def take_over(workspace: Workspace, others: Sequence[Location]) -> list[int]:
    """Copy the fields that a workspace lacks from other stores that have them, and return their rows.

    The key of a field says all that it depends on. So it is the same field, whatever the other study calls the mesh.
    Each is checked as it is read.

    Raises:
        StoreError: A location has no store of a study, or cannot be read or written.
    """
    taken: list[int] = []
    for location in others:
        other = Store.open(location)
        stored = {record.key: (row, record) for row, record in complete_records(other.records()).items()}
        found = {i: stored[key] for i in workspace.pending if (key := workspace.rows[i].key) in stored}
        copies = [_Copy(other, workspace.store, row, i, record) for i, (row, record) in found.items()]
        with ThreadPoolExecutor(_THREADS) as pool:
            made = [copy for copy, is_made in zip(copies, pool.map(_Copy.make, copies), strict=True) if is_made]
        for copy in made:
            workspace.records[copy.into] = copy.record
            taken.append(copy.into)
        _log.info("%s: %d fields taken over from %s", workspace.store.path, len(made), other.path)
    return taken


@dataclass(frozen=True, eq=False)
class _Copy:
    """The copy of a field.

    Attributes:
        source: Store that has the field.
        store: Store that lacks it.
        row: Row in the one.
        into: Row in the other.
        record: Record of the field.
    """

    source: Store
    store: Store
    row: int
    into: int
    record: Record

    def make(self) -> bool:
        """Copy the field with its record; return False where the field is damaged."""
        source, store = self.source, self.store
        places, checksums = source.block_slices(), list(self.record.checksums)
        if places != store.block_slices() or len(checksums) != len(places) + source.has_octaves:
            raise StoreError(
                f"{source.path}: it cuts fields into other blocks than {store.path}; run the study without it, or make "
                "both stores by one version of this program"
            )
        try:
            if source.has_octaves:
                # Behind those of the field.
                store.write_octaves(self.into, source.read_octaves([self.row], [checksums.pop()])[0])
            for place, checksum in zip(places, checksums, strict=True):
                store.write_field(self.into, place, source.read_fields([self.row], place, [checksum])[0])
        except DamageError as error:
            _log.warning("%s; it is computed here", error)
            return False
        store.write_record(self.into, self.record)
        return True
