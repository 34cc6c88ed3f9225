"""How rows become tasks that fit into workers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sobolev_batch import ClusterError, Lattice
from sobolev_batch.batch.cluster.workers import WorkerInfo, Workers
from sobolev_batch.batch.fields.compute import size_tasks
from sobolev_batch.spectral.backends import CPU_COSTS, NufftSpec, Workload
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform.transform import TransformSettings, fastest_spec, projected_bytes
from sobolev_batch.surfaces.sources.registry import ExpectedSize
from tests.support.commands import call, write_toml

ONE_CHUNK = Lattice(5.0, 64).split(1 << 24)
LARGE = Lattice(5.0, 512).split(1 << 24)
TRANSFORM = TransformSettings()


def workers_with(*gigabytes: float, threads: int = 1) -> Workers:
    return Workers(
        tuple(
            WorkerInfo(f"tcp://{number}", threads, 1e9 * allowed, "cpu", "") for number, allowed in enumerate(gigabytes)
        )
    )


def test_a_usual_mesh_is_one_task_with_all_the_memory_it_can_use() -> None:
    groups, allowed, projected = size_tasks(
        ONE_CHUNK, TRANSFORM, ExpectedSize(20_000, 1e7), workers_with(8, 8), rows=100
    )
    assert groups == (ONE_CHUNK,)
    # It claims what it is going to use, and may use what there is.
    assert allowed == pytest.approx(8e9, rel=0.01)
    assert projected_bytes(ONE_CHUNK[0], TRANSFORM, triangles=20_000) < projected < 0.4e9


def test_a_transform_gets_what_its_thread_has_and_no_less_than_it_can_work_in() -> None:
    _, allowed, projected = size_tasks(LARGE, TRANSFORM, ExpectedSize(1000, 0), workers_with(1.5), rows=10)
    assert allowed < projected_bytes(LARGE[0], TRANSFORM) - LARGE[0].size * 16
    assert projected == pytest.approx(1.5e9)
    # Four at once would leave nothing to each: such tasks run beside fewer others.
    _, allowed, projected = size_tasks(LARGE, TRANSFORM, ExpectedSize(1000, 0), workers_with(2.25, threads=4), rows=10)
    assert allowed == pytest.approx(256e6, rel=1e-2)
    assert 2.25e9 / 4 < projected <= 2.25e9


@pytest.mark.parametrize("triangles", [2_500_000, 3_000_000, 20_000_000])
@pytest.mark.parametrize("blocks", [ONE_CHUNK, LARGE])
@pytest.mark.parametrize("threads", [4, 8])
def test_a_transform_can_always_work_in_what_it_gets(triangles: int, blocks: tuple[Block, ...], threads: int) -> None:
    workers = workers_with(5, threads=threads)
    _, allowed, projected = size_tasks(blocks, TRANSFORM, ExpectedSize(triangles, 0), workers, rows=1)
    workload = Workload(triangles * 3, triangles * 12, triangles)
    fastest_spec(NufftSpec(blocks[0].shape, 1e-9), workload, CPU_COSTS, allowed)
    assert projected <= 5e9


@pytest.mark.parametrize(("rows", "groups"), [(1, 4), (2, 2), (4, 1), (1000, 1)])
def test_blocks_of_a_few_meshes_are_spread_over_threads_those_of_many_stay_together(rows: int, groups: int) -> None:
    found, *_ = size_tasks(LARGE, TRANSFORM, ExpectedSize(1000, 0), workers_with(8, 8), rows)
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
        size_tasks(blocks, TRANSFORM, size, workers_with(*gigabytes), rows=1)


@pytest.mark.process
def test_a_lattice_that_fits_into_no_worker_is_refused_with_both_numbers(tmp_path: Path) -> None:
    study = write_toml(tmp_path)
    study.write_text(study.read_text().replace("M = 16", "M = 1024"))
    arguments = "--store", tmp_path / "large.zarr", "--workers", "1", "--memory", "700MB"
    done = call("run", study, *arguments)
    assert done.returncode == 1
    expected = r"it takes about 777\.6MB in one task, and no worker has more than 295\.0MB"
    assert re.search(expected, " ".join(done.stderr.split())), done.stderr
    assert "[1/5]" not in done.stderr
    # Where they are, too large a lattice is a matter of how many blocks.
    planned = call("plan", study, "--store", tmp_path / "large.zarr")
    assert planned.returncode == 0, planned.stderr
    assert "chunks of the lattice: " in planned.stdout
