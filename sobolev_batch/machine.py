"""The memory of this machine, or the part of it that this process may use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil

from sobolev_batch.errors import InputError
from sobolev_batch.parameters import byte_count, format_bytes


@dataclass(frozen=True)
class MachineMemory:
    """Memory that this process can have at most.

    Attributes:
        total_bytes: Number of bytes.
        source: What sets it: this machine, or a limit of a control group.
    """

    total_bytes: int
    source: str

    @classmethod
    def found(cls, root: Path = Path("/")) -> MachineMemory:
        """Return the memory of this machine, or the smallest limit of the control groups of this process.

        Containers, batch systems and systemd limit memory by control groups, of version 1 or 2.

        Args:
            root: Folder of the file system in which /proc and /sys are looked for.
        """
        memory = cls(psutil.virtual_memory().total, "all of this machine")
        for path in _limit_files(root):
            try:
                limit = int(path.read_text())
            # "max" is no limit, and another process may remove a group.
            except (OSError, ValueError):
                continue
            if 0 < limit < memory.total_bytes:
                memory = cls(limit, f"the limit in {path}")
        return memory


def available(memory: float | str) -> int:
    """Return a size of memory in bytes, which this machine has.

    Args:
        memory: Number of bytes, or a text such as "4GB".

    Raises:
        InputError: It is neither, not positive, or more than there is.
    """
    count = byte_count(memory)
    require_machine_memory(count, "memory")
    return count


def require_machine_memory(needed_bytes: float, what: str, advice: str = "") -> None:
    """Refuse to take more memory than there is.

    Args:
        needed_bytes: Memory that is asked for.
        what: What asks for it, as the subject of a message.
        advice: What follows "ask for less" in the message.

    Raises:
        InputError: There is less, in all.
    """
    memory = MachineMemory.found()
    if needed_bytes > memory.total_bytes:
        raise InputError(
            f"{what} of {format_bytes(needed_bytes)} is more than there is: {format_bytes(memory.total_bytes)}, "
            f"{memory.source}; {' '.join(filter(None, ('ask for less', advice)))}"
        )


def _limit_files(root: Path) -> Iterator[Path]:
    """Yield the files that may limit the memory of this process: of its control groups and of those around them."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # no Linux
        return
    for line in lines:
        _, controllers, place = line.split(":", 2)
        if controllers == "":
            # Beyond the lower limit the kernel takes memory back, and the process all but stands still.
            top, names = root / "sys/fs/cgroup", ["memory.max", "memory.high"]
        elif "memory" in controllers.split(","):
            top, names = root / "sys/fs/cgroup/memory", ["memory.limit_in_bytes"]
        else:
            continue
        group = top / place.lstrip("/")
        # Within a container, the group has the name that it has outside, and lies at the top.
        folders = [folder for folder in (group, *group.parents) if folder.is_relative_to(top)]
        yield from (folder / name for folder in folders for name in names)
