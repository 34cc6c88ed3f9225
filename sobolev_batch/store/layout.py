"""The layout of a store: which groups and arrays it has, their metadata documents, and the digest of these.

The driver creates all arrays before any task starts (see `create`). Tasks fill whole chunks and nothing else, so
no two of them write the same chunk. docs/store.md describes the layout for readers.

The metadata of all arrays lie together in one document at the root. A store reads it once, and tasks take along what
they need of it: on object storage every look at a key is a request. For the same reason the keys of new arrays are made
in memory and then written as a whole: zarr and xarray look at a store again and again while they create arrays.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr
import zarr
from numpy.typing import ArrayLike
from pydantic import create_model
from zarr.abc.store import Store as ZarrStore
from zarr.storage import StorePath

from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import DamageError, ForeignError, InputError, StoreError, one_line
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.store.checked import CheckedStore, largest_chunk_bytes
from sobolev_batch.store.encoding import LARGEST_CHUNK_BYTES, ROOT, chunk_key, chunks_of, dataset_keys, documents_in
from sobolev_batch.store.location import Location
from sobolev_batch.store.metadata import (
    MOST_BYTES,
    SCHEMA_VERSION,
    Document,
    attributes_of,
    chunk_shape,
    consolidated,
    problems_of,
    record_in,
)
from sobolev_batch.study.lattice_choice import LatticeChoice

_log = logging.getLogger(__name__)

FIELD = "fourier/fourier"
LABELS = "fourier/mesh"
QUALITY = "fourier/quality"
OCTAVES_GROUP = "octaves"
OCTAVES = "octaves/octaves"
RECORDS = "records"
RECORD = "records/record"
PAGE = "records/page"
# These groups have radial spectra, see `sobolev_batch.norms.spectrum`, and distances, with arrays of their keys.
SPECTRA_GROUP, DISTANCES = "spectra", "distances"
SPECTRA_KEYS, PAIRS_KEYS = f"{SPECTRA_GROUP}/key", f"{DISTANCES}/key"
# The root has these attributes: the digest of tables and metadata; true while the store is being created; and the
# labels of meshes that the study has lost. In the attribute "study" are the names of its objects, where it names any.
# Among its versions, and those of the tables, is that of the numerics by which fields were computed.
NUMERICS = "numerics"
DIGEST, UNFINISHED, OBJECTS, REMOVED = "digest", "unfinished", "objects", "removed"
# This key at the root in object storage has the SHA-256 of keys below the digest, and what listings say of these.
TAGS = "tags.json"
DESCRIPTION = (
    "Begin with the group convergence: distances of meshes to their reference. To read all groups: "
    'xarray.open_datatree(store, engine="zarr"), or sobolev_batch.open_store(store)'
)
# Groups of tables, and those whose rows the root of several objects repeats.
TABLES = ("meshes", "norms", "distances", "convergence", "proximity")
TABLES_OF_ALL = ("meshes", "convergence", "proximity")
# These arrays have chunks for rows, which need not be computed.
_OF_ROWS = frozenset({FIELD, OCTAVES, RECORD, PAGE})
# Most of the time of a request is spent waiting.
_REQUESTS_AT_ONCE = 64
# Hashes of keys, each with what the storage says of the content when it lists the key, if anything.
Hashes = dict[str, tuple[str, str]]
Metadata = tuple[dict[str, Document], Hashes]
# Tasks write into the chunks of these groups; all others are tables, written, listed and hidden as a whole.
GROUPS_OF_TASKS = ("fourier", OCTAVES_GROUP, SPECTRA_GROUP, RECORDS)
# Readers need these entries of the attribute "study" of every root, and more of that of one object, and of several.
_TABLE = create_model("Table", study=(dict[str, Any], ...))
_OF_ANY = create_model("OfAny", name=(str, ...), orders=(list[float], ...), table=(_TABLE, ...))
_LATTICE = create_model("Lattice", xi_max=(float, ...), M=(int, ...))
_OF_ONE = create_model(
    "OfOne", __base__=_OF_ANY, lattice=(_LATTICE, ...), dtype=(ComplexDtype, ...), reference=(str, ...)
)
_OF_OBJECTS = create_model("OfObjects", __base__=_OF_ANY, objects=(list[str], ...))


class Store:
    """Store of a study, by its path or URL. Cheap to make and to pickle.

    Methods raise a `StoreError` if the store cannot be read or written. Metadata that were read are kept: make another
    store to see what other processes have changed of them. Chunks are read anew each time.

    Attributes:
        documents: Metadata documents by the path of their node. That of the root, under "", lacks the others.
        lacks_tables: True once tables were found that another program has written: they are not listed.
    """

    def __init__(self, store: str | Path | Location) -> None:
        self.location = Location.parse(store)
        self.documents: dict[str, Document] = {}
        # These are the SHA-256 of keys below the digest that this process knows, with their tags; see `remember`.
        self._hashes: Hashes = {}
        self._remembered: Hashes = {}
        self.lacks_tables = False

    def __getstate__(self) -> dict[str, Any]:
        carried = {name: self.documents[name] for name in self._arrays_in_progress if name in self.documents}
        return {**vars(self), "documents": carried, "_hashes": {}, "_remembered": {}}

    @classmethod
    def open(cls, store: str | Path | Location) -> Self:
        """Open a store that exists."""
        opened = cls(store)
        opened.attributes()
        return opened

    @property
    def metadata(self) -> Metadata:
        """Metadata read so far, which a store leaves behind when it travels to another process."""
        return dict(self.documents), dict(self._hashes)

    @metadata.setter
    def metadata(self, known: Metadata) -> None:
        self.documents, self._hashes = known

    @property
    def path(self) -> str:
        """Path or URL of the store."""
        return self.location.name

    def damage(self, what: str, problem: str, row: int | None = None) -> DamageError:
        """Return the error for a part of the store that is not what was written."""
        return DamageError(f"{self.path}: {what} is damaged ({problem}); run the study again", problem, row)

    def exists(self) -> bool:
        """Return whether a zarr hierarchy exists; DamageError where only its root is gone, which is written first."""
        if "" not in self.documents:
            if (root := self.stored_document("")) is None:
                if self.stored_document(RECORDS) is not None:
                    raise self.damage("the store", f"{ROOT}, the metadata at the root, is gone")
                return False
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                # zarr repeats in each group what the root has.
                document.pop("consolidated_metadata", None)
                self.documents.setdefault(name, document)
            of_rows = self.documents.keys() & {LABELS, QUALITY, *_OF_ROWS}
            if len({tuple(self.documents[name]["shape"][:1]) for name in of_rows}) > 1:
                raise self.damage(ROOT, "its arrays have different numbers of rows")
            try:
                self.documents[""] = {**root, "attributes": attributes_of(root)}
            except ValueError as error:
                raise self.damage(ROOT, str(error)) from error
        return True

    def attributes(self, *, of_objects: bool | None = False) -> dict[str, Any]:
        """Return the attributes of the root: title, study, similarity, versions; or those of a root of objects.

        StoreError where it is the other one of the two, unless None allows both.
        """
        if not self.exists():
            is_absent = not self.location.scheme and not os.path.lexists(self.path)
            raise ForeignError(f"{self.path}: it {'does not exist' if is_absent else 'holds no store of a study'}")
        attributes: dict[str, Any] = self.documents[""].get("attributes", {})
        if self.is_unfinished:
            raise StoreError(f"{self.path}: it is being laid out, or that was interrupted; run the study again")
        if "schema_version" not in attributes or "study" not in attributes:
            raise ForeignError(f"{self.path}: a zarr store, but not one of a study")
        if (version := attributes["schema_version"]) != SCHEMA_VERSION:
            raise ForeignError(
                f"{self.path}: its schema has version {version}, this program reads {SCHEMA_VERSION}; "
                "run the study again into another store, or read this one with the version that has written it"
            )
        has_objects = OBJECTS in attributes["study"]
        record_in(_OF_OBJECTS if has_objects else _OF_ONE, attributes["study"], f"{self.path}: study in {ROOT}")
        if of_objects and not has_objects:
            raise ForeignError(f"{self.path}: the store of one object, and the study names several; name another store")
        if has_objects and of_objects is False:
            one = f"{self.path}/{next(iter(attributes['study'][OBJECTS]), 'NAME')}"
            raise ForeignError(f"{self.path}: the store of several objects; name that of one, such as {one}")
        try:
            Similarity(**({} if has_objects else attributes["similarity"]))
        except (KeyError, TypeError, InputError) as error:
            raise self.damage(ROOT, f"its similarity makes no sense: {one_line(error)}") from error
        return attributes

    def choice(self) -> LatticeChoice:
        """Return the lattice of all fields, with the octaves beside it."""
        study = self.attributes()["study"]
        dtypes = {"dtype": study["dtype"], "transform_dtype": study["dtype"]}
        given = {**study["lattice"], **dtypes, "closest": (), "reasons": (), "basis": ""}
        try:
            return LatticeChoice.from_dict(study.get("choice") or given, study.get("octaves"))
        except (KeyError, TypeError, InputError) as error:
            raise self.damage(ROOT, f"its lattice makes no sense: {one_line(error)}") from error

    @property
    def is_unfinished(self) -> bool:
        """True if the creation of the store was not finished: nothing in it counts."""
        return self.exists() and bool(self.documents[""].get("attributes", {}).get(UNFINISHED))

    @property
    def removed(self) -> frozenset[str]:
        """Labels of the meshes that the study has lost; their fields stay, in case they come back."""
        return frozenset(self.attributes().get(REMOVED, ()))

    def labels(self) -> tuple[str, ...]:
        """Return the label of each row."""
        return self.read_strings(LABELS)

    @property
    def reference(self) -> int:
        """Row of the reference."""
        places = {label: row for row, label in enumerate(self.labels())}
        if (reference := self.attributes()["study"]["reference"]) not in places:
            raise self.damage(ROOT, f"it has no mesh {reference!r}, which is its reference")
        return places[reference]

    def names_of_rows(self, count: int) -> Sequence[str]:
        """Return what messages call rows: their labels, or their numbers where labels are damaged."""
        with suppress(DamageError):
            return self.labels()
        return [f"row {row}" for row in range(count)]

    def document(self, name: str) -> Document:
        """Return the metadata document of a node."""
        if name not in self.documents and not (self.exists() and name in self.documents):
            raise StoreError(f"{self.path}: the store is incomplete, without {name}; remove it and run the study again")
        return self.documents[name]

    def stored_document(self, name: str) -> Document | None:
        """Return the metadata document of a node that readers may not find yet; None if there is none."""
        key = f"{name}/{ROOT}".lstrip("/")
        if (text := self.location.read(key, MOST_BYTES)) is None:
            return None
        try:
            document = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise self.damage(key, str(error)) from error
        problems = list(problems_of({name: document}))
        for node, problem in problems:
            if name or not _is_of_tables(node):
                raise ForeignError(f"{self.path}: the store is not used: {problem}; this program did not write that")
        if problems:
            # A run makes them from the fields.
            self.lacks_tables = True
            _log.warning("%s: its tables are not used: %s; run makes them again", self.path, problems[0][1])
            nodes = document["consolidated_metadata"]["metadata"]
            document["consolidated_metadata"]["metadata"] = {n: d for n, d in nodes.items() if not _is_of_tables(n)}
        return document

    def keyed_arrays(self) -> list[str]:
        """Return the names of the arrays that tasks of the reduction fill, and of their keys; see `sealed_chunks`."""
        groups = [keys.split("/")[0] for keys in (SPECTRA_KEYS, PAIRS_KEYS) if keys in self.documents]
        names = (name for name in self.documents if "/" in name and name.split("/")[0] in groups)
        return [name for name in names if name.endswith("/key") or len(self.documents[name]["shape"]) > 1]

    def whole_arrays(self) -> list[str]:
        """Return the names of the arrays of tables and coordinates, which are written as a whole.

        Qualities are a copy of what records have, and not among them.
        """
        others = {*_OF_ROWS, QUALITY, *self.keyed_arrays()}
        return [name for name in self.documents if "/" in name and name not in others]

    @property
    def _arrays_in_progress(self) -> frozenset[str]:
        """Names of the arrays that tasks fill, chunk by chunk: what they need of the metadata, a fiftieth of all."""
        return _OF_ROWS.union(self.keyed_arrays())

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array, for reading."""
        # The values of fields are compared with their records, which does more.
        path = StorePath(self._keys(name) if name in (FIELD, OCTAVES) else self.checked_keys(name), name)
        try:
            return zarr.Array(zarr.AsyncArray.from_dict(path, self.document(name)))
        except (ValueError, TypeError, KeyError) as error:
            raise self.damage(name, f"its metadata make no sense: {one_line(error)}") from error

    def checked_keys(self, largest: str = FIELD, *, has_tables: bool = False) -> ZarrStore:
        """Return the store that zarr and xarray take to read arrays up to the largest, whose chunks are checked.

        Where it has tables, no spectrum and no distance of pairs is missing.
        """
        in_progress = _OF_ROWS if has_tables else self._arrays_in_progress
        return CheckedStore(self._keys(largest), self.path, self.documents, in_progress)

    def _keys(self, largest: str) -> ZarrStore:
        return self.location.zarr_store(math.prod(chunk_shape(self.document(largest))) * np.dtype(complex).itemsize)

    def read(self, name: str, selection: Any = ...) -> Any:
        """Return a selection of an array; a damaged one raises a `DamageError`."""
        array = self.array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            return array[selection]

    def read_strings(self, name: str) -> tuple[str, ...]:
        """Return all elements of an array of strings; see `read`."""
        return tuple(map(str, np.asarray(self.read(name)).tolist()))

    def write(self, name: str, index: Sequence[int], values: ArrayLike) -> None:
        """Write values of an array, made of whole chunks, from the chunk of an index on, whose last zeros may lack."""
        document = self.document(name)
        dtype = object if document["data_type"] == "string" else document["data_type"]
        chunks = chunks_of(np.asarray(values, dtype=dtype), chunk_shape(document))
        self._forget(f"{name}/c")
        placed = ((map(sum, zip_longest(index, own, fillvalue=0)), chunk) for own, chunk in chunks)
        self.location.write({chunk_key(name, place): chunk for place, chunk in placed})

    def publish(self, keys: Mapping[str, bytes]) -> None:
        """Write keys of new nodes. Readers find the nodes after `consolidate`."""
        self.location.write(keys)
        tags = self._tags(keys)
        self._hashes |= {key: (hashlib.sha256(content).hexdigest(), tags.get(key, "")) for key, content in keys.items()}
        self.documents |= documents_in(keys)

    def remove(self, group: str) -> None:
        """Remove a group and everything in it, first from what readers find."""
        self.hide([name for name in self.documents if name.split("/")[0] == group])
        self.location.remove(group)
        self._forget(group)

    def hide(self, names: Sequence[str]) -> None:
        """Take nodes out of what readers find; their keys stay."""
        self.documents = {name: document for name, document in self.documents.items() if name not in names}
        self.consolidate()

    def consolidate(self) -> None:
        """Collect the metadata of all nodes at the root, so that one read opens everything, with a new digest."""
        self.documents[""]["attributes"][DIGEST] = self._digest()
        self.location.write({ROOT: json.dumps(consolidated(self.documents)).encode()})

    def has_digest(self, *, is_thorough: bool = False) -> bool:
        """Return whether tables, coordinates and metadata are those that were written together.

        Unless it is thorough, contents that object storage lists as it did before are not read again.
        """
        try:
            if not is_thorough:
                self._recall()
            return bool(self.documents[""]["attributes"].get(DIGEST) == self._digest())
        except (DamageError, ValueError, TypeError, KeyError):
            # zarr has no exception of its own for metadata that make no sense.
            return False

    def _digest(self) -> str:
        """Return the SHA-256 of the root, without this, and of all keys of tables, coordinates and metadata."""
        root = consolidated(self.documents)
        root["attributes"].pop(DIGEST, None)
        # The group of records has the state of the latest run.
        keys = {f"{name}/{ROOT}": MOST_BYTES for name in self.documents if name not in ("", RECORDS)}
        for name in self.whole_arrays():
            keys |= dict.fromkeys(self.chunk_keys(name), largest_chunk_bytes(self.documents[name]))
        unknown = {key: keys[key] for key in sorted(keys.keys() - self._hashes.keys())}
        # A tag that is older than the content is found to have changed; a newer one would hide what happens meanwhile.
        tags = self._tags(unknown)
        with ThreadPoolExecutor(_REQUESTS_AT_ONCE) as pool:
            # A thread takes longer to start than a file to be read.
            each = pool.map if self.location.scheme else map
            for key, content in zip(unknown, each(self.location.read, unknown, unknown.values()), strict=True):
                self._hashes[key] = hashlib.sha256(content or b"").hexdigest(), tags.get(key, "")
        return document_digest([root, {key: self._hashes[key][0] for key in keys}])

    def remember(self) -> None:
        """Write down the hashes of keys that have tags, so that later runs read only those that have changed since."""
        tagged = {key: known for key, known in self._hashes.items() if known[1]}
        if not tagged.items() <= self._remembered.items():
            self.location.write({TAGS: json.dumps(tagged).encode()})
            self._remembered = tagged

    def _recall(self) -> None:
        """Take the hashes over that were remembered of keys whose tags are the same."""
        text = self.location.read(TAGS) if self.location.scheme else None
        with suppress(ValueError, TypeError, AttributeError, RecursionError):  # Other texts are worth nothing.
            known = {str(key): (str(one), str(tag)) for key, (one, tag) in json.loads(text or "{}").items()}
            tags = self._tags(known)
            self._remembered = {key: one for key, one in known.items() if tags.get(key) == one[1]}
            self._hashes = self._remembered | self._hashes

    def _tags(self, keys: Iterable[str]) -> dict[str, str]:
        groups = {key.split("/")[0] for key in keys}
        return {key: tag for group in sorted(groups) for key, tag in self.location.tags(group).items()}

    def _forget(self, name: str) -> None:
        self._hashes = {key: value for key, value in self._hashes.items() if not key.startswith(f"{name}/")}

    def chunk_keys(self, name: str) -> dict[str, tuple[int, ...]]:
        """Return the keys of all chunks of an array, with their indices."""
        document = self.document(name)
        counts = [-(-length // step) for length, step in zip(document["shape"], chunk_shape(document), strict=True)]
        return {chunk_key(name, index): index for index in np.ndindex(*counts)}

    def stored_chunks(self, name: str) -> list[int]:
        """Return the numbers of the stored chunks of an array along its only axis. Its metadata need not be there."""
        prefix = f"{name}/c/"
        numbers = (key.removeprefix(prefix) for key in self.location.sizes(prefix.rstrip("/")))
        return sorted(int(number) for number in numbers if number.isdecimal())

    def incomplete_chunks(self, name: str, sizes: Mapping[str, int]) -> list[tuple[int, ...]]:
        """Return the indices of an array's chunks that are missing, or of a wrong length by the sizes of its keys."""
        document = self.document(name)
        # Strings have no size that is known in advance.
        expected = 0 if document["data_type"] == "string" else largest_chunk_bytes(document)
        stored = {index: sizes.get(key, 0) for key, index in self.chunk_keys(name).items()}
        return [index for index, size in stored.items() if not size or (expected and size != expected)]


def stored_choice(store: str | Path | Location) -> LatticeChoice | None:
    """Return the lattice that was chosen for a store; None where its study gave it, or metadata are damaged."""
    existing = Store(store)
    with suppress(DamageError):
        if existing.exists() and not existing.is_unfinished and existing.attributes()["study"].get("choice"):
            return existing.choice()
    return None


def document_digest(table: Any) -> str:
    """Return the SHA-256 of a table, however its JSON is spelled."""
    return hashlib.sha256(json.dumps(table, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def table_names(store: Store) -> list[str]:
    """Return the names of the groups and arrays of tables that are listed."""
    return list(filter(_is_of_tables, store.documents))


def _is_of_tables(node: str) -> bool:
    return bool(node) and node.split("/")[0] not in GROUPS_OF_TASKS


def table_attributes(store: Store, group: str) -> dict[str, Any] | None:
    """Return the attributes of a group, or None if it is not listed."""
    return store.documents[group].get("attributes", {}) if store.exists() and group in store.documents else None


def hide_tables(store: Store) -> list[str]:
    """Hide the tables, which do not fit together while they are written, and return the names of their nodes."""
    if names := table_names(store):
        store.hide(names)
    return names


def write_table(store: Store, group: str, dataset: xr.Dataset) -> None:
    """Write a group. Readers find it after `Store.consolidate`."""
    large = [name for name, values in dataset.items() if values.nbytes > LARGEST_CHUNK_BYTES]
    store.publish(dataset_keys(group, dataset.drop_vars(large)))
    # They are written one after the other, since keys are copies.
    for name in large:
        store.publish(dataset_keys(group, dataset[[name]].drop_vars(list(dataset.coords), errors="ignore")))
