"""The gallery: its code runs and writes pictures, its commands exist, and its pictures are small."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.cli import cli
from tests.support.gallery import run_blocks, run_icospheres
from tests.support.repository import ROOT, blocks

PAGE = "docs/gallery.md"
MOST_BYTES = 100_000


def test_pictures_are_described_and_small() -> None:
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    pictures = re.findall(r"!\[(.*?)\]\((.*?)\)", text)
    assert len(pictures) > 5
    for description, path in pictures:
        assert len(description) > 20
        assert (ROOT / "docs" / path).stat().st_size <= MOST_BYTES, path


def test_commands_take_their_options() -> None:
    for block in blocks(PAGE, "sh"):
        for line in block.splitlines():
            program, name, *arguments = shlex.split(line)
            assert program == "sobolev-batch"
            # Options and arguments are parsed, and nothing is run.
            cli.commands[name].make_context(name, arguments).close()


def test_the_code_runs(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_icospheres(tmp_path, client)
    monkeypatch.chdir(tmp_path)
    # A cow that is a ball through the place of the patch.
    sb.write_mesh(sb.Similarity(0.38).apply(sb.icosphere(3)), "spot.obj")
    results = run_blocks(PAGE)
    original, twice = (len(results[name].triangles) for name in ("cow", "twice"))
    assert original < twice < 1.1 * original
    assert sb.read_mesh("twice.ply").area == pytest.approx(results["twice"].area)
    assert {path.stem for path in tmp_path.glob("*.png")} == {"matrix", "spectrum"}
    (study,) = blocks(PAGE, "toml")
    (tmp_path / "study.toml").write_text(study)
    assert list(members_of(sb.Study.from_toml("study.toml"))) == [
        "decimated/1360",
        "noisy/0.0015",
        "covered/twice",
        "reference",
    ]
