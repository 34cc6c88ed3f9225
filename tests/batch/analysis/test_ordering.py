"""The order of meshes in tables, and what becomes of it when a study loses, renames or regains meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from tests.support.studies import small_table, variable

# Levels of icospheres by the names of their files: names and triangles say different things.
LEVELS = {"a10": 1, "a9": 2, "b": 0}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, level in LEVELS.items():
        sb.write_mesh(sb.icosphere(level), tmp_path / f"{name}.ply")
    return tmp_path


def run(folder: Path, **family: Any) -> sb.Summary:
    source = {"name": "f", "source": "files", **({} if "meshes" in family else {"paths": ["*.ply"]})}
    study = sb.Study.from_table(small_table(family=[{**source, **family}]), folder=folder)
    return sb.run(study, store_of(folder), workers=1)


def store_of(folder: Path) -> str:
    return f"memory://{folder.as_posix().strip('/').replace('/', '-')}.zarr"


def names(folder: Path) -> list[str]:
    return list(sb.table(store_of(folder), -3)["name"])


@pytest.mark.slow
def test_files_go_from_few_triangles_to_many_and_have_rates(folder: Path) -> None:
    run(folder)
    frame = sb.table(store_of(folder), -3)
    assert frame["name"].tolist() == ["b", "a10", "a9"]
    assert frame["rank"].tolist() == [0, 1, 2]
    assert frame["ordered_by"].tolist() == ["triangles"] * 3
    assert frame["rate"].round().tolist()[1:] == [2, 2]


@pytest.mark.slow
def test_a_key_orders_by_names_naturally_and_then_there_are_no_rates(folder: Path) -> None:
    run(folder, order_by="names")
    frame = sb.table(store_of(folder), -3)
    assert frame["name"].tolist() == ["a9", "a10", "b"]
    assert frame["rate"].isna().all()
    run(folder)
    assert names(folder) == ["b", "a10", "a9"], "the key alone makes the tables anew"


@pytest.mark.slow
def test_copies_with_noise_are_no_sequence(tmp_path: Path) -> None:
    ball = sb.icosphere(1)
    draw = np.random.default_rng(1)
    for noise in (0.0, 0.2, 0.4):
        vertices = ball.vertices + draw.normal(scale=noise, size=ball.vertices.shape)
        # A triangle more or less makes none of them finer.
        sb.write_mesh(sb.Mesh(vertices, ball.triangles[int(10 * noise) :]), tmp_path / f"scan_{noise}.ply")
    run(tmp_path)
    frame = sb.table(store_of(tmp_path), -3)
    assert frame["ordered_by"].tolist() == ["names"] * 3
    assert frame["rate"].isna().all()
    run(tmp_path, order_by="triangles")
    assert sb.table(store_of(tmp_path), -3)["rate"].notna().any()


@pytest.mark.slow
def test_equal_triangle_counts_are_ordered_by_name(tmp_path: Path) -> None:
    for name in ("x10", "x9"):
        sb.write_mesh(sb.icosphere(0), tmp_path / f"{name}.ply")
    run(tmp_path)
    assert names(tmp_path) == ["x9", "x10"]


@pytest.mark.slow
def test_a_mesh_that_failed_comes_last(folder: Path) -> None:
    (folder / "a0.ply").write_text("no mesh")
    run(folder)
    assert names(folder) == ["b", "a10", "a9", "a0"]


@pytest.mark.slow
def test_removed_meshes_leave_the_tables_and_come_back_without_computation(folder: Path) -> None:
    run(folder)
    path, away = folder / "a10.ply", folder / "a10.away"
    path.rename(away)
    summary = run(folder)
    assert summary.computed == ()
    assert "f/a10" not in summary.reused
    assert names(folder) == ["b", "a9"]
    tree = sb.open_store(store_of(folder))
    assert "f/a10" not in variable(tree, "distances", "other").values
    assert sb.status(store_of(folder)).total == 3
    away.rename(path)
    assert run(folder).computed == ()
    assert names(folder) == ["b", "a10", "a9"]


@pytest.mark.slow
def test_the_rate_of_a_mesh_bridges_a_removed_one(folder: Path) -> None:
    run(folder)
    (folder / "a10.ply").unlink()
    run(folder)
    rates = sb.table(store_of(folder), -3).set_index("name")["rate"]
    assert round(rates["a9"]) == 2


@pytest.mark.slow
def test_renamed_meshes_keep_their_fields(folder: Path) -> None:
    run(folder)
    before = sb.table(store_of(folder), -3).set_index("name")["distance"]
    (folder / "a9.ply").rename(folder / "fine.ply")
    assert run(folder).computed == ()
    after = sb.table(store_of(folder), -3).set_index("name")["distance"]
    assert after["fine"] == before["a9"]
    assert set(variable(sb.open_store(store_of(folder)), "fourier", "mesh").values) == {
        "f/b",
        "f/a10",
        "f/fine",
        "reference",
    }
    assert sb.verify(store_of(folder)).is_sound


@pytest.mark.slow
def test_names_that_files_swap_are_not_mixed_up(folder: Path) -> None:
    run(folder)
    before = sb.table(store_of(folder), -3).set_index("name")["distance"]
    for old, new in (("a9", "c"), ("b", "a9"), ("c", "b")):
        (folder / f"{old}.ply").rename(folder / f"{new}.ply")
    run(folder)
    after = sb.table(store_of(folder), -3).set_index("name")["distance"]
    assert after["a9"] == before["b"]
    assert after["b"] == before["a9"]
