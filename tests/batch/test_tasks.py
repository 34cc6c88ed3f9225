"""Tasks of one row, how rows become tasks that fit into workers, and meshes and lattices larger than a worker."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from numpy.typing import NDArray

from sobolev_batch import Lattice, Mesh, Study, open_store, run
from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers
from sobolev_batch.batch.field_costs import size_tasks
from sobolev_batch.batch.field_tasks import Job, compute_mesh, compute_parts, finish_mesh
from sobolev_batch.errors import ClusterError
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.fields import Quality
from sobolev_batch.norms.tail.sampling import Octave
from sobolev_batch.shapes import Similarity, icosphere
from sobolev_batch.sources.registry import ExpectedSize
from sobolev_batch.store.create import prepare_store
from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.records import Records
from sobolev_batch.study.plan import Plan, make_plan
from sobolev_batch.transform.fourier import TransformSettings, projected_bytes, settings_on
from sobolev_batch.transform.lattice import Block, OctaveLattice
from sobolev_batch.transform.nufft_costs import CPU_COSTS, NufftSpec, Workload, fastest_spec
from sobolev_batch.transform.rules import gauss_rule
from tests.support.commands import call, write_toml
from tests.support.members import loaded
from tests.support.repository import ROOT
from tests.support.studies import small_table, variable

FINE = small_table(family=[{"name": "ico", "source": "icosphere", "levels": [0, 5]}])


def job_of(plan: Plan, store_path: Path, label: str = "ico/5", allowed_bytes: float | None = None) -> Job:
    row = next(row for row in plan.rows if row.label == label)
    return Job(prepare_store(store_path, plan), 0, row, plan, allowed_bytes)


def test_a_mesh_is_one_task_whatever_the_memory_allows(store_path: Path) -> None:
    plan = make_plan(Study.from_table(FINE))
    whole = compute_mesh(job_of(plan, store_path), plan.blocks)
    reason = compute_mesh(job_of(plan, store_path.with_name("other.zarr"), allowed_bytes=1.0), plan.blocks).reason
    assert "is what the limit of its worker leaves; raise that limit by --worker-memory" in reason
    # So little that points are added up in batches.
    job = replace(job_of(plan, store_path, allowed_bytes=1.25e7), row=1)
    record = compute_mesh(job, plan.blocks)
    assert record.status == "complete", record.reason
    # Batches of triangles share no nodes with each other.
    assert whole.facts.points <= record.facts.points < 1.1 * whole.facts.points
    assert replace(record.facts, points=whole.facts.points) == whole.facts
    expected, values = Fields(job.store).read([0, 1], plan.lattice.half.place_in(plan.lattice.half))
    assert np.abs(values - expected).max() < 2e-9 * whole.facts.area


def test_octaves_have_the_precision_that_their_own_accuracy_needs(store_path: Path) -> None:
    job, octave = job_of(make_plan(Study.from_table(FINE)), store_path), Octave(2.0, 1)
    lattice = OctaveLattice.random(octave.lowest, octave.highest, 16, np.random.default_rng(0))
    precisions: tuple[ComplexDtype, ...] = ("complex64", "complex128")
    for precision in precisions:
        for distance, expected in ((1.0, "complex64"), (1e-6, "complex128")):
            choice = replace(job.plan.choice, transform_dtype=precision, closest=(distance,))
            study = replace(job.plan.study, orders=(-2.0,), accuracy=Accuracy(0.1))
            both = replace(job, plan=replace(job.plan, study=study, choice=choice, reference=job.planned.label))
            mesh = job.load()
            permitted = both.error_target(mesh)
            assert permitted is not None
            assert settings_on(lattice, mesh, permitted).dtype == expected


def test_what_a_mesh_and_its_reference_cover_is_nothing_beyond_the_octaves(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.3 0.6 0\n"
    cuts = {"reference": "f 1 2 3\nf 1 3 4\n", "anew": "f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"}
    for name, faces in cuts.items():
        (tmp_path / f"{name}.obj").write_text(corners + faces)
    files: dict[str, Any] = {name: {"source": "files", "paths": [f"{name}.obj"]} for name in cuts}
    table = {
        "lattice": {"xi_max": 3.0, "M": 16, "octaves": 1},
        "reference": files["reference"],
        "family": [{"name": "plates", **files["anew"]}],
    }
    plan = make_plan(Study.from_table(small_table(**table), folder=tmp_path))
    reference, row = (next(row for row in plan.rows if row.label == label) for label in ("reference", "plates/anew"))
    job = Job(prepare_store(tmp_path / "store.zarr", plan), 0, row, plan, None, reference)
    stored = compute_parts(job, octaves=True)
    # The next task takes the same one.
    assert job.load_reference() is job.load_reference()
    assert isinstance(stored, list)
    quality = stored[0].quality
    assert quality is not None
    assert quality.tail is not None
    assert quality.tail.difference is not None
    assert not any(quality.tail.difference.errors)


def test_tasks_measure_what_lies_beyond_a_given_lattice_where_faces_are_flat(store_path: Path) -> None:
    plan = make_plan(Study.from_table(small_table()))
    reference = next(row for row in plan.rows if row.label == plan.reference)
    for row in plan.rows[:2]:
        record = compute_mesh(replace(job_of(plan, store_path, row.label), reference=reference), plan.blocks)
        assert record.status == "complete", record.reason
        bounds = Quality.from_json(record.quality).beyond_at([-1.0, -2.0])
        assert np.isfinite(bounds).all()
        # The reference is not apart from itself.
        assert (bounds > 0).all() == (row is not reference)


def test_a_task_whose_record_is_there_writes_nothing(store_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = {"xi_max": 3.0, "M": 16, "octaves": 1}
    study = Study.from_table(small_table(lattice=lattice, norm={"orders": [-2.0]}))
    plan = make_plan(replace(study, largest_chunk_bytes=16_000))
    blocks = plan.blocks
    job = job_of(plan, store_path, "ico/1")
    parts = [*(compute_parts(job, [block]) for block in blocks), compute_parts(job, octaves=True)]
    record = finish_mesh(job, *parts)
    assert (record.status, len(record.checksums)) == ("complete", len(blocks) + 1)

    def refuse(*arguments: Any) -> None:
        raise AssertionError("it is written again")

    for owner in (Fields, Records):
        monkeypatch.setattr(owner, "write", refuse)
    again = [*(compute_parts(job, [block]) for block in blocks), compute_parts(job, octaves=True)]
    # Those whose worker was lost are done again; the results of others may be there still.
    for mixture in (parts, again, [*parts[:2], *again[2:]]):
        assert finish_mesh(job, *mixture) == record
    assert compute_mesh(job, blocks) == record


ONE_CHUNK = Lattice(5.0, 64).half.split(1 << 24)
LARGE = Lattice(5.0, 512).half.split(1 << 24)
TRANSFORM = TransformSettings()


def workers_with(*gigabytes: float, threads: int = 1) -> Workers:
    return Workers(tuple(WorkerInfo(f"tcp://{most}", threads, 1e9 * most, "cpu", "") for most in gigabytes))


def sized(blocks: tuple[Block, ...], triangles: int, workers: Workers, rows: int = 1) -> Any:
    return size_tasks(blocks, TRANSFORM, ExpectedSize(triangles, 0), workers, rows, (blocks[0], 0.0))


def test_a_task_may_use_what_its_thread_has_and_no_less_than_it_can_work_in() -> None:
    groups, allowed, projected = sized(ONE_CHUNK, 20_000, workers_with(8, 9), rows=100)
    assert groups == (ONE_CHUNK,)
    # It claims what it is going to use, and may use what there is.
    assert allowed == pytest.approx(8e9, rel=0.01)
    assert projected_bytes(ONE_CHUNK[0], TRANSFORM, triangles=20_000) < projected < 0.4e9
    _, allowed, projected = sized(LARGE, 1000, workers_with(1.5))
    assert allowed < projected_bytes(LARGE[0], TRANSFORM) - LARGE[0].size * 16
    assert projected == pytest.approx(1.5e9)
    # Four at once would leave nothing to each: such tasks run beside fewer others.
    _, allowed, projected = sized(LARGE, 1000, workers_with(2.25, threads=4))
    assert allowed == pytest.approx(256e6, rel=1e-2)
    assert 2.25e9 / 4 < projected <= 2.25e9


def test_a_transform_can_always_work_in_what_it_gets() -> None:
    for triangles, blocks, threads in product((2_500_000, 3_000_000, 20_000_000), (ONE_CHUNK, LARGE), (4, 8)):
        _, allowed, projected = sized(blocks, triangles, workers_with(5, threads=threads))
        workload = Workload(triangles * 3, triangles * 12, triangles)
        fastest_spec(NufftSpec(blocks[0].shape, 1e-9), workload, CPU_COSTS, allowed)
        assert projected <= 5e9


@pytest.mark.parametrize(("rows", "groups"), [(1, 4), (2, 2), (4, 1), (1000, 1)])
def test_blocks_of_a_few_meshes_are_spread_over_threads_those_of_many_stay_together(rows: int, groups: int) -> None:
    found, *_ = sized(LARGE, 1000, workers_with(8, 9), rows)
    assert len(found) == min(groups, len(LARGE))
    assert tuple(block for group in found for block in group) == LARGE


@pytest.mark.parametrize(
    ("blocks", "size", "gigabytes", "numbers"),
    [
        (ONE_CHUNK, ExpectedSize(1000, 9e9), (3.1, 2.0), ("9.0GB", "3.1GB")),
        (ONE_CHUNK, ExpectedSize(60_000_000, 0), (3.1, 2.0), ("12.3GB", "3.1GB")),
        (LARGE, ExpectedSize(), (0.4,), ("690.5MB", "400.0MB")),
    ],
)
def test_what_fits_into_no_worker_is_refused_with_both_numbers(
    blocks: tuple[Block, ...], size: ExpectedSize, gigabytes: tuple[float, ...], numbers: tuple[str, str]
) -> None:
    needed, most = map(re.escape, numbers)
    with pytest.raises(ClusterError, match=rf"takes about {needed} in one task, and no worker has more than {most}"):
        size_tasks(blocks, TRANSFORM, size, workers_with(*gigabytes), 1, (blocks[0], 0.0))


@pytest.mark.process
def test_a_lattice_that_fits_into_no_worker_is_refused_with_both_numbers(tmp_path: Path) -> None:
    study = write_toml(tmp_path)
    study.write_text(study.read_text().replace("M = 16", "M = 1024"))
    done = call("run", study, "--store", tmp_path / "large.zarr", "--workers", "1", "--worker-memory", "700MB")
    assert done.returncode == 1
    expected = r"it takes about 777\.6MB in one task, and no worker has more than 295\.0MB"
    assert re.search(expected, " ".join(done.stderr.split())), done.stderr
    assert "[1/5]" not in done.stderr
    # Where they are, too large a lattice is a matter of how many blocks.
    planned = call("plan", study, "--store", tmp_path / "large.zarr")
    assert planned.returncode == 0, planned.stderr
    assert "chunks of the lattice: " in planned.stdout


PER_EDGE = 32
SCALE = 0.009


def write_subdivided(mesh: Mesh, per_edge: int, path: Path) -> int:
    """A PLY file of a mesh whose triangles are cut into per_edge² flat ones each; how many it holds."""
    i, j = np.meshgrid(np.arange(per_edge + 1), np.arange(per_edge + 1), indexing="ij")
    inside = i + j <= per_edge
    number = np.cumsum(inside).reshape(inside.shape) - 1
    barycentric = np.stack([per_edge - i[inside] - j[inside], i[inside], j[inside]], axis=1) / per_edge
    a, b = (part[:-1, :-1].ravel() for part in (i, j))
    upright, turned = a + b < per_edge, a + b < per_edge - 1
    small = np.concatenate(
        [
            np.stack([number[a, b], number[a + 1, b], number[a, b + 1]], axis=1)[upright],
            np.stack([number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]], axis=1)[turned],
        ]
    )
    vertices = (barycentric @ mesh.vertices[mesh.triangles]).reshape(-1, 3)
    starts = np.arange(len(mesh.triangles), dtype=np.int32) * np.int32(len(barycentric))
    faces = np.empty(len(starts) * len(small), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = (small.astype(np.int32) + starts[:, None, None]).reshape(-1, 3)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        vertices.astype("<f8").tofile(file)
        faces.tofile(file)
    return len(faces)


def direct_sum(mesh: Mesh, frequencies: NDArray[np.float64]) -> NDArray[np.complex128]:
    """The transform by 64 points a triangle, which knows neither series nor NUFFT nor pieces."""
    rule = gauss_rule(8)
    points = np.einsum("pk,tkx->tpx", rule.barycentric, mesh.vertices[mesh.triangles]).reshape(-1, 3)
    weights = np.outer(mesh.areas, rule.weights).ravel()
    return np.array([np.sum(weights * np.exp(-2j * np.pi * (points @ frequency))) for frequency in frequencies])


def assert_field(store: Path, row: str, lattice: Lattice, mesh: Mesh, eps: float, seed: int) -> None:
    """Compare a stored field with a direct sum at random frequencies."""
    rng = np.random.default_rng(seed)
    index = tuple(rng.integers(0, count, 8) for count in lattice.shape)
    frequencies = np.stack([axis[place] for axis, place in zip(lattice.axes, index, strict=True)], axis=1)
    names = ("xi_x", "xi_y", "xi_z")
    where: dict[str, Any] = {name: ("draw", place) for name, place in zip(names, index, strict=True)}
    found = variable(open_store(store), "fourier", "fourier").sel(mesh=row).isel(where).to_numpy()
    assert np.abs(found - direct_sum(mesh, frequencies)).max() < 5 * eps * mesh.area


@contextmanager
def same_worker(memory: str) -> Iterator[Client]:
    """A cluster of one worker, which must not be ended for its memory."""
    with local_client(1, memory) as client:
        before = client.run(os.getpid)
        yield client
        assert client.run(os.getpid) == before


@pytest.mark.all
@pytest.mark.timeout(900)
def test_twenty_million_triangles_on_a_worker_of_six_gigabytes(tmp_path: Path, store_path: Path) -> None:
    cortex = Study.from_toml(ROOT / "workflows" / "cortex.toml")
    base = loaded(*cortex.object.reference.members(cortex.object.folder))  # type: ignore[union-attr]
    count = write_subdivided(base, PER_EDGE, tmp_path / "huge.ply")
    assert count > 20_000_000
    # Finer, it takes four times the points and as many times as long.
    lattice, eps = Lattice(4.0, 48), 1e-6
    table = small_table(
        lattice={"xi_max": lattice.xi_max, "M": lattice.M},
        norm={"orders": [-2.0]},
        transform={"eps": eps},
        scaling={"mode": "fixed", "scale": SCALE},
        family=[{"name": "cortex", "source": "files", "paths": ["huge.ply"]}],
    )
    study = Study.from_table(table, folder=tmp_path)
    with same_worker("6GB") as client:
        assert not run(study, store_path, client).failed
    meshes = open_store(store_path)["meshes"].to_dataset().sel(mesh="cortex/huge")
    assert meshes["triangles"].item() == count
    scaled = Similarity(SCALE).apply(base)
    assert isinstance(scaled, Mesh)
    assert meshes["area"].item() == pytest.approx(scaled.area, rel=1e-12)
    # A flat subdivision has the transform of the original.
    assert_field(store_path, "cortex/huge", lattice, scaled, eps, seed=1)
    (tmp_path / "huge.ply").unlink()


@pytest.mark.all
@pytest.mark.timeout(900)
def test_a_lattice_of_512_intervals_on_a_worker_of_three_gigabytes(store_path: Path) -> None:
    lattice = Lattice(20.0, 512)
    table = small_table(
        lattice={"xi_max": lattice.xi_max, "M": lattice.M},
        norm={"orders": [-2.0]},
        compare=None,
        family=[{"name": "ico", "source": "icosphere", "levels": [4]}],
    )
    study = Study.from_table(table)
    with same_worker("3GB") as client:
        assert not run(study, store_path, client).failed
    assert_field(store_path, "ico/4", lattice, icosphere(4), 1e-9, seed=2)
    assert len(list((store_path / "fourier" / "fourier" / "c" / "0").rglob("*"))) > 4
    distance = variable(open_store(store_path), "distances", "distance").sel(mesh="ico/4").item()
    assert 0 < distance < 0.1
