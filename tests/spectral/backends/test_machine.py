"""The memory of the machine, with the limits of control groups, which a made-up file system stands in for."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

import sobolev_batch as sb
from sobolev_batch.spectral.backends.machine import MachineMemory, require_machine_memory

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
    surfaces = sb.Sphere(), sb.Sphere(0.9)
    for ask in (
        lambda: sb.distance(*surfaces, -2.0, rtol=0.1, memory="1000TB"),
        lambda: sb.norm(surfaces[0], -2.0, rtol=0.1, memory=1e15),
        lambda: sb.witness(*surfaces, -2.0, [[0, 0, 0]], lattice=sb.Lattice(1.0, 8), memory="1000TB"),
    ):
        with pytest.raises(sb.InputError, match=r"memory of 1\.0PB is more than there is"):
            ask()
