"""Median times of contestants that take turns, and the machine they run on."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import TypeVar

from sobolev_batch.machine import available_cores

Given = TypeVar("Given")

_LIBRARIES = ("numpy", "finufft", "zarr", "dask", "sobolev-batch")


@dataclass(frozen=True)
class Effort:
    """How much time the benchmarks may take.

    Attributes:
        repeats: timed turns of each contestant.
        quick: sizes that only show that everything works.
        large: the sizes that take minutes or many gigabytes as well.
    """

    repeats: int = 3
    quick: bool = False
    large: bool = False

    @property
    def threads(self) -> int:
        """Threads of every contestant that has them: one per core."""
        return available_cores()


def elapsed_seconds(work: Callable[[], object]) -> float:
    """The time that a call takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def take_turns(
    contestants: Sequence[Callable[[Given], object]], prepare: Callable[[], Given], repeats: int
) -> list[float]:
    """The median seconds of each contestant, of turns in the order A B A B ...

    Args:
        contestants: each takes what ``prepare`` made.
        prepare: makes what one turn of one contestant starts from; not timed.
        repeats: timed turns of each; one more goes before them, to fill caches and compile.
    """
    seconds: list[list[float]] = [[] for _ in contestants]
    for turn in range(repeats + 1):
        for contestant, times in zip(contestants, seconds, strict=True):
            given = prepare()
            started = time.perf_counter()
            contestant(given)
            taken = time.perf_counter() - started
            if turn:
                times.append(taken)
    return [median(times) for times in seconds]


def machine_facts() -> list[str]:
    """The commit, the processor and the versions that times depend on, one line each."""
    return [
        f"commit {_commit()}, {date.today()}",
        f"processor: {_processor()}, {os.cpu_count()} logical cores, {available_cores()} of them in use",
        f"python {platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in _LIBRARIES),
    ]


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10"]
    found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def _processor() -> str:
    facts = Path("/proc/cpuinfo")
    if facts.exists():
        for line in facts.read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()
