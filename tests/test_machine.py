"""The memory of the machine, with the limits of control groups, which a made-up file system stands in for."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import click
import psutil
import pytest

import sobolev_batch as sb
from sobolev_batch.batch.cluster.clients import memory_limit
from sobolev_batch.batch.cluster.workers import Workers, allowed_bytes
from sobolev_batch.cli import cli
from sobolev_batch.machine import MachineMemory, require_machine_memory
from tests.support.studies import small_table

TOTAL = psutil.virtual_memory().total
# Files by path, and the bytes that they leave of 1 TB.
TREES: dict[str, tuple[dict[str, str], int | None]] = {
    "no groups": ({}, None),
    "version 2": ({"proc/self/cgroup": "0::/a/b\n", "sys/fs/cgroup/a/b/memory.max": "3000000\n"}, 3_000_000),
    "version 2 without a limit": ({"proc/self/cgroup": "0::/a\n", "sys/fs/cgroup/a/memory.max": "max\n"}, None),
    "a limit of the group around": (
        {
            "proc/self/cgroup": "0::/a/b\n",
            "sys/fs/cgroup/a/b/memory.max": "max\n",
            "sys/fs/cgroup/a/memory.max": "2000000\n",
        },
        2_000_000,
    ),
    "limits of three groups, of which the one between is the tightest": (
        {
            "proc/self/cgroup": "0::/a/b/c\n",
            "sys/fs/cgroup/a/b/c/memory.max": "4000000\n",
            "sys/fs/cgroup/a/b/memory.max": "2500000\n",
            "sys/fs/cgroup/a/memory.max": "3000000\n",
        },
        2_500_000,
    ),
    "the lower limit of version 2": (
        {
            "proc/self/cgroup": "0::/a\n",
            "sys/fs/cgroup/a/memory.max": "4000000\n",
            "sys/fs/cgroup/a/memory.high": "3500000\n",
        },
        3_500_000,
    ),
    "a limit of the group around, in version 1": (
        {
            "proc/self/cgroup": "4:memory:/jobs/7\n",
            "sys/fs/cgroup/memory/jobs/7/memory.limit_in_bytes": "9223372036854771712\n",
            "sys/fs/cgroup/memory/jobs/memory.limit_in_bytes": "4500000\n",
        },
        4_500_000,
    ),
    "a container, at whose top the group lies": (
        {"proc/self/cgroup": "0::/outside/name\n", "sys/fs/cgroup/memory.max": "5000000\n"},
        5_000_000,
    ),
    "version 1": (
        {
            "proc/self/cgroup": "5:cpu:/x\n4:hugetlb,memory:/job\n0::/\n",
            "sys/fs/cgroup/memory/job/memory.limit_in_bytes": "4000000\n",
        },
        4_000_000,
    ),
    "version 1 without a limit": (
        {
            "proc/self/cgroup": "4:memory:/job\n",
            "sys/fs/cgroup/memory/job/memory.limit_in_bytes": "9223372036854771712\n",
        },
        None,
    ),
}


@pytest.mark.parametrize(("files", "limit"), TREES.values(), ids=TREES.keys())
def test_limits_of_control_groups_count(files: dict[str, str], limit: int | None, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    memory = MachineMemory.found(tmp_path)
    assert memory.total_bytes == (TOTAL if limit is None else limit)
    assert ("memory." in memory.source) == (limit is not None)


def test_more_than_there_is_is_refused_with_both_numbers() -> None:
    require_machine_memory(1, "memory")
    with pytest.raises(sb.InputError, match=r"memory of 1\.0PB is more than there is: .*B, (all of|the limit in) "):
        require_machine_memory(1e15, "memory")


SPHERES = sb.Sphere(), sb.Sphere(0.9)
FIELD = sb.fourier_transform(SPHERES[0], sb.Lattice(1.0, 8))
LATTICE = sb.Lattice(1.0, 8)
STUDY = sb.Study.from_table(small_table())
# Every public function with such an argument, by name.
ASKING: dict[str, Callable[[], object]] = {
    "SobolevAccessor.witness": lambda: FIELD.sobolev.witness(SPHERES[1], -2.0, [[0, 0, 0]], memory=1e15),
    "assert_same_surface": lambda: sb.assert_same_surface(*SPHERES, memory="1000TB"),
    "distance": lambda: sb.distance(*SPHERES, -2.0, rtol=0.1, memory="1000TB"),
    "inner_product": lambda: sb.inner_product(*SPHERES, -2.0, rtol=0.1, memory="1000TB"),
    "norm": lambda: sb.norm(SPHERES[0], -2.0, rtol=0.1, memory=1e15),
    "run": lambda: sb.run(STUDY, "memory://greedy.zarr", memory="1000TB"),
    "same_surface": lambda: sb.same_surface(*SPHERES, memory="1000TB"),
    "witness": lambda: sb.witness(*SPHERES, -2.0, [[0, 0, 0]], lattice=LATTICE, memory="1000TB"),
    "yardsticks": lambda: sb.yardsticks(sb.icosphere(1), sb.icosphere(2), -2.0, rtol=0.1, memory="1000TB"),
}


@pytest.mark.parametrize("name", ASKING)
def test_no_function_believes_more_than_there_is(name: str) -> None:
    with pytest.raises(sb.InputError, match=r"memory (of a worker )?of 1\.0PB is more than there is"):
        ASKING[name]()


def test_every_function_with_a_memory_is_asked() -> None:
    public = {name: getattr(sb, name) for name in sb.__all__}
    methods = {
        f"{name}.{own}": value
        for name, kind in public.items()
        if inspect.isclass(kind)
        for own, value in vars(kind).items()
    }
    functions = {name: value for name, value in (public | methods).items() if inspect.isfunction(value)}
    assert {name for name, one in functions.items() if "memory" in inspect.signature(one).parameters} == set(ASKING)


def test_every_command_with_a_memory_is_known() -> None:
    """What `compare`, with and without a bound, and `run` do with it, the tests of commands try."""
    options = {
        name: [option for parameter in command.params for option in parameter.opts if "memory" in option]
        for name, command in cli.commands.items()
        if isinstance(command, click.Command)
    }
    assert {name: found for name, found in options.items() if found} == {
        "compare": ["--memory"],
        "run": ["--memory"],
    }


def test_workers_together_have_no_more_than_the_machine() -> None:
    share = 0.6 * TOTAL
    assert memory_limit(share, 1) == int(share)
    with pytest.raises(
        sb.InputError, match=r"the memory of 2 workers of .* is more .*; ask for less for each, or take"
    ):
        memory_limit(share, 2)


def test_a_worker_that_was_started_with_more_than_there_is_has_what_there_is() -> None:
    assert allowed_bytes(1e15) == allowed_bytes(None) == Workers.of_this_machine(1).largest_allowed_bytes
    assert allowed_bytes(1e9) < allowed_bytes(None)
