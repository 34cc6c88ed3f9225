"""A huge mesh as many tasks: cut once into pieces, transformed piece by piece, added up by a tree.

The pieces lie in the store's scratch space while they are needed, so that each task reads its own and
nothing hangs on the worker that cut the mesh.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.cluster.worker_plugin import backend_of
from sobolev_batch.batch.fields.tasks import Job, Part, facts_of, load_surface, reason_of, settings_of
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
class Cut:
    """A mesh that was cut: everything about it but its triangles.

    Attributes:
        token: tells its pieces from those of any other cut.
        there: the numbers of the pieces that have triangles with an area.
        settings: of the transform of every piece.
        draws: the frequencies at which the field is probed.
        facts: of the whole mesh.
        quality: likewise, with an empty probe; None where the cut failed.
        seconds: spent.
        error: why it failed; empty otherwise.
    """

    token: str = ""
    there: frozenset[int] = frozenset()
    settings: TransformSettings | None = None
    draws: Draws | None = None
    facts: Facts = field(default_factory=Facts)
    quality: Quality | None = None
    seconds: float = 0.0
    error: str = ""


@dataclass(frozen=True, eq=False)
class Partial:
    """What some pieces add to one block of a field.

    Attributes:
        values: complex (block.shape); None where they add nothing.
        exact: complex128, the exact transform of the pieces at the block's draws, or 0.
        points: of the quadrature.
        backends: that computed it.
        seconds: spent.
        error: why it failed; empty otherwise.
    """

    values: Complexes | None = None
    exact: NDArray[np.complex128] | complex = 0j
    points: int = 0
    backends: tuple[str, ...] = ()
    seconds: float = 0.0
    error: str = ""

    def __sizeof__(self) -> int:
        # Dask asks, to know what its workers hold.
        return 0 if self.values is None else self.values.nbytes


def cut_mesh(job: Job, count: int) -> Cut:
    """Make a mesh, describe it, and store it as at most ``count`` pieces of equally many triangles."""
    started = time.perf_counter()
    try:
        mesh = load_surface(job)
        if not isinstance(mesh, Mesh):
            raise MeshError("a closed-form surface cannot be cut into pieces")
        require_inside(mesh, job.lattice)
        settings = settings_of(job, mesh)
        draws = draws_for([mesh], job.lattice, job.orders, settings.lowest_degree(mesh, job.lattice))
        facts, quality = facts_of(mesh, 0), Quality.of_surface(mesh, Probe())
        size = math.ceil(len(mesh.triangles) / count)
        token, there = uuid4().hex, set()
        for number, piece in mesh.batches(size):
            job.store.scratch.write(job.row, token, number, piece)
            there.add(number)
    except StoreError:
        raise
    except Exception as error:
        return Cut(seconds=time.perf_counter() - started, error=reason_of(job, error))
    return Cut(token, frozenset(there), settings, draws, facts, quality, time.perf_counter() - started)


def transform_piece(job: Job, cut: Cut, number: int, block: Block) -> Partial:
    """Transform one piece onto one block of the lattice."""
    if cut.error or number not in cut.there or cut.settings is None or cut.draws is None:
        return Partial()
    started = time.perf_counter()
    try:
        piece = job.store.scratch.read(job.row, cut.token, number)
        execution = Execution(backend_of(job.backend), allowed_bytes=job.memory)
        made = transform_block(piece, job.lattice, block, cut.settings, execution)
        exact = exact_transform(piece, cut.draws.within(block).frequencies)
    except StoreError:
        raise
    except Exception as error:
        return Partial(seconds=time.perf_counter() - started, error=reason_of(job, error))
    return Partial(made.values, exact, made.points, (made.backend,), time.perf_counter() - started)


def add_partials(first: Partial, second: Partial) -> Partial:
    """The sum of two partial blocks."""
    started = time.perf_counter()
    if first.values is None or second.values is None:
        values = second.values if first.values is None else first.values
    else:
        values = first.values + second.values
    return Partial(
        values,
        first.exact + second.exact,
        first.points + second.points,
        (*first.backends, *second.backends),
        first.seconds + second.seconds + time.perf_counter() - started,
        first.error or second.error,
    )


def store_block(job: Job, cut: Cut, total: Partial, block: Block) -> Part:
    """Store a block that all pieces were added to, and probe it."""
    error = cut.error or total.error
    # The cut counts once, with the first block.
    seconds = total.seconds + (cut.seconds if block.start == job.lattice.half.start else 0.0)
    if error or cut.draws is None or cut.quality is None or total.values is None:
        return Part(Facts(), seconds, error or "no part of the mesh has an area")
    started = time.perf_counter()
    checksum = job.store.write_field(job.row, job.lattice.place(block), total.values)
    draws = cut.draws.within(block)
    probe = measure(draws, total.values[draws.places(block)], np.asarray(total.exact))
    return Part(
        replace(cut.facts, points=total.points),
        seconds + time.perf_counter() - started,
        quality=replace(cut.quality, probe=probe),
        checksums=(checksum,),
        backends=total.backends,
    )
