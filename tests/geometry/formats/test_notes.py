"""What a file leaves open is noted wherever its mesh is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sobolev_batch as sb
from sobolev_batch.cli.program import cli
from tests.support.mesh_files import obj
from tests.support.studies import small_table

BENT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]], dtype=np.float64)
FAMILY = {"name": "f", "source": "files", "paths": ["other.obj"]}
NOTE = "1 of 1 faces are not flat"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("bent", "other"):
        Path(f"{name}.obj").write_bytes(obj(BENT, [[0, 1, 2, 3]]))
    return tmp_path


def test_info_and_compare_show_them(folder: Path) -> None:
    shown = CliRunner().invoke(cli, ["info", "bent.obj"]).output
    assert f"note: {NOTE}" in shown
    document = json.loads(CliRunner().invoke(cli, ["info", "bent.obj", "--format", "json"]).output)
    assert [note[: len(NOTE)] for note in document["files"][0]["notes"]] == [NOTE]
    compared = CliRunner().invoke(cli, ["compare", "bent.obj", "other.obj", "--xi-max", "2", "--M", "8"])
    assert compared.stderr.count(NOTE) == 2


def test_a_plan_names_the_meshes(folder: Path) -> None:
    table = small_table(reference={"source": "files", "paths": ["bent.obj"]}, family=[FAMILY])
    doubtful = sb.plan(sb.Study.from_table(table, folder=folder), folder / "s.zarr").object.doubtful
    assert {label: reason[: len(NOTE)] for label, reason in doubtful.items()} == {"reference": NOTE, "f/other": NOTE}
