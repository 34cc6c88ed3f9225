"""The examples of docs/testing.md run as printed, and do what the page says."""

from __future__ import annotations

from pathlib import Path

import pytest

import sobolev_batch as sb
from tests.support.gallery import run_blocks
from tests.support.repository import blocks


@pytest.mark.slow
def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("docs/testing.md", "python")) == 5
    results = run_blocks("docs/testing.md")
    assert capsys.readouterr().out.startswith("same surface: relative distance at most 0.0070 at order -4")
    assert results["lost_face"].outcome == "different"
    assert results["verdict"].outcome == "same"
    # The fixture of the parametrised test is the assertion itself.
    results["test_mesher"]((96, 48), sb.assert_same_surface)
