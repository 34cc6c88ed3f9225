"""A store that a test may damage."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.stores import put_back

FIELD = "fourier/fourier/c/{row}/0/0/0"


@pytest.fixture(scope="module")
def sound(finished_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(finished_store, tmp_path_factory.mktemp("damage") / "results.zarr"))


@pytest.fixture
def store(sound: Path) -> Iterator[Path]:
    """A finished store, whose files are put back after the test."""
    with put_back(sound):
        yield sound
