"""The examples of docs/fitting.md, reconstruction.md and moving.md run as printed, and do what the pages say."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from tests.support.gallery import run_blocks
from tests.support.repository import ROOT, blocks


@pytest.mark.all
def test_the_examples_run_and_come_nearer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(blocks("docs/fitting.md", "python")) == 4
    results = run_blocks("docs/fitting.md")
    fitted, start, target = (results[name] for name in ("fitted", "start", "target"))
    assert fitted.after.distance < fitted.before.distance / 4
    assert sb.read_mesh(tmp_path / "fitted.ply").area == pytest.approx(fitted.mesh.area)
    refined = results["refined"]
    assert 620 < len(refined.mesh.triangles) <= 640
    assert refined.after.distance < fitted.after.distance
    squared = sb.SquaredDistance.for_mesh(start, target, -4.0, lattice=sb.Lattice(8.0, 80))
    assert results["found"]["squared_distance"].sel(order=-4.0) == pytest.approx(
        squared.value(start.vertices), rel=1e-6
    )
    # Inscribed, the mesh lacks area everywhere: the distance falls outwards.
    outwards = (results["found"]["gradient"].sel(order=-4.0).values * start.vertices).sum(axis=1)
    assert (outwards < 0).all()


@pytest.mark.all
def test_the_page_of_reconstruction_runs_and_finds_the_shape() -> None:
    results = run_blocks("docs/reconstruction.md")
    assert results["found"].after.distance < results["found"].before.distance / 50
    shape, mesh = results["shape"], results["found"].mesh
    # The ears are there: their tips are where no point of the ball was.
    tips = np.asarray(shape.vertices)[np.linalg.norm(shape.vertices, axis=1) > 0.95]
    assert np.linalg.norm(np.asarray(mesh.vertices)[:, None] - tips, axis=2).min(axis=0).max() < 0.12


@pytest.mark.all
def test_the_page_about_surfaces_that_move_runs(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    carried, files = blocks("docs/moving.md", "toml")
    study = tomllib.loads(carried)
    simulated = {**study, "family": [*study["family"], *tomllib.loads(files)["family"]]}
    simulated["family"].append({**simulated["family"][0], "name": "fine", "times": [0.0, 0.25]})
    monkeypatch.chdir(tmp_path)
    Path("frames").mkdir()
    Path("storage").mkdir()
    for number, radius in ((0, 1.0), (0.25, 1.1)):
        sb.write_mesh(
            sb.Mesh(radius * np.asarray(sb.icosphere(2).vertices), sb.icosphere(2).triangles), f"frames/t{number}.ply"
        )
    sb.run(sb.Study.from_table(simulated), "storage/study.zarr", client)
    results = run_blocks("docs/moving.md")
    assert results["found"]["family"].values.tolist() == ["level 3", "simulated"]
    assert results["found"]["remesh_time"].sel(family="simulated", order=-2.0).item() == 0.25


def test_the_workflow_of_a_flow_is_a_valid_study() -> None:
    study = sb.Study.from_toml(ROOT / "workflows/flow.toml")
    levels = [family.source.members(ROOT) for family in study.families]
    assert [len(members) for members in levels] == [14, 14, 14]
