"""Memory and cores of the machine, by control groups in a made-up file system; whole numbers that are NumPy's."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import sobolev_batch as sb
from sobolev_batch.batch.cluster.clients import memory_limit
from sobolev_batch.batch.cluster.workers import Workers, allowed_bytes
from sobolev_batch.machine import available_cores, machine_memory, require_machine_memory
from sobolev_batch.transform.fourier import thread_count
from tests.support.repository import public_names
from tests.support.studies import small_table

TOTAL = psutil.virtual_memory().total
V1 = "5:cpu,cpuacct:/x\n4:hugetlb,memory:/jobs/7\n0::/\n"
# Files below /sys/fs/cgroup beside the groups of this process, and the bytes that they leave.
MEMORY: dict[str, tuple[str | None, dict[str, str], int | None]] = {
    "no groups": (None, {}, None),
    "version 2": ("0::/a/b\n", {"a/b/memory.max": "3000000"}, 3_000_000),
    "version 2 without a limit": ("0::/a\n", {"a/memory.max": "max"}, None),
    "the group between three is the tightest": (
        "0::/a/b/c\n",
        {"a/b/c/memory.max": "4000000", "a/b/memory.max": "2500000", "a/memory.max": "3000000"},
        2_500_000,
    ),
    "the lower limit": ("0::/a\n", {"a/memory.max": "4000000", "a/memory.high": "3500000"}, 3_500_000),
    "a container, at whose top the group lies": ("0::/outside\n", {"memory.max": "5000000"}, 5_000_000),
    "version 1": (V1, {"memory/jobs/7/memory.limit_in_bytes": "4000000"}, 4_000_000),
    "version 1, around": (
        V1,
        {"memory/jobs/7/memory.limit_in_bytes": "9223372036854771712", "memory/jobs/memory.limit_in_bytes": "4500000"},
        4_500_000,
    ),
}


def make_root(root: Path, groups: str | None, files: dict[str, str]) -> Path:
    paths = {f"sys/fs/cgroup/{name}": text for name, text in files.items()}
    if groups is not None:
        paths["proc/self/cgroup"] = groups
    for name, text in paths.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(("groups", "files", "limit"), MEMORY.values(), ids=MEMORY.keys())
def test_limits_of_memory_count(groups: str | None, files: dict[str, str], limit: int | None, tmp_path: Path) -> None:
    memory, source = machine_memory(make_root(tmp_path, groups, files))
    assert memory == (TOTAL if limit is None else limit)
    assert ("memory." in source) == (limit is not None)


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        (None, {}, 8),
        ("0::/a\n", {"a/cpu.max": "max 100000"}, 8),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "a/cpu.max": "250000 100000"}, 3),
        ("0::/outside\n", {"cpu.max": "50000 100000"}, 1),
        (V1, {"cpu/x/cpu.cfs_quota_us": "200000", "cpu/x/cpu.cfs_period_us": "100000"}, 2),
        (V1, {"cpu/x/cpu.cfs_quota_us": "-1", "cpu/x/cpu.cfs_period_us": "100000"}, 8),
    ],
)
def test_quotas_and_affinity_limit_cores(
    groups: str | None, files: dict[str, str], cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(8)), raising=False)
    assert available_cores(make_root(tmp_path, groups, files)) == cores


def test_transforms_take_no_more_threads_than_there_are_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0}, raising=False)
    assert thread_count(None) == 1


def test_more_than_there_is_is_refused_with_both_numbers() -> None:
    require_machine_memory(1, "memory")
    with pytest.raises(
        sb.errors.InputError, match=r"memory of 1\.0PB is more than there is: .*B, (all of|the limit in) "
    ):
        require_machine_memory(1e15, "memory")


SPHERES = sb.shapes.Sphere(), sb.shapes.Sphere(0.9)
STUDY = sb.Study.from_table(small_table())
# Every public function with such an argument, by name.
ASKING: dict[str, Callable[[], object]] = {
    "testing.assert_same_surface": lambda: sb.testing.assert_same_surface(*SPHERES, memory="1000TB"),
    "distance": lambda: sb.distance(*SPHERES, -2.0, rtol=0.1, memory="1000TB"),
    "norm": lambda: sb.norm(SPHERES[0], -2.0, rtol=0.1, memory=1e15),
    "run": lambda: sb.run(STUDY, "memory://greedy.zarr", memory="1000TB"),
    "testing.same_surface": lambda: sb.testing.same_surface(*SPHERES, memory="1000TB"),
    "yardsticks": lambda: sb.yardsticks(
        sb.shapes.icosphere(1), sb.shapes.icosphere(2), -2.0, rtol=0.1, memory="1000TB"
    ),
}


@pytest.mark.parametrize("name", ASKING)
def test_no_function_believes_more_than_there_is(name: str) -> None:
    with pytest.raises(sb.errors.InputError, match=r"memory (of a worker )?of 1\.0PB is more than there is"):
        ASKING[name]()


def test_every_function_with_a_memory_is_asked() -> None:
    functions = {name: value for name, value in public_names().items() if inspect.isfunction(value)}
    assert {name for name, one in functions.items() if "memory" in inspect.signature(one).parameters} == set(ASKING)


def test_workers_together_have_no_more_than_the_machine() -> None:
    share = 0.6 * TOTAL
    assert memory_limit(share, 1) == int(share)
    with pytest.raises(
        sb.errors.InputError, match=r"the memory of 2 workers of .* is more .*; ask for less for each, or take"
    ):
        memory_limit(share, 2)


def test_a_worker_that_was_started_with_more_than_there_is_has_what_there_is() -> None:
    assert allowed_bytes(1e15) == allowed_bytes(None) == Workers.of_this_machine(1).largest_allowed_bytes
    assert allowed_bytes(1e9) < allowed_bytes(None)


@pytest.mark.slow
def test_integers_of_numpy_are_whole_numbers() -> None:
    few: Any = np.int64(3)
    small: Any = np.int8(100)
    goal: Any = np.int64(40)
    assert sb.Lattice(1.0, small) == sb.Lattice(1.0, 100)
    # As an integer of 8 bits, 100 times 100 is 16.
    assert len(sb.shapes.Torus(2.0, 1.0).mesh(small, small).triangles) == 20_000
    assert len(sb.shapes.icosphere(few).triangles) == 1280
    fitted = sb.fitting.refine(sb.shapes.icosphere(0), sb.shapes.Sphere(), -4.0, triangles=goal, steps=few)
    assert 20 < len(fitted.mesh.triangles) <= 40
    for wrong in (True, np.True_, 3.0, "3"):
        with pytest.raises(sb.errors.InputError, match="level must be an integer"):
            sb.shapes.icosphere(wrong)  # type: ignore[arg-type]
