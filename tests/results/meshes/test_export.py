"""Witness functions in files, read back by other programs."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import trimesh
from click.testing import CliRunner, Result
from plyfile import PlyData

import sobolev_batch as sb
from sobolev_batch.cli import cli
from sobolev_batch.results.figures.meshes import StudyMeshes, fields_of, witness_at_vertices
from tests.support.spheres import LABELS, LONG, ORDERS, RADIUS, STRANGE

Spheres = tuple[str, Path]


def call(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["witness", *map(str, arguments)])


def read_ply(path: Path) -> Any:
    # In memory: the next file may have the same name.
    return PlyData.read(path, mmap=False)


def evaluated(place: str, label: str, points: np.ndarray) -> np.ndarray:
    """By the public function, from the stored fields, at points in the meshes' own unit."""
    tree = sb.open_store(place)
    fields = tree["fourier"].to_dataset()["fourier"]
    found = tree.attrs["similarity"]
    scaled = found["scale"] * (points - np.array(found["origin"]))
    return np.asarray(sb.witness(fields.sel(mesh=label), fields.sel(mesh="reference"), ORDERS, scaled).values)


@pytest.mark.slow
def test_ply_holds_the_mesh_of_the_file_and_its_witness(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    for label in LABELS:
        path = sb.write_witness(place, label, tmp_path / "a.ply", folder=folder)
        there = trimesh.load(path, process=False)
        own = sb.read_mesh(folder / f"{label.removeprefix('files/')}.obj")
        assert (there.vertices == own.vertices).all()
        assert (there.faces == own.triangles).all()
        columns = read_ply(path)["vertex"].data
        expected = evaluated(place, label, own.vertices)
        for name, values in zip(("witness_minus_4", "witness_minus_2_5"), expected, strict=True):
            assert columns[name].dtype == np.dtype("<f8")
            assert columns[name] == pytest.approx(values, rel=1e-9, abs=1e-9 * np.abs(values).max())
        assert columns["quality"] == pytest.approx(columns["witness_minus_4"], rel=1e-6)
        (unit,) = re.findall(rb"one unit of the study is (\S+)", path.read_bytes())
        assert float(unit) == pytest.approx(RADIUS)


@pytest.mark.slow
def test_vtp_holds_the_same(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    columns = read_ply(sb.write_witness(place, LABELS[1], tmp_path / "a.ply", folder=folder))
    there = pyvista.read(sb.write_witness(place, LABELS[1], tmp_path / "a.vtp", folder=folder))
    assert (there.points == np.stack([columns["vertex"][axis] for axis in "xyz"], axis=1)).all()
    assert (there.faces.reshape(-1, 4)[:, 1:] == np.vstack(columns["face"]["vertex_indices"])).all()
    assert (there.point_data["witness, order -4"] == columns["vertex"]["witness_minus_4"]).all()
    assert (there.point_data["witness, order -2.5"] == columns["vertex"]["witness_minus_2_5"]).all()
    assert there.active_scalars_name == "witness, order -4"
    assert there.field_data["notes"][0].endswith(r"files/beside against reference, study Kugeln gr\xf6\xdfer")


@pytest.mark.slow
def test_vertices_that_no_triangle_uses_may_lie_anywhere(spheres: Spheres) -> None:
    place, folder = spheres
    tree = sb.open_store(place)
    _, scaled = StudyMeshes.from_tree(tree, folder).make(LABELS[1])
    mesh = sb.Mesh(np.vstack([scaled.vertices, [[1e6, 0, 0], [0, 0, 0]]]), scaled.triangles)
    values = witness_at_vertices(*fields_of(tree, LABELS[1]), ORDERS, mesh)
    assert np.isnan(values[:, -2:]).all()
    assert np.isfinite(values[:, :-2]).all()


@pytest.mark.slow
def test_the_command_writes_all_meshes_into_one_folder(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    done = call(place, "--output", tmp_path / "out", "--folder", folder)
    assert done.exit_code == 0
    assert done.stderr == ""
    names = [Path(line).name for line in done.stdout.splitlines()]
    assert names == ["0000-files-Groe-u.ply", "0002-files-beside.ply", f"0003-files-{LONG}"[:65] + ".ply"]
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in tmp_path.rglob("*.ply")) == names
    chosen = call(
        *(place, "--output", tmp_path, "--folder", folder, "--order", "-2.5", "--mesh", LABELS[1], "--mesh", LABELS[1])
    )
    assert chosen.stdout == f"{tmp_path}/0002-files-beside.ply\n"
    assert "witness_minus_4" not in read_ply(tmp_path / "0002-files-beside.ply")["vertex"].data.dtype.names


@pytest.mark.slow
def test_meshes_that_changed_or_failed_are_named_and_the_others_written(spheres: Spheres, tmp_path: Path) -> None:
    place, folder = spheres
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "beside.obj").write_text((copy / "large.obj").read_text())
    (copy / f"{STRANGE}.obj").unlink()
    done = call(place, "--output", tmp_path, "--folder", copy)
    assert done.exit_code == 3
    lost, changed = done.stderr.splitlines()
    assert lost.startswith(f"{LABELS[0]}: ")
    assert "No such file" in lost
    assert changed == (
        "files/beside: the study makes another mesh here than the one that was computed; its files have changed"
    )
    assert [Path(line).name[:4] for line in done.stdout.splitlines()] == ["0003"]
    failed = call(place, "--output", tmp_path, "--folder", folder, "--mesh", "files/bad", "--mesh", "closed/sphere")
    assert failed.exit_code == 3
    assert (
        failed.stderr
        == "files/bad: its status is 'failed'\nclosed/sphere: a surface that is no mesh has no triangles\n"
    )


@pytest.mark.slow
def test_what_cannot_be_asked_for(spheres: Spheres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place, folder = spheres
    refused: list[tuple[str, str, list[float] | None, str]] = [
        ("files/besides", "a.ply", None, "no mesh 'files/besides', did you mean 'files/beside'"),
        ("nobody", "a.ply", None, "no mesh 'nobody', its labels are such as 'files/"),
        ("reference", "a.ply", None, "'reference' is the reference"),
        ("files/beside", "a.stl", None, r"written as \.ply or \.vtp, found '\.stl'"),
        ("files/beside", "a.ply", [-0.5], "below -1/2, found -0.5"),
        ("files/beside", "a.ply", [], "at least one order"),
        ("files/bad", "a.ply", None, "its status is 'failed'"),
    ]
    for label, name, orders, message in refused:
        with pytest.raises(sb.InputError, match=message):
            sb.write_witness(place, label, tmp_path / name, orders, folder)
    with pytest.raises(sb.StoreError, match="cannot be written there: No such file"):
        sb.write_witness(place, "files/beside", tmp_path / "nowhere" / "a.ply", folder=folder)
    tree = sb.open_store(place).load()
    tree["convergence"].attrs["reference"] = "files/bad"
    with pytest.raises(sb.InputError, match="the reference 'files/bad' is failed"):
        sb.write_witness(tree, LABELS[1], tmp_path / "a.ply", folder=folder)
    (tmp_path / "taken").write_text("")
    done = call(place, "--output", tmp_path / "taken", "--folder", folder)
    assert isinstance(done.exception, sb.StoreError)
    assert "no files can be written there" in str(done.exception)
    monkeypatch.setitem(__import__("sys").modules, "pyvista", None)
    with pytest.raises(sb.InputError, match=r"library pyvista.*pip install 'sobolev-batch\[vtk\]'"):
        sb.write_witness(place, "files/beside", tmp_path / "a.vtp", folder=folder)
    assert os.listdir(tmp_path) == ["taken"]
