"""What runs on a worker: a mesh's source becomes its stored Fourier field and a completion record.

Each task is a pure function of its arguments that writes whole chunks, so running it again, or
twice at once, leaves the same store.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from distributed import get_worker

from sobolev_batch.batch.cluster.worker_plugin import backend_of
from sobolev_batch.batch.storage.timestamps import utc_now
from sobolev_batch.batch.store.records import Facts, Record
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.study.schema import Backends
from sobolev_batch.errors import InputError, LatticeError, MeshError, StoreError
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
from sobolev_batch.surfaces.sources.registry import Member

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """Everything that the field of one row depends on, where it goes, and what it may use.

    Attributes:
        store, row: where it goes.
        label: of the row, for people.
        key: of the row.
        member, similarity: the surface.
        lattice, transform, orders, aim: the field; see `Plan`.
        fingerprint: of the member when the study was planned; empty if that is not to be checked.
        memory: what one transform may take besides its mesh and its block, in bytes.
        backend: "auto", "cpu" or "gpu".
    """

    store: Store
    row: int
    label: str
    key: str
    member: Member
    similarity: Similarity
    lattice: Lattice
    transform: TransformSettings
    orders: tuple[float, ...]
    aim: DistanceTarget | None = None
    memory: float | None = None
    backend: Backends = "auto"
    fingerprint: str = ""


@dataclass(frozen=True)
class Part:
    """What one task did for a mesh; ``error`` is empty unless it failed."""

    facts: Facts
    seconds: float
    error: str = ""
    quality: Quality | None = None
    checksums: tuple[int, ...] = ()
    backends: tuple[str, ...] = ()


def compute_mesh(job: Job, blocks: Sequence[Block]) -> Record:
    """Compute and store the whole field of a mesh, then its completion record, unless that is there."""
    # Dask has a task done again whose worker was lost with the result.
    there = job.store.read_record(job.row)
    if there is not None and there.completes(job.key):
        return there
    return finish_mesh(job, [compute_blocks(job, blocks)])


def compute_blocks(job: Job, blocks: Sequence[Block]) -> Part:
    """Compute and store some blocks of a mesh's field.

    A mesh that cannot be made or transformed does not raise: the reason is part of the outcome, so
    that one bad mesh stops nothing else.

    Raises:
        StoreError: the store cannot be written, which is not the mesh's fault.
    """
    started = time.perf_counter()
    try:
        surface = load_surface(job)
        part = _compute(job, surface, blocks)
        return replace(part, facts=facts_of(surface, part.facts.points), seconds=time.perf_counter() - started)
    except StoreError:
        raise
    except Exception as error:
        return Part(Facts(), time.perf_counter() - started, reason_of(job, error))


def load_surface(job: Job) -> Surface:
    """The surface of a job, in the study's unit.

    Raises:
        MeshError: it cannot be made, or is not the one that the study was planned with: its field would be
            recorded under the key of another.
    """
    surface = job.similarity.apply(job.member.load())
    if job.fingerprint and job.member.fingerprint_digest() != job.fingerprint:
        raise MeshError("a file of it was changed while the study was going on; run the study again")
    return surface


def reason_of(job: Job, error: Exception) -> str:
    """Why a mesh failed, in one line; what is not the fault of its input is logged with its traceback."""
    if isinstance(error, LatticeError):
        advice = "" if job.aim is None else "; it was chosen for surfaces that reach less far: name another store"
        return f"{error}{advice}"
    if isinstance(error, InputError):
        return str(error)
    _log.error("%s failed for a reason that is not its mesh's", job.label, exc_info=error)
    return " ".join(str(error).split()) or type(error).__name__


def settings_of(job: Job, surface: Surface) -> TransformSettings:
    """The settings of a field that is computed block by block: as forecast, not measured and mended."""
    if job.aim is None or isinstance(surface, Sphere):
        return job.transform
    return choose_settings(surface, job.lattice, job.aim.error_target(surface), job.transform)


def _compute(job: Job, surface: Surface, blocks: Sequence[Block]) -> Part:
    """Compute and store some blocks; what there is to tell of the surface itself is left out."""
    execution = Execution(backend_of(job.backend), allowed_bytes=job.memory)
    if tuple(blocks) == (job.lattice.half,):
        if job.aim is not None and not isinstance(surface, Sphere):
            goal = job.aim.error_target(surface)
            field = field_for(surface, job.lattice, goal, job.transform, execution)
        else:
            field = compute_field(surface, job.lattice, job.transform, job.orders, execution)
        checksum = job.store.write_field(job.row, job.lattice.place(job.lattice.half), field.values)
        return Part(Facts(points=field.points), 0.0, "", field.quality, (checksum,), (field.backend,))
    settings = settings_of(job, surface)
    plan = settings.plan(surface, job.lattice)
    draws = draws_for([surface], job.lattice, job.orders, plan.lowest_degree)
    probes, backends, checksums, points = [], [], [], 0
    for block in blocks:
        made = transform_block(surface, job.lattice, block, settings, execution, plan)
        checksums.append(job.store.write_field(job.row, job.lattice.place(block), made.values))
        probes.append(probe_block(surface, job.lattice, settings, job.orders, block, made.values, draws))
        backends.append(made.backend)
        points = made.points
    quality = Quality.of_surface(surface, join(probes))
    return Part(Facts(points=points), 0.0, "", quality, tuple(checksums), tuple(backends))


def finish_mesh(job: Job, parts: Sequence[Part]) -> Record:
    """Write the completion record of a mesh whose blocks are all stored, or that failed."""
    errors = [part.error for part in parts if part.error]
    qualities = [part.quality for part in parts if part.quality is not None]
    record = Record(
        key=job.key,
        status="failed" if errors else "complete",
        reason=errors[0] if errors else "",
        facts=Facts() if errors else parts[0].facts,
        quality="" if errors else _whole(qualities).to_json(),
        checksums=() if errors else tuple(checksum for part in parts for checksum in part.checksums),
        seconds=sum(part.seconds for part in parts),
        worker=_worker_address(),
        backend=", ".join(dict.fromkeys(backend for part in parts for backend in part.backends)),
        finished=utc_now(),
    )
    job.store.write_record(job.row, record)
    _log.info("%s: %s in %.2f s by %s", job.label, record.status, record.seconds, record.backend)
    return record


def _whole(qualities: Sequence[Quality]) -> Quality:
    return replace(qualities[0], probe=join([quality.probe for quality in qualities]))


def facts_of(surface: Surface, points: int) -> Facts:
    """What is recorded of a surface and its points."""
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
