from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sobolev_batch import MeshError, read_mesh, read_points

ROWS = [(0.0, 0.5, 1.0, 0.25), (1.0, -2.0, 3.5, 0.75)]


def ply(path: Path, *, text: bool) -> None:
    vertices = np.array(ROWS, dtype=[(name, "f8") for name in ("x", "y", "z", "patch")])
    PlyData([PlyElement.describe(vertices, "vertex")], text=text).write(path)


@pytest.mark.parametrize(
    ("name", "content", "weight"),
    [
        ("a.xyz", "# a scan\n0 0.5 1 0.25\n\n1 -2 3.5 0.75\n", 4),
        ("a.csv", "x, y, z, patch\n0,0.5,1,0.25\n1,-2,3.5,0.75\n", "patch"),
        ("a.csv", "id,X,Y,Z,patch\n7,0,0.5,1,0.25\n8,1,-2,3.5,0.75\n", "patch"),
        ("a.csv", "nx,ny,nz,x,y,z,patch\n0,0,1,0,0.5,1,0.25\n0,0,1,1,-2,3.5,0.75\n", 7),
        ("a.csv", 'x,y,"z",scan id,"patch",time\n0,0.5,1,"a, b",0.25,9\n1,-2,3.5,c,0.75,9\n', "patch"),
        ("a.csv", "x,y,z,r,patch,extra\n0,0.5,1,,0.25,9\n1,-2,3.5,,0.75,9\n", "patch"),
        ("a.txt", "//X Y Z patch\n0 0.5 1 0.25\n1 -2 3.5 0.75\n", "patch"),
        ("a.txt.gz", "x y z patch\r\n0 0.5 1 0.25\r\n1 -2 3.5 0.75", 4),
    ],
)
def test_text_is_read_by_columns(tmp_path: Path, name: str, content: str, weight: Any) -> None:
    data = content.encode()
    (tmp_path / name).write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    cloud = read_points(tmp_path / name, weight=weight)
    assert np.column_stack([cloud.points, cloud.weights]).tolist() == [list(row) for row in ROWS]
    assert read_points(tmp_path / name, area=3.0).weights.tolist() == [1.5, 1.5]


@pytest.mark.parametrize("text", [True, False])
def test_vertices_of_ply_files_are_points(tmp_path: Path, text: bool) -> None:
    ply(tmp_path / "a.ply", text=text)
    cloud = read_points(tmp_path / "a.ply", weight="patch")
    assert np.column_stack([cloud.points, cloud.weights]).tolist() == [list(row) for row in ROWS]
    with pytest.raises(MeshError, match=r"a.ply: the PLY file has 2 vertices and no faces: read it as points"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("name", "content", "options", "message"),
    [
        ("a.xyz", "0 0 0 1\n", {}, "give weight, the property or column"),
        ("a.xyz", "0 0 0 1\n", {"weight": 4, "area": 1.0}, "both weight and area are given; give one of them"),
        ("a.obj", "v 0 0 0\n", {"area": 1.0}, "no format of points has this name; known are .ply, .xyz, .txt, .csv"),
        ("a.xyz", "0 0 0 1\n", {"weight": 5}, "has 4 columns and no column 5"),
        ("a.xyz", "0 0 0 1\n", {"weight": "patch"}, "has no column 'patch' and does not name its columns"),
        ("a.csv", "x,y,z\n0,0,0\n", {"weight": "patch"}, "has no column 'patch'; its columns are x, y, z"),
        ("a.xyz", "0 0\n", {"area": 1.0}, "the first line has 2 columns, expected x, y, z"),
        ("a.xyz", "0 0 0\n\n1 1\n", {"area": 1.0}, "line 3 has 2 columns, the first line 3; write every column in"),
        ("a.xyz", "0 0 0 1\n0 0 one 1\n", {"area": 1.0}, "line 2: column 3 is 'one', expected a number; mend it, or"),
        ("a.csv", "0,0,,1\n", {"area": 1.0}, "line 1: column 3 is empty, expected a number"),
        ("a.csv", "x,y,z,r,patch\n0,0,0,1\n", {"area": 1.0}, "line 2 has 4 columns, the first line 5"),
        ("a.csv", "x,y,z,r,patch\n0,0,0,1,\n", {"weight": "patch"}, "line 2: column 5 is empty"),
        ("a.csv", "id,a,b\n0,0,0\n", {"area": 1.0}, "names the columns id, a, b, none of them x; name the coordinates"),
        ("a.csv", "x,y,z,X\n0,0,0,1\n", {"area": 1.0}, "2 of them x; name the coordinates x, y and z there, once each"),
        ("a.csv", "x,y,z,r,r\n0,0,0,1,2\n", {"weight": "r"}, "2 columns are named 'r'; give the number of one of them"),
        ("a.xyz", "# nothing\n", {"area": 1.0}, "the first line has 0 columns"),
        ("a.csv", "x,y,z\n", {"area": 1.0}, "the file has no points"),
        ("a.xyz", "0 0 nan 1\n", {"area": 1.0}, "1 of 1 points have NaN"),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n", {"area": 1.0}, "no PLY header announces vertices"),
    ],
)
def test_what_holds_no_points_is_refused(
    tmp_path: Path, name: str, content: str, options: dict[str, Any], message: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(MeshError, match=message) as caught:
        read_points(tmp_path / name, **options)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_properties_of_ply_files_have_names(tmp_path: Path) -> None:
    ply(tmp_path / "a.ply", text=False)
    for weight, message in (
        (4, "give the name of the weight"),
        ("area", "no property 'area'; theirs are x, y, z"),
    ):
        with pytest.raises(MeshError, match=message):
            read_points(tmp_path / "a.ply", weight=weight)
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(whole[:-3])
    with pytest.raises(MeshError, match="announces"):
        read_points(tmp_path / "a.ply", area=1.0)
