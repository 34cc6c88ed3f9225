"""Places that cannot hold a store are refused before anything is computed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.support.commands import call, write_toml


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("typo/results.zarr", "there is no folder {folder}/typo to hold the store; make it first"),
        ("file", "it is a file"),
        ("folder", "not empty and holds no store"),
        pytest.param(
            *("/proc/results.zarr", "/proc/results.zarr: the store cannot be written"),
            marks=pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that nobody can write to"),
        ),
        pytest.param(
            *("closed/results.zarr", "results.zarr: the store cannot be written: Permission denied"),
            marks=pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere"),
        ),
    ],
)
def test_a_place_that_cannot_hold_a_store(place: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("text")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "precious.txt").write_text("text")
    (tmp_path / "closed").mkdir(mode=0o555)
    done = call("run", write_toml(tmp_path), "--store", tmp_path / place)
    assert done.returncode == 2
    assert message.format(folder=tmp_path) in done.stderr
    assert "dashboard" not in done.stderr
    assert not (tmp_path / "typo").exists()
