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

from sobolev_batch.batch.fields.tasks import Job, StoredBlocks, facts_of, finish_octaves
from sobolev_batch.batch.store.records import Facts
from sobolev_batch.errors import MeshError, StoreError
from sobolev_batch.spectral.errors.a_priori import ErrorTarget
from sobolev_batch.spectral.errors.probe import Draws, Probe, measure
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.errors.samples import draws_for
from sobolev_batch.spectral.exact.triangles import exact_transform
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.octaves.limit import EnergyLimit
from sobolev_batch.spectral.octaves.values import OctaveValues, octave_values
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import require_inside, transform_block
from sobolev_batch.surfaces.shapes.mesh import Mesh

# Comparisons of a batch with exact values on each lattice of an octave.
_OCTAVE_CHECKS = 4

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
        octave_target: Largest error of the whole mesh's values in each octave, if an accuracy is asked for.
    """

    token: str = ""
    batches: frozenset[int] = frozenset()
    transform: TransformSettings | None = None
    draws: Draws | None = None
    facts: Facts = field(default_factory=Facts)
    quality: Quality | None = None
    seconds: float = 0.0
    error: str = ""
    octave_target: ErrorTarget | None = None


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
        facts, quality = facts_of(mesh, 0), Quality.from_surface(mesh, Probe())
        octave_target = None if job.settings.tail is None else job.octave_target(mesh)
        token, batches = uuid4().hex, set()
        for number, batch in mesh.batches(math.ceil(len(mesh.triangles) / count)):
            job.store.scratch.write(job.index, token, number, batch)
            batches.add(number)
    except StoreError:
        raise
    except Exception as error:
        return SplitMesh(seconds=time.perf_counter() - started, error=job.failure_reason(error))
    seconds = time.perf_counter() - started
    return SplitMesh(token, frozenset(batches), transform, draws, facts, quality, seconds, "", octave_target)


def transform_batch(job: Job, split: SplitMesh, number: int, block: Block) -> BlockSum:
    """Transform one batch onto one block of the lattice."""
    if split.error or number not in split.batches or split.transform is None or split.draws is None:
        return BlockSum()
    started = time.perf_counter()
    lattice = job.settings.lattice
    try:
        batch = job.store.scratch.read(job.index, split.token, number)
        result = transform_block(batch, lattice, block, split.transform, job.execution)
        exact = exact_transform(batch, split.draws.within(block).frequencies)
    except StoreError:
        raise
    except Exception as error:
        return BlockSum(seconds=time.perf_counter() - started, error=job.failure_reason(error))
    return BlockSum(result.values, exact, result.points, (result.backend,), time.perf_counter() - started)


def octaves_of_batches(job: Job, split: SplitMesh) -> StoredBlocks:
    """Compute and store the values of a split mesh in octaves, batch after batch."""
    tail = job.settings.tail
    if split.error or split.quality is None or tail is None:
        return StoredBlocks(Facts(), 0.0, split.error or "the study has no octaves")
    started = time.perf_counter()
    # The errors of the batches add up.
    target = None if split.octave_target is None else split.octave_target.tightened(len(split.batches))
    settings = job.octave_settings(target)
    totals: list[OctaveValues] = []
    try:
        for number in sorted(split.batches):
            batch = job.store.scratch.read(job.index, split.token, number)
            values = [
                octave_values(batch, octave, job.settings.orders, settings, job.execution, checks=_OCTAVE_CHECKS)
                for octave in tail.sampled
            ]
            totals = [one + other for one, other in zip(totals, values, strict=True)] if totals else values
    except StoreError:
        raise
    except Exception as error:
        return StoredBlocks(Facts(), time.perf_counter() - started, job.failure_reason(error))
    # Its triangles are taken to coincide with no others: to look that up would take the whole mesh.
    stored = finish_octaves(job, split.quality, totals, EnergyLimit(2 * split.quality.area), None)
    return replace(stored, seconds=time.perf_counter() - started)


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
