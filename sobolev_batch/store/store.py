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
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from itertools import accumulate, product
from pathlib import Path
from typing import Any, Self

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store as ZarrStore
from zarr.buffer.cpu import NDBuffer
from zarr.storage import StorePath

from sobolev_batch.errors import DamageError, StoreError
from sobolev_batch.store.checked import CHANGED, CheckedStore, checksum_of, largest_chunk_bytes
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import MOST_BYTES, SCHEMA_VERSION, Document, check_documents
from sobolev_batch.store.records import WITHDRAWN, Record, RunRecord, record_from_table
from sobolev_batch.study.lattice_choice import LatticeChoice
from sobolev_batch.transform.lattice import AXES, Block, Lattice

_log = logging.getLogger(__name__)

# Of a field's values: slices of a block of the lattice, or the slice of all samples of octaves.
Place = tuple[slice, ...]

ROOT = "zarr.json"
FIELD = "fourier/fourier"
LABELS = "fourier/mesh"
QUALITY = "fourier/quality"
OCTAVES_GROUP = "octaves"
OCTAVES = "octaves/octaves"
RECORDS = "records"
RECORD = "records/record"
PAGE = "records/page"
# Radial spectra, see `sobolev_batch.norms.spectrum`, and distances, with their keys.
SPECTRA_GROUP, DISTANCES = "spectra", "distances"
SPECTRA_KEYS, PAIRS_KEYS = f"{SPECTRA_GROUP}/key", f"{DISTANCES}/key"
# Attributes of the root: the digest of tables and metadata; true while the store is being created; the objects of a
# collection; the labels of meshes that the study has lost.
DIGEST, UNFINISHED, COLLECTION, REMOVED = "digest", "unfinished", "collection", "removed"
_RUN = "run"
# Written by tasks, and by themselves: the digest leaves them out. Qualities are a copy of what records have.
_BESIDE_DIGEST = (FIELD, OCTAVES, RECORD, PAGE, QUALITY)
# Arrays with chunks for rows, which need not be computed.
_OF_ROWS = frozenset({FIELD, OCTAVES, RECORD, PAGE})
_REQUESTS_AT_ONCE = 64


class Store:
    """Store of a study, by its path or URL. Cheap to make and to pickle.

    Methods raise a `StoreError` if the store cannot be read or written. Metadata that were read are kept: make another
    store to see what other processes have changed of them. Chunks are read anew each time.

    Attributes:
        documents: Metadata documents by the path of their node. That of the root, under "", lacks the others.
    """

    def __init__(self, store: str | Path | Location) -> None:
        self.location = Location.parse(store)
        self.documents: dict[str, Document] = {}
        # SHA-256 of keys below the digest, where this process knows them.
        self._hashes: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        carried = {name: self.documents[name] for name in self._arrays_in_progress if name in self.documents}
        return {"location": self.location, "documents": carried, "_hashes": {}}

    @classmethod
    def open(cls, store: str | Path | Location) -> Self:
        """Open a store that exists."""
        opened = cls(store)
        opened.attributes()
        return opened

    @property
    def path(self) -> str:
        """Path or URL of the store."""
        return self.location.name

    def exists(self) -> bool:
        """Return whether a zarr hierarchy exists; DamageError where only its root is gone, which is written first."""
        if "" not in self.documents:
            root = self.stored_document("")
            if root is None:
                if self.stored_document(RECORDS) is not None:
                    problem = f"{ROOT}, the metadata at the root, is gone"
                    raise DamageError(f"{self.path}: {problem}; run the study again", problem)
                return False
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                # zarr repeats in each group what the root has.
                document.pop("consolidated_metadata", None)
                self.documents.setdefault(name, document)
            self.documents[""] = root
        return True

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the root: title, study, similarity, versions."""
        if not self.exists() or self.documents[""].get("node_type") != "group":
            raise StoreError(f"{self.path}: it holds no store of a study")
        attributes: dict[str, Any] = self.documents[""].get("attributes", {})
        if COLLECTION in attributes:
            raise StoreError(
                f"{self.path}: the store of a collection; each of its objects has its own, {self.path}/NAME; "
                "sobolev-batch status shows their names"
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

    def choice(self) -> LatticeChoice:
        """Return the lattice of all fields, with the octaves beside it."""
        study = self.attributes()["study"]
        dtypes = {"dtype": study["dtype"], "transform_dtype": study["dtype"]}
        given = {**study["lattice"], **dtypes, "closest": (), "reasons": (), "basis": ""}
        return LatticeChoice.from_table(study.get("choice") or given, study.get("octaves"))

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
        """Return the metadata document of a node."""
        if name not in self.documents and not (self.exists() and name in self.documents):
            raise StoreError(
                f"{self.path}: the store is incomplete: it has no {name}; remove it and run the study again"
            )
        return self.documents[name]

    def is_array(self, name: str) -> bool:
        """Return whether the root lists an array of this name."""
        return self.documents.get(name, {}).get("node_type") == "array"

    def keyed_arrays(self) -> list[str]:
        """Return the names of the arrays that tasks of the reduction fill, and of their keys; see `tables`."""
        groups = [keys.split("/")[0] for keys in (SPECTRA_KEYS, PAIRS_KEYS) if keys in self.documents]
        names = (name for name in self.documents if "/" in name and name.split("/")[0] in groups)
        return [name for name in names if name.endswith("/key") or len(self.documents[name]["shape"]) > 1]

    @property
    def _arrays_in_progress(self) -> frozenset[str]:
        """Names of the arrays that tasks fill, chunk by chunk: what they need of the metadata, a fiftieth of all."""
        return _OF_ROWS.union(self.keyed_arrays())

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array, for reading and writing."""
        # The values of fields are compared with their records, which does more.
        path = StorePath(self._keys(name) if name in (FIELD, OCTAVES) else self.checked_keys(name), name)
        metadata = zarr.AsyncArray.from_dict(path, self.document(name)).metadata
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        return zarr.Array(zarr.AsyncArray(metadata, path, config={"write_empty_chunks": True}))

    def checked_keys(self, largest: str = FIELD, *, has_tables: bool = False) -> ZarrStore:
        """Return the store that zarr and xarray take to read arrays up to the largest, whose chunks are checked.

        Where it has tables, no spectrum and no distance of pairs is missing.
        """
        in_progress = _OF_ROWS if has_tables else self._arrays_in_progress
        return CheckedStore(self._keys(largest), self.path, self.documents, in_progress)

    def _keys(self, largest: str) -> ZarrStore:
        chunk = self.document(largest)["chunk_grid"]["configuration"]["chunk_shape"]
        return self.location.zarr_store(math.prod(chunk) * np.dtype(np.complex128).itemsize)

    def read(self, name: str, selection: Any = ...) -> Any:
        """Return a selection of an array; a damaged one raises a `DamageError`."""
        array = self.array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            return array[selection]

    def read_strings(self, name: str) -> tuple[str, ...]:
        """Return all elements of an array of strings; see `read`."""
        return tuple(map(str, np.asarray(self.read(name)).tolist()))

    def write(self, name: str, selection: Any, values: Any) -> None:
        """Write a selection of an array, made of whole chunks."""
        array = self.array(name)
        self._forget(name)
        with self.location.access("written"):
            array[selection] = values

    def publish(self, keys: Mapping[str, bytes]) -> None:
        """Write keys of new nodes. Readers find the nodes after `consolidate`."""
        self.location.write(keys)
        for key, content in keys.items():
            self._hashes[key] = hashlib.sha256(content).hexdigest()
            if key.endswith(f"/{ROOT}"):
                self.documents[key.removesuffix(f"/{ROOT}")] = json.loads(content)

    def remove(self, group: str) -> None:
        """Remove a group and everything in it, first from what readers find."""
        self.documents = {name: document for name, document in self.documents.items() if name.split("/")[0] != group}
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
        """Return the document at the root with those of all nodes, as zarr consolidates them, without the digest."""
        attributes = {name: value for name, value in self.documents[""]["attributes"].items() if name != DIGEST}
        # Readers list the variables of a group in this order: the number and its error first.
        names = sorted(filter(None, self.documents), key=lambda name: name.split("/")[0])
        nodes = {name: self.documents[name] for name in names}
        consolidated = {"kind": "inline", "must_understand": False, "metadata": nodes}
        return {**self.documents[""], "attributes": attributes, "consolidated_metadata": consolidated}

    def _digest(self, root: Document) -> str:
        """Return the SHA-256 of a root and of all keys of the tables, coordinates and metadata that it lists."""
        # The group of records has the state of the latest run.
        keys = {f"{name}/{ROOT}": MOST_BYTES for name in self.documents if name not in ("", RECORDS)}
        beside = {*_BESIDE_DIGEST, *self.keyed_arrays()}
        for name in filter(self.is_array, self.documents):
            if name not in beside:
                keys |= dict.fromkeys(self.chunk_keys(name), largest_chunk_bytes(self.documents[name]))
        unknown = {key: keys[key] for key in sorted(keys.keys() - self._hashes.keys())}
        with ThreadPoolExecutor(_REQUESTS_AT_ONCE) as pool:
            contents = pool.map(self.location.read, unknown, unknown.values())
            for key, content in zip(unknown, contents, strict=True):
                self._hashes[key] = hashlib.sha256(content or b"").hexdigest()
        return digest_of([root, {key: self._hashes[key] for key in keys}])

    def _forget(self, name: str) -> None:
        self._hashes = {key: value for key, value in self._hashes.items() if not key.startswith(f"{name}/")}

    def chunk_keys(self, name: str) -> dict[str, tuple[int, ...]]:
        """Return the keys of all chunks of an array, with their indices."""
        document = self.document(name)
        steps = document["chunk_grid"]["configuration"]["chunk_shape"]
        counts = [-(-length // step) for length, step in zip(document["shape"], steps, strict=True)]
        return {"/".join([f"{name}/c", *map(str, index)]): index for index in np.ndindex(*counts)}

    def stored_chunks(self, name: str) -> list[int]:
        """Return the numbers of the stored chunks of an array along its only axis. Its metadata need not be there."""
        prefix = f"{name}/c/"
        numbers = (key.removeprefix(prefix) for key in self.location.sizes(prefix.rstrip("/")))
        return sorted(int(number) for number in numbers if number.isdigit())

    def incomplete_chunks(self, name: str, sizes: Mapping[str, int]) -> list[tuple[int, ...]]:
        """Return the indices of an array's chunks that are missing, or of a wrong length by the sizes of its keys."""
        document = self.document(name)
        # Strings have no size that is known in advance.
        expected = 0 if document["data_type"] == "string" else largest_chunk_bytes(document)
        stored = {index: sizes.get(key, 0) for key, index in self.chunk_keys(name).items()}
        return [index for index, size in stored.items() if not size or (expected and size != expected)]

    def stored_document(self, name: str) -> Document | None:
        """Return the metadata document of a node that readers may not find yet; None if there is none."""
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

    @property
    def parts(self) -> tuple[tuple[int, Store], ...]:
        """The stores that this one is made of, each with the number of rows before its own; see `JoinedStore`."""
        return ((0, self),)

    @property
    def row_count(self) -> int:
        """Number of rows."""
        return int(self.document(FIELD)["shape"][0])

    # Labels and records

    def labels(self) -> tuple[str, ...]:
        """Return the label of each row."""
        return self.read_strings(LABELS)

    def examine_records(self) -> tuple[list[Record | None], dict[int, str]]:
        """Return the completion record of each row, None if it has none that can be read, and the damage of those."""
        records: list[Record | None] = [None] * self.document(RECORD)["shape"][0]
        step, paged = self._pages()
        own = [row for row in self.stored_chunks(RECORD) if row < len(records)]
        lines, damage = self._read_lines(PAGE, range(paged), step) | self._read_lines(RECORD, own, 1), {}
        for row, line in lines.items():
            try:
                if isinstance(line, DamageError):
                    raise line
                records[row] = Record.from_json(line, row)
            except DamageError as error:
                damage[row] = error.what
        return records, damage

    def _read_lines(self, name: str, rows: Sequence[int], step: int) -> dict[int, str | DamageError]:
        """Return the texts of rows, which begin with a chunk of this length, or the damage of their chunk."""
        if not rows:
            return {}
        try:
            return dict(zip(rows, map(str, self.read(name, list(rows)).tolist()), strict=True))
        except DamageError as error:
            if len(rows) <= step:
                return dict.fromkeys(rows, error)
        # Each chunk is read by itself to see which.
        parts = (rows[start : start + step] for start in range(0, len(rows), step))
        return {row: line for part in parts for row, line in self._read_lines(name, part, step).items()}

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
        with suppress(DamageError):
            line = str(self.read(RECORD, row))
            return Record.from_json(str(self.read(PAGE, row)) if not line and row < self._pages()[1] else line, row)
        return None

    def write_record(self, row: int, record: Record | None) -> None:
        """Write the completion record of a row, or withdraw it: one chunk, replaced as a whole."""
        self.write(RECORD, row, WITHDRAWN if record is None else record.to_json(row))

    def collect_records(self, records: Sequence[Record | None]) -> None:
        """Collect the records of all rows in pages, each of rows that all have one, and remove their own chunks.

        If the process ends in between, a page and the chunks beside it say the same.
        """
        step, paged = self._pages()
        pages: dict[int, list[int]] = {}
        for row in self.stored_chunks(RECORD) if paged else ():
            pages.setdefault(row // step, []).append(row)
        most_bytes = largest_chunk_bytes(self.document(PAGE))
        for page, own in pages.items():
            start = page * step
            lines = [record.to_json(start + i) for i, record in enumerate(records[start : start + step]) if record]
            if len(lines) == step and sum(map(len, lines)) < most_bytes // 2:
                self.write(PAGE, slice(start, start + step), np.array(lines, dtype=object))
                self.location.discard(*(f"{RECORD}/c/{row}" for row in own))

    def _pages(self) -> tuple[int, int]:
        """Return the number of rows of a page, and that of all rows that full pages may hold."""
        document = self.document(PAGE)
        count, step = document["shape"][0], document["chunk_grid"]["configuration"]["chunk_shape"][0]
        return step, count - count % step

    def read_run(self) -> RunRecord | None:
        """Return the record of the latest run, or None before the first one."""
        document = self.stored_document(RECORDS)
        if document is None:
            raise DamageError(f"{self.path}: {RECORDS}/{ROOT} is missing; run the study again", "it is not there")
        table = document.get("attributes", {}).get(_RUN)
        if table is None:
            return None
        digest, name = table.pop(DIGEST, ""), f"{self.path}: {RECORDS}/{ROOT}, the record of the latest run,"
        if digest != digest_of(table):
            raise DamageError(f"{name} is damaged ({CHANGED}): {table}; run the study again", CHANGED)
        return record_from_table(RunRecord, table, name)

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run: an attribute of the group of records, in one key."""
        document = self.document(RECORDS)
        # Not remembered: consolidated metadata would tell readers of a run that ended long ago.
        run = {**asdict(record), DIGEST: digest_of(asdict(record))}
        changed = {**document, "attributes": {**document.get("attributes", {}), _RUN: run}}
        self.location.write({f"{RECORDS}/{ROOT}": json.dumps(changed).encode()})

    # Fields

    def places(self) -> tuple[Place, ...]:
        """Return the places of a field's values: its blocks, in the order of a plan's blocks, and then its octaves."""
        array = self.array(FIELD)
        axes = [
            [slice(start, min(start + step, total)) for start in range(0, total, step)]
            for total, step in zip(array.shape[1:], array.chunks[1:], strict=True)
        ]
        octaves = [(slice(0, self.document(OCTAVES)["shape"][1]),)] if OCTAVES in self.documents else []
        return (*product(*axes), *octaves)

    def blocks_of(self, lattice: Lattice) -> tuple[Block, ...]:
        """Return the blocks of a field on its lattice, in the order of `places`."""
        x, y, z = lattice.half.start
        return tuple(
            Block((x + i.start, y + j.start, z + k.start), (i.stop - i.start, j.stop - j.start, k.stop - k.start))
            for i, j, k in (place for place in self.places() if len(place) == len(AXES))
        )

    def write_field(self, row: int, place: Place, values: NDArray[Any]) -> int:
        """Write a row's values at a place, made of whole chunks, and return their checksum for `read_fields`."""
        array = self.array(_array_at(place))
        values = np.ascontiguousarray(values, dtype=array.dtype)
        with self.location.access("written"):
            array.set_basic_selection((row, *place), values)
        return checksum_of(values)

    def read_fields(self, rows: Sequence[int], place: Place, checksums: Sequence[int] | None = None) -> NDArray[Any]:
        """Return the values of several rows at a place, complex (len(rows), ...).

        They are compared with the checksums that the tasks returned; without these, missing values read as NaN. A
        DamageError names the row whose values are damaged, lost, or others.
        """
        array = self.array(_array_at(place))
        values = np.empty((len(rows), *(axis.stop - axis.start for axis in place)), dtype=array.dtype)
        # On object storage, all but a wrong checksum is a failure of the access.
        damage = ValueError if self.location.scheme else (OSError, ValueError)

        def read(i: int) -> None:
            with self.location.access("read"):
                try:
                    # In place: copying a field costs as much as reading it.
                    array.get_basic_selection((rows[i], *place), out=NDBuffer.from_numpy_array(values[i]))
                except damage as error:
                    raise self._damage(rows[i], str(error)) from error
            if checksums is not None and checksum_of(values[i]) != checksums[i]:
                lost = bool(np.isnan(values[i]).all())
                raise self._damage(rows[i], "it is not there" if lost else "it is not what was written for its record")

        # Most of the time of a request is spent waiting.
        with ThreadPoolExecutor(max(1, len(rows)) if self.location.scheme else 1) as pool:
            list(pool.map(read, range(len(rows))))
        return values

    def damage_of_field(self, row: int, record: Record) -> str:
        """Read the field of a row, and return how it differs from its record; empty if it does not."""
        places = self.places()
        if len(record.checksums) != len(places):
            return f"its record knows of {len(record.checksums)} blocks, and the store has {len(places)}"
        try:
            for place, checksum in zip(places, record.checksums, strict=True):
                self.read_fields([row], place, [checksum])
        except DamageError as error:
            return error.what
        return ""

    def rows_with_complete_fields(self) -> set[int]:
        """Return the rows whose blocks all exist in their full length. No block is read."""
        rows = set(range(self.row_count))
        for name in self.documents.keys() & {FIELD, OCTAVES}:
            rows -= {index[0] for index in self.incomplete_chunks(name, self.location.sizes(f"{name}/c"))}
        return rows

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


class JoinedStore(Store):
    """Stores of one lattice and one reference, read as one: rows follow each other, metadata are the first one's."""

    def __init__(self, stores: Sequence[Store], labels: Sequence[str]) -> None:
        super().__init__(stores[0].location)
        self.documents = stores[0].documents
        self._stores, self._labels = tuple(stores), tuple(labels)

    @property
    def parts(self) -> tuple[tuple[int, Store], ...]:
        """The stores, each with the number of rows before its own."""
        firsts = accumulate((store.row_count for store in self._stores), initial=0)
        return tuple(zip(firsts, self._stores, strict=False))

    def labels(self) -> tuple[str, ...]:
        """Return the label of each row; empty for rows that are left out."""
        return self._labels

    def read_fields(self, rows: Sequence[int], place: Place, checksums: Sequence[int] | None = None) -> NDArray[Any]:
        """Return the values of several rows at a place, from the store of each; see `Store.read_fields`."""
        found: dict[int, NDArray[Any]] = {}
        for first, store in self.parts:
            places = [k for k, row in enumerate(rows) if first <= row < first + store.row_count]
            expected = None if checksums is None else [checksums[k] for k in places]
            found |= zip(places, store.read_fields([rows[k] - first for k in places], place, expected), strict=True)
        return np.stack([found[k] for k in range(len(rows))])


def _array_at(place: Place) -> str:
    return FIELD if len(place) == len(AXES) else OCTAVES


def digest_of(table: Any) -> str:
    """Return the SHA-256 of a table, however its JSON is spelled."""
    return hashlib.sha256(json.dumps(table, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def stored_choice(store: str | Path | Location) -> LatticeChoice | None:
    """Return the lattice that was chosen for a store; None where its study gave it, or metadata are damaged."""
    existing = Store(store)
    with suppress(DamageError):
        if existing.exists() and not existing.is_unfinished and existing.attributes()["study"].get("choice"):
            return existing.choice()
    return None
