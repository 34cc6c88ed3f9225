"""Store: one zarr hierarchy with the fields, records and tables of a study.

The driver creates all arrays before any task starts (see `create`). Tasks fill whole chunks and nothing else, so
no two of them write the same chunk. docs/store.md describes the layout for readers.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from zarr.buffer.cpu import NDBuffer

from sobolev_batch.batch.storage.checked import CHANGED, RecordedChunks, checksum_of, document_digest
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.hierarchy import (
    DIGEST,
    FIELD,
    LABELS,
    OCTAVE_LABELS,
    OCTAVES,
    QUALITY,
    RECORD,
    RECORDS,
    ROOT,
    Hierarchy,
    StoredChunks,
)
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.batch.store.record_table import RecordTable
from sobolev_batch.batch.store.records import Record, RunRecord
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.spectral.lattice import Block, Lattice

_log = logging.getLogger(__name__)

BlockSlices = tuple[slice, slice, slice]

# Attribute of the root of a store that is being created.
UNFINISHED = "unfinished"
# Attribute of the root of the store of a collection.
COLLECTION = "collection"
# Attribute of the root with the labels of meshes that the study has lost.
REMOVED = "removed"
_MESHES, _ROWS = "meshes/mesh", "meshes/row"
_RUN = "run"


class Store(Hierarchy):
    """Store of a study, by its path or URL. Cheap to make and to pickle."""

    def __getstate__(self) -> dict[str, Any]:
        # Tasks need only these; tables have fifty times as much.
        carried = {
            name: document
            for name, document in self.documents.items()
            if name in (FIELD, OCTAVES) or name.startswith(f"{RECORDS}/")
        }
        return {"location": self.location, "documents": carried, "digests": {}}

    @classmethod
    def open(cls, store: str | Path | Location) -> Self:
        """Open a store that exists.

        Raises:
            StoreError: There is none, it cannot be read, or it has another schema.
        """
        opened = cls(store)
        opened.attributes()
        return opened

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the root: title, study, similarity, versions.

        Raises:
            StoreError: No store of this package's schema exists.
        """
        if not self.exists() or self.documents[""].get("node_type") != "group":
            raise StoreError(f"{self.path}: no store of a study is there")
        attributes: dict[str, Any] = self.documents[""].get("attributes", {})
        if COLLECTION in attributes:
            names = ", ".join(attributes[COLLECTION].get("objects", ())[:3])
            raise StoreError(
                f"{self.path}: the store of a collection; each of its objects has a store of its own below it: {names}"
            )
        if self.is_unfinished:
            raise StoreError(
                f"{self.path}: the store is being laid out, or whoever did that was interrupted; run the study again"
            )
        if "schema_version" not in attributes or "study" not in attributes:
            raise StoreError(f"{self.path}: a zarr store, but not one of a study")
        version = attributes["schema_version"]
        if version != SCHEMA_VERSION:
            raise StoreError(
                f"{self.path}: its schema has version {version}, this program reads {SCHEMA_VERSION}; "
                "run the study again into another store, or read this one with the version that has written it"
            )
        return attributes

    @property
    def is_unfinished(self) -> bool:
        """True if the creation of the store was not finished: nothing in it counts."""
        return self.exists() and bool(self.documents[""].get("attributes", {}).get(UNFINISHED))

    @property
    def recorded_chunks(self) -> tuple[RecordedChunks, ...]:
        """Arrays whose chunks the records of their rows tell of."""
        found = []
        # The checksum of the octaves stands behind those of the field.
        for name, first in ((FIELD, 0), (OCTAVES, -1)):
            if name in self.documents:
                array = self.array(name)
                found.append(RecordedChunks(name, RECORD, array.shape, array.chunks, array.dtype.str, first))
        return tuple(found)

    def labels(self) -> tuple[str, ...]:
        """Return the label of each row. If they are damaged, take those of the octaves or of the table of meshes.

        Raises:
            DamageError: Neither can be read.
            StoreError: The store cannot be read.
        """
        labels = next(filter(None, map(self._labels_of, self._label_arrays)), ()) or self._labels_in_tables()
        if not labels:
            raise DamageError(
                f"{self.path}: {LABELS} is damaged, and nothing else says which field is whose; remove the store and "
                "run the study again",
                "the labels are damaged",
            )
        return labels

    def repair_labels(self) -> None:
        """Write labels again that are damaged, or of which one of two copies has been changed."""
        copies = {name: self._labels_of(name) for name in self._label_arrays}
        labels = next(filter(None, copies.values()), ()) or self.labels()
        if any(copy != labels for copy in copies.values()):
            self.write_labels(labels)
            self.consolidate()

    def write_labels(self, labels: Sequence[str]) -> None:
        """Write the label of each row."""
        for name in self._label_arrays:
            self.write(name, ..., np.array(labels, dtype=object))

    @property
    def removed(self) -> frozenset[str]:
        """Labels of the meshes that the study has lost; their fields stay, in case they come back."""
        return frozenset(self.attributes().get(REMOVED, ()))

    @property
    def record_table(self) -> RecordTable[Record]:
        """Completion records of all rows."""
        return RecordTable(self, RECORD, Record)

    def records(self) -> tuple[Record | None, ...]:
        """Return the completion record of each row, or None if it has none that can be read."""
        records, damage = self.record_table.examine()
        for row, problem in damage.items():
            label = self.labels()[row]
            _log.warning("%s: the record of %s is damaged and counts as not there: %s", self.path, label, problem)
        return tuple(records)

    def read_record(self, row: int) -> Record | None:
        """Return the completion record of one row, or None if it has none that can be read."""
        return self.record_table.read_row(row)

    def write_record(self, row: int, record: Record | None) -> None:
        """Write the completion record of a row, or erase it: one chunk, replaced as a whole."""
        self.record_table.write(row, record)

    def block_slices(self) -> tuple[BlockSlices, ...]:
        """Return the slices of a field's blocks, in the order of a plan's blocks."""
        array = self.array(FIELD)
        axes = [
            [slice(start, min(start + step, total)) for start in range(0, total, step)]
            for total, step in zip(array.shape[1:], array.chunks[1:], strict=True)
        ]
        return tuple((x, y, z) for x, y, z in product(*axes))

    def blocks_of(self, lattice: Lattice) -> tuple[Block, ...]:
        """Return the blocks of a field on its lattice, in the order of `block_slices`."""
        x, y, z = lattice.half.start
        return tuple(
            Block((x + i.start, y + j.start, z + k.start), (i.stop - i.start, j.stop - j.start, k.stop - k.start))
            for i, j, k in self.block_slices()
        )

    @property
    def has_octaves(self) -> bool:
        """True if values in octaves lie beside the fields."""
        return OCTAVES in self.documents

    def write_field(self, row: int, block: BlockSlices, values: NDArray[Any]) -> int:
        """Write one block of a row's field, made of whole chunks, and return its checksum for `read_fields`."""
        return self._write_chunks(FIELD, (row, *block), values)

    def write_octaves(self, row: int, values: NDArray[Any]) -> int:
        """Write a row's values at all samples of octaves, one chunk, and return their checksum for `read_octaves`."""
        return self._write_chunks(OCTAVES, (row, slice(None)), values)

    def read_octaves(self, rows: Sequence[int], checksums: Sequence[int] | None = None) -> NDArray[Any]:
        """Return the values of several rows at all samples of octaves, complex (len(rows), n); see `read_fields`."""
        return self._read_rows(OCTAVES, rows, (slice(0, self.array(OCTAVES).shape[1]),), checksums)

    def read_fields(
        self, rows: Sequence[int], block: BlockSlices, checksums: Sequence[int] | None = None
    ) -> NDArray[Any]:
        """Return one block of several rows' fields, complex (len(rows), ...).

        Args:
            rows: Rows to read.
            block: Slices of the block.
            checksums: Checksums that the tasks returned for the block of each row. Without them, a missing block
                reads as NaN.

        Raises:
            DamageError: A block is damaged, lost, or another one; the error names its row.
            StoreError: The store cannot be read.
        """
        return self._read_rows(FIELD, rows, block, checksums)

    def _write_chunks(self, name: str, selection: tuple[int | slice, ...], values: NDArray[Any]) -> int:
        array = self.array(name)
        values = np.ascontiguousarray(values, dtype=array.dtype)
        with self.location.access("written"):
            array[selection] = values
        return checksum_of(values)

    def _read_rows(
        self, name: str, rows: Sequence[int], block: tuple[slice, ...], checksums: Sequence[int] | None
    ) -> NDArray[Any]:
        array = self.array(name)
        values = np.empty((len(rows), *(axis.stop - axis.start for axis in block)), dtype=array.dtype)
        # On object storage, all but a wrong checksum is a failure of the access.
        damage = ValueError if self.location.scheme else (OSError, ValueError)

        def read(i: int) -> None:
            with self.location.access("read"):
                try:
                    # In place: copying a field costs as much as reading it.
                    array.get_basic_selection((rows[i], *block), out=NDBuffer.from_numpy_array(values[i]))
                except damage as error:
                    raise self._damage(rows[i], str(error)) from error
            if checksums is not None and checksum_of(values[i]) != checksums[i]:
                lost = bool(np.isnan(values[i]).all())
                raise self._damage(rows[i], "it is not there" if lost else "it is not what was written for its record")

        if self.location.scheme and len(rows) > 1:
            # Most of the time of a request is spent waiting.
            with ThreadPoolExecutor(len(rows)) as pool:
                list(pool.map(read, range(len(rows))))
        else:
            for i in range(len(rows)):
                read(i)
        return values

    def rows_with_complete_fields(self) -> set[int]:
        """Return the rows of which every block exists in its full length. No block is read."""
        rows = set(range(self.array(FIELD).shape[0]))
        for chunks in (StoredChunks(self, name) for name in (FIELD, OCTAVES) if name in self.documents):
            blocks = list(np.ndindex(*chunks.counts[1:]))
            rows = {row for row in rows if chunks.are_complete((row, *block) for block in blocks)}
        return rows

    def read_run(self) -> RunRecord | None:
        """Return the record of the latest run, or None before the first one."""
        table = (self._read_document(RECORDS) or {}).get("attributes", {}).get(_RUN)
        if table is None:
            return None
        if table.pop(DIGEST, None) != document_digest(table):
            raise DamageError(f"{self.path}: the record of the latest run is damaged ({CHANGED}): {table}", CHANGED)
        return RunRecord.from_table(table)

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run: an attribute of the group of records, in one key."""
        document = self.document(RECORDS)
        # Not remembered: consolidated metadata would tell readers of a run that ended long ago.
        table = record.to_table()
        run = {**table, DIGEST: document_digest(table)}
        changed = {**document, "attributes": {**document.get("attributes", {}), _RUN: run}}
        self.location.write({f"{RECORDS}/{ROOT}": json.dumps(changed).encode()})

    def write_qualities(self, qualities: Sequence[str]) -> None:
        """Write the coordinate `quality` of all fields."""
        self.write(QUALITY, ..., np.array(qualities, dtype=object))

    def _damage(self, row: int, problem: str) -> DamageError:
        return DamageError(
            f"{self.path}: the field of {self.labels()[row]} is damaged ({problem}); run the study again", problem, row
        )

    def _labels_in_tables(self) -> tuple[str, ...]:
        """Return the labels that the table of meshes gives to rows, or none where it lacks one."""
        if _ROWS not in self.documents:
            return ()
        try:
            rows = np.asarray(self.read(_ROWS, ...)).tolist()
        except DamageError:
            return ()
        by_row = dict(zip(rows, self._labels_of(_MESHES), strict=False))
        return tuple(by_row[i] for i in range(len(by_row))) if set(by_row) == set(range(self._row_count)) else ()

    @property
    def _label_arrays(self) -> tuple[str, ...]:
        return (LABELS, OCTAVE_LABELS) if self.has_octaves else (LABELS,)

    @property
    def _row_count(self) -> int:
        return int(self.array(LABELS).shape[0])

    def _labels_of(self, name: str) -> tuple[str, ...]:
        """Return the labels in an array, or none if it is damaged or incomplete."""
        try:
            labels = self.read_strings(name)
        except DamageError:
            return ()
        return labels if all(labels) else ()


def stored_choice(store: str | Path | Location) -> LatticeChoice | None:
    """Return the lattice that was chosen for a store; None without one, or if its study gave the lattice.

    Damaged metadata tell none.

    Raises:
        StoreError: The location cannot be read, or holds something else.
    """
    existing = Store(store)
    try:
        if not existing.exists() or existing.is_unfinished:
            return None
    except DamageError:
        return None
    study = existing.attributes()["study"]
    return LatticeChoice.from_table(study["choice"], study.get("octaves")) if study.get("choice") else None
