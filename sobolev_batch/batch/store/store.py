"""The store: one zarr hierarchy with the fields, records and tables of a study.

The driver lays out all arrays before any task starts (`preparation`); tasks fill whole chunks of them and
nothing else, so no two writers ever meet in one chunk. docs/store.md describes the layout for readers.

The metadata of all arrays lie together in one document at the root. A store reads that once and its
tasks take along what they need of it: on object storage every look at a key is a request.
"""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any, Self

import google_crc32c
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.buffer import Buffer
from zarr.abc.store import Store as ZarrStore
from zarr.buffer.cpu import Buffer as BytesBuffer
from zarr.buffer.cpu import NDBuffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore, StorePath

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.scratch import Scratch
from sobolev_batch.batch.store.metadata import MOST_BYTES, SCHEMA_VERSION, Document, check_documents
from sobolev_batch.batch.store.records import Record, RunRecord
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.errors import DamageError, StoreError

_log = logging.getLogger(__name__)

Place = tuple[slice, slice, slice]

ROOT = "zarr.json"
# The attribute of the root of a store that is being laid out.
UNFINISHED = "unfinished"
FIELD = "fourier/fourier"
LABELS = "fourier/mesh"
QUALITY = "fourier/quality"
RECORD = "records/record"
RECORDS = "records"
WITNESS_GROUP = "witness"
WITNESS = "witness/witness"
_MESHES = "meshes/mesh"
_RUN = "run"
# Bytes of the codec at the end of a chunk.
CHECKSUM_BYTES = 4
_REQUESTS_AT_ONCE = 64


class Store:
    """An existing store, by its path or URL. Cheap to make and to pickle.

    What it has read of the metadata it keeps: make another one to see what other processes have
    changed of it. Chunks are read anew each time.

    Attributes:
        location: where it is.
        documents: metadata documents by the path of their node; that of the root, under "", without the others.
    """

    def __init__(self, place: str | Path | Location) -> None:
        self.location = Location.of(place)
        self.documents: dict[str, Document] = {}

    def __getstate__(self) -> dict[str, Any]:
        # What tasks write and read; tables have fifty times as much.
        carried = {
            name: document
            for name, document in self.documents.items()
            if name in (FIELD, WITNESS) or name.startswith(f"{RECORDS}/")
        }
        return {"location": self.location, "documents": carried}

    @property
    def path(self) -> str:
        """The path or URL."""
        return self.location.name

    @classmethod
    def open(cls, place: str | Path | Location) -> Self:
        """Open a store that exists.

        Raises:
            StoreError: there is none, it cannot be reached, or it has another schema.
        """
        store = cls(place)
        store.attributes()
        return store

    def is_there(self) -> bool:
        """Whether a zarr hierarchy is there.

        Raises:
            StoreError: the place cannot be reached.
        """
        if "" not in self.documents:
            root = self._read_document("")
            if root is None:
                return False
            # What the root repeats of groups, these repeat of what is in them.
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                document.pop("consolidated_metadata", None)
                self.documents.setdefault(name, document)
            self.documents[""] = root
        return True

    def keys(self, name: str = FIELD) -> ZarrStore:
        """What zarr and xarray take to read the store, with an eye to the chunks of one array."""
        chunk = self.document(name)["chunk_grid"]["configuration"]["chunk_shape"]
        return self.location.keys(math.prod(chunk) * np.dtype(np.complex128).itemsize)

    def attributes(self) -> dict[str, Any]:
        """The attributes of the root: title, study, similarity, versions.

        Raises:
            StoreError: no store of this package's schema is there.
        """
        if not self.is_there() or self.documents[""].get("node_type") != "group":
            raise StoreError(f"{self.path}: no store of a study is there")
        found: dict[str, Any] = self.documents[""].get("attributes", {})
        if self.is_unfinished:
            raise StoreError(
                f"{self.path}: the store is being laid out, or whoever did that was interrupted; run the study again"
            )
        if "schema_version" not in found or "study" not in found:
            raise StoreError(f"{self.path}: a zarr store, but not one of a study")
        if found["schema_version"] != SCHEMA_VERSION:
            raise StoreError(
                f"{self.path}: its schema has version {found['schema_version']}, this program reads {SCHEMA_VERSION}; "
                "name another store for this program, or read this one with the version that has written it"
            )
        return found

    @property
    def is_unfinished(self) -> bool:
        """Whether a store is there that was not laid out to the end: nothing in it counts."""
        return self.is_there() and bool(self.documents[""].get("attributes", {}).get(UNFINISHED))

    def labels(self) -> tuple[str, ...]:
        """The label of each row.

        Where they are damaged, those of the table of meshes serve, in the same order.

        Raises:
            DamageError: neither can be read.
            StoreError: the store cannot be reached.
        """
        labels = self._labels_of(LABELS)
        if not labels and _MESHES in self.documents and self.array(_MESHES).shape == self.array(LABELS).shape:
            labels = self._labels_of(_MESHES)
        if not labels:
            raise DamageError(
                f"{self.path}: {LABELS} is damaged, and nothing else says which field is whose; remove the store and "
                "run the study again",
                "the labels are damaged",
            )
        return labels

    def mend_labels(self) -> None:
        """Write the labels again where they are damaged and the table of meshes has them."""
        if not self._labels_of(LABELS):
            labels = self.labels()
            array = self.array(LABELS)
            with self.location.access("written"):
                array[:] = np.array(labels, dtype=object)

    def records(self) -> tuple[Record | None, ...]:
        """The completion record of each row, None where there is none that can be read."""
        records, damaged = self._examine_records()
        for row, what in damaged.items():
            label = self.labels()[row]
            _log.warning("%s: the record of %s is damaged and counts as not there: %s", self.path, label, what)
        return records

    def read_record(self, row: int) -> Record | None:
        """The completion record of one row, None where there is none that can be read."""
        line = self._read_record(row)
        try:
            return None if isinstance(line, DamageError) else Record.from_json(line)
        except StoreError:
            return None

    def damaged_records(self) -> dict[int, str]:
        """What is wrong with the record of each row that has one which cannot be read."""
        return self._examine_records()[1]

    def places(self) -> tuple[Place, ...]:
        """Where each block of a field lies in it, in the order of a plan's blocks."""
        array = self.array(FIELD)
        starts = (range(0, total, step) for total, step in zip(array.shape[1:], array.chunks[1:], strict=True))
        places = []
        for offsets in product(*starts):
            x, y, z = (
                slice(offset, min(offset + step, total))
                for offset, total, step in zip(offsets, array.shape[1:], array.chunks[1:], strict=True)
            )
            places.append((x, y, z))
        return tuple(places)

    def write_record(self, row: int, record: Record | None) -> None:
        """Write the completion record of a row, or withdraw it: one chunk, replaced as a whole."""
        array = self.array(RECORD)
        with self.location.access("written"):
            array[row] = "" if record is None else record.to_json()

    def write_field(self, row: int, place: Place, values: NDArray[Any]) -> int:
        """Write one block of a row's field, which must be whole chunks.

        Returns:
            The checksum by which `read_fields` knows it again.
        """
        array = self.array(FIELD)
        values = np.ascontiguousarray(values, dtype=array.dtype)
        with self.location.access("written"):
            array[(row, *place)] = values
        return checksum_of(values)

    def read_fields(self, rows: Sequence[int], place: Place, checksums: Sequence[int] | None = None) -> NDArray[Any]:
        """One block of several rows' fields, complex (len(rows), ...).

        Args:
            rows: which.
            place: of the block.
            checksums: that its blocks have if they are what the tasks have written; without them, a
                block that is not there reads as NaN.

        Raises:
            DamageError: a block is damaged, lost, or another one; it names its row.
            StoreError: the store cannot be reached.
        """
        array = self.array(FIELD)
        values = np.empty((len(rows), *(part.stop - part.start for part in place)), dtype=array.dtype)
        # On object storage all but a wrong checksum is a failure to reach it.
        damage = ValueError if self.location.scheme else (OSError, ValueError)

        def read(i: int) -> None:
            with self.location.access("read"):
                try:
                    # Into its place: a copy of a field costs as much as reading it.
                    array.get_basic_selection((rows[i], *place), out=NDBuffer.from_numpy_array(values[i]))
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

    def rows_with_whole_fields(self) -> set[int]:
        """The rows of which every block is there, as long as it should be; nothing is read of them."""
        array = self.array(FIELD)
        whole = math.prod(array.chunks) * array.dtype.itemsize + CHECKSUM_BYTES
        sizes = self.location.sizes(f"{FIELD}/c")
        blocks = list(np.ndindex(*(-(-n // m) for n, m in zip(array.shape[1:], array.chunks[1:], strict=True))))
        return {
            row
            for row in range(array.shape[0])
            if all(sizes.get(f"{FIELD}/{array.metadata.encode_chunk_key((row, *block))}") == whole for block in blocks)
        }

    @property
    def scratch(self) -> Scratch:
        """Room for pieces of meshes, which no reader needs."""
        return Scratch(self.location)

    def read_run(self) -> RunRecord | None:
        """The record of the latest run, or None where none was ever begun."""
        document = self._read_document(RECORDS) or {}
        table = document.get("attributes", {}).get(_RUN)
        return None if table is None else RunRecord.from_table(table)

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run: an attribute of the group of records, with one key written at once."""
        document = self.document(RECORDS)
        # Not remembered: consolidated metadata would tell readers of a run that ended long ago.
        changed = {**document, "attributes": {**document.get("attributes", {}), _RUN: record.to_table()}}
        self.location.write({f"{RECORDS}/{ROOT}": json.dumps(changed).encode()})

    def write_qualities(self, qualities: Sequence[str]) -> None:
        """Set the coordinate `quality` of all fields."""
        array = self.array(QUALITY)
        with self.location.access("written"):
            array[:] = np.array(qualities, dtype=object)

    def consolidate(self) -> None:
        """Collect the metadata of all groups at the root, so that one read opens everything."""
        nodes = {f"{name}/{ROOT}".lstrip("/"): document for name, document in self.documents.items()}
        known: dict[str, Buffer] = {key: _to_buffer(document) for key, document in nodes.items()}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(MemoryStore(known), zarr_format=3)
        self.location.write({ROOT: known[ROOT].to_bytes()})

    def _damage(self, row: int, what: str) -> DamageError:
        return DamageError(
            f"{self.path}: the field of {self.labels()[row]} is damaged ({what}); run the study again", what, row
        )

    def _labels_of(self, name: str) -> tuple[str, ...]:
        """The labels that an array holds; none where it is damaged, or a part of it not there."""
        try:
            labels = self.texts(name)
        except DamageError:
            return ()
        return labels if all(labels) else ()

    def _examine_records(self) -> tuple[tuple[Record | None, ...], dict[int, str]]:
        lines: list[str | DamageError]
        try:
            lines = list(self.texts(RECORD))
        except DamageError:
            # One of them at least: which, is seen one by one.
            lines = [self._read_record(row) for row in range(self.array(RECORD).shape[0])]
        records: list[Record | None] = []
        damaged = {}
        for row, line in enumerate(lines):
            try:
                if isinstance(line, DamageError):
                    raise line
                records.append(Record.from_json(line))
            except StoreError as error:
                damaged[row] = str(error)
                records.append(None)
        return tuple(records), damaged

    def _read_record(self, row: int) -> str | DamageError:
        try:
            return str(self.read(RECORD, row))
        except DamageError as error:
            return error

    def document(self, name: str) -> Document:
        """The metadata document of a node, from the root's if it was not read yet."""
        if name not in self.documents and self.is_there() and name not in self.documents:
            document = self._read_document(name)
            if document is not None:
                self.documents[name] = document
        if name not in self.documents:
            raise StoreError(
                f"{self.path}: the store is incomplete: it has no {name}; remove it and run the study again"
            )
        return self.documents[name]

    def _read_document(self, name: str) -> Document | None:
        text = self.location.read(f"{name}/{ROOT}".lstrip("/"), MOST_BYTES)
        if text is None:
            return None
        try:
            document = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise StoreError(
                f"{self.path}: no store of a study is there: {name}/{ROOT} is damaged ({error})"
            ) from error
        check_documents(self.path, {name: document})
        return document

    def array(self, name: str) -> zarr.Array[Any]:
        """An array by the path of its node, for reading and writing."""
        place = StorePath(self.keys(name), name)
        known = zarr.AsyncArray.from_dict(place, self.document(name))
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        return zarr.Array(zarr.AsyncArray(known.metadata, place, config={"write_empty_chunks": True}))

    def has(self, name: str) -> bool:
        """Whether a node is there, listed at the root or not."""
        return name in self.documents or self._read_document(name) is not None

    def resize(self, name: str, shape: tuple[int, ...]) -> None:
        """Give an array another shape; chunks within both stay."""
        array = self.array(name)
        with self.location.access("written"):
            array.resize(shape)
        del self.documents[name]
        self.document(name)

    def create_texts(self, name: str, count: int, *, chunk: int) -> None:
        """Create an array of texts along `mesh`, all of them empty."""
        made: dict[str, Buffer] = {}
        zarr.create_group(MemoryStore(made), zarr_format=3).create_array(
            name,
            shape=(count,),
            dtype=str,
            chunks=(chunk,),
            compressors=(Crc32cCodec(),),
            dimension_names=("mesh",),
            fill_value="",
        )
        self.publish({f"{name}/{ROOT}": made[f"{name}/{ROOT}"]}, last="")

    def remove(self, name: str) -> None:
        """Remove a node and everything in it, if it is there; `consolidate` makes that known to readers."""
        for known in [known for known in self.documents if known == name or known.startswith(f"{name}/")]:
            del self.documents[known]
        self.location.remove(name)

    def texts(self, name: str) -> tuple[str, ...]:
        """All of an array of texts.

        Raises:
            DamageError, StoreError: as for `read`.
        """
        return tuple(map(str, np.asarray(self.read(name, ...)).tolist()))

    def read(self, name: str, where: Any) -> Any:
        """Some of an array.

        Raises:
            DamageError: it is damaged.
            StoreError: the store cannot be reached.
        """
        array = self.array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            try:
                return array[where]
            except ValueError as error:
                raise DamageError(f"{self.path}: {name} is damaged ({error})", str(error)) from error

    def publish(self, made: dict[str, Buffer], last: str) -> None:
        """Write keys that were made in memory, the one that says that the others are there at the end."""
        self.location.write({key: value.to_bytes() for key, value in made.items() if key != last})
        if last in made:
            self.location.write({last: made[last].to_bytes()})
        for key, value in made.items():
            if key.endswith(f"/{ROOT}"):
                self.documents[key.removesuffix(f"/{ROOT}")] = json.loads(value.to_bytes())


def stored_choice(place: str | Path | Location) -> LatticeChoice | None:
    """The lattice that the fields of a store were chosen to have; None without a store, or where it was given.

    Raises:
        StoreError: the place cannot be reached, or holds something else.
    """
    store = Store(place)
    if not store.is_there() or store.is_unfinished:
        return None
    table = store.attributes()["study"].get("choice")
    return LatticeChoice.from_table(table) if table else None


def checksum_of(values: NDArray[Any]) -> int:
    """CRC-32C of a C-ordered array."""
    data: Any = values.view(np.uint8).reshape(-1)
    # The library takes what cannot change while it reads.
    data.flags.writeable = False
    return int(google_crc32c.value(data))


def _to_buffer(document: Document) -> Buffer:
    return BytesBuffer.from_bytes(json.dumps(document).encode())
