"""The plan of a study for people: its lattice, tasks, memory and storage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from distributed import Client

from sobolev_batch.batch.cluster.clients import available_cores
from sobolev_batch.batch.cluster.worker_plugin import prepare_workers
from sobolev_batch.batch.cluster.workers import Workers
from sobolev_batch.batch.fields.sizing import TaskSizes, size_rows
from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.store.store import Store, stored_choice
from sobolev_batch.batch.study.plan import Plan, make_plan
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.workspace import complete_records
from sobolev_batch.parameters import format_bytes
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.surfaces.shapes.similarity import Similarity

DEFAULT_FOLDER = Path("storage")


@dataclass(frozen=True)
class StudyPlan:
    """Forecast of a run of a study; ``print(plan)`` shows what ``sobolev-batch plan`` shows.

    Attributes:
        store: Path or URL of the study's store.
        stored: Labels of the surfaces whose fields the store has already.
        refused: Reason for each surface that fits into no worker, by label.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "spheres"},
    ...     "lattice": {"xi_max": 2.0, "M": 8},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> plan = sb.plan(study, "memory://forecast.zarr")
    >>> plan.labels, plan.lattice, plan.stored
    (('ico/0', 'ico/1', 'reference'), Lattice(xi_max=2.0, M=8), ())
    """

    store: str
    stored: tuple[str, ...]
    refused: dict[str, str]
    _plan: Plan = field(repr=False)
    _workers: Workers = field(repr=False)
    _sizes: dict[str, TaskSizes] = field(repr=False)

    @property
    def study(self) -> Study:
        """Study."""
        return self._plan.study

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all surfaces, the reference among them."""
        return tuple(row.label for row in self._plan.rows)

    @property
    def reference(self) -> str:
        """Label of the reference."""
        return self._plan.reference

    @property
    def memory_bytes(self) -> dict[str, float]:
        """Projected peak memory of each surface's largest task, by label."""
        return {label: size.projected_bytes for label, size in self._sizes.items()}

    @property
    def task_count(self) -> int:
        """Number of tasks, if nothing were stored."""
        return sum(size.task_count for size in self._sizes.values())

    @property
    def lattice(self) -> Lattice:
        """Lattice of all fields."""
        return self._plan.lattice

    @property
    def octaves(self) -> int:
        """Number of octaves that are sampled beyond the lattice."""
        return 0 if self._plan.tail is None else len(self._plan.tail.octaves)

    @property
    def dtype(self) -> str:
        """Type of the fields, "complex128" or "complex64"."""
        return self._plan.choice.dtype

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the lattice, where the study asks for an accuracy."""
        return self._plan.choice.reasons

    @property
    def similarity(self) -> Similarity:
        """Similarity from the meshes' own unit of length to the study's."""
        return self._plan.similarity

    @property
    def field_bytes(self) -> int:
        """Bytes of one stored field."""
        return self._plan.field_bytes

    @property
    def total_bytes(self) -> int:
        """Bytes of all stored fields."""
        return self.field_bytes * len(self.labels)

    def __str__(self) -> str:
        return "\n".join(f"{name + ':' * bool(name):<14} {text}" for name, text in self._lines())

    def _lines(self) -> Iterator[tuple[str, str]]:
        study, lattice = self.study, self.lattice
        orders = ", ".join(f"{order:g}" for order in study.orders)
        yield "study", study.title
        yield "surfaces", f"{len(self.labels)} in {len(study.families)} families, reference {self.reference}"
        origin = " ".join(f"{x:.9g}" for x in self.similarity.origin)
        yield "similarity", f"scale {self.similarity.scale:.9g}, origin {origin}"
        yield (
            "lattice",
            f"xi_max {lattice.xi_max:g}, M {lattice.M}, spacing {lattice.spacing:g}, "
            f"half period {lattice.half_period:g}",
        )
        yield "orders", orders
        yield from self._octave_lines()
        yield from self._transform_lines()
        yield "backend", study.backend
        if study.witness:
            witness_orders = ", ".join(f"{order:g}" for order in study.witness)
            yield "witness", f"of order {witness_orders}, at the vertices of every mesh"
        if study.proximity is not None:
            yield "proximity", f"Hausdorff and Chamfer distances, from {study.proximity:,} points on each mesh"
        yield from self._task_lines()
        yield "storage", f"{format_bytes(self.field_bytes)} per surface, {format_bytes(self.total_bytes)} in all"
        yield "store", f"{self.store}, {len(self.stored)} of {len(self.labels)} already stored"

    def _octave_lines(self) -> Iterator[tuple[str, str]]:
        tail = self._plan.tail
        if tail is None:
            return
        shortest = 1 / (tail.highest_frequency * self.similarity.scale)
        yield (
            "octaves",
            f"{self.octaves} beyond the lattice, to |xi| {tail.highest_frequency:.4g}: wavelengths down to "
            f"{shortest:.3g} of the files' unit; {tail.size:,} samples",
        )
        seconds = float(f"{self._plan.octave_seconds:.1g}")
        octave_bytes = format_bytes(tail.size * self._plan.item_bytes)
        yield "", f"{octave_bytes} per surface; about {seconds:g} s of processor time in all"

    def _transform_lines(self) -> Iterator[tuple[str, str]]:
        accuracy, transform = self.study.accuracy, self._plan.transform
        if accuracy is None:
            yield (
                "transform",
                f"eps {transform.eps:g}, {transform.dtype}, quadrature {transform.quadrature.method}",
            )
            return
        allowed = f"{format_bytes(accuracy.allowed_bytes)} for a transform, M <= {accuracy.largest_intervals}"
        yield "accuracy", f"rtol {accuracy.rtol:g} of every distance to {self.reference}; {allowed}"
        for reason in self.reasons:
            yield "chosen", reason
        yield "transform", f"{self.dtype}, eps and quadrature for each surface from its distance"

    def _task_lines(self) -> Iterator[tuple[str, str]]:
        workers = self._workers
        gpus = sum(member.backend == "gpu" for member in workers.members)
        yield (
            "workers",
            f"{len(workers.members)}, with {workers.threads} threads and {gpus} GPUs together; for tasks, "
            f"{format_bytes(workers.allowed_bytes_per_task)} or more of memory a thread",
        )
        chunks = len(self._plan.blocks)
        yield "tasks", f"{self.task_count} for {len(self._sizes)} surfaces; chunks of the lattice: {chunks}"
        for label, size in self._sizes.items():
            if size.batches > 1:
                yield "split", f"{label} into {size.batches} batches of triangles"
        if self._sizes:
            largest, size = max(self._sizes.items(), key=lambda item: item[1].projected_bytes)
            yield "memory", f"up to {format_bytes(size.projected_bytes)} in a task, of {largest}"
        for label, reason in self.refused.items():
            yield "refused", f"{label}: {reason}"


def plan(
    study: Study | str | Path, store: str | Path | Location | None = None, client: Client | None = None
) -> StudyPlan:
    """Return what running a study would do, without computing anything.

    The reference is loaded, and a few other surfaces where the study asks for an accuracy.

    Args:
        study: Study, or the path of a study file.
        store: Path or URL of a new or existing store; default storage/NAME.zarr.
        client: Client of the cluster to plan for; default processes on this machine, one per core.

    Raises:
        StudyError, MeshError, LatticeError: The study cannot be carried out.
        AccuracyError: The accuracy that the study asks for is out of reach.
        ClusterError: No worker has the GPU that the study asks for, or enough memory for its lattice.
        StoreError: The store cannot be reached, or the location holds something else.

    >>> import sobolev_batch as sb
    >>> found = sb.plan("workflows/icosphere.toml")
    >>> len(found.labels), len(found.stored), found.lattice
    (5, 5, Lattice(xi_max=5.0, M=48))
    >>> print(found)  # doctest: +ELLIPSIS
    study:         ...
    surfaces:      5 in 1 families, reference reference
    ...
    """
    study = study if isinstance(study, Study) else Study.from_toml(study)
    location = default_store(study) if store is None else Location.of(store)
    study_plan = make_plan(study, stored_choice(location))
    workers = Workers.of_this_machine(available_cores()) if client is None else prepare_workers(client, study.libraries)
    sizes, refused = size_rows(study_plan, study_plan.rows, workers.with_backend(study.backend))
    stored = _stored_keys(location)
    return StudyPlan(
        store=str(location),
        stored=tuple(row.label for row in study_plan.rows if row.key and stored.get(row.label) == row.key),
        refused=refused,
        _plan=study_plan,
        _workers=workers,
        _sizes=sizes,
    )


def default_store(study: Study) -> Location:
    """Return the location of a study's store if none is named."""
    return Location.of(DEFAULT_FOLDER / f"{study.name}.zarr")


def _stored_keys(location: Location) -> dict[str, str]:
    """Return the keys of all stored fields by label."""
    store = Store(location)
    if not store.exists() or store.is_unfinished:
        return {}
    store.attributes()
    labels = store.labels()
    return {labels[row]: record.key for row, record in complete_records(store.records()).items()}
