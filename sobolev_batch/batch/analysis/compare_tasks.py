"""The tasks of comparisons: they run on a worker, load a mesh again, and compare it with the reference.

Like the tasks of fields, each is a pure function of its arguments that writes whole chunks and its record last.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.batch.store.comparison_records import ComparisonRecord, ComparisonRecords, Kind
from sobolev_batch.batch.store.store import Store
from sobolev_batch.batch.store.witness_array import Witnesses
from sobolev_batch.errors import InputError, MeshError, StoreError, one_line
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.metrics.witness import Evaluation
from sobolev_batch.spectral.shells import SobolevWeights
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.proximity import proximity
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.sources.registry import Member

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredMesh:
    """A mesh whose field is stored.

    Attributes:
        row: Row of the store.
        label: Label of the row.
        member: Source of the mesh.
        digest: Digest of the mesh whose field is stored, in the study's unit.
        checksums: Checksums of the blocks of its field.
    """

    row: int
    label: str
    member: Member
    digest: str
    checksums: tuple[int, ...]

    def load(self, similarity: Similarity) -> Mesh:
        """Load the mesh, in the study's unit.

        Raises:
            MeshError: It cannot be loaded, or is not the mesh whose field is stored.
        """
        surface = similarity.apply(self.member.load())
        if not isinstance(surface, Mesh) or surface.digest != self.digest:
            raise MeshError(
                f"what is made of {self.label} now is not the mesh whose field is stored; a file of it may have "
                "changed: run the study again"
            )
        return surface


@dataclass(frozen=True)
class Comparison:
    """A mesh that is to be compared with the reference.

    Attributes:
        store: Store of both fields and of the outcome.
        key: Key of the record.
        mesh, reference: The two meshes.
        similarity: Similarity of the study.
    """

    store: Store
    key: str
    mesh: StoredMesh
    reference: StoredMesh
    similarity: Similarity

    def record(self, kind: Kind, compare: Callable[[], ComparisonRecord]) -> ComparisonRecord:
        """Compare and write the record; a mesh that cannot be compared does not raise."""
        started = time.perf_counter()
        try:
            record = compare()
        except StoreError:
            raise
        except Exception as error:
            if not isinstance(error, InputError):
                _log.error("%s: %s failed for a reason that is not its mesh's", self.mesh.label, kind, exc_info=error)
            record = ComparisonRecord(self.key, "failed", one_line(error))
        record = replace(record, seconds=time.perf_counter() - started)
        ComparisonRecords(self.store, kind).write(self.mesh.row, record)
        return record


@dataclass(frozen=True)
class WitnessSettings:
    """The settings of witness functions.

    Attributes:
        lattice: Lattice of the fields.
        blocks: Blocks of the fields, as they are stored.
        orders: Sobolev orders s.
        allowed_bytes: Memory that the NUFFT may take.
    """

    lattice: Lattice
    blocks: tuple[Block, ...]
    orders: tuple[float, ...]
    allowed_bytes: float


def compare_by_witness(comparison: Comparison, settings: WitnessSettings) -> ComparisonRecord:
    """Store the witness function of a mesh against the reference, at its vertices, then a record.

    It is NaN at vertices that no triangle uses.
    """
    lattice, orders = settings.lattice, settings.orders

    def compare() -> ComparisonRecord:
        mesh = comparison.mesh.load(comparison.similarity)
        evaluation = Evaluation(
            # Other vertices may lie anywhere, beyond the lattice's period too.
            mesh.used_coordinates,
            SobolevWeights(lattice, orders),
            TransformSettings(),
            threads=1,
            allowed_bytes=settings.allowed_bytes,
        )
        sums = np.zeros((len(orders), len(mesh.used_vertices)))
        for number, block in enumerate(settings.blocks):
            difference = _difference(comparison, lattice, block, number)
            for inner in block.split(evaluation.largest):
                sums += evaluation.of_block(inner, difference[inner.place_in(block)])
        values = np.full((len(orders), len(mesh.vertices)), np.nan)
        values[:, mesh.used_vertices] = sums
        checksum = Witnesses(comparison.store).write(comparison.mesh.row, values)
        return ComparisonRecord(comparison.key, "complete", checksum=checksum)

    return comparison.record("witness", compare)


def compare_by_proximity(comparison: Comparison, points: int) -> ComparisonRecord:
    """Measure Hausdorff and Chamfer distances of a mesh from the reference, and store them as a record.

    Args:
        comparison: Meshes to compare.
        points: Number of points that are drawn on each of the two.
    """

    def compare() -> ComparisonRecord:
        mesh, reference = (stored.load(comparison.similarity) for stored in (comparison.mesh, comparison.reference))
        return ComparisonRecord(comparison.key, "complete", numbers=asdict(proximity(mesh, reference, points=points)))

    return comparison.record("proximity", compare)


def _difference(comparison: Comparison, lattice: Lattice, block: Block, number: int) -> NDArray[np.complex128]:
    """Return one block of the difference of both fields, complex128."""
    stored = comparison.mesh, comparison.reference
    rows, checksums = [mesh.row for mesh in stored], [mesh.checksums[number] for mesh in stored]
    fields = comparison.store.read_fields(rows, lattice.place(block), checksums)
    # In place: of a large lattice another copy might not fit.
    difference: NDArray[np.complex128] = fields[0].astype(np.complex128, copy=False)
    difference -= fields[1]
    return difference
