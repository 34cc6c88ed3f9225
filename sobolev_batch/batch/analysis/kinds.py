"""The kinds of comparison with the reference: what each takes, computes and leaves in the store."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from sobolev_batch.batch.analysis.compare_tasks import (
    Comparison,
    StoredMesh,
    WitnessSettings,
    compare_by_proximity,
    compare_by_witness,
)
from sobolev_batch.batch.cluster.execution import Task
from sobolev_batch.batch.fields.sizing import LEAST_TRANSFORM_BYTES, MESH_BYTES
from sobolev_batch.batch.store.comparison_records import ComparisonRecord, ComparisonRecords, Kind
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.store.witness_array import Witnesses
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.workspace import Workspace
from sobolev_batch.spectral.metrics.datasets import describe
from sobolev_batch.surfaces.proximity import POINT_BYTES, TRIANGLE_BYTES, Proximity

# Raise it whenever comparisons come out differently: they are then made again.
_VERSION = 1
_PROXIMITY_GROUP = "proximity"
# Of a witness function, for each vertex: coordinates, and values with their terms in the NUFFT for each order.
_VERTEX_BYTES, _VALUE_BYTES = 48.0, 24.0
# Two fields, and the chunk that is being read.
_BLOCKS_HELD = 3

Records = Sequence[ComparisonRecord | None]


@dataclass(frozen=True, eq=False)
class Meshes:
    """The meshes of a workspace that can be compared with its reference."""

    workspace: Workspace

    @cached_property
    def complete(self) -> Mapping[int, Record]:
        """Records of the rows whose fields are stored."""
        return self.workspace.complete

    @cached_property
    def reference(self) -> int:
        """Row of the reference."""
        return self.workspace.reference

    @cached_property
    def rows(self) -> tuple[int, ...]:
        """Rows of the meshes: not the reference itself, and not surfaces in closed form."""
        if self.reference not in self.complete:
            return ()
        return tuple(i for i, record in self.complete.items() if i != self.reference and record.facts.triangles)

    @property
    def vertex_counts(self) -> dict[int, int]:
        """Number of vertices of each mesh."""
        return {i: self.complete[i].facts.vertices for i in self.rows}

    def stored(self, i: int) -> StoredMesh:
        """Return a mesh as tasks take it."""
        row, record = self.workspace.rows[i], self.complete[i]
        return StoredMesh(i, row.label, row.member, record.facts.digest, record.checksums)

    def loading_bytes(self, i: int) -> float:
        """Return the memory that loading a mesh takes at most."""
        mesh_bytes = MESH_BYTES * self.complete[i].facts.triangles
        return max(self.workspace.rows[i].member.expected_size().projected_bytes, mesh_bytes)


@dataclass(frozen=True, eq=False)
class ComparisonKind(ABC):
    """One kind of comparison of meshes with the reference."""

    meshes: Meshes
    name: ClassVar[Kind]

    @property
    def store(self) -> Store:
        """Store of the comparisons."""
        return self.meshes.workspace.store

    @property
    def study(self) -> Study:
        """Study that asks for the comparisons."""
        return self.meshes.workspace.plan.study

    @property
    def records(self) -> ComparisonRecords:
        """Records of the comparisons."""
        return ComparisonRecords(self.store, self.name)

    @property
    @abstractmethod
    def is_wanted(self) -> bool:
        """True where the study asks for this kind."""

    @abstractmethod
    def inputs(self, i: int) -> list[Any]:
        """Return all that the comparison of a mesh depends on, besides the two meshes."""

    @abstractmethod
    def projected_bytes(self, i: int) -> float:
        """Return the memory that the task of a mesh takes at most."""

    @abstractmethod
    def task(self, i: int, allowed_bytes: float) -> Task:
        """Return the task of a mesh.

        Args:
            i: Row of the mesh.
            allowed_bytes: Memory of a task while all threads are busy.
        """

    @abstractmethod
    def create(self) -> None:
        """Create the group of the comparisons, or keep the one that the store has."""

    @abstractmethod
    def finish(self, records: Records) -> None:
        """Have readers find the comparisons."""

    @abstractmethod
    def is_finished(self, listed: Store, records: Records) -> bool:
        """Return True where readers of a store find the comparisons."""

    def pending(self, records: Records) -> list[int]:
        """Return the meshes whose comparison is to be made."""
        return [i for i in self.meshes.rows if not self.has_record(i, records)]

    def has_record(self, i: int, records: Records) -> bool:
        """Return True where a mesh was compared with what there is now."""
        record = records[i]
        return record is not None and record.completes(self.key(i))

    def key(self, i: int) -> str:
        """Return the SHA-256 of all that the comparison of a mesh depends on."""
        digests = [self.meshes.complete[row].facts.digest for row in (i, self.meshes.reference)]
        parts = [_VERSION, self.name, *digests, *self.inputs(i)]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def comparison(self, i: int) -> Comparison:
        """Return a mesh and the reference as tasks take them."""
        mesh, reference = self.meshes.stored(i), self.meshes.stored(self.meshes.reference)
        return Comparison(self.store, self.key(i), mesh, reference, self.meshes.workspace.plan.similarity)


class WitnessKind(ComparisonKind):
    """Witness functions at the vertices of each mesh."""

    name: ClassVar[Kind] = "witness"

    @property
    def is_wanted(self) -> bool:
        """True where the study asks for witness functions."""
        return bool(self.study.witness)

    def inputs(self, i: int) -> list[Any]:
        """Return the keys of both fields, and the orders."""
        keys = [self.meshes.complete[row].key for row in (i, self.meshes.reference)]
        return [*keys, list(self.study.witness)]

    def projected_bytes(self, i: int) -> float:
        """Return the memory of the mesh, its values, blocks of two fields, and the NUFFT."""
        block_bytes = float(self.meshes.workspace.plan.blocks[0].size * np.dtype(np.complex128).itemsize)
        vertex_bytes = _VERTEX_BYTES + _VALUE_BYTES * len(self.study.witness)
        values_bytes = vertex_bytes * self.meshes.complete[i].facts.vertices
        return self.meshes.loading_bytes(i) + values_bytes + _BLOCKS_HELD * block_bytes + LEAST_TRANSFORM_BYTES

    def task(self, i: int, allowed_bytes: float) -> Task:
        """Return the task, with a NUFFT that may take what its thread has left."""
        plan, projected_bytes = self.meshes.workspace.plan, self.projected_bytes(i)
        transform_bytes = LEAST_TRANSFORM_BYTES + max(0.0, allowed_bytes - projected_bytes)
        settings = WitnessSettings(plan.lattice, plan.blocks, plan.study.witness, transform_bytes)
        label = self.meshes.workspace.labels[i]
        return Task(compare_by_witness, (self.comparison(i), settings), projected_bytes, row=i, label=label)

    def pending(self, records: Records) -> list[int]:
        """Return the meshes without a record, and those of which values are lost."""
        pending = set(super().pending(records))
        if len(pending) < len(self.meshes.rows):
            witnesses = Witnesses(self.store)
            whole = witnesses.complete_rows(self.meshes.vertex_counts) if witnesses.exist() else set()
            pending |= set(self.meshes.rows) - whole
        return sorted(pending)

    def create(self) -> None:
        """Create the array, of as many vertices as the largest mesh has."""
        workspace = self.meshes.workspace
        vertices = max(self.meshes.vertex_counts.values(), default=1)
        Witnesses(self.store).create(workspace.labels, self.study.witness, workspace.plan.reference, max(1, vertices))
        self.records.create(len(workspace.labels))

    def finish(self, records: Records) -> None:
        """Remove values without a record, and list the array."""
        # A task that outlives the run which submitted it may have written others.
        counts = {i: count for i, count in self.meshes.vertex_counts.items() if self.has_record(i, records)}
        Witnesses(self.store).remove_unused(counts)
        Witnesses(self.store).list_for_readers()

    def is_finished(self, listed: Store, records: Records) -> bool:
        """Return True where the root lists the array."""
        return Witnesses(listed).are_listed()


class ProximityKind(ComparisonKind):
    """Hausdorff and Chamfer distances of each mesh."""

    name: ClassVar[Kind] = "proximity"

    @property
    def is_wanted(self) -> bool:
        """True where the study asks for these distances."""
        return self.study.proximity is not None

    def inputs(self, i: int) -> list[Any]:
        """Return the number of points on each mesh."""
        return [self.study.proximity]

    def projected_bytes(self, i: int) -> float:
        """Return the memory of both meshes, their search trees and points."""
        both = i, self.meshes.reference
        triangles = sum(self.meshes.complete[row].facts.triangles for row in both)
        points_bytes = 2 * POINT_BYTES * (self.study.proximity or 0)
        return sum(map(self.meshes.loading_bytes, both)) + TRIANGLE_BYTES * triangles + points_bytes

    def task(self, i: int, allowed_bytes: float) -> Task:
        """Return the task."""
        arguments = self.comparison(i), self.study.proximity
        label = self.meshes.workspace.labels[i]
        return Task(compare_by_proximity, arguments, self.projected_bytes(i), row=i, label=label)

    def create(self) -> None:
        """Create the table, without values."""
        rows = len(self.meshes.workspace.labels)
        if not self.store.has(_PROXIMITY_GROUP):
            # Before the records: what the study does not ask for any more is found by its group.
            Tables(self.store).write(_PROXIMITY_GROUP, self._dataset([None] * rows))
        self.records.create(rows)

    def finish(self, records: Records) -> None:
        """Write the table."""
        Tables(self.store).write(_PROXIMITY_GROUP, self._dataset(records))

    def is_finished(self, listed: Store, records: Records) -> bool:
        """Return True where the table is made from these records."""
        attributes = Tables(listed).attributes(_PROXIMITY_GROUP)
        return attributes is not None and attributes.get("digest") == self._digest(self._current(records))

    def _dataset(self, records: Records) -> xr.Dataset:
        """Return the numbers of `Proximity` (mesh), and `reason` where they are NaN."""
        records = self._current(records)
        columns: dict[str, Any] = {
            name: [record.numbers[name] if record and record.numbers else np.nan for record in records]
            for name in (field.name for field in fields(Proximity))
        }
        columns["reason"] = np.array([record.reason if record else "" for record in records], dtype=object)
        attributes = {
            "reference": self.meshes.workspace.plan.reference,
            "points": self.study.proximity,
            "digest": self._digest(records),
        }
        labels = np.array(self.meshes.workspace.labels, dtype=object)
        variables = {name: ("mesh", values) for name, values in columns.items()}
        dataset = xr.Dataset(variables, coords={"mesh": labels}, attrs=attributes)
        return describe(dataset.isel(mesh=sorted(self.meshes.workspace.rows)))

    def _current(self, records: Records) -> list[ComparisonRecord | None]:
        """Return the records of the meshes and points that there are now."""
        rows = set(self.meshes.rows)
        return [
            record if record is not None and i in rows and record.key == self.key(i) else None
            for i, record in enumerate(records)
        ]

    def _digest(self, records: Records) -> str:
        lines = [None if record is None else record.to_json(row) for row, record in enumerate(records)]
        return hashlib.sha256(json.dumps([self.meshes.workspace.labels, lines]).encode()).hexdigest()
