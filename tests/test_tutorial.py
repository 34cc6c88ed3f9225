"""The examples of docs/tutorial.md run as printed, and its statements about formulas and stores are true."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.cli import cli
from tests.support.gallery import run_blocks, run_icospheres
from tests.support.repository import ROOT, blocks


@pytest.mark.all
def test_the_tutorial_runs_and_is_right(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    (commands,) = blocks("docs/tutorial.md", "sh")
    for line in commands.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "sobolev-batch"
        result = CliRunner().invoke(cli, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    assert {path.name for path in tmp_path.iterdir()} >= {"pictures", "report.html"}

    results = run_blocks("docs/tutorial.md")
    assert results["certain"] is True
    assert results["rates"].index.tolist() == ["icosphere/1", "icosphere/2", "icosphere/3"]
    assert results["rates"].to_numpy() == pytest.approx(2, abs=0.05)
    assert results["excess"] < 0
    assert 0.5 < results["longest"] < 1
    assert (results["w"].values < 0).all()

    # The description of stores has every group and every variable of a store.
    text = (ROOT / "docs" / "store.md").read_text(encoding="utf-8")
    for group in results["tree"].subtree:
        for name in (*group.data_vars, *group.coords, *group.attrs):
            assert f"`{name}`" in text, (group.path, name)


def test_the_table_of_weights() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (-\d+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    assert len(rows) == 4
    for order, *wavelengths in rows:
        for weight, wavelength in zip((1 / 2, 1 / 10, 1 / 100), map(float, wavelengths), strict=True):
            assert (1 + wavelength**-2) ** float(order) == pytest.approx(weight, rel=0.12)


def test_the_cow_is_a_valid_study(tmp_path: Path) -> None:
    (study,) = blocks("docs/tutorial.md", "toml")
    (tmp_path / "study.toml").write_text(study)
    found = sb.Study.from_toml(tmp_path / "study.toml")
    assert found.accuracy is not None
    assert found.orders == (-2.0, -4.0)
