"""What the driver, the scheduler and the store add to each of very many meshes and objects."""

from __future__ import annotations

import resource
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from distributed import Client, LocalCluster

import sobolev_batch as sb
from benchmarks.table import Row, at_most
from benchmarks.timing import Effort, elapsed_seconds
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Progress
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
        status = elapsed_seconds(lambda: sb.status(store))
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
    yield row("tables", ended - marks["tables begins"])
    yield row("status", status)
    yield row("a run that finds everything there", again)
    yield row(f"{_ADDED} more", added)
    yield Row("scale", "open the store and read a table of it", f"{opened:.3g} s")
    yield Row("scale", "distances of all meshes to the reference at a new order", f"{every:.3g} s")
    yield Row("scale", "distance of two meshes at a new order", f"{pair:.3g} s")
    yield Row("scale", "peak memory of driver, client and scheduler in one process", f"{peak_bytes / 1e6:.3g} MB")


def many_objects(effort: Effort) -> Iterator[Row]:
    """Processor time and memory of a study of many objects with four meshes and a reference each, on own workers."""
    count = 1000 if effort.large else 100 if not effort.quick else 4
    with TemporaryDirectory() as name:
        folder = Path(name)
        _write_objects(folder, count)
        store = folder / "many.zarr"
        for lattice in ({"lattice": {"xi_max": 3.0, "M": 24}}, {"accuracy": {"rtol": 5e-2}}):
            is_given = "lattice" in lattice
            what = f"{count} objects x 5 meshes, {'lattice given' if is_given else 'rtol 5e-2'}, {_WORKERS} workers"
            study = sb.Study.from_table({**_OBJECTS, **lattice}, folder=folder)
            before, driver, started = _children_seconds(), time.process_time(), time.perf_counter()
            sb.run(study, store, workers=_WORKERS)
            driver, wall = time.process_time() - driver, time.perf_counter() - started
            each = f"{1e3 * driver / (5 * count):.3g} ms a mesh"
            yield Row("objects", f"{what}: driver and scheduler", f"{driver:.3g} CPU s, {each}")
            workers = _children_seconds() - before
            yield Row(
                "objects", f"{what}: workers", f"{workers:.3g} CPU s, {1e3 * workers / (5 * count):.3g} ms a mesh"
            )
            yield Row("objects", f"{what}: wall time", f"{wall:.3g} s")
            again = _processor_seconds(partial(sb.run, study, store))
            yield Row("objects", f"{what}: a run that finds everything there", f"{again:.3g} CPU s")
            yield Row("objects", f"{what}: status", f"{_processor_seconds(lambda: sb.status(store)):.3g} CPU s")
            read = _processor_seconds(lambda: sb.table(store))
            yield Row("objects", f"{what}: table of all rows", f"{read:.3g} CPU s")
            shutil.rmtree(store)
        peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        yield Row("objects", "peak memory of driver, client and scheduler in one process", f"{peak_bytes / 1e6:.3g} MB")


def waiting_workers(effort: Effort) -> Iterator[Row]:
    """How long workers wait while other objects have work, and how many threads are kept busy."""
    yield from _waiting_objects(effort)
    yield from _idle_threads(effort)


def _waiting_objects(effort: Effort) -> Iterator[Row]:
    """Wall time of objects whose meshes only wait, beside that of one: a worker is idle where no object has work."""
    seconds, most = (15, 8) if not effort.quick else (1, 2)
    times = {}
    for count in (1, most):
        study: dict[str, Any] = {
            "study": {"name": "waiting"},
            "accuracy": {"rtol": 5e-2},
            "norm": {"orders": [-2.0]},
            "object": [
                {"name": f"egg{k}", "reference": {"source": "ellipsoid", "axes": [1.0, 0.7 + 0.01 * k, 0.6]}}
                for k in range(count)
            ],
            "family": [
                {
                    "name": word,
                    "source": "command",
                    "mesh": {"source": "icosphere", "levels": [2]},
                    "command": ["sh", "-c", f"sleep {seconds}; cp {{input}} {{output}}", word, "{object}"],
                }
                for word in ("one", "two")
            ],
        }
        with TemporaryDirectory() as name:
            started = time.perf_counter()
            sb.run(
                sb.Study.from_table(study), Path(name) / "waiting.zarr", workers=8, memory="1GB", allow_commands=True
            )
            times[count] = time.perf_counter() - started
    what = f"{most} objects x 2 commands that wait {seconds} s, 8 workers: wall time over that of one object"
    ratio, both = times[most] / times[1], f"{times[most]:.3g} and {times[1]:.3g} s"
    yield Row("waiting", what, both, ratio=ratio, target=at_most(2.5))


def _idle_threads(effort: Effort) -> Iterator[Row]:
    """Share of the time until the last mesh is begun for which threads make none; making one is to sleep."""
    threads, objects, each, seconds = (256, 60, 40, 20.0) if not effort.quick else (8, 2, 12, 0.5)
    with TemporaryDirectory() as name:
        folder, times = Path(name), Path(name) / "times.txt"
        _write_icosahedra(folder, objects)
        mesh = {"source": "files", "paths": ["{object}.off"]}
        study = {
            **_STUDY,
            "reference": mesh,
            "object": [{"name": f"{number:07}"} for number in range(objects)],
            "family": [
                {
                    "name": "slept",
                    "source": _Sleeping(times, seconds),
                    "mesh": mesh,
                    "share": list(range(each)),
                    "version": "1",
                }
            ],
        }
        # Threads take little memory while they sleep, and the machine has less than the 256 would be given.
        memory = "lambda: (10**12, 'a simulated machine')"
        preload = f"from sobolev_batch.batch.cluster import workers; workers.machine_memory = {memory}"
        cluster = LocalCluster(n_workers=2, threads_per_worker=threads // 2, preload=[preload], dashboard_address=None)
        with cluster, Client(cluster) as client:
            sb.run(sb.Study.from_table(study, folder=folder), folder / "slept.zarr", client)
        begins, ends = np.loadtxt(times).T
    busy = np.minimum(ends, begins.max()) - begins
    idle = float(1 - busy.sum() / (threads * np.ptp(begins)))
    what = f"{objects * each} meshes of {objects} objects that take {seconds:g} s and more, {threads} threads"
    yield Row("waiting", f"{what}: time without a mesh", f"{idle:.1%}", ratio=idle, target=at_most(0.05))


@dataclass(frozen=True)
class _Sleeping:
    """A remesher that takes its time, and notes when."""

    times: Path
    seconds: float

    def __call__(self, mesh: sb.Mesh, share: int) -> sb.Mesh:
        begin = time.time()
        time.sleep(self.seconds * (1 + share / 2000))
        with self.times.open("a") as file:
            file.write(f"{begin!r} {time.time()!r}\n")
        return sb.Mesh(mesh.vertices * (1 + 1e-3 * share), mesh.triangles)


_OBJECTS: dict[str, Any] = {
    "study": {"name": "many"},
    "norm": {"orders": [-2.0, -4.0]},
    "reference": {"source": "files", "paths": ["{object}/reference.ply"]},
    "family": [{"name": "noisy", "source": "files", "paths": ["{object}/noisy*.ply"]}],
}


def _write_objects(folder: Path, count: int) -> None:
    """Write ellipsoids of 1,280 triangles, and for each four noisy meshes of 320 and 1,280 triangles."""
    rng = np.random.default_rng(0)
    for number in range(count):
        (folder / f"{number:05}").mkdir()
        axes = 1 + 0.3 * rng.random(3)
        for name, level, noise in (("reference", 3, 0.0), *((f"noisy{k}", 2 + k // 2, 0.003) for k in range(4))):
            sphere = sb.shapes.icosphere(level)
            radii = 1 + noise * rng.normal(size=(len(sphere.vertices), 1))
            sb.write_mesh(sb.Mesh(sphere.vertices * axes * radii, sphere.triangles), folder / f"{number:05}/{name}.ply")


def _children_seconds() -> float:
    """Return the processor time of processes that this one has started, and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _processor_seconds(act: Callable[[], object]) -> float:
    started = time.process_time()
    act()
    return time.process_time() - started


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
