"""Store: one zarr hierarchy with the fields, records and tables of a study.

The driver creates all arrays before any task starts (see `create`). Tasks fill whole chunks and nothing else, so
no two of them write the same chunk. docs/store.md describes the layout for readers.

The metadata of all arrays lie together in one document at the root. A store reads it once, and tasks take along what
they need of it: on object storage every look at a key is a request.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.buffer import Buffer
from zarr.abc.store import Store as ZarrStore
from zarr.buffer.cpu import Buffer as BytesBuffer
from zarr.buffer.cpu import NDBuffer
from zarr.storage import MemoryStore, StorePath

from sobolev_batch.batch.storage.checked import (
    CHANGED,
    CHECKSUM_BYTES,
    CheckedStore,
    checksum_of,
    largest_chunk_bytes,
)
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.metadata import MOST_BYTES, SCHEMA_VERSION, Document, check_documents
from sobolev_batch.batch.store.records import Record, RunRecord
from sobolev_batch.batch.study.lattice_choice import LatticeChoice
from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.spectral.lattice import Block, Lattice

_log = logging.getLogger(__name__)

BlockSlices = tuple[slice, slice, slice]

ROOT = "zarr.json"
FIELD = "fourier/fourier"
LABELS = "fourier/mesh"
QUALITY = "fourier/quality"
OCTAVES_GROUP = "octaves"
OCTAVES = "octaves/octaves"
OCTAVE_LABELS = "octaves/mesh"
RECORDS = "records"
RECORD = "records/record"
# Attributes of the root: the digest of tables and metadata; true while the store is being created; the objects of a
# collection; the labels of meshes that the study has lost.
DIGEST, UNFINISHED, COLLECTION, REMOVED = "digest", "unfinished", "collection", "removed"
_RUN = "run"
# Written by tasks, and by themselves: the digest leaves them out. Qualities are a copy of what records have.
_BESIDE_DIGEST = (FIELD, OCTAVES, RECORD, QUALITY)
_REQUESTS_AT_ONCE = 64


class Store:
    """Store of a study, by its path or URL. Cheap to make and to pickle.

    Methods raise a `StoreError` if the store cannot be read or written. Metadata that were read are kept: make another
    store to see what other processes have changed of them. Chunks are read anew each time.

    Attributes:
        location: Location of the store.
        documents: Metadata documents by the path of their node. That of the root, under "", lacks the others.
    """

    def __init__(self, store: str | Path | Location) -> None:
        self.location = Location.parse(store)
        self.documents: dict[str, Document] = {}
        # SHA-256 of keys below the digest, where this process knows them.
        self._hashes: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Tasks need only these; tables have fifty times as much.
        carried = {name: document for name, document in self.documents.items() if name in (FIELD, OCTAVES, RECORD)}
        return {"location": self.location, "documents": carried, "_hashes": {}}

    @classmethod
    def open(cls, store: str | Path | Location) -> Self:
        """Open a store that exists.

        Raises:
            StoreError: There is none, it cannot be read, or it has another schema.
        """
        opened = cls(store)
        opened.attributes()
        return opened

    @property
    def path(self) -> str:
        """Path or URL of the store."""
        return self.location.name

    def exists(self) -> bool:
        """Return whether a zarr hierarchy exists.

        Raises:
            DamageError: The metadata at its root cannot be read.
        """
        if "" not in self.documents:
            root = self._read_document("")
            if root is None:
                return False
            # Groups repeat the metadata of what is in them, as the root does.
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                document.pop("consolidated_metadata", None)
                self.documents.setdefault(name, document)
            self.documents[""] = root
        return True

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the root: title, study, similarity, versions.

        Raises:
            StoreError: No store of this package's schema exists.
        """
        if not self.exists() or self.documents[""].get("node_type") != "group":
            raise StoreError(f"{self.path}: it holds no store of a study")
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
    def removed(self) -> frozenset[str]:
        """Labels of the meshes that the study has lost; their fields stay, in case they come back."""
        return frozenset(self.attributes().get(REMOVED, ()))

    # Nodes

    def document(self, name: str) -> Document:
        """Return the metadata document of a node.

        Raises:
            StoreError: The root does not list the node.
        """
        if name not in self.documents and not (self.exists() and name in self.documents):
            raise StoreError(
                f"{self.path}: the store is incomplete: it has no {name}; remove it and run the study again"
            )
        return self.documents[name]

    def is_array(self, name: str) -> bool:
        """Return whether the root lists an array of this name."""
        return self.documents.get(name, {}).get("node_type") == "array"

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array, for reading and writing."""
        chunk = self.document(name)["chunk_grid"]["configuration"]["chunk_shape"]
        keys = self.location.zarr_store(math.prod(chunk) * np.dtype(np.complex128).itemsize)
        # The values of fields are compared with their records, which does more.
        store = keys if name in (FIELD, OCTAVES) else CheckedStore(keys, self.path, self.documents)
        path = StorePath(store, name)
        metadata = zarr.AsyncArray.from_dict(path, self.document(name)).metadata
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        return zarr.Array(zarr.AsyncArray(metadata, path, config={"write_empty_chunks": True}))

    def checked_keys(self) -> ZarrStore:
        """Return the store that zarr and xarray take to read all arrays, whose chunks are checked."""
        chunk = self.document(FIELD)["chunk_grid"]["configuration"]["chunk_shape"]
        keys = self.location.zarr_store(math.prod(chunk) * np.dtype(np.complex128).itemsize)
        return CheckedStore(keys, self.path, self.documents)

    def read(self, name: str, selection: Any = ...) -> Any:
        """Return a selection of an array.

        Raises:
            DamageError: The array is damaged.
            StoreError: The store cannot be read.
        """
        array = self.array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            return array[selection]

    def read_strings(self, name: str) -> tuple[str, ...]:
        """Return all elements of an array of strings.

        Raises:
            DamageError, StoreError: See `read`.
        """
        return tuple(map(str, np.asarray(self.read(name)).tolist()))

    def write(self, name: str, selection: Any, values: Any) -> None:
        """Write a selection of an array, made of whole chunks."""
        array = self.array(name)
        self._forget(name)
        with self.location.access("written"):
            array[selection] = values

    def publish(self, keys: Mapping[str, bytes], last: str = "") -> None:
        """Write keys of new nodes, and the last one after all others. Readers find the nodes after `consolidate`."""
        self.location.write({key: content for key, content in keys.items() if key != last})
        if last in keys:
            self.location.write({last: keys[last]})
        for key, content in keys.items():
            self._hashes[key] = hashlib.sha256(content).hexdigest()
            if key.endswith(f"/{ROOT}"):
                self.documents[key.removesuffix(f"/{ROOT}")] = json.loads(content)

    def hide(self, names: Iterable[str]) -> None:
        """Forget nodes. They stay, but readers do not find them after `consolidate`."""
        for name in names:
            del self.documents[name]

    def remove(self, group: str) -> None:
        """Remove a group and everything in it, first from what readers find."""
        self.hide([name for name in self.documents if name == group or name.startswith(f"{group}/")])
        self.consolidate()
        self.location.remove(group)
        self._forget(group)

    def consolidate(self) -> None:
        """Collect the metadata of all nodes at the root, so that one read opens everything, with a new digest."""
        root = self._root()
        root["attributes"][DIGEST] = self._digest(root)
        self.documents[""]["attributes"][DIGEST] = root["attributes"][DIGEST]
        self.location.write({ROOT: json.dumps(root).encode()})

    def has_digest(self) -> bool:
        """Return whether tables, coordinates and metadata are those that were written together."""
        try:
            return bool(self.documents[""]["attributes"].get(DIGEST) == self._digest(self._root()))
        except (DamageError, ValueError, TypeError, KeyError):
            # zarr has no exception of its own for metadata that make no sense.
            return False

    def _root(self) -> Document:
        """Return the document at the root with those of all nodes, and without the digest."""
        attributes = {name: value for name, value in self.documents[""]["attributes"].items() if name != DIGEST}
        documents = {**self.documents, "": {**self.documents[""], "attributes": attributes}}
        keys: dict[str, Buffer] = {
            f"{name}/{ROOT}".lstrip("/"): BytesBuffer.from_bytes(json.dumps(document).encode())
            for name, document in documents.items()
        }
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(MemoryStore(keys), zarr_format=3)
        return dict(json.loads(keys[ROOT].to_bytes()))

    def _digest(self, root: Document) -> str:
        """Return the SHA-256 of a root and of all keys of the tables, coordinates and metadata that it lists."""
        # The group of records has the state of the latest run.
        keys = {f"{name}/{ROOT}": MOST_BYTES for name in self.documents if name not in ("", RECORDS)}
        for name in filter(self.is_array, self.documents):
            if name not in _BESIDE_DIGEST:
                keys |= dict.fromkeys(self.chunk_keys(name), largest_chunk_bytes(self.documents[name]))
        unknown = {key: keys[key] for key in sorted(keys.keys() - self._hashes.keys())}
        with ThreadPoolExecutor(_REQUESTS_AT_ONCE) as pool:
            contents = pool.map(self.location.read, unknown, unknown.values())
            for key, content in zip(unknown, contents, strict=True):
                self._hashes[key] = hashlib.sha256(content or b"").hexdigest()
        return _digest_of([root, {key: self._hashes[key] for key in keys}])

    def _forget(self, name: str) -> None:
        self._hashes = {key: value for key, value in self._hashes.items() if not key.startswith(f"{name}/")}

    def chunk_keys(self, name: str) -> dict[str, tuple[int, ...]]:
        """Return the keys of all chunks of an array, with their indices."""
        document = self.document(name)
        steps = document["chunk_grid"]["configuration"]["chunk_shape"]
        counts = [-(-length // step) for length, step in zip(document["shape"], steps, strict=True)]
        return {"/".join([f"{name}/c", *map(str, index)]): index for index in np.ndindex(*counts)}

    def incomplete_chunks(self, name: str, sizes: Mapping[str, int]) -> list[tuple[int, ...]]:
        """Return the indices of the chunks of an array that are missing, or of a wrong length. No chunk is read.

        Args:
            name: Path of the array.
            sizes: Sizes of its keys.
        """
        document = self.document(name)
        expected = 0
        # Strings have no size that is known in advance.
        if document["data_type"] != "string":
            length = math.prod(document["chunk_grid"]["configuration"]["chunk_shape"])
            has_checksum = document["codecs"][-1]["name"] == "crc32c"
            expected = length * np.dtype(document["data_type"]).itemsize + CHECKSUM_BYTES * has_checksum
        stored = {index: sizes.get(key, 0) for key, index in self.chunk_keys(name).items()}
        return [index for index, size in stored.items() if not size or (expected and size != expected)]

    def _read_document(self, name: str) -> Document | None:
        key = f"{name}/{ROOT}".lstrip("/")
        text = self.location.read(key, MOST_BYTES)
        if text is None:
            return None
        try:
            document = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            problem = f"{key} is damaged ({error})"
            raise DamageError(f"{self.path}: it holds no store of a study: {problem}", problem) from error
        check_documents(self.path, {name: document})
        return document

    # Labels and records

    def labels(self) -> tuple[str, ...]:
        """Return the label of each row.

        Raises:
            DamageError: They cannot be read.
            StoreError: The store cannot be read.
        """
        return self.read_strings(LABELS)

    def examine_records(self) -> tuple[list[Record | None], dict[int, str]]:
        """Return the completion record of each row, None if it has none that can be read, and the damage of those."""
        count, damage = self.document(RECORD)["shape"][0], {}
        try:
            lines: Sequence[str | DamageError] = self.read_strings(RECORD)
        except DamageError:
            # At least one of them; read each by itself to see which.
            lines = [self._record_line(row) for row in range(count)]
        records: list[Record | None] = [None] * count
        for row, line in enumerate(lines):
            try:
                if isinstance(line, DamageError):
                    raise line
                records[row] = Record.from_json(line, row)
            except DamageError as error:
                damage[row] = error.what
        return records, damage

    def records(self) -> tuple[Record | None, ...]:
        """Return the completion record of each row, or None if it has none that can be read."""
        records, damage = self.examine_records()
        # Read once for all of them.
        labels = self._labels_or_numbers(len(records)) if damage else ()
        for row, problem in damage.items():
            _log.warning("%s: the record of %s is damaged and counts as not there: %s", self.path, labels[row], problem)
        return tuple(records)

    def read_record(self, row: int) -> Record | None:
        """Return the completion record of one row, or None if it has none that can be read."""
        line = self._record_line(row)
        try:
            return None if isinstance(line, DamageError) else Record.from_json(line, row)
        except DamageError:
            return None

    def write_record(self, row: int, record: Record | None) -> None:
        """Write the completion record of a row, or erase it: one chunk, replaced as a whole."""
        self.write(RECORD, row, "" if record is None else record.to_json(row))

    def _record_line(self, row: int) -> str | DamageError:
        try:
            return str(self.read(RECORD, row))
        except DamageError as error:
            return error

    def read_run(self) -> RunRecord | None:
        """Return the record of the latest run, or None before the first one.

        Raises:
            DamageError: It cannot be read.
        """
        document = self._read_document(RECORDS)
        if document is None:
            raise DamageError(f"{self.path}: {RECORDS}/{ROOT} is missing; run the study again", "it is not there")
        table = document.get("attributes", {}).get(_RUN)
        if table is None:
            return None
        digest = table.pop(DIGEST, "")
        if digest != _digest_of(table):
            raise DamageError(f"{self.path}: the record of the latest run is damaged ({CHANGED}): {table}", CHANGED)
        return RunRecord.from_table(table)

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run: an attribute of the group of records, in one key."""
        document = self.document(RECORDS)
        # Not remembered: consolidated metadata would tell readers of a run that ended long ago.
        run = {**record.to_table(), DIGEST: _digest_of(record.to_table())}
        changed = {**document, "attributes": {**document.get("attributes", {}), _RUN: run}}
        self.location.write({f"{RECORDS}/{ROOT}": json.dumps(changed).encode()})

    # Fields

    @property
    def has_octaves(self) -> bool:
        """True if values in octaves lie beside the fields."""
        return OCTAVES in self.documents

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

    def damage_of_field(self, row: int, record: Record) -> str:
        """Read the field of a row, and return how it differs from its record; empty if it does not."""
        places, checksums = self.block_slices(), list(record.checksums)
        count = len(places) + self.has_octaves
        if len(checksums) != count:
            return f"its record knows of {len(checksums)} blocks, and the store has {count}"
        try:
            if self.has_octaves:
                # Behind those of the field.
                self.read_octaves([row], [checksums.pop()])
            for place, checksum in zip(places, checksums, strict=True):
                self.read_fields([row], place, [checksum])
        except DamageError as error:
            return error.what
        return ""

    def rows_with_complete_fields(self) -> set[int]:
        """Return the rows whose blocks all exist in their full length. No block is read."""
        rows = set(range(self.document(FIELD)["shape"][0]))
        for name in (FIELD, OCTAVES) if self.has_octaves else (FIELD,):
            rows -= {index[0] for index in self.incomplete_chunks(name, self.location.sizes(f"{name}/c"))}
        return rows

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

    def _damage(self, row: int, problem: str) -> DamageError:
        label = self._labels_or_numbers(row + 1)[row]
        return DamageError(
            f"{self.path}: the field of {label} is damaged ({problem}); run the study again", problem, row
        )

    def _labels_or_numbers(self, count: int) -> Sequence[str]:
        try:
            return self.labels()
        except DamageError:
            return [f"row {row}" for row in range(count)]


def _digest_of(table: Any) -> str:
    """Return the SHA-256 of a table, however its JSON is spelled."""
    return hashlib.sha256(json.dumps(table, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def stored_choice(store: str | Path | Location) -> LatticeChoice | None:
    """Return the lattice that was chosen for a store; None without one, or if its study gave the lattice.

    From damaged metadata it is None.

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
