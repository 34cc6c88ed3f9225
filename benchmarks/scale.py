"""What the scheduler and the store add to each of very many meshes: a study of tiny ones."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import sobolev_batch as sb
from benchmarks.table import Row
from benchmarks.timing import Effort, elapsed_seconds
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.batch.status import Status
from sobolev_batch.store.layout import Store
from sobolev_batch.store.records import Records

_WORKERS = 2
# Meshes that are added to those that are there.
_ADDED = 100


def tiny_meshes(effort: Effort) -> Iterator[Row]:
    """Times of a study of tiny meshes, by stage; a mesh's share of each is what a million would have, too."""
    count = 10_000 if effort.large else 1000 if not effort.quick else 50
    with TemporaryDirectory() as name, local_client(_WORKERS) as client:
        folder = Path(name)
        _write_icosahedra(folder, count)
        study = sb.Study.from_table(_STUDY, folder=folder)
        store = folder / "tiny.zarr"
        marks: dict[str, float] = {}

        def note(progress: Progress) -> None:
            marks.setdefault(f"{progress.stage} begins", time.perf_counter())
            marks[f"{progress.stage} ends"] = time.perf_counter()

        started = time.perf_counter()
        sb.run(study, store, client, on_progress=note)
        ended = time.perf_counter()
        tasks = sum(record.seconds for record in Records(Store(store)).read() if record is not None)
        peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        status = elapsed_seconds(lambda: Status.from_store(store))
        again = elapsed_seconds(lambda: sb.run(study, store, client))
        opened = elapsed_seconds(lambda: sb.open_store(store)["convergence"]["distance"].load())
        sobolev = sb.open_store(store).sobolev
        every = elapsed_seconds(lambda: sobolev.distance(-2.5))
        pair = elapsed_seconds(lambda: sobolev.distance(-3.5, "icosahedra/0000001", "icosahedra/0000002"))
        _write_icosahedra(folder, _ADDED, first=count)
        added = elapsed_seconds(lambda: sb.run(sb.Study.from_table(_STUDY, folder=folder), store, client))
    fields = marks["fields ends"] - marks["fields begins"]

    def row(what: str, seconds: float) -> Row:
        each = f"{seconds:.3g} s, {1e3 * seconds / count:.3g} ms each"
        return Row("scale", f"{count} tiny meshes, {_WORKERS} workers: {what}", each)

    yield row("planning", marks["cluster begins"] - started)
    yield row("fields", fields)
    yield row("of it tasks, by each worker", tasks / _WORKERS)
    yield row("of it scheduler, records, driver", fields - tasks / _WORKERS)
    yield row("reduction and tables", ended - marks["reduction begins"])
    yield row("status", status)
    yield row("a run that finds everything there", again)
    yield row(f"{_ADDED} more", added)
    yield Row("scale", "open the store and read a table of it", f"{opened:.3g} s")
    yield Row("scale", "distances of all meshes to the reference at a new order", f"{every:.3g} s")
    yield Row("scale", "distance of two meshes at a new order", f"{pair:.3g} s")
    yield Row("scale", "peak memory of driver, client and scheduler in one process", f"{peak_bytes / 1e6:.3g} MB")


_STUDY: dict[str, Any] = {
    "study": {"name": "tiny"},
    "lattice": {"xi_max": 0.8, "M": 4},
    "norm": {"orders": [-4.0]},
    "reference": {"source": "sphere"},
    "family": [{"name": "icosahedra", "source": "files", "paths": ["*.off"]}],
}


def _write_icosahedra(folder: Path, count: int, first: int = 0) -> None:
    mesh = sb.shapes.icosphere(0)
    faces = "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.triangles.tolist())
    rng = np.random.default_rng(first)
    for number in range(first, first + count):
        vertices = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in (mesh.vertices * rng.uniform(0.8, 1)).tolist())
        (folder / f"{number:07}.off").write_text(f"OFF\n12 20 0\n{vertices}{faces}")
