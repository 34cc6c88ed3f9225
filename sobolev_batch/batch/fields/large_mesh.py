"""A huge mesh as many tasks: split once into batches of triangles, transformed by batches, added up by a tree.

The batches lie in the store's scratch space while they are needed, so that each task reads its own and
nothing depends on the worker that split the mesh.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.cluster.worker_plugin import worker_backend
from sobolev_batch.batch.fields.tasks import Job, StoredBlocks, facts_of
from sobolev_batch.batch.store.records import Facts
from sobolev_batch.errors import MeshError, StoreError
from sobolev_batch.spectral.errors.probe import Draws, Probe, measure
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.errors.samples import draws_for
from sobolev_batch.spectral.exact.triangles import exact_transform
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.spectral.transform.transform import require_inside, transform_block
from sobolev_batch.surfaces.shapes.mesh import Mesh

Complexes = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class SplitMesh:
    """A mesh that was split into batches: all of it but the triangles.

    Attributes:
        token: Mark of its batches, different from that of any other split.
        batches: Numbers of the batches that have triangles with an area.
        transform: Settings of the transform of every batch.
        draws: Frequencies at which the field is probed, drawn once for all batches and blocks.
        facts: Facts of the whole mesh.
        quality: Quality of the whole mesh with an empty probe; None where the split failed.
        seconds: Time spent.
        error: Reason why it failed; empty otherwise.
    """

    token: str = ""
    batches: frozenset[int] = frozenset()
    transform: TransformSettings | None = None
    draws: Draws | None = None
    facts: Facts = field(default_factory=Facts)
    quality: Quality | None = None
    seconds: float = 0.0
    error: str = ""


@dataclass(frozen=True, eq=False)
class BlockSum:
    """The sum of the transforms of some batches on one block of a field.

    Attributes:
        values: complex (block.shape); None where they add nothing.
        exact: complex128, exact transform of the batches at the draws in the block, or 0.
        points: Number of quadrature points.
        backends: Backends that computed it.
        seconds: Time spent.
        error: Reason why it failed; empty otherwise.
    """

    values: Complexes | None = None
    exact: NDArray[np.complex128] | complex = 0j
    points: int = 0
    backends: tuple[str, ...] = ()
    seconds: float = 0.0
    error: str = ""

    def __sizeof__(self) -> int:
        # Dask asks, to know the memory of its workers.
        return 0 if self.values is None else self.values.nbytes


def split_mesh(job: Job, count: int) -> SplitMesh:
    """Load a mesh, describe it, and store it as at most ``count`` batches of equally many triangles."""
    started = time.perf_counter()
    lattice = job.settings.lattice
    try:
        mesh = job.load()
        if not isinstance(mesh, Mesh):
            raise MeshError("a closed-form surface cannot be split into batches of triangles")
        require_inside(mesh, lattice)
        transform = job.transform_settings(mesh)
        draws = draws_for([mesh], lattice, job.settings.orders, transform.lowest_degree(mesh, lattice))
        facts, quality = facts_of(mesh, 0), Quality.of_surface(mesh, Probe())
        token, batches = uuid4().hex, set()
        for number, batch in mesh.batches(math.ceil(len(mesh.triangles) / count)):
            job.store.scratch.write(job.index, token, number, batch)
            batches.add(number)
    except StoreError:
        raise
    except Exception as error:
        return SplitMesh(seconds=time.perf_counter() - started, error=job.failure_reason(error))
    return SplitMesh(token, frozenset(batches), transform, draws, facts, quality, time.perf_counter() - started)


def transform_batch(job: Job, split: SplitMesh, number: int, block: Block) -> BlockSum:
    """Transform one batch onto one block of the lattice."""
    if split.error or number not in split.batches or split.transform is None or split.draws is None:
        return BlockSum()
    started = time.perf_counter()
    lattice = job.settings.lattice
    execution = Execution(worker_backend(job.settings.backend), allowed_bytes=job.allowed_bytes)
    try:
        batch = job.store.scratch.read(job.index, split.token, number)
        result = transform_block(batch, lattice, block, split.transform, execution)
        exact = exact_transform(batch, split.draws.within(block).frequencies)
    except StoreError:
        raise
    except Exception as error:
        return BlockSum(seconds=time.perf_counter() - started, error=job.failure_reason(error))
    return BlockSum(result.values, exact, result.points, (result.backend,), time.perf_counter() - started)


def add_sums(first: BlockSum, second: BlockSum) -> BlockSum:
    """Add two sums for the same block."""
    started = time.perf_counter()
    if first.values is None or second.values is None:
        values = second.values if first.values is None else first.values
    else:
        values = first.values + second.values
    return BlockSum(
        values,
        first.exact + second.exact,
        first.points + second.points,
        (*first.backends, *second.backends),
        first.seconds + second.seconds + time.perf_counter() - started,
        first.error or second.error,
    )


def store_block(job: Job, split: SplitMesh, total: BlockSum, block: Block) -> StoredBlocks:
    """Store a block that the transforms of all batches were added to, and probe it."""
    error = split.error or total.error
    lattice = job.settings.lattice
    # The split counts once, with the first block.
    seconds = total.seconds + (split.seconds if block.start == lattice.half.start else 0.0)
    if error or split.draws is None or split.quality is None or total.values is None:
        return StoredBlocks(Facts(), seconds, error or "no triangle of the mesh has an area")
    started = time.perf_counter()
    checksum = job.store.write_field(job.index, lattice.place(block), total.values)
    draws = split.draws.within(block)
    probe = measure(draws, total.values[draws.places(block)], np.asarray(total.exact))
    return StoredBlocks(
        replace(split.facts, points=total.points),
        seconds + time.perf_counter() - started,
        quality=replace(split.quality, probe=probe),
        checksums=(checksum,),
        backends=total.backends,
    )
