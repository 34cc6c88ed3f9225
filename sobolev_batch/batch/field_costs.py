"""What the tasks of fields take: the memory that they are sized by, and the time that they are predicted to need."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.errors import ClusterError
from sobolev_batch.norms.tail.values import SurfaceSize
from sobolev_batch.sources.registry import ExpectedSize
from sobolev_batch.study.plan import Plan, Row
from sobolev_batch.transform.fourier import TransformSettings, field_seconds, projected_bytes
from sobolev_batch.transform.lattice import Block

# Bytes of a triangle while its mesh is described and moved to the study's unit, at the measured peak.
MESH_BYTES = 100.0
# With less, the batches of points of a transform become so small that it is slow.
_LEAST_TRANSFORM_BYTES = 256e6
# Bytes of a triangle while quadrature rules are chosen.
_CHOICE_BYTES = 100.0
# Bytes of a sample of octaves: its frequency, weight, place and value, and what makes them.
_SAMPLE_BYTES = 150.0
# Time to describe and record a surface, and that of each of its triangles.
_ROW_SECONDS, _TRIANGLE_SECONDS = 0.015, 5e-6
# Time to compare one with the reference beyond octaves: 0.15 to 0.9 s up to 80,000 triangles, 0.3 s for most.
_COMPARING_SECONDS = 0.3
# Groups of blocks of the lattice. The blocks of a group are computed in one task.
BlockGroups = tuple[tuple[Block, ...], ...]
# Tasks that compare their surface with the reference load it too, unless it has more triangles.
_LARGEST_REFERENCE = 3 << 20


class TaskSizes(NamedTuple):
    """Sizes of the tasks of a row: its groups, the memory of one transform besides mesh and block, and of a task."""

    groups: BlockGroups
    allowed_bytes: float
    task_bytes: float


def is_predictable(row: Row) -> bool:
    """Tell whether the size of a surface is known before it is made: nobody knows how long a program takes."""
    return row.member.expected_size().is_known


def size_rows(plan: Plan, rows: Sequence[Row], workers: Workers) -> tuple[dict[str, TaskSizes], dict[str, str]]:
    """Return what the tasks of rows take, by their labels, and the reason for each row that fits into no worker."""
    octaves, samples = ((), 0) if plan.tail is None else (plan.tail.octaves, plan.tail.size)
    blocks = [plan.blocks[0], *(lattice.half for octave in octaves for lattice in octave.lattices)]
    reference = reference_in_tasks(plan)
    triangles = 0 if reference is None else reference.member.expected_size().triangles
    beyond = max(blocks, key=lambda block: block.size), _SAMPLE_BYTES * samples + MESH_BYTES * triangles

    def sizes_for(size: ExpectedSize) -> TaskSizes:
        return size_tasks(plan.blocks, plan.transform, size, workers, len(rows), beyond)

    # Where not even a mesh without triangles fits, the lattice is too large: a ClusterError for all rows.
    sizes_for(ExpectedSize())
    sizes, refused = {}, {}
    for row in rows:
        try:
            sizes[row.label] = sizes_for(row.member.expected_size())
        except ClusterError as error:
            refused[row.label] = f"the mesh is too large: {error}"
    return sizes, refused


def reference_in_tasks(plan: Plan) -> Row | None:
    """Return the reference, where tasks compare their surface with it beyond the lattice; None if it is huge."""
    row = next(row for row in plan.rows if row.label == plan.reference)
    is_small = row.member.expected_size().triangles <= _LARGEST_REFERENCE
    return row if (plan.tail is not None or plan.choice.compared_with) and is_small else None


def size_tasks(
    blocks: Sequence[Block],
    transform: TransformSettings,
    size: ExpectedSize,
    workers: Workers,
    rows: int,
    beyond: tuple[Block, float],
) -> TaskSizes:
    """Fit a row's tasks into the memory of workers.

    Each task holds the mesh. Its transform adds up batches of points, as large as the memory allows. Every task is kept
    within what a worker has for each of its threads, as long as that leaves a transform enough to work in; a task that
    takes more runs beside fewer others. Beyond the lattice are the largest block that is transformed, and the bytes
    that are held besides: samples in octaves, and the reference.
    """
    block, beyond_bytes = beyond
    block_bytes = float(block.size * np.dtype(transform.dtype).itemsize)
    mesh_bytes = MESH_BYTES * size.triangles
    # The mesh, the block, and a block that it is added to or compared with.
    held_bytes = mesh_bytes + 2 * block_bytes + beyond_bytes
    least_bytes = _LEAST_TRANSFORM_BYTES + _CHOICE_BYTES * size.triangles
    loading_bytes = max(size.projected_bytes, mesh_bytes)
    workers.require_memory(max(loading_bytes, held_bytes + least_bytes))
    allowed_bytes = max(least_bytes, workers.allowed_bytes_per_task - held_bytes)
    # The transform seldom takes all that it may, but a mesh may turn out larger than its file suggested.
    wanted_bytes = projected_bytes(block, transform, triangles=size.triangles) - block_bytes
    computing_bytes = held_bytes + min(allowed_bytes, max(wanted_bytes, least_bytes))
    # A task computes as many blocks as leaves two tasks for every thread: each task loads the mesh anew.
    count = min(len(blocks), max(1, math.ceil(2 * workers.threads / max(rows, 1))))
    ends = [len(blocks) * k // count for k in range(count + 1)]
    groups = tuple(tuple(blocks[first:last]) for first, last in pairwise(ends))
    return TaskSizes(groups, allowed_bytes, max(loading_bytes, computing_bytes))


def row_seconds(plan: Plan, row: Row) -> float:
    """Return the predicted time of a row's tasks, on the machine that constants were measured on."""
    expected = row.member.expected_size()
    size = SurfaceSize(expected.triangles, plan.reference_area)
    # An accuracy takes coarser settings where it can; what they save is little beside octaves.
    transform = field_seconds(expected.triangles, plan.reference_area, plan.lattice, plan.transform)
    octaves = () if plan.tail is None else plan.tail.octaves
    comparing = _COMPARING_SECONDS if octaves and row.label != plan.reference else 0.0
    sampling = sum(size.sampling_seconds(octave) for octave in octaves) + comparing
    return _ROW_SECONDS + _TRIANGLE_SECONDS * expected.triangles + expected.seconds + transform + sampling
