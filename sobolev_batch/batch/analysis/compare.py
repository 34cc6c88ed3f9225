"""Comparing meshes with the reference once their fields are stored, where a study asks for it."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import xarray as xr
from distributed import Client, Future

from sobolev_batch.batch.analysis.compare_tasks import Comparison, Stored, compare_by_proximity, compare_by_witness
from sobolev_batch.batch.cluster.execution import deal, many_in_flight
from sobolev_batch.batch.cluster.outcomes import DEADLY, is_suspect
from sobolev_batch.batch.cluster.progress import Notify, Progress
from sobolev_batch.batch.cluster.workers import MEMORY, Workers
from sobolev_batch.batch.fields.sizing import LEAST_ROOM_BYTES, MESH_BYTES
from sobolev_batch.batch.store.comparison_records import (
    KINDS,
    ComparisonRecord,
    ComparisonRecords,
    Kind,
    missing_comparisons,
)
from sobolev_batch.batch.store.records import Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.tables import Tables
from sobolev_batch.batch.store.witness_array import Witnesses
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.errors import StoreError
from sobolev_batch.surfaces.proximity import POINT_BYTES, TRIANGLE_BYTES

_log = logging.getLogger(__name__)

# Raise it whenever comparisons come out differently: they are then made anew.
_VERSION = 1
PROXIMITY = "proximity"
# Of a witness function, for each vertex: coordinates, and values with their terms in the NUFFT for each order.
_VERTEX_BYTES, _VALUE_BYTES = 48.0, 24.0
# Two fields and what is read of one.
_BLOCKS_HELD = 3


@dataclass(frozen=True, eq=False)
class Comparer:
    """The comparisons of a study, and how far they are in a store.

    Attributes:
        store, plan: as they are called.
        rows: the plan's, in the order in which the store holds them.
        complete: the records of those whose fields are there.
        reference: the row of the reference.
    """

    store: Store
    plan: Plan
    rows: Sequence[Row]
    complete: Mapping[int, Record]
    reference: int

    @classmethod
    def of(cls, store: Store, plan: Plan, rows: Sequence[Row], records: Sequence[Record | None]) -> Self:
        """The comparisons of a study between rows of a store, with the records of all rows."""
        complete = {i: record for i, record in enumerate(records) if record and record.status == "complete"}
        return cls(store, plan, rows, complete, [row.label for row in rows].index(plan.reference))

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """What the study asks for."""
        asked = {"witness": bool(self.plan.study.witness), "proximity": self.plan.study.proximity is not None}
        return tuple(kind for kind in KINDS if asked[kind])

    @property
    def is_done(self) -> bool:
        """Whether the store holds what the study asks for, and nothing else of the kind."""
        if self._left_over():
            return False
        if not self.kinds:
            return True
        # Of this store some nodes may be known that the root does not list.
        listed = Store.open(self.store.location)
        notes = {kind: ComparisonRecords(self.store, kind).read() for kind in self.kinds}
        return not any(self._left(kind, notes[kind]) for kind in self.kinds) and all(
            Witnesses(listed).are_listed() if kind == "witness" else self._is_tabulated(listed, notes[kind])
            for kind in self.kinds
        )

    def carry_out(self, client: Client, crew: Workers, notify: Notify) -> dict[str, str]:
        """Make the comparisons that the store lacks, and have readers find all.

        Returns:
            What each mesh lacks that could not be compared, and why, by its label.

        Raises:
            DamageError: a field is not what was stored.
            StoreError: the store could not be read or written.
            ClusterError: the scheduler was lost.
        """
        left_over = self._left_over()
        if not self.kinds and not left_over:
            return {}
        # Until all are there a reader finds none: rows may be those of other fields, of other orders, or not there.
        for name in [name for name in self.store.documents if name.split("/")[0] in KINDS]:
            del self.store.documents[name]
        self.store.consolidate()
        for kind in left_over:
            ComparisonRecords(self.store, kind).remove()
            self.store.remove(kind)
        left = {}
        for kind in self.kinds:
            self._lay_out(kind)
            notes = ComparisonRecords(self.store, kind).read()
            left[kind] = self._left(kind, notes)
            # Those of others speak for nothing; those that are to be replaced would speak for the values of another
            # mesh, were that mesh to come back after an end in the middle.
            kept = set(self._wanted) - set(left[kind])
            for i in [i for i, note in enumerate(notes) if note is not None and i not in kept]:
                ComparisonRecords(self.store, kind).write(i, None)
        total, done = sum(map(len, left.values())), 0

        def conclude(i: int) -> None:
            nonlocal done
            done += 1
            notify(Progress("comparisons", done, total, self.rows[i].label))

        if total:
            notify(Progress("comparisons", 0, total))
        for kind, rows in left.items():
            if rows:
                self._make(kind, rows, client, crew, conclude)
        found = {kind: ComparisonRecords(self.store, kind).read() for kind in self.kinds}
        if "witness" in found:
            notes = found["witness"]
            # A task that outlives the run which submitted it may have written others.
            made = [i for i in self._wanted if (note := notes[i]) and note.completes(self._key("witness", i))]
            Witnesses(self.store).remove_unused({i: self.complete[i].facts.vertices for i in made})
            Witnesses(self.store).list_for_readers()
        if "proximity" in found:
            Tables(self.store).write(PROXIMITY, self._proximity_dataset(found["proximity"]))
        self.store.consolidate()
        return missing_comparisons([row.label for row in self.rows], found, self._wanted)

    def _left_over(self) -> list[Kind]:
        """What the store has, or has begun to have, and the study does not ask for."""
        there = self.store.location.names()
        return [kind for kind in KINDS if kind not in self.kinds and kind in there]

    @cached_property
    def _wanted(self) -> tuple[int, ...]:
        """The meshes that can be compared: not the reference itself, and not surfaces in closed form."""
        if self.reference not in self.complete:
            return ()
        return tuple(i for i, record in self.complete.items() if i != self.reference and record.facts.triangles)

    def _left(self, kind: Kind, notes: Sequence[ComparisonRecord | None]) -> list[int]:
        """The meshes whose comparison is to be made, given the notes that there are."""
        left = {i for i in self._wanted if (note := notes[i]) is None or not note.completes(self._key(kind, i))}
        if kind == "witness" and len(left) < len(self._wanted):
            witnesses = Witnesses(self.store)
            counts = {i: self.complete[i].facts.vertices for i in self._wanted}
            whole = witnesses.complete_rows(counts) if witnesses.exist() else set()
            left |= set(self._wanted) - whole
        return sorted(left)

    def _key(self, kind: Kind, i: int) -> str:
        """SHA-256 of all that the comparison of a mesh depends on."""
        record, of_reference = self.complete[i], self.complete[self.reference]
        parts: list[Any] = [_VERSION, kind, record.facts.digest, of_reference.facts.digest]
        if kind == "witness":
            parts += [record.key, of_reference.key, list(self.plan.study.witness)]
        else:
            parts += [self.plan.study.proximity]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def _lay_out(self, kind: Kind) -> None:
        if kind == "witness":
            labels = [row.label for row in self.rows]
            vertices = max([1, *(self.complete[i].facts.vertices for i in self._wanted)])
            Witnesses(self.store).create(labels, self.plan.study.witness, self.plan.reference, vertices)
        elif not self.store.has(PROXIMITY):
            # Before the notes: what is not asked for any more is found by its group.
            Tables(self.store).write(PROXIMITY, self._proximity_dataset([None] * len(self.rows)))
        ComparisonRecords(self.store, kind).create(len(self.rows))

    def _make(
        self, kind: Kind, left: Sequence[int], client: Client, crew: Workers, conclude: Callable[[int], None]
    ) -> None:
        notes = ComparisonRecords(self.store, kind)
        needed = {i: self._needed_bytes(kind, i) for i in left}
        claims = any(count > crew.share_bytes for count in needed.values())

        def give_up(i: int, reason: str) -> None:
            _log.error("%s: %s: %s", self.rows[i].label, kind, reason)
            notes.write(i, ComparisonRecord(self._key(kind, i), "failed", reason))
            conclude(i)

        def submit(i: int, rank: int) -> Future:
            task, arguments = self._task(kind, crew, needed[i])
            comparison = self._comparison(kind, i)
            resources = {MEMORY: needed[i]} if claims else None
            return client.submit(task, comparison, *arguments, pure=False, resources=resources)

        for i in left:
            if needed[i] > crew.largest_bytes:
                give_up(
                    i,
                    f"it takes about {needed[i] / 1e9:.2g} GB in one task, and no worker has more than "
                    f"{crew.largest_bytes / 1e9:.2g} GB to spare; start workers with more memory",
                )
        todo = [i for i in left if needed[i] <= crew.largest_bytes]
        for i, outcome in deal(client, submit, todo, many_in_flight(crew)):
            if isinstance(outcome, StoreError):
                raise outcome
            if isinstance(outcome, ComparisonRecord):
                conclude(i)
            else:
                give_up(i, DEADLY.format(outcome) if is_suspect(outcome) else f"{type(outcome).__name__}: {outcome}")

    def _task(
        self, kind: Kind, crew: Workers, needed: float
    ) -> tuple[Callable[..., ComparisonRecord], tuple[Any, ...]]:
        """What is to be called besides the comparison itself."""
        plan = self.plan
        if kind == "witness":
            room = LEAST_ROOM_BYTES + max(0.0, crew.share_bytes - needed)
            return compare_by_witness, (plan.lattice, plan.blocks, plan.study.witness, room)
        return compare_by_proximity, (plan.study.proximity,)

    def _comparison(self, kind: Kind, i: int) -> Comparison:
        mesh, reference = self._stored(i), self._stored(self.reference)
        return Comparison(self.store, self._key(kind, i), mesh, reference, self.plan.similarity)

    def _stored(self, i: int) -> Stored:
        row, record = self.rows[i], self.complete[i]
        return Stored(i, row.label, row.member, record.facts.digest, record.checksums)

    def _needed_bytes(self, kind: Kind, i: int) -> float:
        """What the task of a comparison takes at most."""

        def making(row: int) -> float:
            made = MESH_BYTES * self.complete[row].facts.triangles
            return max(self.rows[row].member.expected_size().projected_bytes, made)

        if kind == "witness":
            vertices = self.complete[i].facts.vertices
            block_bytes = float(self.plan.blocks[0].size * np.dtype(np.complex128).itemsize)
            values = (_VERTEX_BYTES + _VALUE_BYTES * len(self.plan.study.witness)) * vertices
            return making(i) + values + _BLOCKS_HELD * block_bytes + LEAST_ROOM_BYTES
        triangles = sum(self.complete[row].facts.triangles for row in (i, self.reference))
        drawn = 2 * POINT_BYTES * (self.plan.study.proximity or 0)
        return making(i) + making(self.reference) + TRIANGLE_BYTES * triangles + drawn

    def _proximity_dataset(self, notes: Sequence[ComparisonRecord | None]) -> xr.Dataset:
        """`hausdorff`, `chamfer` and `chamfer_error` (mesh), NaN where there is no comparison, and why."""
        notes = self._current(notes)
        units = {"units": "unit length"}
        columns = {
            name: ("mesh", np.array([note.numbers[name] if note and note.numbers else np.nan for note in notes]), units)
            for name in ("hausdorff", "chamfer", "chamfer_error")
        }
        reasons = np.array([note.reason if note else "" for note in notes], dtype=object)
        return xr.Dataset(
            {**columns, "reason": ("mesh", reasons)},
            coords={"mesh": np.array([row.label for row in self.rows], dtype=object)},
            attrs={
                "reference": self.plan.reference,
                "points": self.plan.study.proximity,
                "digest": self._proximity_digest(notes),
            },
        )

    def _current(self, notes: Sequence[ComparisonRecord | None]) -> list[ComparisonRecord | None]:
        """The notes of proximities that are those of the meshes and points that there are."""
        wanted = set(self._wanted)
        return [
            note if note is not None and i in wanted and note.key == self._key("proximity", i) else None
            for i, note in enumerate(notes)
        ]

    def _proximity_digest(self, notes: Sequence[ComparisonRecord | None]) -> str:
        lines = [None if note is None else note.to_json() for note in notes]
        labels = [row.label for row in self.rows]
        return hashlib.sha256(json.dumps([labels, lines]).encode()).hexdigest()

    def _is_tabulated(self, store: Store, notes: Sequence[ComparisonRecord | None]) -> bool:
        """Whether the table of proximities is there, and made from the notes that are."""
        attributes = Tables(store).attributes(PROXIMITY)
        return attributes is not None and attributes.get("digest") == self._proximity_digest(self._current(notes))
