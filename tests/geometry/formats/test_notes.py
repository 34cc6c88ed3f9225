"""What a file leaves open is noted wherever its mesh is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import sobolev_batch as sb
from sobolev_batch.cli.program import cli
from sobolev_batch.errors import MeshError
from tests.support.mesh_files import BIG, Gltf, obj, off, ply, stl_binary
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES
from tests.support.studies import small_table

BENT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]], dtype=np.float64)
FAMILY = {"name": "f", "source": "files", "paths": ["other.obj"]}
NOTE = "1 of 1 faces are not flat"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("bent", "other"):
        Path(f"{name}.obj").write_bytes(obj(BENT, [[0, 1, 2, 3]]))
    return tmp_path


def test_info_and_compare_show_them(folder: Path) -> None:
    shown = CliRunner().invoke(cli, ["info", "bent.obj"]).output
    assert f"note: {NOTE}" in shown
    document = json.loads(CliRunner().invoke(cli, ["info", "bent.obj", "--format", "json"]).output)
    assert [note[: len(NOTE)] for note in document["files"][0]["notes"]] == [NOTE]
    compared = CliRunner().invoke(cli, ["compare", "bent.obj", "other.obj", "--xi-max", "2", "--M", "8"])
    assert compared.stderr.count(NOTE) == 2


def test_a_plan_names_the_meshes(folder: Path) -> None:
    table = small_table(reference={"source": "files", "paths": ["bent.obj"]}, family=[FAMILY])
    doubtful = sb.plan(sb.Study.from_table(table, folder=folder), folder / "s.zarr").object.doubtful
    assert {label: reason[: len(NOTE)] for label, reason in doubtful.items()} == {"reference": NOTE, "f/other": NOTE}


BALL = sb.shapes.icosphere(1)


def several(*placed: tuple[float, float]) -> bytes:
    """Balls of some radii, each at a place on the x-axis."""
    vertices = np.concatenate([radius * BALL.vertices + [x, 0, 0] for radius, x in placed])
    faces = np.concatenate([BALL.triangles + 42 * i for i in range(len(placed))])
    return obj(vertices, faces.tolist())


APART = obj(BALL.vertices[BALL.triangles].reshape(-1, 3), np.arange(240).reshape(-1, 3).tolist())
RANGES = [*BOX_VERTICES, [np.nan, np.nan, np.nan], [np.inf, 0, 0]]
UTM = BOX_VERTICES * [25, 25, 5] + [500_000, 5_000_000, 100]
SEVEN = UTM + np.array([0.4, 0, 0.25])
INFO: dict[str, tuple[str, bytes, list[str], list[str]]] = {
    "one ball": (".obj", several((1, 0)), ["closed, all triangles face outwards"], ["components", "note"]),
    "shells": (".obj", several((1, 0), (0.5, 0), (0.1, 0), (1, 3)), ["4 closed components, 2 inside others"], ["note"]),
    "beside": (".obj", several((1, 0), (0.1, 0.95), (0.1, 1.2)), ["3 closed components"], ["inside"]),
    "twice": (".obj", several((1, 0), (1, 0)), ["every triangle is there twice", "80 duplicate triangles"], ["closed"]),
    "seams": (".obj", APART, ["closed, all triangles face outwards", "volume 3.6"], ["open", "components"]),
    "range map": (".ply", ply(RANGES[::-1], [[9 - i for i in f] for f in BOX_TRIANGLES]), ["note: 2 vertices"], []),
    "UTM": (".obj", obj(UTM, BOX_TRIANGLES), ["y 5000000 to 5000050, z 100 to 120: 25 by 50 by 20"], ["note"]),
    "UTM in single precision": (".stl", stl_binary(UTM, BOX_TRIANGLES), ["single precision keeps 2 digits"], []),
    "UTM in seven digits": (".off", off(SEVEN, BOX_TRIANGLES), ["a text of seven digits keeps 2 digits"], []),
    "UTM in eight digits": (".off", off(SEVEN + 0.01, BOX_TRIANGLES), [], ["note"]),
    "UTM of glTF": (".glb", Gltf([[(UTM, BOX_TRIANGLES, None)]], [{"mesh": 0}]).glb(), ["keeps 2 digits"], []),
    "UTM and a place without data": (".ply", ply([*UTM, [0, 0, 0]], BOX_TRIANGLES, BIG), ["keeps 2 digits"], []),
}


@pytest.mark.parametrize("name", INFO)
def test_info_tells_the_situation(tmp_path: Path, name: str) -> None:
    ending, content, expected, missing = INFO[name]
    path = tmp_path / f"scan{ending}"
    path.write_bytes(content)
    shown = CliRunner().invoke(cli, ["info", str(path)]).output.partition("\n")[2]
    assert [text for text in expected if text not in shown] == [], shown
    assert [text for text in missing if text in shown] == [], shown


def test_a_used_vertex_needs_coordinates(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(ply([*BOX_VERTICES[:-1], [np.nan, 0, 0]], BOX_TRIANGLES))
    with pytest.raises(MeshError, match="1 of 8 vertices have NaN"):
        sb.read_mesh(path)
