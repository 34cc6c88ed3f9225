"""The tasks of a field: they run on a worker, and turn a mesh's source into stored values and a completion record.

A task is a pure function that writes whole chunks, so running it again, or twice at once, leaves the same store.
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sobolev_batch import compiled
from sobolev_batch.batch.cluster.workers import this_worker, worker_backend
from sobolev_batch.errors import InputError, LatticeError, MemoryLimitError, MeshError, StoreError, naming, one_line
from sobolev_batch.geometry.surface import Similarity, Surface
from sobolev_batch.norms.fields import Quality, TailQuality, field_for
from sobolev_batch.norms.tail.remainder import Remainder, remainder, remainder_between, remainder_of_flat
from sobolev_batch.norms.tail.sampling import TailSampling
from sobolev_batch.norms.tail.values import octave_values
from sobolev_batch.parameters import format_bytes
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.layout import Store
from sobolev_batch.store.lock import utc_now
from sobolev_batch.store.records import Facts, Record, Records
from sobolev_batch.study.plan import Plan, Row
from sobolev_batch.transform.fourier import (
    NUMERICS_VERSION,
    ErrorTarget,
    Execution,
    choose_settings,
    transform_block,
)
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.lattice import Block
from sobolev_batch.transform.probe import COMMON, Probe, draws_for, join, probe_block

_log = logging.getLogger(__name__)

# Fraction of a field's error that each octave may have, inverted: the squares of some octaves' errors add up.
_OCTAVES_TIGHTENING = 5.0
# The last task's reference, by fingerprint and scale, most likely the next one's; kept up to so many triangles.
_KEPT_TRIANGLES = 1 << 20
_reference: dict[tuple[str, Similarity], Surface] = {}


@dataclass(frozen=True)
class Job:
    """The field of one row, and where it is stored.

    Attributes:
        row, planned: Row of the store, and what the plan has for it.
        plan: What all rows share; see `Plan.without_surfaces`.
        allowed_bytes: Memory that one transform may take besides its mesh and its block.
        reference: The reference, where surfaces are compared beyond the lattice; None if it is too large.
        numerics: Version of the numerics that the key of the row has.
    """

    store: Store
    row: int
    planned: Row
    plan: Plan
    allowed_bytes: float | None = None
    reference: Row | None = None
    numerics: int = NUMERICS_VERSION

    @property
    def key(self) -> str:
        """Key of the record of this field: that of the row, where this process computes as the study was planned."""
        is_same = self.numerics == NUMERICS_VERSION
        return self.planned.key if is_same else f"{self.planned.key} by numerics {NUMERICS_VERSION}"

    @property
    def execution(self) -> Execution:
        """Execution of the transforms on this worker."""
        return Execution(worker_backend(self.plan.study.backend), allowed_bytes=self.allowed_bytes)

    def load(self) -> Surface:
        """Load the surface, in the study's unit; MeshError where it is not the one that the study was planned with."""
        return self._loaded(self.planned)

    def load_reference(self) -> Surface | None:
        """Load the reference, in the study's unit; None where it is too large. See `load` for errors."""
        if self.reference is None:
            return None
        key = self.reference.fingerprint, self.plan.similarity
        if (kept := _reference.get(key)) is not None:
            return kept
        _reference.clear()
        with naming("the reference", MeshError):
            found = self._loaded(self.reference)
        if self.reference.fingerprint and kind_of(found).triangles <= _KEPT_TRIANGLES:
            _reference[key] = found
        return found

    def _loaded(self, one: Row) -> Surface:
        surface = self.plan.similarity.apply(one.member.load())
        if one.fingerprint and one.member.fingerprint_digest() != one.fingerprint:
            raise MeshError("a file of it was changed while the study was going on; run the study again")
        return surface

    def error_target(self, surface: Surface) -> ErrorTarget | None:
        """Return the target for the errors of a surface's values; None where the settings alone count."""
        target = self.plan.distance_target(self.planned)
        return None if target is None or kind_of(surface).is_closed_form else target.error_target(surface)

    def stored_record(self) -> Record | None:
        """Return the completion record of the field if it exists: Dask repeats tasks whose worker was lost."""
        record = Records(self.store).read_one(self.row, of_this_run=True)
        return record if record is not None and record.completes(self.key) else None

    def failure_reason(self, error: Exception) -> str:
        """Return why the mesh failed, in one line, and log the traceback where its input is not to blame."""
        reason = one_line(error)
        if isinstance(error, LatticeError) and self.plan.study.accuracy is not None:
            reason = (
                f"{reason}; it was chosen for surfaces that reach less far. Is this one in the same unit of length? "
                "If it is, name another store, for which the lattice is chosen anew"
            )
        if isinstance(error, MemoryLimitError):
            limit = (worker := this_worker()) and worker.memory_manager.memory_limit
            told = f" of {format_bytes(limit)}" if limit else ""
            reason = (
                f"{reason}. That is what the limit{told} of its worker leaves; raise that limit by --worker-memory of "
                "run, or by --memory-limit of dask worker"
            )
        if not isinstance(error, InputError):
            _log.error("%s failed for a reason that is not its mesh's", self.planned.label, exc_info=error)
        return reason


@dataclass(frozen=True)
class StoredBlocks:
    """The outcome of a task that stored blocks of a field; ``error`` is empty unless it failed."""

    facts: Facts = field(default_factory=Facts)
    seconds: float = 0.0
    error: str = ""
    quality: Quality | None = None
    checksums: tuple[int, ...] = ()
    backends: tuple[str, ...] = ()


def compute_mesh(job: Job, blocks: Sequence[Block]) -> Record:
    """Compute and store the whole field of a mesh, then its completion record, unless that exists.

    The reason of a failure goes into the record, so that one bad mesh stops nothing else; but for a StoreError.
    """
    stored = compute_parts(job, blocks, octaves=job.plan.tail is not None)
    return stored if isinstance(stored, Record) else _finished(job, stored)


def compute_parts(job: Job, blocks: Sequence[Block] = (), octaves: bool = False) -> list[StoredBlocks] | Record:
    """Compute and store some blocks of a mesh's field, and its values in octaves; see `compute_mesh`.

    Return what was stored, the first with the time or the reason of a failure; or the record of the mesh, if it exists.
    """
    if record := job.stored_record():
        return record
    started, tail, first = time.perf_counter(), job.plan.tail, job.plan.lattice.half.start
    try:
        # Another worker that computes them again must write the same bytes. Octaves take long enough for loops to pay.
        with compiled.by_itself(loops=tail is not None):
            surface = job.load()
            target = job.error_target(surface)
            stored = [_store_blocks(job, surface, blocks, target)] if blocks else []
            if octaves and tail is not None:
                stored.append(_store_octaves(job, tail, surface, target))
            elif blocks and blocks[0].start == first and (quality := stored[0].quality) is not None:
                stored[0] = replace(stored[0], quality=replace(quality, beyond=_beyond_lattice(job, surface)))
    except StoreError:
        raise
    except Exception as error:
        return [StoredBlocks(seconds=time.perf_counter() - started, error=job.failure_reason(error))]
    return [replace(stored[0], seconds=time.perf_counter() - started), *stored[1:]]


def finish_mesh(job: Job, *parts: list[StoredBlocks] | Record) -> Record:
    """Write the completion record of a mesh whose blocks are all stored, or that failed, unless it exists."""
    record = next((part for part in parts if isinstance(part, Record)), None) or job.stored_record()
    return record or _finished(job, [stored for part in parts if isinstance(part, list) for stored in part])


def _store_octaves(job: Job, tail: TailSampling, surface: Surface, target: ErrorTarget | None) -> StoredBlocks:
    settings = target.tightened(_OCTAVES_TIGHTENING) if target else job.plan.transform
    values = [octave_values(surface, octave, job.plan.study.orders, settings, job.execution) for octave in tail.octaves]
    cutoff, difference = tail.highest_frequency, None
    if (reference := job.load_reference()) is not None:
        difference = remainder_between((surface, reference), cutoff, execution=job.execution)
    quality = TailQuality(
        tuple(float(radius) for octave in values for radius in octave.radii),
        tuple(float(square) for octave in values for square in octave.squares),
        remainder([surface], [1], cutoff, execution=job.execution, is_scale=True),
        difference,
    )
    samples = np.concatenate([octave.values for octave in values])
    checksum = Fields(job.store).write(job.row, (slice(0, len(samples)),), samples)
    return StoredBlocks(quality=Quality(surface.area, surface.extent, Probe(), quality), checksums=(checksum,))


def _beyond_lattice(job: Job, surface: Surface) -> Remainder | None:
    """Return what lies beyond a lattice in the distance from the reference; None where it is extrapolated."""
    cutoff = job.plan.lattice.xi_max
    if job.reference is None or job.plan.tail is not None:
        return None
    if job.reference.label == job.planned.label:
        return Remainder.alike(cutoff)
    reference = job.load_reference()
    return None if reference is None else remainder_of_flat((surface, reference), cutoff, execution=job.execution)


def _store_blocks(job: Job, surface: Surface, blocks: Sequence[Block], target: ErrorTarget | None) -> StoredBlocks:
    """Compute and store blocks; the settings of one of several follow from their a priori error."""
    lattice, execution = job.plan.lattice, job.execution
    if target and tuple(blocks) == (lattice.half,):
        whole = field_for(surface, lattice, target, job.plan.transform, execution, lasting=True)
        checksum = Fields(job.store).write(job.row, lattice.half.place_in(lattice.half), whole.values)
        facts = Facts.of_surface(surface, whole.points)
        return StoredBlocks(facts, quality=whole.quality, checksums=(checksum,), backends=(whole.backend,))
    transform = choose_settings(surface, lattice, target, job.plan.transform) if target else job.plan.transform
    kind = transform.kind_for(surface, lattice)
    draws = draws_for([surface], lattice, job.plan.study.orders, kind.lowest_degree, COMMON, lasting=True)
    probes, backends, checksums, points = [], [], [], 0
    for block in blocks:
        result = transform_block(surface, lattice, block, transform, execution, kind)
        checksums.append(Fields(job.store).write(job.row, block.place_in(lattice.half), result.values))
        probes.append(probe_block(surface, lattice, transform, block, result.values, draws, execution))
        backends.append(result.backend)
        points = result.points
    facts, quality = Facts.of_surface(surface, points), Quality(surface.area, surface.extent, join(probes))
    return StoredBlocks(facts, quality=quality, checksums=tuple(checksums), backends=tuple(backends))


def _finished(job: Job, stored: Sequence[StoredBlocks]) -> Record:
    worker, backends = this_worker(), dict.fromkeys(backend for blocks in stored for backend in blocks.backends)
    record = Record(
        key=job.key,
        numerics=NUMERICS_VERSION,
        status="complete",
        remark=job.planned.member.remark(),
        seconds=sum(blocks.seconds for blocks in stored),
        worker=worker.address if worker else "local",
        backend=", ".join(backends),
        finished=utc_now(),
        cost=job.planned.member.cost(),
    )
    if errors := [blocks.error for blocks in stored if blocks.error]:
        record = replace(record, status="failed", reason=errors[0])
    else:
        qualities = [blocks.quality for blocks in stored if blocks.quality is not None]
        tail = next((quality.tail for quality in qualities if quality.tail is not None), None)
        quality = replace(qualities[0], probe=join([quality.probe for quality in qualities]), tail=tail)
        checksums = tuple(checksum for blocks in stored for checksum in blocks.checksums)
        record = replace(record, facts=stored[0].facts, quality=quality.to_json(), checksums=checksums)
    Records(job.store).write(job.row, record)
    _log.info("%s: %s in %.2f s by %s", job.planned.label, record.status, record.seconds, record.backend)
    return record
