"""The store: one zarr hierarchy with the fields, records and tables of a study.

The driver lays out all arrays before any task starts; tasks fill whole chunks of them and nothing
else, so no two writers ever meet in one chunk. docs/store.md describes the layout for readers.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.buffer.cpu import NDBuffer
from zarr.codecs import Crc32cCodec

from sobolev_batch.batch.choice import Choice
from sobolev_batch.batch.plan import Plan
from sobolev_batch.batch.records import Record, RunRecord
from sobolev_batch.errors import StoreError
from sobolev_batch.spectral.lattice import AXES
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Similarity

SCHEMA_VERSION = 2

Place = tuple[slice, slice, slice]

_FIELD = "fourier/fourier"
_QUALITY = "fourier/quality"
_RECORD = "records/record"
_RUN = "records/run"
_SCRATCH = "scratch"
_PIECE_ARRAYS = ("vertices", "triangles")
_RECORDED_VERSIONS = ("sobolev-batch", "finufft", "modepy", "numpy", "scipy", "xarray", "zarr")


class Store:
    """An existing store, by its path. Cheap to make and to pickle; every call opens what it needs."""

    def __init__(self, path: str | Path) -> None:
        self.path = str(path)

    @classmethod
    def prepare(cls, path: str | Path, plan: Plan) -> Self:
        """Create the store of a plan, or open it if it is already there and take up new meshes.

        Raises:
            StoreError: the place cannot be written, holds something else, or a store of another
                study; nothing is changed then.
        """
        store = cls(path)
        try:
            if store._is_new():
                store._create(plan)
            else:
                store._check_same_study(plan)
                if store._lattice() != _lattice_entry(plan):
                    store._replace_fields(plan)
                store._extend(plan)
                store._update_attributes(plan)
            store.consolidate()
        except OSError as error:
            raise StoreError(f"{path}: the store cannot be written: {error.strerror or error}") from error
        return store

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a store that exists.

        Raises:
            StoreError: there is none, or it has another schema.
        """
        store = cls(path)
        store.attributes()
        return store

    def attributes(self) -> dict[str, Any]:
        """The attributes of the root: title, study, similarity, versions.

        Raises:
            StoreError: no store of this package's schema is there.
        """
        try:
            found = dict(zarr.open_group(self.path, mode="r").attrs)
        except (OSError, ValueError, KeyError) as error:
            raise StoreError(f"{self.path}: no store of a study is there ({type(error).__name__}: {error})") from error
        if "schema_version" not in found or "study" not in found:
            raise StoreError(f"{self.path}: a zarr store, but not one of a study")
        if found["schema_version"] != SCHEMA_VERSION:
            raise StoreError(
                f"{self.path}: its schema has version {found['schema_version']}, this program reads {SCHEMA_VERSION}"
            )
        return found

    def labels(self) -> tuple[str, ...]:
        """The label of each row."""
        return tuple(map(str, np.asarray(zarr.open_array(self.path, path="fourier/mesh", mode="r")[:]).tolist()))

    def records(self) -> tuple[Record | None, ...]:
        """The completion record of each row, None where there is none."""
        lines = np.asarray(zarr.open_array(self.path, path=_RECORD, mode="r")[:]).tolist()
        return tuple(Record.from_json(str(line)) for line in lines)

    def write_record(self, row: int, record: Record) -> None:
        """Write the completion record of a row: one chunk, replaced as a whole."""
        zarr.open_array(self.path, path=_RECORD, mode="r+")[row] = record.to_json()

    def write_field(self, row: int, place: Place, values: NDArray[Any]) -> None:
        """Write one block of a row's field, which must be whole chunks."""
        # Chunks of zeros are data too: they must exist, or they would read as never computed.
        array = zarr.open_array(self.path, path=_FIELD, mode="r+", config={"write_empty_chunks": True})
        array[(row, *place)] = values

    def read_fields(self, rows: Sequence[int], place: Place) -> NDArray[Any]:
        """One block of several rows' fields, complex (len(rows), ...).

        Raises:
            StoreError: a chunk is damaged; the message names its row.
        """
        array = zarr.open_array(self.path, path=_FIELD, mode="r")
        values = np.empty((len(rows), *(part.stop - part.start for part in place)), dtype=array.dtype)
        for i, row in enumerate(rows):
            try:
                # Into its place: a copy of a field costs as much as reading it.
                array.get_basic_selection((row, *place), out=NDBuffer.from_numpy_array(values[i]))
            except (OSError, ValueError) as error:
                raise StoreError(
                    f"{self.path}: the field of {self.labels()[row]} is damaged ({error}); "
                    "remove the store's record of it and run the study again"
                ) from error
        return values

    def write_piece(self, row: int, number: int, mesh: Mesh) -> None:
        """Keep a piece of a row's mesh in the scratch space, until `discard_pieces`."""
        root = self._writable_root()
        for name in _PIECE_ARRAYS:
            values = getattr(mesh, name)
            root.create_array(
                _piece(row, number, name),
                data=values,
                chunks=values.shape,
                compressors=(Crc32cCodec(),),
                overwrite=True,
            )

    def read_piece(self, row: int, number: int) -> Mesh:
        """A piece that was written.

        Raises:
            StoreError: it is not there, or damaged.
        """
        try:
            vertices, triangles = (
                np.asarray(zarr.open_array(self.path, path=_piece(row, number, name), mode="r")[:])
                for name in _PIECE_ARRAYS
            )
        except (OSError, ValueError, KeyError) as error:
            raise StoreError(
                f"{self.path}: piece {number} of the mesh of {self.labels()[row]} cannot be read ({error}); "
                "run the study again"
            ) from error
        return Mesh.of_checked(vertices, triangles)

    def discard_pieces(self, row: int | None = None) -> None:
        """Remove the pieces of a row, or of all."""
        root = self._writable_root()
        path = _SCRATCH if row is None else f"{_SCRATCH}/{row}"
        if path in root:
            del root[path]

    def read_run(self) -> RunRecord | None:
        """The record of the latest run, or None where none was ever begun."""
        try:
            lines = np.asarray(zarr.open_array(self.path, path=_RUN, mode="r")[:]).tolist()
        except FileNotFoundError:  # a store that was made before runs were recorded
            return None
        return RunRecord.from_json(str(lines[0]))

    def write_run(self, record: RunRecord) -> None:
        """Replace the record of the latest run."""
        root = self._writable_root()
        if _RUN not in root:
            root.create_array(_RUN, shape=(1,), dtype=str, chunks=(1,), fill_value="", dimension_names=("run",))
        zarr.open_array(self.path, path=_RUN, mode="r+")[:] = np.array([record.to_json()], dtype=object)

    def _writable_root(self) -> zarr.Group:
        # Consolidated metadata knows nothing of what was added after it.
        return zarr.open_group(self.path, mode="r+", use_consolidated=False)

    def write_qualities(self, qualities: Sequence[str]) -> None:
        """Set the coordinate `quality` of all fields."""
        zarr.open_array(self.path, path=_QUALITY, mode="r+")[:] = np.array(qualities, dtype=object)

    def write_table(self, group: str, dataset: xr.Dataset) -> None:
        """Replace a group of small arrays, each in one chunk."""
        dataset.to_zarr(
            self.path, group=group, mode="w", zarr_format=3, consolidated=False, encoding=_table_encoding(dataset)
        )

    def read_table(self, group: str) -> xr.Dataset | None:
        """A group of small arrays, or None where it was not written yet."""
        try:
            with xr.open_zarr(self.path, group=group, consolidated=False, chunks=None) as dataset:
                table: xr.Dataset = dataset.load()
                return table
        except (FileNotFoundError, KeyError):
            return None

    def consolidate(self) -> None:
        """Collect the metadata of all groups at the root, so that one read opens everything."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(self.path)

    def _is_new(self) -> bool:
        place = Path(self.path)
        if not place.exists():
            return True
        if not place.is_dir():
            raise StoreError(f"{self.path}: a file is there; name a folder that is new or holds a store")
        if not any(place.iterdir()):
            return True
        if not (place / "zarr.json").exists():
            raise StoreError(f"{self.path}: the folder is not empty and holds no store; name another")
        return False

    def _create(self, plan: Plan) -> None:
        nearest = next(folder for folder in [Path(self.path), *Path(self.path).absolute().parents] if folder.exists())
        if not os.access(nearest, os.W_OK):
            raise StoreError(f"{self.path}: the store cannot be written: no permission in {nearest}")
        zarr.create_group(self.path, zarr_format=3)
        self._lay_out(plan)

    def _replace_fields(self, plan: Plan) -> None:
        """Remove everything that was computed and lay out the arrays for another lattice."""
        root = zarr.open_group(self.path, mode="r+")
        for group in list(root.group_keys()):
            del root[group]
        self._lay_out(plan)

    def _lay_out(self, plan: Plan) -> None:
        labels = [row.label for row in plan.rows]
        lattice = plan.lattice
        chunk = plan.blocks[0].shape
        root = zarr.open_group(self.path, mode="r+")
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
            self.path, group="fourier", mode="a", zarr_format=3, consolidated=False, encoding=_table_encoding(axes)
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
        # The attributes come last: a folder without them is not taken for a store.
        self._update_attributes(plan)

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
        for name in (_RECORD, _FIELD, _QUALITY, "fourier/mesh"):
            array = zarr.open_array(self.path, path=name, mode="r+")
            array.resize((len(there) + len(added), *array.shape[1:]))
            if name == "fourier/mesh":
                array[len(there) :] = np.array(added, dtype=object)

    def _update_attributes(self, plan: Plan) -> None:
        study = plan.study
        zarr.open_group(self.path, mode="r+").attrs.update(
            {
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
        )


def _piece(row: int, number: int, name: str) -> str:
    return f"{_SCRATCH}/{row}/{number}/{name}"


def stored_choice(path: str | Path) -> Choice | None:
    """The lattice that the fields of a store were chosen to have; None without a store, or where it was given."""
    if not (Path(path) / "zarr.json").exists():
        return None
    table = Store.open(path).attributes()["study"].get("choice")
    return Choice.from_table(table) if table else None


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
