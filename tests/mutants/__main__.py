"""Take guards out one at a time: python -m tests.mutants [PATH ...] [--count N] [--seed S]."""

from __future__ import annotations

import ast
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory
from typing import NamedTuple

import click

from tests.support.repository import ROOT

PATHS = ("sobolev_batch/batch", "sobolev_batch/store", "sobolev_batch/geometry/formats", "sobolev_batch/sources")
_IS_CHECK = re.compile("_?(require|check)(_|$)")
# A mutant that hangs is noticed too.
_TEST_SECONDS = 300
# All tests passed, or none exists.
_PASSED = (0, 5)


class Guard(NamedTuple):
    """A condition that ends in an exception, or a call that may raise one and does nothing else.

    `path` is that of the module, from the root of the repository, and `without` its source without the guard.
    """

    path: str
    line: int
    text: str
    without: str


def guards_of(source: str, path: str) -> Iterator[Guard]:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        field = ""
        if isinstance(node, ast.If) and any(isinstance(statement, ast.Raise) for statement in node.body):
            field = "test"
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            field = "value" if _IS_CHECK.match(ast.unparse(node.value.func).rpartition(".")[2]) else ""
        if field:
            guard = getattr(node, field)
            setattr(node, field, ast.Constant(None))
            yield Guard(path, guard.lineno, ast.unparse(guard), ast.unparse(tree))
            setattr(node, field, guard)


def killer_of(copy: Path, guard: Guard) -> str:
    """Take a guard out of a copy of the repository, and return the first test that fails; empty if all pass."""
    module = copy / guard.path
    source = module.read_text()
    module.write_text(guard.without)
    try:
        return next(filter(None, (_first_failure(copy, tests) for tests in mirrors_of(copy, guard.path))), "")
    finally:
        module.write_text(source)


def mirrors_of(root: Path, path: str) -> list[str]:
    """Return the tests of a module, those that are nearest to it first: its own, its folder's, and of its layer."""
    parts = Path(path).with_suffix("").parts[1:]
    folders = [Path("tests", *parts[:depth]) for depth in range(len(parts) - 1, 0, -1)]
    nearest = Path("tests", *parts[:-1], f"test_{parts[-1].lstrip('_')}.py")
    found = [str(test) for test in (nearest, *folders) if (root / test).exists()]
    return [*found, "tests/faults"] if parts[0] == "batch" else found


def _first_failure(copy: Path, tests: str) -> str:
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


def _copy(folder: Path) -> Path:
    listed = subprocess.check_output(["git", "ls-files", "-z", "-co", "--exclude-standard"], cwd=ROOT, text=True)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    return folder


@click.command()
@click.argument("paths", nargs=-1)
@click.option("--count", type=click.IntRange(min=1), help="How many guards, chosen at random; all by default.")
@click.option("--seed", default=0, show_default=True, help="Of the choice.")
@click.option("--jobs", default=2, show_default=True, help="How many at a time.")
def main(paths: tuple[str, ...], count: int | None, seed: int, jobs: int) -> None:
    """Take guards out of the modules at PATHS; status 1 if the tests pass without one of them."""
    modules = [
        module
        for path in paths or PATHS
        for module in (sorted((ROOT / path).rglob("*.py")) if (ROOT / path).is_dir() else [ROOT / path])
    ]
    found = [guard for module in modules for guard in guards_of(module.read_text(), str(module.relative_to(ROOT)))]
    chosen = random.Random(seed).sample(found, min(count or len(found), len(found)))
    survivors = 0
    with TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as pool:
        copies: Queue[Path] = Queue()
        for number in range(jobs):
            copies.put(_copy(Path(folder, f"copy-{number}")))

        def tried(guard: Guard) -> str:
            copy = copies.get()
            try:
                return killer_of(copy, guard)
            finally:
                copies.put(copy)

        for guard, killer in zip(chosen, pool.map(tried, chosen), strict=True):
            survivors += not killer
            verdict = f"killed by {killer}" if killer else "SURVIVED"
            click.echo(f"{guard.path}:{guard.line}: {guard.text}: {verdict}")
    click.echo(f"{len(chosen) - survivors} of {len(chosen)} guards are held by a test")
    sys.exit(bool(survivors))


if __name__ == "__main__":
    main()
