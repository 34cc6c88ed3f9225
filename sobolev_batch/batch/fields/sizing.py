"""How the field of one row becomes tasks: parts of its mesh, blocks of the lattice, and their memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.errors import ClusterError
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import projected_bytes
from sobolev_batch.surfaces.sources.registry import ExpectedSize

# Meshes above one and a half times this are cut into parts of about this many triangles, whatever the
# cluster, so that the same sums are formed on any; smaller ones only where memory is short. The
# transform of such a part takes seconds, its FFT a small part of them.
_PART_TRIANGLES = 1 << 21
_FEWEST_TRIANGLES = 1 << 16
# Measured peak of describing a mesh and moving it to the study's unit, for each triangle.
MESH_BYTES = 100.0
# Less makes a transform's batches and parts of a block so small that it becomes slow.
LEAST_ROOM_BYTES = 256e6
# Of the choice of rules, for each triangle.
_CHOICE_BYTES = 100.0


@dataclass(frozen=True)
class Layout:
    """The tasks of one row.

    Attributes:
        parts: of the mesh, each transformed in a task of its own; 1 leaves it whole.
        groups: of blocks, those of one group in one task.
        transform_bytes: what one transform may take, besides its mesh and its block.
        making_bytes: what the task takes that makes the mesh.
        task_bytes: what any other takes at most; the same where the mesh is whole.
    """

    parts: int
    groups: tuple[tuple[Block, ...], ...]
    transform_bytes: float
    making_bytes: float
    task_bytes: float

    @property
    def largest_bytes(self) -> float:
        """What the most demanding task takes."""
        return max(self.making_bytes, self.task_bytes)

    @property
    def task_count(self) -> int:
        """How many tasks it makes."""
        if self.parts == 1:
            return len(self.groups) + (len(self.groups) > 1)
        # Parts, their sums in pairs, and the storing of each block; the cut and the record.
        return 2 * self.parts * sum(map(len, self.groups)) + 2


def lay_out_rows(plan: Plan, rows: Sequence[Row], crew: Workers) -> tuple[dict[str, Layout], dict[str, str]]:
    """The layouts of rows by their labels, and for each that fits into no worker the reason.

    Raises:
        ClusterError: the lattice itself fits into no worker, whatever the mesh.
    """
    lay_out(plan.blocks, plan.transform, ExpectedSize(), crew, len(rows))
    layouts, refused = {}, {}
    for row in rows:
        try:
            layouts[row.label] = lay_out(plan.blocks, plan.transform, row.member.expected_size(), crew, len(rows))
        except ClusterError as error:
            refused[row.label] = f"the mesh is too large: {error}"
    return layouts, refused


def lay_out(
    blocks: Sequence[Block], transform: TransformSettings, size: ExpectedSize, crew: Workers, rows: int
) -> Layout:
    """Fit a row's tasks into the memory of workers.

    Every task is kept within what a worker has for each of its threads, as long as that leaves a
    transform enough to work in; a task that needs more runs beside fewer others.

    Args:
        blocks: of the lattice, all but the last equal.
        transform: settings of the fields.
        size: of the row's surface.
        crew: the workers.
        rows: how many rows are to be computed.

    Raises:
        ClusterError: no worker has the memory that it takes.
    """
    block = blocks[0]
    block_bytes = float(block.size * np.dtype(transform.dtype).itemsize)

    def least(triangles: float) -> float:
        return LEAST_ROOM_BYTES + _CHOICE_BYTES * triangles

    def fixed(triangles: float) -> float:
        # The block and what it is added to or compared with.
        return MESH_BYTES * triangles + 2 * block_bytes

    whole = size.triangles <= 1.5 * _PART_TRIANGLES and (
        fixed(size.triangles) + least(size.triangles) <= crew.largest_bytes
    )
    part = size.triangles if whole else _PART_TRIANGLES
    while not whole and fixed(part) + least(part) > crew.share_bytes and part > _FEWEST_TRIANGLES:
        part //= 2
    making = max(size.projected_bytes, MESH_BYTES * size.triangles)
    needed = max(making, fixed(part) + least(part))
    if needed > crew.largest_bytes:
        raise ClusterError(
            f"it takes about {needed / 1e9:.2g} GB in one task, and no worker has more than "
            f"{crew.largest_bytes / 1e9:.2g} GB to spare (of its limit it keeps 15 % and 0.3 GB for itself); "
            "start workers with more memory"
        )
    room = max(least(part), crew.share_bytes - fixed(part))
    # Not all of the room is taken, but a mesh may turn out larger than its file suggested.
    wanted = projected_bytes(block, transform, triangles=part) - block_bytes
    task = fixed(part) + min(room, max(wanted, least(part)))
    parts = 1 if whole else max(1, math.ceil(size.triangles / part))
    # A task computes as many blocks as leaves two for every thread: each makes the mesh anew.
    count = len(blocks) if parts > 1 else min(len(blocks), max(1, math.ceil(2 * crew.threads / max(rows, 1))))
    ends = [len(blocks) * k // count for k in range(count + 1)]
    groups = tuple(tuple(blocks[first:last]) for first, last in pairwise(ends))
    return Layout(parts, groups, room, max(making, task) if parts == 1 else making, task)
