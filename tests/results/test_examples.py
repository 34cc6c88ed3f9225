"""The examples in docstrings of results and of the command line run as they stand, beside a small store."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client

import sobolev_batch as sb
from tests.support.gallery import run_icospheres
from tests.support.repository import PACKAGE

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def modules() -> Iterator[tuple[str, Path]]:
    for layer in ("results", "cli"):
        for file in sorted((PACKAGE / layer).rglob("*.py")):
            if not file.name.startswith("_"):
                yield ".".join(["sobolev_batch", *file.relative_to(PACKAGE).with_suffix("").parts]), file


def examples(name: str) -> list[doctest.DocTest]:
    return [test for test in doctest.DocTestFinder().find(importlib.import_module(name)) if test.examples]


WITH_EXAMPLES = [name for name, file in modules() if ">>>" in file.read_text(encoding="utf-8")]


@pytest.fixture(scope="module")
def folder(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with storage/icosphere.zarr and the study workflows/icosphere.toml."""
    folder = tmp_path_factory.mktemp("examples")
    run_icospheres(folder, client)
    return folder


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in examples(name):
        runner.run(test)
    assert runner.tries > 0
    assert runner.failures == 0


def test_public_names_have_examples() -> None:
    for name in sb.__all__:
        value = getattr(sb, name)
        if value.__module__.startswith("sobolev_batch.results") and callable(value) and name[0].islower():
            assert ">>> " in (value.__doc__ or ""), name
