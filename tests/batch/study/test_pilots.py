"""Pilots: what they are chosen from, and that no wrong mesh decides about others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch.study.lattice_choice import choose_pilots
from tests.support.commands import call
from tests.support.members import members
from tests.support.studies import small_table


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Balls whose names are not in the order of their triangles, one in another unit, and one that is no mesh."""
    for level, name in enumerate("zxy"):
        sb.write_mesh(sb.icosphere(level), tmp_path / f"{name}.off")
    ball = sb.icosphere(3)
    sb.write_mesh(sb.Mesh(25.4 * ball.vertices, ball.triangles), tmp_path / "inches.off")
    (tmp_path / "broken.off").write_text("OFF\n" + "1 2 3\n" * 10_000)
    return tmp_path


def study(folder: Path, **accuracy: Any) -> sb.Study:
    family = [{"name": "f", "source": "files", "paths": ["*.off"]}]
    table = small_table(accuracy={"rtol": 0.1, **accuracy}, lattice=None, norm={"orders": [-4.0]}, family=family)
    return sb.Study.from_table(table, folder=folder)


def test_pilots_are_the_coarsest_and_the_finest_that_can_be_compared(folder: Path) -> None:
    found = {f"f/{member.name}": ("f", member) for member in members({"source": "files", "paths": ["*.off"]}, folder)}
    pilots, set_aside = choose_pilots(found, sb.Similarity(), sb.Sphere().extent)
    assert set(pilots) == {"f/z", "f/y"}
    assert set(set_aside) == {"f/broken", "f/inches"}
    assert "its extent is 25.4 times that of the reference" in set_aside["f/inches"]


@pytest.mark.slow
def test_a_mesh_beyond_the_pilots_has_its_place_in_the_lattice(folder: Path) -> None:
    ball = sb.icosphere(1)
    sb.write_mesh(sb.Mesh(1.5 * ball.vertices, ball.triangles), folder / "large.off")
    plan = sb.plan(study(folder), folder / "s.zarr")
    assert plan.lattice.half_period > 1.5
    assert set(plan.doubtful) == {"f/broken", "f/inches"}
    assert "doubtful:      f/inches: its extent is 25.4 times that" in str(plan)


def test_wrong_meshes_fail_by_their_own_names_and_the_others_have_their_accuracy(client: Client, folder: Path) -> None:
    summary = sb.run(study(folder), folder / "mixed.zarr", client)
    assert set(summary.failed) == {"f/broken", "f/inches"}
    assert "in the same unit of length?" in summary.failed["f/inches"]
    table = sb.table(folder / "mixed.zarr").set_index("mesh").drop(["f/broken", "f/inches"])
    assert table["within"].all()
    exact = [sb.distance(sb.icosphere(level), sb.Sphere(), -4.0, rtol=1e-3)["distance"].item() for level in range(3)]
    for name, value in zip("zxy", exact, strict=True):
        assert abs(table["distance"][f"f/{name}"] - value) <= 1.01 * table["error"][f"f/{name}"] + 1e-3 * value


def test_only_wrong_meshes_are_refused_with_a_reason(folder: Path) -> None:
    for name in "xyz":
        (folder / f"{name}.off").unlink()
    with pytest.raises(sb.StudyError, match=r"none of the study's surfaces can serve .*f/(broken|inches): "):
        sb.plan(study(folder), folder / "s.zarr")


@pytest.mark.all
def test_a_best_effort_serves_the_meshes_that_can_be_served(client: Client, folder: Path) -> None:
    near = sb.icosphere(2)
    rough = np.random.default_rng(0).normal(size=near.vertices.shape)
    twin = sb.Mesh(near.vertices + 1e-5 * rough, near.triangles)
    sb.write_mesh(twin, folder / "near.off")
    for name in ("inches", "broken"):
        (folder / f"{name}.off").unlink()
    table = {**study(folder).table, "norm": {"orders": [-0.7]}}
    table["reference"] = {"source": "icosphere", "levels": [2]}
    strict = sb.Study.from_table(table, folder=folder)
    with pytest.raises(sb.AccuracyError, match=r"rtol 0\.1 .* at order -0\.7"):
        sb.plan(strict, folder / "s.zarr")
    table["accuracy"]["best_effort"] = True
    best = sb.Study.from_table(table, folder=folder)
    assert sb.run(best, folder / "best.zarr", client).failed == {}
    found = sb.table(folder / "best.zarr").set_index("mesh")
    assert found["within"][["f/z", "f/x", "f/near"]].all()
    # The lattice shows next to nothing of the third: close points do.
    exact = sb.distance(twin, near, -0.7, rtol=0.02)
    difference = abs(found["distance"]["f/near"] - exact["distance"].item())
    assert difference <= found["error"]["f/near"] + exact["error"].item()
    # The last one is the reference itself.
    assert found["distance"]["f/y"] <= found["error"]["f/y"]


def test_units_are_doubted_where_numbers_are_shown(client: Client, folder: Path) -> None:
    small = sb.icosphere(2)
    sb.write_mesh(sb.Mesh(small.vertices / 10, small.triangles), folder / "small.off")
    store = folder / "mixed.zarr"
    sb.run(study(folder), store, client)
    printed = call("table", str(store), folder=folder).stdout
    doubt = "f/small: it is 10 times as small as the reference: are both in the same unit of length?"
    assert doubt in printed
    sb.report(store, folder / "report.html")
    page = (folder / "report.html").read_text()
    assert "1 mesh may be in another unit or place" in page
    compared = call("compare", "small.off", "z.off", "--order", "-4", "--no-scaling", folder=folder)
    assert "note: small.off: it is 9.73 times as small as the reference" in compared.stderr
