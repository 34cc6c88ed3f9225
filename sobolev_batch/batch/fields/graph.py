"""Fields as graphs of Dask tasks, each of which claims the memory and the device that it needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from distributed import Client, Future

from sobolev_batch.batch.cluster.workers import GPU, MEMORY, Workers
from sobolev_batch.batch.fields.large_mesh import add_partials, cut_mesh, store_block, transform_piece
from sobolev_batch.batch.fields.sizing import Layout
from sobolev_batch.batch.fields.tasks import Job, compute_blocks, compute_mesh, finish_mesh
from sobolev_batch.batch.study.schema import Backends


@dataclass(frozen=True, eq=False)
class Submitter:
    """Hands tasks to a cluster.

    Attributes:
        client: of the cluster.
        claims_memory: whether tasks have to claim their memory; where each fits beside as many as a worker
            has threads, none needs to, and the scheduler is free to deal them out as it likes.
        claims_gpu: whether transforms have to run where a GPU is.
        blocks: of the lattice.
    """

    client: Client
    claims_memory: bool
    claims_gpu: bool
    blocks: int

    @classmethod
    def of(cls, client: Client, crew: Workers, backend: Backends, layouts: Iterable[Layout], blocks: int) -> Submitter:
        """The submitter for fields with these layouts."""
        largest = max((layout.largest_bytes for layout in layouts), default=0.0)
        return cls(client, largest > crew.share_bytes, backend == "gpu", blocks)

    def field(self, job: Job, layout: Layout, rank: int) -> Future:
        """Compute and store a field; the result is its completion record.

        Args:
            job: what to compute.
            layout: as which tasks.
            rank: fields of lower rank come first.
        """
        groups = layout.groups
        if layout.parts > 1:
            return self._field_of_pieces(job, layout, rank)
        if len(groups) == 1:
            return self._submit(compute_mesh, job, groups[0], claim=layout.making_bytes, transforms=True)
        parts = [
            self._submit(compute_blocks, job, group, claim=layout.making_bytes, transforms=True) for group in groups
        ]
        return self._submit(finish_mesh, job, parts)

    def _field_of_pieces(self, job: Job, layout: Layout, rank: int) -> Future:
        # Mesh after mesh and block after block, and sums before further pieces: what waits to be added
        # up waits in memory.
        first = -2 * rank * (self.blocks + 1)
        cut = self._submit(cut_mesh, job, layout.parts, claim=layout.making_bytes, priority=first)
        claim = layout.task_bytes
        parts = []
        for number, block in enumerate(block for group in layout.groups for block in group):
            later = first - 2 * (number + 1)
            pieces = [
                self._submit(transform_piece, job, cut, part, block, claim=claim, transforms=True, priority=later)
                for part in range(layout.parts)
            ]
            total = self._sum(pieces, claim, later + 1)
            parts.append(self._submit(store_block, job, cut, total, block, claim=claim, priority=later + 1))
        return self._submit(finish_mesh, job, parts, priority=first)

    def _sum(self, partials: Sequence[Future], claim: float, priority: int) -> Future:
        """Add in pairs, pairs of pairs and so on: no task waits for more than two others."""
        level = list(partials)
        while len(level) > 1:
            pairs = [level[k : k + 2] for k in range(0, len(level), 2)]
            level = [
                self._submit(add_partials, *pair, claim=claim, priority=priority) if len(pair) > 1 else pair[0]
                for pair in pairs
            ]
        return level[0]

    def _submit(
        self,
        task: Callable[..., Any],
        *arguments: Any,
        claim: float = 0.0,
        transforms: bool = False,
        priority: int = 0,
    ) -> Future:
        resources = {}
        if self.claims_memory and claim:
            resources[MEMORY] = claim
        if self.claims_gpu and transforms:
            resources[GPU] = 1.0
        return self.client.submit(task, *arguments, pure=False, priority=priority, resources=resources or None)
