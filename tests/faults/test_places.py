"""Places that cannot hold a store are refused before anything is computed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.support.commands import call, write_toml


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    done = call("run", write_toml(tmp_path), "--store", tmp_path / "typo" / "results.zarr")
    assert done.returncode == 2
    assert f"there is no folder {tmp_path / 'typo'} to hold the store; make it first" in done.stderr
    assert "dashboard" not in done.stderr
    assert not (tmp_path / "typo").exists()


@pytest.mark.parametrize("there", ["file", "folder"])
def test_something_else_is_there(there: str, tmp_path: Path) -> None:
    place = tmp_path / "place"
    if there == "file":
        place.write_text("text")
    else:
        place.mkdir()
        (place / "precious.txt").write_text("text")
    done = call("run", write_toml(tmp_path), "--store", place)
    assert done.returncode == 2
    assert {"file": "a file is there", "folder": "not empty and holds no store"}[there] in done.stderr
    assert "dashboard" not in done.stderr


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that nobody can write to")
def test_a_place_that_nobody_can_write(tmp_path: Path) -> None:
    done = call("run", write_toml(tmp_path), "--store", "/proc/results.zarr")
    assert done.returncode == 2
    assert "/proc/results.zarr: the store cannot be written" in done.stderr
    assert "dashboard" not in done.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    done = call("run", write_toml(tmp_path), "--store", closed / "results.zarr")
    assert done.returncode == 2
    assert "results.zarr: the store cannot be written: Permission denied" in done.stderr
    assert "dashboard" not in done.stderr
