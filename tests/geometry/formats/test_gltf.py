"""The reader of glTF scenes: every surface of the scene, where its nodes place it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sobolev_batch.errors import MeshError
from sobolev_batch.shapes import icosphere
from tests.support.mesh_files import Gltf, Read, box_scene
from tests.support.shapes import BOX_AREA, BOX_TRIANGLES, BOX_VERTICES, CLOSED, box, mesh_counts, soup

ROTATION = [0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]  # by a right angle about z


# Nodes, the roots of the scene, and the area and the upper corner of what they place.
PLACED: dict[str, tuple[list[dict[str, Any]], list[int] | None, float, list[float]]] = {
    "stretched": ([{"mesh": 0, "scale": [3, 1, 1]}], None, 2 * (6 + 12 + 8), [3, 2, 4]),
    "scaled, then rotated, then shifted": (
        [{"mesh": 0, "scale": [3, 1, 1], "rotation": ROTATION, "translation": [9, 0, 0]}],
        None,
        52,
        [9, 3, 4],
    ),
    # Column by column: the same rotation, with lengths doubled and a shift.
    "matrix": ([{"mesh": 0, "matrix": [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 9, 0, 0, 1]}], None, 4 * 28, [9, 2, 8]),
    "child": ([{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "translation": [1, 0, 0]}], [0], 4 * 28, [4, 4, 8]),
    "outside the scene": ([{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}], [0], 28, [1, 2, 4]),
}


@pytest.mark.parametrize("name", PLACED)
def test_gltf_nodes_place_their_meshes(read: Read, name: str) -> None:
    nodes, roots, area, upper = PLACED[name]
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], nodes, roots)
    mesh = read(".glb", scene.glb())
    assert mesh.area == pytest.approx(area, rel=1e-14)
    assert mesh.extent.box[1] == pytest.approx(upper, abs=1e-14)
    embedded = read(".gltf", scene.gltf())
    assert soup(embedded) == soup(mesh)


def test_gltf_meshes_may_have_several_primitives_and_no_indices(read: Read) -> None:
    halves = [(BOX_VERTICES, BOX_TRIANGLES[:6], None), (BOX_VERTICES, BOX_TRIANGLES[6:], 4)]
    corners = [(BOX_VERTICES[np.array(BOX_TRIANGLES)].reshape(-1, 3), None, None)]
    for parts in (halves, corners):
        mesh = read(".glb", Gltf([parts], [{"mesh": 0}]).glb())
        assert (soup(mesh), mesh.counts) == (soup(box()), CLOSED)
    twice = read(".glb", Gltf([halves], [{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}]).glb())
    assert twice.area == 5 * BOX_AREA


@pytest.mark.parametrize(("level", "index"), [(2, "uint8"), (6, "uint16"), (2, "uint32")])
def test_gltf_parts_with_many_vertices_do_not_run_into_each_other(read: Read, level: int, index: str) -> None:
    # The second part's come after the first's, and no longer fit the type.
    ball = icosphere(level)
    nodes: list[dict[str, Any]] = [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    mesh = read(".glb", Gltf([[(ball.vertices, ball.triangles, None)]], nodes, index=index).glb())
    assert mesh.area == pytest.approx(2 * ball.area, rel=1e-6)
    assert mesh.vertices.shape == (2 * len(ball.vertices), 3)
    assert mesh.counts == mesh_counts(0, 0, 0, 0, components=2, euler=4)


@pytest.mark.parametrize("mode", range(7))
def test_gltf_points_and_lines_have_no_area_and_strips_are_refused(read: Read, mode: int) -> None:
    corners = [[0, 0, 9], [1, 0, 9], [0, 2, 9], [1, 2, 9]]
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None), (corners, [0, 1, 2], mode)]], [{"mesh": 0}])
    if mode > 4:
        with pytest.raises(MeshError, match=f"the mode {mode}, strips or fans; export plain triangles"):
            read(".glb", scene.glb())
    else:
        assert read(".glb", scene.glb()).area == (29 if mode == 4 else 28)


def test_gltf_vertices_may_be_interleaved_with_others(read: Read) -> None:
    scene = box_scene()
    wide = np.column_stack([BOX_VERTICES, np.full((8, 3), 7.0)]).astype(np.float32)
    position = scene.accessor(wide, "VEC3", "float32")
    scene.tree["bufferViews"][-1]["byteStride"] = 24
    scene.tree["accessors"][position]["count"] = 8
    scene.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position
    assert soup(read(".glb", scene.glb())) == soup(box())
