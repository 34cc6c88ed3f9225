"""The examples of docs/fitting.md run as printed, and do what the page says."""

from __future__ import annotations

from pathlib import Path

import pytest

import sobolev_batch as sb
from tests.support.gallery import run_blocks
from tests.support.repository import blocks


def test_the_examples_run_and_come_nearer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("docs/fitting.md", "python")) == 3
    results = run_blocks("docs/fitting.md")
    fitted, start, target = (results[name] for name in ("fitted", "start", "target"))
    assert fitted.after.distance < fitted.before.distance / 4
    assert sb.read_mesh(tmp_path / "fitted.ply").area == pytest.approx(fitted.mesh.area)
    squared = sb.SquaredDistance.of(start, target, -4.0, lattice=sb.Lattice(4.0, 40))
    assert results["found"]["squared_distance"].sel(order=-4.0) == pytest.approx(
        squared.value(start.vertices), rel=1e-6
    )
    # Inscribed, the mesh lacks area everywhere: the distance falls outwards.
    outwards = (results["found"]["gradient"].sel(order=-4.0).values * start.vertices).sum(axis=1)
    assert (outwards < 0).all()
