"""The examples in docstrings run as they stand; those of results and commands beside a small store."""

from __future__ import annotations

import doctest
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
from distributed import Client

from tests.support.repository import PACKAGE, run_icospheres

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
FILES = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>>" in file.read_text(encoding="utf-8")]
NAMES = [".".join([PACKAGE.name, *file.relative_to(PACKAGE).with_suffix("").parts]) for file in FILES]
BESIDE_A_STORE = tuple(
    f"{PACKAGE.name}.{layer}"
    for layer in (
        "tables.",
        "extras.figures",
        "extras.leagues",
        "extras.report",
        "cli.",
        "extras.plot",
        "batch.verify",
        "batch.status",
        "batch.dry_run",
    )
)
# It runs a study on a cluster of its own.
WITH_CLUSTER = f"{PACKAGE.name}.batch.run"


def examples(module: ModuleType) -> Iterator[doctest.DocTest]:
    """Yield the examples of a module, also those of cached properties, which doctest does not look at."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    yield from finder.find(module)
    for name, kind in vars(module).items():
        if isinstance(kind, type) and kind.__module__ == module.__name__:
            for attribute, value in vars(kind).items():
                if isinstance(value, cached_property):
                    yield from finder.find(value.func, f"{name}.{attribute}", globs=vars(module).copy())


def run(name: str) -> None:
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in examples(import_module(name)):
        runner.run(test)
    assert runner.tries > 0
    assert runner.failures == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.process] if name == WITH_CLUSTER else [])
        for name in NAMES
        if not name.startswith(BESIDE_A_STORE)
    ],
)
def test_examples_run(name: str) -> None:
    run(name)


@pytest.fixture(scope="module")
def folder(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with storage/icosphere.zarr and the study workflows/icosphere.toml."""
    folder = tmp_path_factory.mktemp("examples")
    run_icospheres(folder, client)
    return folder


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(BESIDE_A_STORE)])
def test_examples_beside_a_store_run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    run(name)
