"""The field of a row as a graph of tasks, each with the memory and the device that it takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sobolev_batch.batch.cluster.execution import Task
from sobolev_batch.batch.fields.large_mesh import add_sums, octaves_of_batches, split_mesh, store_block, transform_batch
from sobolev_batch.batch.fields.sizing import TaskSizes
from sobolev_batch.batch.fields.tasks import Job, compute_blocks, compute_mesh, compute_octaves, finish_mesh


def field_task(job: Job, sizes: TaskSizes, rank: int = 0) -> Task:
    """Return the task that computes and stores a field, after those that it depends on.

    The result is the completion record of the field.

    Args:
        job: Field to compute.
        sizes: Tasks to compute it by.
        rank: Fields of lower rank come first.
    """
    if sizes.batches > 1:
        return _Batches(job, sizes, rank).field_task()
    needs_gpu = job.settings.backend == "gpu"
    if len(sizes.block_groups) == 1:
        (blocks,) = sizes.block_groups
        return Task(compute_mesh, (job, blocks), sizes.loading_bytes, needs_gpu, row=job.index, label=job.row.label)
    groups = [Task(compute_blocks, (job, blocks), sizes.loading_bytes, needs_gpu) for blocks in sizes.block_groups]
    if job.settings.tail is not None:
        groups.append(Task(compute_octaves, (job,), sizes.loading_bytes, needs_gpu))
    return Task(finish_mesh, (job, groups), row=job.index, label=job.row.label)


@dataclass(frozen=True)
class _Batches:
    """The tasks of a field whose mesh is split into batches."""

    job: Job
    sizes: TaskSizes
    rank: int

    def field_task(self) -> Task:
        # Mesh after mesh and block after block, and sums before further batches: what waits to be added
        # up waits in memory.
        blocks = [block for group in self.sizes.block_groups for block in group]
        first = -2 * self.rank * (len(blocks) + 1)
        split = Task(split_mesh, (self.job, self.sizes.batches), self.sizes.loading_bytes, priority=first)
        stored = []
        for number, block in enumerate(blocks, 1):
            priority = first - 2 * number
            sums = [self._transform(split, batch, block, priority) for batch in range(self.sizes.batches)]
            total = self._sum(sums, priority + 1)
            arguments = self.job, split, total, block
            stored.append(Task(store_block, arguments, self.sizes.batch_bytes, priority=priority + 1))
        if self.job.settings.tail is not None:
            needs_gpu = self.job.settings.backend == "gpu"
            last = first - 2 * len(blocks) - 1
            stored.append(Task(octaves_of_batches, (self.job, split), self.sizes.batch_bytes, needs_gpu, priority=last))
        row = self.job.row
        return Task(finish_mesh, (self.job, stored), priority=first, row=self.job.index, label=row.label)

    def _transform(self, split: Task, batch: int, block: object, priority: int) -> Task:
        needs_gpu = self.job.settings.backend == "gpu"
        return Task(transform_batch, (self.job, split, batch, block), self.sizes.batch_bytes, needs_gpu, priority)

    def _sum(self, sums: Sequence[Task], priority: int) -> Task:
        """Add in pairs, pairs of pairs and so on: no task waits for more than two others."""
        if len(sums) == 1:
            return sums[0]
        pairs = [tuple(sums[k : k + 2]) for k in range(0, len(sums), 2)]
        return self._sum(
            [
                Task(add_sums, pair, self.sizes.batch_bytes, priority=priority) if len(pair) > 1 else pair[0]
                for pair in pairs
            ],
            priority,
        )
