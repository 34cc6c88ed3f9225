"""Places that cannot hold a store are refused before anything is computed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.commands import COMMAND, command, write_toml

_NOBODY = 65534


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    done = command("run", write_toml(tmp_path), "--store", tmp_path / "typo" / "results.zarr")
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
    done = command("run", write_toml(tmp_path), "--store", place)
    assert done.returncode == 2
    assert {"file": "a file is there", "folder": "not empty and holds no store"}[there] in done.stderr
    assert "dashboard" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="gives up the rights of the superuser by setting the user")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    """As a user who may read it and not write."""
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o755)
    study = write_toml(tmp_path)
    for folder in [tmp_path, *tmp_path.parents]:
        if os.getuid() == 0 and folder.stat().st_uid == 0:
            folder.chmod(folder.stat().st_mode | 0o055)
    closed.chmod(0o555)
    done = subprocess.run(
        [*COMMAND, "run", str(study), "--store", str(closed / "results.zarr")],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        user=_NOBODY if os.getuid() == 0 else None,
        env={**os.environ, "HOME": str(tmp_path), "MPLCONFIGDIR": str(tmp_path)},
    )
    assert done.returncode == 2, done.stderr
    assert "results.zarr: the store cannot be written: Permission denied" in done.stderr
    assert "dashboard" not in done.stderr
