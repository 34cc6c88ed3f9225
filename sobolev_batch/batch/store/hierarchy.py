"""Hierarchy: the metadata of a store's groups and arrays, and access to the arrays.

The metadata of all arrays lie together in one document at the root. A hierarchy reads it once, and tasks take
along what they need of it: on object storage every look at a key is a request.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import zarr
from zarr.abc.buffer import Buffer
from zarr.abc.store import Store as ZarrStore
from zarr.buffer.cpu import Buffer as BytesBuffer
from zarr.storage import MemoryStore, StorePath

from sobolev_batch.batch.storage.checked import (
    CHANGED,
    CheckedStore,
    NotingStore,
    RecordedChunks,
    digest_of,
    document_digest,
)
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.metadata import MOST_BYTES, SCHEMA_VERSION, Document, check_documents
from sobolev_batch.errors import DamageError, StoreError

ROOT = "zarr.json"
FIELD = "fourier/fourier"
LABELS = "fourier/mesh"
QUALITY = "fourier/quality"
OCTAVES_GROUP = "octaves"
OCTAVES = "octaves/octaves"
OCTAVE_LABELS = "octaves/mesh"
RECORDS = "records"
RECORD = "records/record"
# Length of the checksum at the end of a chunk.
_CHECKSUM_BYTES = 4
# Attributes of the root: digest of the content of each chunk of small arrays, and that of the root itself.
DIGESTS, DIGEST = "digests", "digest"
_REQUESTS_AT_ONCE = 64


class Hierarchy:
    """Groups and arrays of a store. Cheap to make.

    Methods raise a `StoreError` if the store cannot be read or written. Metadata that were read are kept: make another
    hierarchy to see what other processes have changed of them. Chunks are read anew each time.

    Attributes:
        location: Location of the store.
        documents: Metadata documents by the path of their node. That of the root, under "", lacks the others.
        digests: Digest of the content of each key that is read as a whole: the chunks of tables and coordinates.
    """

    def __init__(self, store: str | Path | Location) -> None:
        self.location = Location.parse(store)
        self.documents: dict[str, Document] = {}
        self.digests: dict[str, str] = {}

    @property
    def path(self) -> str:
        """Path or URL of the store."""
        return self.location.name

    def exists(self) -> bool:
        """Return whether a zarr hierarchy exists.

        Raises:
            DamageError: The metadata at its root are not those that were written.
        """
        if "" not in self.documents:
            root = self._read_document("")
            if root is None:
                return False
            self.digests = dict(root.get("attributes", {}).pop(DIGESTS, {}))
            # Groups repeat the metadata of what is in them, as the root does.
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                document.pop("consolidated_metadata", None)
                self.documents.setdefault(name, document)
            self.documents[""] = root
        return True

    @classmethod
    def of_nodes(cls, store: str | Path | Location, groups: Iterable[str]) -> Self:
        """Return a hierarchy from the metadata of some groups and their arrays, where those at the root are damaged.

        Raises:
            StoreError: The location cannot be read, or metadata are damaged too.
        """
        made = cls(store)
        for group in groups:
            ending = f"/{ROOT}"
            for key in made.location.sizes(group):
                document = made._read_document(key.removesuffix(ending)) if key.endswith(ending) else None
                if document is not None:
                    document.pop("consolidated_metadata", None)
                    made.documents[key.removesuffix(ending)] = document
        return made

    def has(self, name: str) -> bool:
        """Return whether a node exists, listed at the root or not."""
        return name in self.documents or self._read_document(name) is not None

    def document(self, name: str) -> Document:
        """Return the metadata document of a node."""
        if name not in self.documents and self.exists() and name not in self.documents:
            document = self._read_document(name)
            if document is not None:
                self.documents[name] = document
        if name not in self.documents:
            raise StoreError(
                f"{self.path}: the store is incomplete: it has no {name}; remove it and run the study again"
            )
        return self.documents[name]

    def zarr_store(self, name: str = FIELD, recorded: Sequence[RecordedChunks] = ()) -> ZarrStore:
        """Return the store that zarr and xarray take, adapted to the chunks of one array.

        It holds what is read against the digests, and chunks of some arrays against the records of their rows.
        """
        chunk = self.document(name)["chunk_grid"]["configuration"]["chunk_shape"]
        store = self.location.zarr_store(math.prod(chunk) * np.dtype(np.complex128).itemsize)
        return CheckedStore(store, self.path, dict(self.digests), recorded) if self.digests or recorded else store

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array, for reading and writing."""
        store = self.zarr_store(name)
        if not name.startswith(f"{RECORDS}/") and name not in (FIELD, OCTAVES):
            store = NotingStore(store, self.digests)
        path = StorePath(store, name)
        metadata = zarr.AsyncArray.from_dict(path, self.document(name)).metadata
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        return zarr.Array(zarr.AsyncArray(metadata, path, config={"write_empty_chunks": True}))

    def read(self, name: str, selection: Any) -> Any:
        """Return a selection of an array.

        Raises:
            DamageError: The array is damaged.
            StoreError: The store cannot be read.
        """
        array = self.array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            try:
                return array[selection]
            except ValueError as error:
                raise DamageError(f"{self.path}: {name} is damaged ({error})", str(error)) from error

    def read_strings(self, name: str) -> tuple[str, ...]:
        """Return all elements of an array of strings.

        Raises:
            DamageError, StoreError: See `read`.
        """
        return tuple(map(str, np.asarray(self.read(name, ...)).tolist()))

    def write(self, name: str, selection: Any, values: Any) -> None:
        """Write a selection of an array, made of whole chunks."""
        array = self.array(name)
        with self.location.access("written"):
            array[selection] = values

    def resize(self, name: str, shape: tuple[int, ...]) -> None:
        """Change the shape of an array; chunks within both shapes stay."""
        array = self.array(name)
        with self.location.access("written"):
            array.resize(shape)
        del self.documents[name]
        self.document(name)

    def remove(self, name: str) -> None:
        """Remove a node and everything in it. Readers see that after `consolidate`."""
        self.hide([path for path in self.documents if path == name or path.startswith(f"{name}/")])
        self.location.remove(name)

    def hide(self, names: Iterable[str]) -> None:
        """Forget nodes. They stay, but readers do not find them after `consolidate`."""
        for name in names:
            del self.documents[name]
            self.forget_digests(name)

    def publish(self, keys: Mapping[str, bytes], last: str = "") -> None:
        """Write keys of a layout. The last one says that the others exist."""
        self.location.write({key: content for key, content in keys.items() if key != last})
        if last in keys:
            self.location.write({last: keys[last]})
        for key, content in keys.items():
            if key.endswith(f"/{ROOT}"):
                self.documents[key.removesuffix(f"/{ROOT}")] = json.loads(content)
            else:
                self.digests[key] = digest_of(content)

    def consolidate(self) -> None:
        """Collect the metadata of all groups at the root, so that one read opens everything, and the digests."""
        keys: dict[str, Buffer] = {
            f"{name}/{ROOT}".lstrip("/"): BytesBuffer.from_bytes(json.dumps(document).encode())
            for name, document in self.documents.items()
        }
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(MemoryStore(keys), zarr_format=3)
        root = json.loads(keys[ROOT].to_bytes())
        root["attributes"][DIGESTS] = self.digests
        self.location.write({ROOT: json.dumps(sealed(root)).encode()})

    def differing_documents(self) -> dict[str, str]:
        """Return what is wrong with the metadata that nodes have of their own, which readers of one array take."""
        differing = {}
        for name in filter(None, self.documents):
            try:
                document = self._read_document(name)
            except StoreError as error:
                differing[name] = error.what if isinstance(error, DamageError) else str(error)
                continue
            if document is None:
                differing[name] = "its metadata are not there"
            elif _shared(name, document) != _shared(name, self.documents[name]):
                differing[name] = "its metadata are not those at the root of the store"
        return differing

    def restore_documents(self, names: Iterable[str]) -> None:
        """Write the metadata of nodes again as the root has them."""
        self.location.write({f"{name}/{ROOT}": json.dumps(self.documents[name]).encode() for name in names})

    def digest_stored(self, name: str) -> None:
        """Take what is stored of a small array for what was written."""
        for key in self.location.sizes(f"{name}/c"):
            content = self.location.read(key)
            if content is not None:
                self.digests[key] = digest_of(content)

    def forget_digests(self, name: str) -> None:
        """Forget the digests of an array, which is about to be written."""
        for key in [key for key in self.digests if key.startswith(f"{name}/c/") or key == f"{name}/c"]:
            del self.digests[key]

    def _read_document(self, name: str) -> Document | None:
        text = self.location.read(f"{name}/{ROOT}".lstrip("/"), MOST_BYTES)
        if text is None:
            return None
        try:
            document = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            problem = f"{f'{name}/{ROOT}'.lstrip('/')} is damaged ({error})"
            raise DamageError(f"{self.path}: no store of a study is there: {problem}", problem) from error
        if not name:
            # First, since a run repairs what was changed, and not what somebody else wrote.
            require_intact(self.path, document)
        check_documents(self.path, {name: document})
        return document


def _shared(name: str, document: Document) -> Document:
    """Return what a node and the root both say of it. The state of the latest run is in the group of records alone."""
    alone = {"consolidated_metadata", *(["attributes"] if name == RECORDS else [])}
    return {key: value for key, value in document.items() if key not in alone}


def sealed(root: Document) -> Document:
    """Return the metadata of a root with their own digest."""
    attributes = {name: value for name, value in root["attributes"].items() if name != DIGEST}
    unsealed = {**root, "attributes": attributes}
    return {**root, "attributes": {**attributes, DIGEST: document_digest(unsealed)}}


def require_intact(path: str, root: Document) -> None:
    """Take the digest off the metadata of a root.

    Raises:
        DamageError: They are not those that were written.
    """
    attributes = root.get("attributes")
    attributes = attributes if isinstance(attributes, dict) else {}
    digest = attributes.pop(DIGEST, None)
    # Another schema is refused, with its own message, and may make digests in another way.
    is_readable = attributes.get("schema_version") == SCHEMA_VERSION
    if is_readable and digest != document_digest(root):
        raise DamageError(
            f"{path}: {ROOT}, the metadata at the root, is damaged ({CHANGED}); run the study again", CHANGED
        )


class StoredChunks:
    """Chunks of an array in its store, judged by their sizes alone.

    Args:
        hierarchy: Hierarchy of the array.
        name: Path of the array.
        sizes: Sizes of its keys; they are listed if left out.
    """

    def __init__(self, hierarchy: Hierarchy, name: str, sizes: Mapping[str, int] | None = None) -> None:
        self.array = hierarchy.array(name)
        self._name = name
        self._sizes = hierarchy.location.sizes(f"{name}/c") if sizes is None else sizes
        # Strings have no size that is known in advance.
        self._expected = None
        if self.array.dtype.kind in "biufc":
            length = math.prod(self.array.chunks) * self.array.dtype.itemsize
            self._expected = length + _CHECKSUM_BYTES * bool(self.array.ndim)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return tuple(-(-n // m) for n, m in zip(self.array.shape, self.array.chunks, strict=True))

    def are_complete(self, indices: Iterable[tuple[int, ...]]) -> bool:
        """Return whether all of these chunks exist and have the length that they should have."""
        for index in indices:
            size = self._sizes.get(f"{self._name}/{self.array.metadata.encode_chunk_key(index)}", 0)
            if not size or (self._expected is not None and size != self._expected):
                return False
        return True
