"""Trials of mutants: the tests of a module on a copy of the repository."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from tests.mutants.guards import Guard

# A mutant that hangs is noticed too.
_TEST_SECONDS = 300
_NO_TESTS = 5
_PASSED = (0, _NO_TESTS)


@dataclass(frozen=True)
class Trial:
    """What the tests said of a guard that was taken out.

    Attributes:
        guard: The guard.
        killed_by: First test that failed; empty if the mutant survived.
    """

    guard: Guard
    killed_by: str


def try_all(root: Path, guards: Iterable[Guard], folder: Path, jobs: int) -> Iterator[Trial]:
    """Yield what the tests say of each guard, as soon as it is known."""
    copies: Queue[Path] = Queue()
    for number in range(jobs):
        copies.put(copy_of(root, folder / f"copy-{number}"))

    def tried(guard: Guard) -> Trial:
        copy = copies.get()
        try:
            return try_one(copy, guard)
        finally:
            copies.put(copy)

    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(tried, guards)


def try_one(copy: Path, guard: Guard) -> Trial:
    """Take a guard out of a copy of the repository, run the tests and put it back."""
    module = copy / guard.path
    source = module.read_bytes()
    module.write_bytes(guard.taken_out(source))
    try:
        for tests in mirrors_of(copy, guard.path):
            failed = _first_failure(copy, tests)
            if failed:
                return Trial(guard, failed)
    finally:
        module.write_bytes(source)
    return Trial(guard, "")


def mirrors_of(root: Path, path: str) -> list[str]:
    """Return the tests of a module, those that are nearest to it first: its own, its folder's, and of its layer."""
    parts = Path(path).with_suffix("").parts[1:]
    folders = [Path("tests", *parts[:depth]) for depth in range(len(parts) - 1, 0, -1)]
    nearest = Path("tests", *parts[:-1], f"test_{parts[-1].lstrip('_')}.py")
    found = [str(test) for test in (nearest, *folders) if (root / test).exists()]
    return [*found, "tests/faults"] if parts[0] == "batch" else found


def copy_of(root: Path, copy: Path) -> Path:
    """Copy the files of a repository, as they are on the disk."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=root,
        capture_output=True,
        check=True,
        text=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((root / name).read_bytes())
    return copy


def _first_failure(copy: Path, tests: str) -> str:
    """Return the first test that fails, or what else ended them; empty if all pass."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist",
         "--timeout", str(_TEST_SECONDS), tests],
        cwd=copy,
        # Before what is installed, in processes that tests start too.
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )  # fmt: skip
    if done.returncode in _PASSED:
        return ""
    failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failures[0].split(" - ")[0] if failures else f"{tests} ended with status {done.returncode}"
