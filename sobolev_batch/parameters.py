"""Parameters of the public interface, and the memory and cores of this machine, which they may not exceed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from numbers import Integral
from pathlib import Path
from typing import TypeGuard

import psutil
from pydantic import ByteSize, TypeAdapter, ValidationError

from sobolev_batch.errors import InputError

_ROOT = Path("/")
_BYTE_SIZE = TypeAdapter(ByteSize)


def is_whole_number(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer of Python or NumPy, and no truth value.

    >>> import numpy as np
    >>> is_whole_number(np.int64(3)), is_whole_number(True), is_whole_number(3.0)
    (True, False, False)
    """
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_seed(seed: object) -> None:
    """Refuse anything but a whole number from 0 on, by an InputError."""
    if not is_whole_number(seed) or seed < 0:
        raise InputError(f"seed must be a whole number from 0 on, found {seed!r}")


def byte_count(memory: float | str) -> int:
    """Return a size of memory in bytes, from their number or a text; InputError where it is neither, or not positive.

    >>> byte_count("4GB"), byte_count("800MiB"), byte_count(2e9)
    (4000000000, 838860800, 2000000000)
    """
    try:
        # Pydantic refuses a float that is no whole number.
        count = int(_BYTE_SIZE.validate_python(int(memory) if isinstance(memory, float) else memory))
    except (ValidationError, ValueError, OverflowError):
        count = 0
    if count <= 0 or isinstance(memory, bool):
        raise InputError(
            f"memory must be a positive number of bytes, or a size such as '4GB' or '800MiB', found {memory!r}"
        )
    return count


def fraction(value: float | str) -> float:
    """Return a positive fraction, given as a number or in per cent; InputError where it is neither, or not positive.

    >>> fraction("1%"), fraction("0.01"), fraction(0.01)
    (0.01, 0.01, 0.01)
    """
    text = str(value).strip()
    try:
        number = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        number = math.nan
    if isinstance(value, bool) or not 0 < number < math.inf:
        raise InputError(f"a fraction is a positive number such as 0.01, or a text such as '1%', found {value!r}")
    return number


def format_bytes(count: float) -> str:
    """Return a number of bytes as people read it.

    >>> format_bytes(4e9)
    '4.0GB'
    """
    return ByteSize(count).human_readable(decimal=True)


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
