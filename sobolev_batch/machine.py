"""The memory and the cores of this machine that this process may use."""

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import byte_count, format_bytes

_ROOT = Path("/")


def machine_memory(root: Path = _ROOT) -> tuple[int, str]:
    """Return the bytes that this process can have at most, and what sets them: the machine, or a control group.

    Containers, batch systems and systemd limit processes by control groups, of version 1 or 2. Dask looks at the
    outermost group only, where a job of SLURM has its limits further in. The root has /proc and /sys.
    """
    most, source = psutil.virtual_memory().total, "all of this machine"
    for group in _control_groups(root, "memory"):
        # Beyond the lower limit, memory.high, the kernel takes memory back, and the process all but stands still.
        for name in ("memory.max", "memory.high", "memory.limit_in_bytes"):
            # "max" is no limit, and another process may remove a group.
            with suppress(OSError, ValueError):
                limit = int((group / name).read_text())
                if 0 < limit < most:
                    most, source = limit, f"the limit in {group / name}"
    return most, source


def available_cores(root: Path = _ROOT) -> int:
    """Return the number of cores that this process may use, by its affinity and the quotas of its control groups."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        count = os.cpu_count() or 1
    for group in _control_groups(root, "cpu"):
        for names in (["cpu.max"], ["cpu.cfs_quota_us", "cpu.cfs_period_us"]):
            with suppress(OSError, ValueError):
                quota, period = map(int, " ".join((group / name).read_text() for name in names).split())
                if quota > 0:
                    count = min(count, math.ceil(quota / period))
    return count


def available(memory: float | str) -> int:
    """Return a size of memory in bytes, as `byte_count` does, and refuse more than this machine has."""
    count = byte_count(memory)
    require_machine_memory(count, "memory")
    return count


def require_machine_memory(needed_bytes: float, what: str, advice: str = "") -> None:
    """Refuse to take more memory than there is, in a message about what takes it, with more advice."""
    most, source = machine_memory()
    if needed_bytes > most:
        raise InputError(
            f"{what} of {format_bytes(needed_bytes)} is more than there is: {format_bytes(most)}, "
            f"{source}; {' '.join(filter(None, ('ask for less', advice)))}"
        )


def _control_groups(root: Path, controller: str) -> Iterator[Path]:
    """Yield the folders of the control groups that this process is in, and of those around them."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # no Linux
        return
    for line in lines:
        _, controllers, place = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = root / "sys/fs/cgroup" / (controller if controllers else "")
        # Within a container, the group has the name that it has outside, and lies at the top.
        group = top / place.lstrip("/")
        yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(top))
