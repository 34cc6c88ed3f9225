"""What runs on a worker once fields are stored: a mesh, made again, is compared with the reference itself.

Like tasks of fields, each is a pure function of its arguments that writes whole chunks and its note last.
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
from sobolev_batch.errors import InputError, MeshError, StoreError
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
class Stored:
    """A surface whose field is stored.

    Attributes:
        row: of the store.
        label: for people.
        member: what makes it.
        digest: of the mesh whose field is stored, in the study's unit.
        checksums: of its field's blocks.
    """

    row: int
    label: str
    member: Member
    digest: str
    checksums: tuple[int, ...]

    def made_again(self, similarity: Similarity) -> Mesh:
        """The mesh, in the study's unit.

        Raises:
            MeshError: it cannot be made, or is not the one whose field is stored.
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
        store: where both are, and where the outcome goes.
        key: of its note.
        mesh, reference: the two.
        similarity: of the study.
    """

    store: Store
    key: str
    mesh: Stored
    reference: Stored
    similarity: Similarity


def compare_by_witness(
    comparison: Comparison,
    lattice: Lattice,
    blocks: tuple[Block, ...],
    orders: tuple[float, ...],
    memory: float,
) -> ComparisonRecord:
    """Store the witness function of a mesh against the reference, at its vertices, then a note.

    It is NaN at vertices that no triangle uses.

    Args:
        comparison: what to compare.
        lattice: of both fields.
        blocks: of the fields, as they are stored.
        orders: s, each.
        memory: bytes that the NUFFT may take.
    """

    def outcome() -> ComparisonRecord:
        mesh = comparison.mesh.made_again(comparison.similarity)
        evaluation = Evaluation(
            # Others may lie anywhere, beyond the lattice's period too.
            mesh.used_coordinates,
            SobolevWeights(lattice, orders),
            TransformSettings(),
            threads=1,
            allowed_bytes=memory,
        )
        found = np.zeros((len(orders), len(mesh.used_vertices)))
        for number, block in enumerate(blocks):
            difference = _difference(comparison, lattice, block, number)
            for part in block.split(evaluation.largest):
                found += evaluation.of_block(part, difference[part.place_in(block)])
        values = np.full((len(orders), len(mesh.vertices)), np.nan)
        values[:, mesh.used_vertices] = found
        checksum = Witnesses(comparison.store).write(comparison.mesh.row, values)
        return ComparisonRecord(comparison.key, "complete", checksum=checksum)

    return _noted(comparison, "witness", outcome)


def compare_by_proximity(comparison: Comparison, points: int) -> ComparisonRecord:
    """Measure Hausdorff and Chamfer distances of a mesh from the reference, and store them as a note.

    Args:
        comparison: what to compare.
        points: drawn on each of the two.
    """

    def outcome() -> ComparisonRecord:
        mesh, reference = (
            stored.made_again(comparison.similarity) for stored in (comparison.mesh, comparison.reference)
        )
        return ComparisonRecord(comparison.key, "complete", numbers=asdict(proximity(mesh, reference, points=points)))

    return _noted(comparison, "proximity", outcome)


def _difference(comparison: Comparison, lattice: Lattice, block: Block, number: int) -> NDArray[np.complex128]:
    """One block of the difference of both fields, complex128."""
    stored = comparison.mesh, comparison.reference
    checksums = [each.checksums[number] for each in stored]
    fields = comparison.store.read_fields([each.row for each in stored], lattice.place(block), checksums)
    # In place: of a large lattice another copy might not fit.
    difference: NDArray[np.complex128] = fields[0].astype(np.complex128, copy=False)
    difference -= fields[1]
    return difference


def _noted(comparison: Comparison, kind: Kind, outcome: Callable[[], ComparisonRecord]) -> ComparisonRecord:
    """Have a comparison made and its note written; a mesh that cannot be compared does not raise."""
    started = time.perf_counter()
    try:
        note = outcome()
    except StoreError:
        raise
    except Exception as error:
        if not isinstance(error, InputError):
            _log.error("%s: %s failed for a reason that is not its mesh's", comparison.mesh.label, kind, exc_info=error)
        note = ComparisonRecord(comparison.key, "failed", " ".join(str(error).split()) or type(error).__name__)
    note = replace(note, seconds=time.perf_counter() - started)
    ComparisonRecords(comparison.store, kind).write(comparison.mesh.row, note)
    return note
