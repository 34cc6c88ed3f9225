"""Comparisons of meshes with the reference once their fields are stored, where a study asks for them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from sobolev_batch.batch.analysis.kinds import ComparisonKind, Meshes, ProximityKind, WitnessKind
from sobolev_batch.batch.cluster.execution import Cluster, describe_failure
from sobolev_batch.batch.cluster.progress import Steps
from sobolev_batch.batch.store.comparison_records import KINDS, ComparisonRecord, failed_comparisons
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.workspace import Workspace

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Comparer:
    """The comparisons of a workspace.

    Attributes:
        workspace: Workspace with the records that it has now.
        meshes: Meshes to be compared.
        kinds: Kinds of comparison that the study asks for.
        unwanted: Kinds that the store has, or has begun to have, and the study does not ask for.
    """

    workspace: Workspace
    meshes: Meshes
    kinds: tuple[ComparisonKind, ...]
    unwanted: tuple[ComparisonKind, ...]

    @classmethod
    def of(cls, workspace: Workspace) -> Self:
        """Return the comparisons of a workspace, by the kinds that its study asks for."""
        meshes, names = Meshes(workspace), workspace.store.location.names()
        every_kind: tuple[ComparisonKind, ...] = WitnessKind(meshes), ProximityKind(meshes)
        kinds = tuple(kind for kind in every_kind if kind.is_wanted)
        unwanted = tuple(kind for kind in every_kind if not kind.is_wanted and kind.name in names)
        return cls(workspace, meshes, kinds, unwanted)

    @property
    def is_done(self) -> bool:
        """True where the store holds what the study asks for, and nothing else of the kind."""
        if self.unwanted or not self.kinds:
            return not self.unwanted
        # This store may know nodes that the root does not list.
        listed = Store.open(self.workspace.store.location)
        for kind in self.kinds:
            records = kind.records.read()
            if kind.pending(records) or not kind.is_finished(listed, records):
                return False
        return True

    def run(self, cluster: Cluster) -> dict[str, str]:
        """Make the comparisons that the store lacks, and have readers find all.

        Returns:
            Comparisons that could not be made and why, by the label of the mesh.

        Raises:
            DamageError: A field is not what was stored.
            StoreError: The store could not be read or written.
            ClusterError: The scheduler was lost.
        """
        if not self.kinds and not self.unwanted:
            return {}
        self._hide()
        for kind in self.unwanted:
            kind.records.remove()
            self.workspace.store.remove(kind.name)
        pending = {kind: self._prepare(kind) for kind in self.kinds}
        total = sum(map(len, pending.values()))
        if total:
            steps = Steps(cluster.notify, "comparisons", total)
            for kind, rows in pending.items():
                self._make(kind, rows, cluster, steps)
        records = {kind.name: kind.records.read() for kind in self.kinds}
        for kind in self.kinds:
            kind.finish(records[kind.name])
        self.workspace.store.consolidate()
        return failed_comparisons(dict(enumerate(self.workspace.labels)), records, self.meshes.rows)

    def _hide(self) -> None:
        """Have readers find no comparison until all are made: rows may be those of other fields or orders."""
        store = self.workspace.store
        for name in [name for name in store.documents if name.split("/")[0] in KINDS]:
            del store.documents[name]
        store.consolidate()

    def _prepare(self, kind: ComparisonKind) -> list[int]:
        """Create the group of a kind, and return the meshes whose comparison is to be made."""
        kind.create()
        records = kind.records.read()
        pending = kind.pending(records)
        # A record that stays would speak for the values of another mesh, were that mesh to come back after an
        # end in the middle.
        kept = set(self.meshes.rows) - set(pending)
        for i, record in enumerate(records):
            if record is not None and i not in kept:
                kind.records.write(i, None)
        return pending

    def _make(self, kind: ComparisonKind, pending: Sequence[int], cluster: Cluster, steps: Steps) -> None:
        records = kind.records
        tasks = [kind.task(i, cluster.workers.allowed_bytes_per_task) for i in pending]
        projected_bytes = max((task.projected_bytes for task in tasks), default=0.0)
        for task, outcome in cluster.run(tasks, projected_bytes):
            label = self.workspace.rows[task.row].label
            if not isinstance(outcome, ComparisonRecord):
                reason = describe_failure(outcome)
                _log.error("%s: %s: %s", label, kind.name, reason)
                records.write(task.row, ComparisonRecord(kind.key(task.row), "failed", reason))
            steps.advance(label)
