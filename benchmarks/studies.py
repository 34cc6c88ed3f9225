"""Times of whole studies: what a cluster and a store add to bare transforms and bare matrix products."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from shutil import rmtree
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from distributed import Client

import sobolev_batch as sb
from benchmarks.memory import highest_bytes
from benchmarks.table import Row, Target, as_bytes, as_seconds, at_most
from benchmarks.timing import Effort, elapsed_seconds, take_turns
from sobolev_batch.arrays import Reals
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.transform.fourier import TransformSettings, transform_block
from sobolev_batch.transform.lattice import SobolevWeights

_WORKERS = 2
_OVERHEAD = at_most(1.1)
_ALL_PAIRS = at_most(1.7)
_ALL_PAIRS_BYTES = 2e9
_XI_MAX = 5.0
_SAMPLE_PER_WORKER = 8


@dataclass(frozen=True)
class Split:
    """Where the time of a run went.

    Attributes:
        planning: seconds until the first task was about to be submitted.
        fields: seconds while meshes were transformed.
        tables: seconds from the first part of the tables to the last table.
        tasks: seconds spent within the tasks of the fields, of all workers together.
    """

    planning: float
    fields: float
    tables: float
    tasks: float

    @property
    def total(self) -> float:
        """Seconds of the whole run."""
        return self.planning + self.fields + self.tables


@dataclass(frozen=True)
class Parts:
    """What the parts of a task take by themselves, in seconds.

    Attributes:
        reading: of the mesh's file.
        transform: the bare transform.
        describing: edge lengths, counts and digest, which go into the mesh's record.
    """

    reading: float
    transform: float
    describing: float


def study_overhead(effort: Effort) -> Iterator[Row]:
    """Item 5: a study of many meshes against its transforms alone."""
    count, level, intervals = (8, 3, 32) if effort.quick else (200, 5, 64)
    splits: list[Split] = []
    parts: list[Parts] = []
    with TemporaryDirectory() as name, local_client(_WORKERS) as client:
        folder = Path(name)
        paths = _write_meshes(folder, count, level)
        study = sb.Study.from_table(_study_of_files(intervals), folder=folder)
        # The workers' tables of rules are made once, whatever the number of meshes.
        _parts(client, paths, study)
        for _ in range(effort.repeats):
            splits.append(_split_run(study, folder / "study.zarr", client))
            rmtree(folder / "study.zarr")
            parts.append(_parts(client, paths, study))
    pure = count * median(part.transform for part in parts)
    what = f"study of {count} x T_{level}, M = {intervals}"

    def row(name: str, seconds: float, target: Target | None = None) -> Row:
        return Row("5", f"{what}: {name}", as_seconds(seconds), as_seconds(pure), seconds / pure, target)

    yield row("wall time x workers", _WORKERS * median(split.total for split in splits), _OVERHEAD)
    yield row("of it planning", _WORKERS * median(split.planning for split in splits))
    yield row("of it fields", _WORKERS * median(split.fields for split in splits))
    yield row("of the fields within tasks", median(split.tasks for split in splits))
    yield row("of the tasks reading", count * median(part.reading for part in parts))
    yield row("of the tasks describing", count * median(part.describing for part in parts))
    yield row("of it tables", _WORKERS * median(split.tables for split in splits))


def all_pairs(effort: Effort) -> Iterator[Row]:
    """Item 6: the distances of all pairs of stored fields against the bare matrix product."""
    count, intervals = (24, 32) if effort.quick else (500, 64)
    orders = (-10.0, -5.0, -2.0)
    by_reference, by_pair = (_study_of_spheres(count, intervals, orders, pairs) for pairs in ("reference", "all"))
    with TemporaryDirectory() as name, local_client(_WORKERS) as client:
        store = Path(name) / "pairs.zarr"

        def forget() -> None:
            """Replace the tables by those of the reference alone, so that the pairs are missing again."""
            sb.run(by_reference, store, client)

        def package(_: None) -> object:
            return sb.run(by_pair, store, client)

        def product(_: None) -> object:
            return [part @ fields.T for part in weighted]

        forget()
        fields = _stored_fields(store)
        weighted = [fields * weights for weights in _weights(sb.Lattice(_XI_MAX, intervals), orders)]
        ours, bare = take_turns([package, product], forget, effort.repeats)
        # Of their whole life; this process has the other contestant's matrices.
        peak = sum(client.run(highest_bytes).values())
    what = f"all pairs of {count} fields, M = {intervals}, {len(orders)} orders, {as_bytes(fields.nbytes)}"
    yield Row("6", what, as_seconds(ours), as_seconds(bare), ours / bare, _ALL_PAIRS)
    share = peak / _ALL_PAIRS_BYTES
    yield Row(
        "6", f"{what}: peak memory of {_WORKERS} workers", as_bytes(peak), as_bytes(_ALL_PAIRS_BYTES), share, at_most(1)
    )


def _split_run(study: sb.Study, store: Path, client: Client) -> Split:
    first: dict[str, float] = {}
    tasks: list[float] = []

    def listen(progress: Progress) -> None:
        first.setdefault(progress.stage, time.perf_counter())
        if progress.record is not None:
            tasks.append(progress.record.seconds)

    started = time.perf_counter()
    sb.run(study, store, client, on_progress=listen)
    ended = time.perf_counter()
    fields, tables = first["fields"], first["tables"]
    return Split(fields - started, tables - fields, ended - tables, sum(tasks))


def _parts(client: Client, paths: Sequence[Path], study: sb.Study) -> Parts:
    """The mean times of a mesh's parts while every worker is busy with the same part of others."""
    shares = [paths[i::_WORKERS][:_SAMPLE_PER_WORKER] for i in range(_WORKERS)]
    futures = [
        client.submit(_measure_parts, share, study.lattice, study.transform, workers=[worker], pure=False)
        for share, worker in zip(shares, client.scheduler_info()["workers"], strict=True)
    ]
    found: list[Parts] = client.gather(futures)
    return Parts(*np.mean([astuple(parts) for parts in found], axis=0).tolist())


def _measure_parts(paths: Sequence[Path], lattice: sb.Lattice, transform: TransformSettings) -> Parts:
    meshes: list[sb.Mesh] = []
    reading = elapsed_seconds(lambda: meshes.extend(sb.read_mesh(path) for path in paths))

    def transform_all() -> None:
        for mesh in meshes:
            transform_block(mesh, lattice, lattice.half, transform)

    def describe_all() -> None:
        for mesh in meshes:
            _ = mesh.edge_lengths, mesh.counts, mesh.digest

    parts = reading, elapsed_seconds(transform_all), elapsed_seconds(describe_all)
    return Parts(*(seconds / len(meshes) for seconds in parts))


def _write_meshes(folder: Path, count: int, level: int) -> list[Path]:
    """Icospheres whose radius varies by a hundredth from vertex to vertex."""
    rng = np.random.default_rng(0)
    sphere = sb.shapes.icosphere(level)
    paths = [folder / f"{i:03}.ply" for i in range(count)]
    for path in paths:
        radii = 1 + 0.01 * rng.uniform(-1, 1, (len(sphere.vertices), 1))
        trimesh.Trimesh(radii * sphere.vertices, sphere.triangles, process=False).export(path)
    return paths


def _study_of_files(intervals: int) -> dict[str, Any]:
    return {
        "study": {"name": "overhead"},
        "lattice": {"xi_max": _XI_MAX, "M": intervals},
        "norm": {"orders": [-10.0]},
        "reference": {"source": "sphere"},
        "family": [{"name": "perturbed", "source": "files", "paths": ["*.ply"]}],
    }


def _study_of_spheres(count: int, intervals: int, orders: Sequence[float], pairs: str) -> sb.Study:
    """Spheres in closed form, since tables take as long whatever the fields hold."""
    rng = np.random.default_rng(0)
    families = [
        {
            "name": f"{i}",
            "source": "sphere",
            "radius": rng.uniform(0.5, 0.9),
            "center": rng.uniform(-0.3, 0.3, 3).tolist(),
        }
        for i in range(count)
    ]
    table = {
        "study": {"name": "pairs"},
        "lattice": {"xi_max": _XI_MAX, "M": intervals},
        "norm": {"orders": list(orders)},
        "compare": {"pairs": pairs},
        "reference": {"source": "family", "family": "0"},
        "family": families,
    }
    return sb.Study.from_table(table)


def _stored_fields(store: Path) -> Reals:
    """Real and imaginary parts of all fields of a store, a row each (fields, 2 · samples)."""
    fourier = sb.open_store(store)["fourier"].to_dataset()["fourier"]
    return fourier.values.reshape(len(fourier), -1).view(np.float64)


def _weights(lattice: sb.Lattice, orders: Sequence[float]) -> Iterator[Reals]:
    """For each order what a real or imaginary part counts for in the squared norm (2 · samples,)."""
    trapezoid = lattice.trapezoid_weights(lattice.half).ravel()
    shells = lattice.shells(lattice.half).ravel()
    for by_shell in SobolevWeights(lattice, tuple(orders)).per_shell:
        yield np.repeat(trapezoid * by_shell[shells], 2)
