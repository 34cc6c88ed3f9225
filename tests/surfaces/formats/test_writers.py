"""Mesh files that are written come back as they were."""

from __future__ import annotations

import os
import re
import resource
from pathlib import Path

import numpy as np
import pytest
import trimesh

import sobolev_batch as sb

# Digits at both ends of the range, and vertices that no triangle uses.
VERTICES = np.array([[0.1, -2 / 3, 1e-300], [1e6 + 1 / 3, 3.0, np.pi], [0.0, 7.0, -1e-9], [5.0, 5.0, 5.0]])
MESH = sb.Mesh(VERTICES, [[0, 1, 2], [2, 1, 0]])


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".OBJ"])
def test_every_digit_comes_back(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh{suffix}"
    sb.write_mesh(MESH, path)
    found = sb.read_mesh(path)
    np.testing.assert_array_equal(found.vertices, MESH.vertices)
    np.testing.assert_array_equal(found.triangles, MESH.triangles)


def test_stl_has_single_precision(tmp_path: Path) -> None:
    ball = sb.icosphere(1)
    sb.write_mesh(ball, str(tmp_path / "mesh.stl"))
    found = sb.read_mesh(tmp_path / "mesh.stl")
    corners = np.asarray(found.vertices)[found.triangles]
    np.testing.assert_allclose(corners, np.asarray(ball.vertices)[ball.triangles], rtol=0, atol=1e-7)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
def test_other_programs_read_them(suffix: str, tmp_path: Path) -> None:
    sb.write_mesh(sb.icosphere(2), tmp_path / f"mesh{suffix}")
    found = trimesh.load_mesh(tmp_path / f"mesh{suffix}")
    assert (len(found.vertices), len(found.faces)) == (162, 320)
    assert found.area == pytest.approx(sb.icosphere(2).area, rel=1e-6)


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        sb.InputError, match=re.escape("are written as .ply, .obj, .stl, .off; found the suffix '.xyz'")
    ):
        sb.write_mesh(MESH, tmp_path / "mesh.xyz")
    with pytest.raises(sb.InputError, match="there is no folder"):
        sb.write_mesh(MESH, tmp_path / "nowhere" / "mesh.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(sb.InputError, match="it exists already and is no file"):
        sb.write_mesh(MESH, tmp_path / "folder.ply")
    with pytest.raises(sb.MeshError, match="cannot be written there: File name too long"):
        sb.write_mesh(MESH, tmp_path / f"{'x' * 300}.ply")
    assert os.listdir(tmp_path) == ["folder.ply"]


def test_an_old_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    sb.write_mesh(sb.icosphere(0), path)
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before), limits[1]))
    try:
        with pytest.raises(sb.MeshError, match=r"mesh\.ply: the mesh cannot be written there: File too large"):
            sb.write_mesh(sb.icosphere(3), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
