"""Places that cannot hold a store, and lattices that no memory holds, are refused before anything is computed."""

from __future__ import annotations

import os
import re
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


@pytest.mark.process
def test_a_lattice_that_fits_into_no_worker_is_refused_with_both_numbers(tmp_path: Path) -> None:
    study = write_toml(tmp_path)
    study.write_text(study.read_text().replace("M = 16", "M = 1024"))
    arguments = "--store", tmp_path / "large.zarr", "--workers", "1", "--memory", "700MB"
    done = call("run", study, *arguments)
    assert done.returncode == 1
    expected = r"it takes about 777\.6MB in one task, and no worker has more than 295\.0MB"
    assert re.search(expected, " ".join(done.stderr.split())), done.stderr
    assert "[1/5]" not in done.stderr
    # Where they are, too large a lattice is a matter of how many blocks.
    planned = call("plan", study, "--store", tmp_path / "large.zarr")
    assert planned.returncode == 0, planned.stderr
    assert "chunks of the lattice: " in planned.stdout
