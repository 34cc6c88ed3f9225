"""The order of meshes in tables, and what becomes of it when a study loses, renames or regains meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sobolev_batch as sb
from sobolev_batch.tables.convergence import format_table
from tests.support.studies import small_table, variable

pytestmark = pytest.mark.slow

# Levels of icospheres by the names of their files: names and triangles say different things.
LEVELS = {"a10": 1, "a9": 2, "b": 0}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, level in LEVELS.items():
        sb.write_mesh(sb.shapes.icosphere(level), tmp_path / f"{name}.ply")
    return tmp_path


def run(folder: Path, **family: Any) -> sb.result_types.Summary:
    source = {"name": "f", "source": "files", **({} if "meshes" in family else {"paths": ["*.ply"]})}
    study = sb.Study.from_table(small_table(family=[{**source, **family}]), folder=folder)
    return sb.run(study, store_of(folder), workers=1)


def store_of(folder: Path) -> str:
    return f"memory://{folder.as_posix().strip('/').replace('/', '-')}.zarr"


def table(folder: Path) -> pd.DataFrame:
    """Return the rows of order -3 by the names of the meshes, in their order."""
    return sb.table(store_of(folder), -3).set_index("name")


def names(folder: Path) -> list[str]:
    return list(table(folder).index)


def headers(folder: Path) -> list[str]:
    """Return the columns of the table for people."""
    return next(line for line in format_table(store_of(folder)).splitlines() if line.startswith("mesh ")).split()


def test_files_go_from_few_triangles_to_many_and_have_rates_unless_a_key_orders_them(folder: Path) -> None:
    (folder / "a0.ply").write_text("no mesh")
    run(folder)
    frame = table(folder)
    # A mesh that failed comes last.
    assert frame.index.tolist() == ["b", "a10", "a9", "a0"]
    assert frame["rank"].tolist() == [0, 1, 2, 3]
    assert frame["ordered_by"].tolist() == ["triangles"] * 4
    assert frame["rate"].round().tolist()[1:3] == [2, 2]
    assert "rate" in headers(folder)
    # The key alone makes the tables anew.
    run(folder, order_by="names")
    assert names(folder) == ["a0", "a9", "a10", "b"]
    assert table(folder)["rate"].isna().all()
    assert "rate" not in headers(folder)
    run(folder)
    assert names(folder) == ["b", "a10", "a9", "a0"]


def test_copies_with_noise_are_no_sequence(tmp_path: Path) -> None:
    ball = sb.shapes.icosphere(1)
    draw = np.random.default_rng(1)
    for noise in (0.0, 0.2, 0.4):
        vertices = ball.vertices + draw.normal(scale=noise, size=ball.vertices.shape)
        # A triangle more or less makes none of them finer.
        sb.write_mesh(sb.Mesh(vertices, ball.triangles[int(10 * noise) :]), tmp_path / f"scan_{noise}.ply")
    run(tmp_path)
    frame = table(tmp_path)
    assert frame["ordered_by"].tolist() == ["names"] * 3
    assert frame["rate"].isna().all()
    run(tmp_path, order_by="triangles")
    assert table(tmp_path)["rate"].notna().any()


def test_removed_meshes_leave_the_tables_and_come_back_without_computation(folder: Path) -> None:
    run(folder)
    path, away = folder / "a10.ply", folder / "a10.away"
    path.rename(away)
    summary = run(folder)
    assert summary.computed == ()
    assert "f/a10" not in summary.reused
    # The rate bridges the mesh that is gone.
    assert names(folder) == ["b", "a9"]
    assert round(table(folder)["rate"]["a9"]) == 2
    tree = sb.open_store(store_of(folder))
    assert "f/a10" not in variable(tree, "distances", "other").values
    assert sb.status(store_of(folder)).total == 3
    away.rename(path)
    assert run(folder).computed == ()
    assert names(folder) == ["b", "a10", "a9"]


@pytest.mark.parametrize(
    ("renames", "computed"), [([("a9", "fine")], ()), ([("a9", "c"), ("b", "a9"), ("c", "b")], ("f/a9", "f/b"))]
)
def test_renamed_meshes_keep_their_fields_and_swapped_names_are_not_mixed_up(
    folder: Path, renames: list[tuple[str, str]], computed: tuple[str, ...]
) -> None:
    run(folder)
    expected = table(folder)["distance"]
    for old, new in renames:
        (folder / f"{old}.ply").rename(folder / f"{new}.ply")
        expected = expected.rename({old: new})
    assert run(folder).computed == computed
    assert table(folder)["distance"].to_dict() == expected.to_dict()
    labels = {"reference", *(f"f/{name}" for name in expected.index)}
    assert set(variable(sb.open_store(store_of(folder)), "fourier", "mesh").values) == labels
    assert sb.verify(store_of(folder)).is_sound
