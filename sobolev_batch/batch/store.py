"""The store: one zarr hierarchy with the fields, records and tables of a study.

The driver lays out all arrays before any task starts; tasks fill whole chunks of them and nothing
else, so no two writers ever meet in one chunk. docs/store.md describes the layout for readers.

The metadata of all arrays lie together in one document at the root. A store reads that once and its
tasks take along what they need of it: on object storage every look at a key is a request.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.abc.buffer import Buffer
from zarr.abc.store import Store as ZarrStore
from zarr.buffer.cpu import Buffer as BytesBuffer
from zarr.buffer.cpu import NDBuffer
from zarr.codecs import Crc32cCodec
from zarr.storage import MemoryStore, StorePath

from sobolev_batch.batch.choice import Choice
from sobolev_batch.batch.documents import MOST_BYTES, SCHEMA_VERSION, Document, check_documents
from sobolev_batch.batch.location import Location
from sobolev_batch.batch.plan import Plan
from sobolev_batch.batch.records import Record, RunRecord
from sobolev_batch.batch.scratch import Scratch
from sobolev_batch.errors import StoreError
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.surfaces.similarity import Similarity

Place = tuple[slice, slice, slice]

_ROOT = "zarr.json"
_FIELD = "fourier/fourier"
_LABELS = "fourier/mesh"
_QUALITY = "fourier/quality"
_RECORD = "records/record"
_RECORDS, _RUN = "records", "run"
_REQUESTS_AT_ONCE = 64
_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "modepy", "numpy", "scipy", "xarray", "zarr")


class Store:
    """An existing store, by its path or URL. Cheap to make and to pickle.

    What it has read of the metadata it keeps: make another one to see what other processes have
    changed of it. Chunks are read anew each time.
    """

    def __init__(self, place: str | Path | Location) -> None:
        self.location = Location.of(place)
        # Metadata documents by the path of their node; of the root, under "", without the others.
        self._documents: dict[str, Document] = {}

    def __getstate__(self) -> dict[str, Any]:
        # What tasks write and read; tables have fifty times as much.
        carried = {name: self._documents[name] for name in (_FIELD, _RECORD) if name in self._documents}
        return {"location": self.location, "_documents": carried}

    @property
    def path(self) -> str:
        """The path or URL."""
        return self.location.name

    @classmethod
    def prepare(cls, place: str | Path | Location, plan: Plan) -> Self:
        """Create the store of a plan, or open it if it is already there and take up new meshes.

        Raises:
            StoreError: the place cannot be reached or written, holds something else, or a store of
                another study; nothing is changed then.
        """
        store = cls(place)
        if not store.is_there():
            store.location.require_free()
            store._lay_out(plan)
        else:
            store._check_same_study(plan)
            with store.location.access("written"):
                if store._lattice() != _lattice_entry(plan):
                    store._replace_fields(plan)
                store._extend(plan)
                store._documents[""]["attributes"].update(_attributes(plan))
                # Written even if nothing changed: a place that refuses it must do so before tasks start.
                store.consolidate()
        return store

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
        if "" not in self._documents:
            root = self._read_document("")
            if root is None:
                return False
            # What the root repeats of groups, these repeat of what is in them.
            for name, document in (root.pop("consolidated_metadata", None) or {}).get("metadata", {}).items():
                document.pop("consolidated_metadata", None)
                self._documents.setdefault(name, document)
            self._documents[""] = root
        return True

    def keys(self, name: str = _FIELD) -> ZarrStore:
        """What zarr and xarray take to read the store, with an eye to the chunks of one array."""
        chunk = self._document(name)["chunk_grid"]["configuration"]["chunk_shape"]
        return self.location.keys(math.prod(chunk) * np.dtype(np.complex128).itemsize)

    def attributes(self) -> dict[str, Any]:
        """The attributes of the root: title, study, similarity, versions.

        Raises:
            StoreError: no store of this package's schema is there.
        """
        if not self.is_there() or self._documents[""].get("node_type") != "group":
            raise StoreError(f"{self.path}: no store of a study is there")
        found: dict[str, Any] = self._documents[""].get("attributes", {})
        if "schema_version" not in found or "study" not in found:
            raise StoreError(f"{self.path}: a zarr store, but not one of a study")
        if found["schema_version"] != SCHEMA_VERSION:
            raise StoreError(
                f"{self.path}: its schema has version {found['schema_version']}, this program reads {SCHEMA_VERSION}"
            )
        return found

    def labels(self) -> tuple[str, ...]:
        """The label of each row."""
        return self._read_texts(_LABELS)

    def records(self) -> tuple[Record | None, ...]:
        """The completion record of each row, None where there is none."""
        return tuple(Record.from_json(line) for line in self._read_texts(_RECORD))

    def write_record(self, row: int, record: Record) -> None:
        """Write the completion record of a row: one chunk, replaced as a whole."""
        array = self._array(_RECORD)
        with self.location.access("written"):
            array[row] = record.to_json()

    def write_field(self, row: int, place: Place, values: NDArray[Any]) -> None:
        """Write one block of a row's field, which must be whole chunks."""
        array = self._array(_FIELD)
        with self.location.access("written"):
            array[(row, *place)] = values

    def read_fields(self, rows: Sequence[int], place: Place) -> NDArray[Any]:
        """One block of several rows' fields, complex (len(rows), ...).

        Raises:
            StoreError: a chunk is damaged or cannot be read; the message names its row.
        """
        array = self._array(_FIELD)
        values = np.empty((len(rows), *(part.stop - part.start for part in place)), dtype=array.dtype)
        # On object storage all but a wrong checksum is a failure to reach it.
        damage = ValueError if self.location.scheme else (OSError, ValueError)

        def read(i: int) -> None:
            with self.location.access("read"):
                try:
                    # Into its place: a copy of a field costs as much as reading it.
                    array.get_basic_selection((rows[i], *place), out=NDBuffer.from_numpy_array(values[i]))
                except damage as error:
                    raise StoreError(
                        f"{self.path}: the field of {self.labels()[rows[i]]} is damaged ({error}); "
                        "remove the store's record of it and run the study again"
                    ) from error

        if self.location.scheme and len(rows) > 1:
            # Most of the time of a request is spent waiting.
            with ThreadPoolExecutor(len(rows)) as pool:
                list(pool.map(read, range(len(rows))))
        else:
            for i in range(len(rows)):
                read(i)
        return values

    @property
    def scratch(self) -> Scratch:
        """Room for pieces of meshes, which no reader needs."""
        return Scratch(self.location)

    def read_run(self) -> RunRecord | None:
        """The record of the latest run, or None where none was ever begun."""
        document = self._read_document(_RECORDS) or {}
        table = document.get("attributes", {}).get(_RUN)
        return None if table is None else RunRecord.from_table(table)

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run: an attribute of the group of records, with one key written at once."""
        document = self._document(_RECORDS)
        # Not remembered: consolidated metadata would tell readers of a run that ended long ago.
        changed = {**document, "attributes": {**document.get("attributes", {}), _RUN: record.to_table()}}
        self.location.write({f"{_RECORDS}/{_ROOT}": json.dumps(changed).encode()})

    def write_qualities(self, qualities: Sequence[str]) -> None:
        """Set the coordinate `quality` of all fields."""
        array = self._array(_QUALITY)
        with self.location.access("written"):
            array[:] = np.array(qualities, dtype=object)

    def write_table(self, group: str, dataset: xr.Dataset) -> None:
        """Replace a group of small arrays, each in one chunk; `consolidate` makes it known to readers."""
        made: dict[str, Buffer] = {}
        dataset.to_zarr(
            MemoryStore(made),
            group=group,
            mode="w",
            zarr_format=3,
            consolidated=False,
            encoding=_table_encoding(dataset),
        )
        made.pop(_ROOT, None)
        there = [name for name in self._documents if name.startswith(f"{group}/")]
        for name in there:
            if f"{name}/{_ROOT}" not in made:
                self.location.remove(name)
                del self._documents[name]
        self._publish(made, last=f"{group}/{_ROOT}")

    def table_attributes(self, group: str) -> dict[str, Any] | None:
        """The attributes of a group of small arrays, or None where it was not written yet."""
        return self._documents[group].get("attributes", {}) if self.is_there() and group in self._documents else None

    def consolidate(self) -> None:
        """Collect the metadata of all groups at the root, so that one read opens everything."""
        nodes = {f"{name}/{_ROOT}".lstrip("/"): document for name, document in self._documents.items()}
        known: dict[str, Buffer] = {key: _to_buffer(document) for key, document in nodes.items()}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(MemoryStore(known), zarr_format=3)
        self.location.write({_ROOT: known[_ROOT].to_bytes()})

    def _document(self, name: str) -> Document:
        """The metadata document of a node, from the root's if it was not read yet."""
        if name not in self._documents and self.is_there() and name not in self._documents:
            document = self._read_document(name)
            if document is not None:
                self._documents[name] = document
        if name not in self._documents:
            raise StoreError(
                f"{self.path}: the store is incomplete: it has no {name}; remove it and run the study again"
            )
        return self._documents[name]

    def _read_document(self, name: str) -> Document | None:
        text = self.location.read(f"{name}/{_ROOT}".lstrip("/"), MOST_BYTES)
        if text is None:
            return None
        try:
            document = dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise StoreError(
                f"{self.path}: no store of a study is there: {name}/{_ROOT} is damaged ({error})"
            ) from error
        check_documents(self.path, {name: document})
        return document

    def _array(self, name: str) -> zarr.Array[Any]:
        place = StorePath(self.keys(name), name)
        known = zarr.AsyncArray.from_dict(place, self._document(name))
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        return zarr.Array(zarr.AsyncArray(known.metadata, place, config={"write_empty_chunks": True}))

    def _read_texts(self, name: str) -> tuple[str, ...]:
        array = self._array(name)
        # Each record is a chunk, and a chunk a request.
        with self.location.access("read"), zarr.config.set({"async.concurrency": _REQUESTS_AT_ONCE}):
            return tuple(map(str, np.asarray(array[:]).tolist()))

    def _publish(self, made: dict[str, Buffer], last: str) -> None:
        """Write keys that were made in memory, the one that says that the others are there at the end."""
        self.location.write({key: value.to_bytes() for key, value in made.items() if key != last})
        if last in made:
            self.location.write({last: made[last].to_bytes()})
        for key, value in made.items():
            if key.endswith(f"/{_ROOT}"):
                self._documents[key.removesuffix(f"/{_ROOT}")] = json.loads(value.to_bytes())

    def _replace_fields(self, plan: Plan) -> None:
        """Remove everything that was computed and lay out the arrays for another lattice."""
        tables = {name.split("/")[0] for name in self._documents if name} - {"fourier", "records"}
        # Records go first: without one, a mesh counts as not computed, whatever is left of it.
        for prefix in (f"{_RECORD}/c", *sorted(tables), f"{_FIELD}/c", f"{_QUALITY}/c"):
            self.location.remove(prefix)
        self._lay_out(plan)

    def _lay_out(self, plan: Plan) -> None:
        labels = [row.label for row in plan.rows]
        lattice = plan.lattice
        chunk = plan.blocks[0].shape
        made: dict[str, Buffer] = {}
        root = zarr.create_group(MemoryStore(made), zarr_format=3)
        root.create_array(
            _FIELD,
            shape=(len(labels), *lattice.shape),
            dtype=plan.choice.precision,
            chunks=(1, *chunk),
            compressors=(Crc32cCodec(),),
            fill_value=complex(np.nan, np.nan),
            dimension_names=("mesh", *AXES),
            # xarray takes what `coordinates` names for coordinates, so it stays with a selected field.
            attributes={
                "long_name": "Fourier transform of the area measure, xi_z >= 0 half",
                "coordinates": "quality",
            },
        )
        root.create_array(
            _QUALITY,
            shape=(len(labels),),
            dtype=str,
            chunks=(len(labels),),
            compressors=(Crc32cCodec(),),
            fill_value="",
            dimension_names=("mesh",),
        )
        units = {"units": "cycles per unit length"}
        coordinates: dict[str, Any] = {name: (name, axis, units) for name, axis in zip(AXES, lattice.axes, strict=True)}
        coordinates["mesh"] = ("mesh", np.array(labels, dtype=object))
        axes = xr.Dataset(coords=coordinates)
        axes.to_zarr(
            MemoryStore(made),
            group="fourier",
            mode="a",
            zarr_format=3,
            consolidated=False,
            encoding=_table_encoding(axes),
        )
        root.create_array(
            _RECORD,
            shape=(len(labels),),
            dtype=str,
            chunks=(1,),
            compressors=(Crc32cCodec(),),
            dimension_names=("mesh",),
            fill_value="",
        )
        kept = self._documents.get("", {}).get("attributes", {})
        self._documents = {"": {**json.loads(made.pop(_ROOT).to_bytes()), "attributes": {**kept, **_attributes(plan)}}}
        self._publish(made, last="")
        # The root comes last: a folder without it is not taken for a store.
        self.consolidate()

    def _check_same_study(self, plan: Plan) -> None:
        study = self.attributes()["study"]
        # A lattice that was chosen may be chosen anew; one that was given is part of the study.
        chosen = plan.study.accuracy is not None
        differences = [
            f"{what} {old}, not {new}"
            for what, old, new in (
                ("the study", repr(study["name"]), repr(plan.study.name)),
                ("a lattice of", *map(_described, (study["lattice"], _lattice_entry(plan)["lattice"]))),
                ("dtype", repr(study["dtype"]), repr(plan.choice.precision)),
            )
            if old != new and not (chosen and what != "the study" and study.get("choice"))
        ]
        removed = set(self.labels()) - {row.label for row in plan.rows}
        if removed:
            differences.append(f"meshes that this study lacks, such as {min(removed)!r}")
        if differences:
            raise StoreError(
                f"{self.path}: a store of another study is there, with {'; '.join(differences)}. "
                "Name another store, or remove this one"
            )

    def _lattice(self) -> dict[str, Any]:
        study = self.attributes()["study"]
        return {"lattice": study["lattice"], "dtype": study["dtype"]}

    def _extend(self, plan: Plan) -> None:
        """Append rows for meshes that the study has gained; the rows that are there stay."""
        there = self.labels()
        known = set(there)
        added = [row.label for row in plan.rows if row.label not in known]
        if not added:
            return
        for name in (_RECORD, _FIELD, _QUALITY, _LABELS):
            array = self._array(name)
            array.resize((len(there) + len(added), *array.shape[1:]))
            if name == _LABELS:
                array[len(there) :] = np.array(added, dtype=object)
            del self._documents[name]
            self._document(name)


def stored_choice(place: str | Path | Location) -> Choice | None:
    """The lattice that the fields of a store were chosen to have; None without a store, or where it was given.

    Raises:
        StoreError: the place cannot be reached, or holds something else.
    """
    store = Store(place)
    if not store.is_there():
        return None
    table = store.attributes()["study"].get("choice")
    return Choice.from_table(table) if table else None


def _attributes(plan: Plan) -> dict[str, Any]:
    """What the root of the store of a plan says."""
    study = plan.study
    return {
        "title": study.title,
        "schema_version": SCHEMA_VERSION,
        "study": {
            "name": study.name,
            **_lattice_entry(plan),
            "eps": None if study.accuracy else study.transform.accuracy,
            "choice": plan.choice.to_table() if study.accuracy else None,
            "orders": list(study.orders),
            "reference": plan.reference,
            "table": dict(study.table),
        },
        "similarity": _similarity_entry(plan.similarity),
        "versions": {name: version(name) for name in _RECORDED_VERSIONS},
    }


def _to_buffer(document: Document) -> Buffer:
    return BytesBuffer.from_bytes(json.dumps(document).encode())


def _described(lattice: dict[str, Any]) -> str:
    return f"xi_max {lattice['xi_max']:.6g} and M {lattice['M']}"


def _lattice_entry(plan: Plan) -> dict[str, Any]:
    return {"lattice": {"xi_max": plan.lattice.xi_max, "M": plan.lattice.M}, "dtype": plan.choice.precision}


def _similarity_entry(similarity: Similarity) -> dict[str, Any]:
    return {"scale": similarity.scale, "origin": list(similarity.origin)}


def _table_encoding(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """One chunk per array, with a checksum."""
    return {
        str(name): {"compressors": (Crc32cCodec(),), "chunks": variable.shape}
        for name, variable in dataset.variables.items()
        if variable.ndim
    }
