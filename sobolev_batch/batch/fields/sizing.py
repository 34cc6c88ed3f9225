"""The tasks of one row: batches of its triangles, blocks of the lattice, and their memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.errors import ClusterError
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import projected_bytes
from sobolev_batch.surfaces.sources.registry import ExpectedSize

# Meshes above one and a half times this are split into batches of about this many triangles, whatever the
# cluster, so that the same sums are formed on any; smaller ones only where memory is short. The
# transform of such a batch takes seconds, its FFT a small fraction of them.
_BATCH_TRIANGLES = 1 << 21
_FEWEST_TRIANGLES = 1 << 16
# Measured peak of describing a mesh and moving it to the study's unit, for each triangle.
MESH_BYTES = 100.0
# With less, the batches of points of a transform become so small that it is slow.
LEAST_TRANSFORM_BYTES = 256e6
# For the choice of quadrature rules, for each triangle.
_CHOICE_BYTES = 100.0
# Of a sample of octaves: its frequency, weight, place and value, and what makes them.
_SAMPLE_BYTES = 150.0


@dataclass(frozen=True)
class TaskSizes:
    """The tasks of one row.

    Attributes:
        batches: Number of batches of triangles, each transformed in a task of its own; 1 leaves the mesh whole.
        block_groups: Groups of blocks. The blocks of a group are computed in one task.
        allowed_bytes: Memory that one transform may take besides its mesh and its block.
        loading_bytes: Projected memory of the task that loads the mesh.
        batch_bytes: Projected memory of any other task; the same where the mesh is whole.
        octave_tasks: Number of tasks of their own for octaves, where the field has more than one task.
    """

    batches: int
    block_groups: tuple[tuple[Block, ...], ...]
    allowed_bytes: float
    loading_bytes: float
    batch_bytes: float
    octave_tasks: int = 0

    @property
    def projected_bytes(self) -> float:
        """Memory of the largest task."""
        return max(self.loading_bytes, self.batch_bytes)

    @property
    def task_count(self) -> int:
        """Number of tasks."""
        if self.batches == 1:
            # Several groups have a task for the record too.
            return 1 if len(self.block_groups) == 1 else len(self.block_groups) + 1 + self.octave_tasks
        # Batches, their sums in pairs, and the storing of each block; the split and the record.
        return 2 * self.batches * sum(map(len, self.block_groups)) + 2 + self.octave_tasks


def size_rows(plan: Plan, rows: Sequence[Row], workers: Workers) -> tuple[dict[str, TaskSizes], dict[str, str]]:
    """Return the tasks of rows by their labels, and the reason for each row that fits into no worker.

    Raises:
        ClusterError: The lattice itself fits into no worker, whatever the mesh.
    """
    held = _OctaveBytes.of(plan)
    size_tasks(plan.blocks, plan.transform, ExpectedSize(), workers, len(rows), held)
    sizes, refused = {}, {}
    for row in rows:
        size = row.member.expected_size()
        try:
            sizes[row.label] = size_tasks(plan.blocks, plan.transform, size, workers, len(rows), held)
        except ClusterError as error:
            refused[row.label] = f"the mesh is too large: {error}"
    return sizes, refused


def reference_in_tasks(plan: Plan) -> Row | None:
    """Return the reference as tasks of octaves load it beside their mesh; None without octaves, or if it is huge."""
    row = next(row for row in plan.rows if row.label == plan.reference)
    is_small = row.member.expected_size().triangles <= 1.5 * _BATCH_TRIANGLES
    return row if plan.tail is not None and is_small else None


@dataclass(frozen=True)
class _OctaveBytes:
    """Memory that the octaves of a plan take in a task.

    Attributes:
        block: Samples of the largest lattice; None without one.
        held: Bytes of all samples, their values, and the reference.
    """

    block: Block | None = None
    held: float = 0.0

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Return the memory for a plan; none without octaves."""
        if plan.tail is None:
            return cls()
        blocks = [lattice.half for sampling in plan.tail.octaves for lattice in sampling.lattices]
        reference = reference_in_tasks(plan)
        triangles = 0 if reference is None else reference.member.expected_size().triangles
        largest = max(blocks, key=lambda block: block.size, default=None)
        return cls(largest, _SAMPLE_BYTES * plan.tail.size + MESH_BYTES * triangles)


def size_tasks(
    blocks: Sequence[Block],
    transform: TransformSettings,
    size: ExpectedSize,
    workers: Workers,
    rows: int,
    octaves: _OctaveBytes | None = None,
) -> TaskSizes:
    """Fit a row's tasks into the memory of workers.

    Every task is kept within what a worker has for each of its threads, as long as that leaves a
    transform enough to work in; a task that takes more runs beside fewer others.

    Args:
        blocks: Blocks of the lattice, all but the last of equal size.
        transform: Settings of the fields.
        size: Size of the row's surface.
        workers: Workers of the cluster.
        rows: Number of rows that are to be computed.
        octaves: Memory that octaves take.

    Raises:
        ClusterError: No worker has the memory.
    """
    octaves = octaves or _OctaveBytes()
    block = max(blocks[0], octaves.block or blocks[0], key=lambda one: one.size)
    block_bytes = float(block.size * np.dtype(transform.dtype).itemsize)

    def transform_bytes(triangles: float) -> float:
        return LEAST_TRANSFORM_BYTES + _CHOICE_BYTES * triangles

    def held_bytes(triangles: float) -> float:
        # The mesh, the block, and a block that it is added to or compared with.
        return MESH_BYTES * triangles + 2 * block_bytes + octaves.held

    def least_bytes(triangles: float) -> float:
        return held_bytes(triangles) + transform_bytes(triangles)

    fits = least_bytes(size.triangles) <= workers.largest_allowed_bytes
    whole = size.triangles <= 1.5 * _BATCH_TRIANGLES and fits
    batch = size.triangles if whole else _BATCH_TRIANGLES
    while not whole and least_bytes(batch) > workers.allowed_bytes_per_task and batch > _FEWEST_TRIANGLES:
        batch //= 2
    loading_bytes = max(size.projected_bytes, MESH_BYTES * size.triangles)
    workers.require_memory(max(loading_bytes, least_bytes(batch)))
    allowed_bytes = max(transform_bytes(batch), workers.allowed_bytes_per_task - held_bytes(batch))
    # The transform seldom takes all that it may, but a mesh may turn out larger than its file suggested.
    wanted_bytes = projected_bytes(block, transform, triangles=batch) - block_bytes
    batch_bytes = held_bytes(batch) + min(allowed_bytes, max(wanted_bytes, transform_bytes(batch)))
    batches = 1 if whole else max(1, math.ceil(size.triangles / batch))
    # A task computes as many blocks as leaves two tasks for every thread: each task loads the mesh anew.
    count = len(blocks) if batches > 1 else min(len(blocks), max(1, math.ceil(2 * workers.threads / max(rows, 1))))
    ends = [len(blocks) * k // count for k in range(count + 1)]
    groups = tuple(tuple(blocks[first:last]) for first, last in pairwise(ends))
    if batches == 1:
        loading_bytes = max(loading_bytes, batch_bytes)
    return TaskSizes(batches, groups, allowed_bytes, loading_bytes, batch_bytes, octave_tasks=int(octaves.held > 0))
