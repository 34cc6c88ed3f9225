"""The examples of the README run as printed."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import sobolev_batch as sb
from tests.support.repository import ROOT, blocks


def test_the_study_file_is_valid(tmp_path: Path) -> None:
    (study,) = blocks("README.md", "toml")
    lattice = blocks("docs/studies.md", "toml")[1]
    (tmp_path / "study.toml").write_text(study)
    assert sb.Study.from_toml(tmp_path / "study.toml").orders == (-2.0, -4.0)
    on_lattice = re.sub(r"^\[accuracy\].*?\n\n", lattice + "\n", study, flags=re.M | re.S)
    (tmp_path / "study.toml").write_text(on_lattice)
    assert sb.Study.from_toml(tmp_path / "study.toml").lattice == sb.Lattice(5.0, 64)


@pytest.mark.process
@pytest.mark.all
def test_the_python_example_and_the_queries_run(tmp_path: Path) -> None:
    (example,) = blocks("README.md", "python")
    small = (ROOT / "workflows" / "icosphere.toml").read_text().replace("M = 128", "M = 32")
    (tmp_path / "workflows").mkdir()
    (tmp_path / "storage").mkdir()
    (tmp_path / "workflows" / "icosphere.toml").write_text(small.replace("3, 4, 5, 6, 7]", "3]"))
    # The first block of docs/store.md opens the store, the others query it.
    queries = "".join(blocks("docs/store.md", "python"))
    indented = "".join(f"    {line}\n" for line in queries.splitlines())
    (tmp_path / "example.py").write_text(example + indented)
    completed = subprocess.run(
        [sys.executable, "-W", "error", "example.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    assert re.search(r"icosphere/3 +0\.00", completed.stdout)
