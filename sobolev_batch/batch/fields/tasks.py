"""The tasks of a field: they run on a worker, and turn a mesh's source into stored values and a completion record.

Each task is a pure function of its arguments that writes whole chunks, so running it again, or
twice at once, leaves the same store.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from distributed import get_worker

from sobolev_batch.batch.cluster.worker_plugin import worker_backend
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.plan import Plan, Row
from sobolev_batch.batch.study.schema import Backends
from sobolev_batch.errors import InputError, LatticeError, MeshError, StoreError, one_line
from sobolev_batch.spectral.adaptive.solve import DistanceTarget
from sobolev_batch.spectral.errors.a_priori import choose_settings
from sobolev_batch.spectral.errors.probe import join
from sobolev_batch.spectral.errors.quality import Quality
from sobolev_batch.spectral.errors.samples import draws_for, probe_block
from sobolev_batch.spectral.fields import compute_field, field_for
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.transform.settings import Execution, TransformSettings
from sobolev_batch.spectral.transform.transform import transform_block
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FieldSettings:
    """The settings that all fields of a plan share; see `Plan`."""

    lattice: Lattice
    transform: TransformSettings
    orders: tuple[float, ...]
    similarity: Similarity
    backend: Backends = "auto"

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Return the settings of a plan."""
        return cls(plan.lattice, plan.transform, plan.study.orders, plan.similarity, plan.study.backend)


@dataclass(frozen=True)
class Job:
    """The field of one row, and where it is stored.

    Attributes:
        store: Store of the field.
        index: Index of the row in the store.
        row: Row of the plan.
        settings: Settings of all fields.
        distance_target: Accuracy that the field is computed for, if the study asks for one.
        allowed_bytes: Memory that one transform may take besides its mesh and its block.
    """

    store: Store
    index: int
    row: Row
    settings: FieldSettings
    distance_target: DistanceTarget | None = None
    allowed_bytes: float | None = None

    def load(self) -> Surface:
        """Load the surface, in the study's unit.

        Raises:
            MeshError: It cannot be loaded, or is not the one that the study was planned with: its field would be
                recorded under the key of another.
        """
        surface = self.settings.similarity.apply(self.row.member.load())
        if self.row.fingerprint and self.row.member.fingerprint_digest() != self.row.fingerprint:
            raise MeshError("a file of it was changed while the study was going on; run the study again")
        return surface

    def transform_settings(self, surface: Surface) -> TransformSettings:
        """Return the settings of a field that is computed block by block, from its a priori error."""
        if self.distance_target is None or isinstance(surface, Sphere):
            return self.settings.transform
        return choose_settings(
            surface, self.settings.lattice, self.distance_target.error_target(surface), self.settings.transform
        )

    def failure_reason(self, error: Exception) -> str:
        """Return why the mesh failed, in one line, and log the traceback where its input is not to blame."""
        if isinstance(error, LatticeError):
            if self.distance_target is None:
                return str(error)
            return f"{error}; it was chosen for surfaces that reach less far: name another store"
        if isinstance(error, InputError):
            return str(error)
        _log.error("%s failed for a reason that is not its mesh's", self.row.label, exc_info=error)
        return one_line(error)


@dataclass(frozen=True)
class StoredBlocks:
    """The outcome of a task that stored blocks of a field; ``error`` is empty unless it failed."""

    facts: Facts
    seconds: float
    error: str = ""
    quality: Quality | None = None
    checksums: tuple[int, ...] = ()
    backends: tuple[str, ...] = ()


def compute_mesh(job: Job, blocks: Sequence[Block]) -> Record:
    """Compute and store the whole field of a mesh, then its completion record, unless that is there."""
    # Dask has a task done again whose worker was lost with the result.
    record = job.store.read_record(job.index)
    if record is not None and record.completes(job.row.key):
        return record
    return finish_mesh(job, [compute_blocks(job, blocks)])


def compute_blocks(job: Job, blocks: Sequence[Block]) -> StoredBlocks:
    """Compute and store some blocks of a mesh's field.

    A mesh that cannot be loaded or transformed does not raise: the reason is part of the outcome, so
    that one bad mesh stops nothing else.

    Raises:
        StoreError: The store cannot be written, which is not the mesh's fault.
    """
    started = time.perf_counter()
    try:
        surface = job.load()
        is_whole = tuple(blocks) == (job.settings.lattice.half,)
        stored = _store_whole(job, surface) if is_whole else _store_blocks(job, surface, blocks)
        facts = facts_of(surface, stored.facts.points)
        return replace(stored, facts=facts, seconds=time.perf_counter() - started)
    except StoreError:
        raise
    except Exception as error:
        return StoredBlocks(Facts(), time.perf_counter() - started, job.failure_reason(error))


def _store_whole(job: Job, surface: Surface) -> StoredBlocks:
    """Compute and store a field of one block; its facts have the number of points alone."""
    lattice, transform = job.settings.lattice, job.settings.transform
    execution = Execution(worker_backend(job.settings.backend), allowed_bytes=job.allowed_bytes)
    if job.distance_target is not None and not isinstance(surface, Sphere):
        error_target = job.distance_target.error_target(surface)
        field = field_for(surface, lattice, error_target, transform, execution)
    else:
        field = compute_field(surface, lattice, transform, job.settings.orders, execution)
    checksum = job.store.write_field(job.index, lattice.place(lattice.half), field.values)
    return StoredBlocks(Facts(points=field.points), 0.0, "", field.quality, (checksum,), (field.backend,))


def _store_blocks(job: Job, surface: Surface, blocks: Sequence[Block]) -> StoredBlocks:
    """Compute and store some of several blocks; the facts have the number of points alone."""
    lattice, orders = job.settings.lattice, job.settings.orders
    execution = Execution(worker_backend(job.settings.backend), allowed_bytes=job.allowed_bytes)
    transform = job.transform_settings(surface)
    plan = transform.plan(surface, lattice)
    draws = draws_for([surface], lattice, orders, plan.lowest_degree)
    probes, backends, checksums, points = [], [], [], 0
    for block in blocks:
        result = transform_block(surface, lattice, block, transform, execution, plan)
        checksums.append(job.store.write_field(job.index, lattice.place(block), result.values))
        probes.append(probe_block(surface, lattice, transform, orders, block, result.values, draws))
        backends.append(result.backend)
        points = result.points
    quality = Quality.of_surface(surface, join(probes))
    return StoredBlocks(Facts(points=points), 0.0, "", quality, tuple(checksums), tuple(backends))


def finish_mesh(job: Job, stored: Sequence[StoredBlocks]) -> Record:
    """Write the completion record of a mesh whose blocks are all stored, or that failed."""
    errors = [blocks.error for blocks in stored if blocks.error]
    backends = dict.fromkeys(backend for blocks in stored for backend in blocks.backends)
    record = Record(
        key=job.row.key,
        status="failed" if errors else "complete",
        reason=errors[0] if errors else "",
        facts=Facts() if errors else stored[0].facts,
        quality="" if errors else _joined_quality(stored).to_json(),
        checksums=() if errors else tuple(checksum for blocks in stored for checksum in blocks.checksums),
        seconds=sum(blocks.seconds for blocks in stored),
        worker=_worker_address(),
        backend=", ".join(backends),
        finished=utc_now(),
    )
    job.store.write_record(job.index, record)
    _log.info("%s: %s in %.2f s by %s", job.row.label, record.status, record.seconds, record.backend)
    return record


def _joined_quality(stored: Sequence[StoredBlocks]) -> Quality:
    qualities = [blocks.quality for blocks in stored if blocks.quality is not None]
    return replace(qualities[0], probe=join([quality.probe for quality in qualities]))


def facts_of(surface: Surface, points: int) -> Facts:
    """Return what is recorded of a surface and its quadrature points."""
    if not isinstance(surface, Mesh):
        return Facts(area=surface.area, points=points)
    (mean_length, longest), counts = surface.edge_length_range, surface.counts
    return Facts(
        vertices=len(surface.vertices),
        triangles=len(surface.triangles),
        area=surface.area,
        edge_length_mean=mean_length,
        edge_length_max=longest,
        zero_area_triangles=counts.zero_area,
        duplicate_triangles=counts.duplicate,
        boundary_edges=counts.boundary_edges,
        nonmanifold_edges=counts.nonmanifold_edges,
        digest=surface.digest,
        points=points,
    )


def _worker_address() -> str:
    try:
        return str(get_worker().address)
    except ValueError:  # called outside a cluster
        return "local"
