"""Memory that is not there is foreseen: nothing is begun that would be killed again and again."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.commands import call, write_toml


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
