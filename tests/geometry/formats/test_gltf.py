"""The reader of glTF scenes: every surface of the scene, where its nodes place it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.errors import MeshError
from sobolev_batch.shapes import icosphere
from sobolev_batch.sources.files import FileMember
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
    "mirrored": ([{"mesh": 0, "scale": [-1, -1, -1]}], None, 28, [0, 0, 0]),
    "outside the scene": ([{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}], [0], 28, [1, 2, 4]),
}


@pytest.mark.parametrize("name", PLACED)
def test_gltf_nodes_place_their_meshes(read: Read, name: str) -> None:
    nodes, roots, area, upper = PLACED[name]
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], nodes, roots)
    mesh = read(".glb", scene.glb())
    assert mesh.area == pytest.approx(area, rel=1e-14)
    assert mesh.extent.box[1] == pytest.approx(upper, abs=1e-14)
    # Triangles face outwards, also in a mirror.
    assert mesh.volume > 0
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


def test_a_gltf_rotation_of_zeros_turns_nothing(read: Read) -> None:
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0, "rotation": [0, 0, 0, 0]}])
    assert read(".glb", scene.glb()).area == pytest.approx(BOX_AREA)


def test_gltf_rotations_of_few_digits_do_not_stretch(read: Read) -> None:
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0, "rotation": [0.7, 0, 0, 0.7]}])
    assert read(".glb", scene.glb()).area == pytest.approx(BOX_AREA, rel=1e-14)


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
def test_gltf_points_and_lines_have_no_area(read: Read, mode: int) -> None:
    corners = [[0, 0, 9], [1, 0, 9], [0, 2, 9], [1, 2, 9]]
    # As a fan, the corners go round.
    indices = {4: [0, 1, 2, 1, 3, 2], 5: [0, 1, 2, 3], 6: [0, 1, 3, 2]}.get(mode, [0, 1, 2])
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None), (corners, indices, mode)]], [{"mesh": 0}])
    assert read(".glb", scene.glb()).area == (30 if mode >= 4 else 28)


def instanced() -> Gltf:
    """Three boxes: as it is, turned and twice as large, and three times as large; 14 times its area."""
    scene = box_scene()
    attributes = {
        "TRANSLATION": scene.accessor([[0, 0, 0], [9, 0, 0], [0, 40, 0]], "VEC3", "float32"),
        "ROTATION": scene.accessor(np.array([[0, 0, 0, 1], ROTATION, [0, 0, 0, 1]]), "VEC4", "float32"),
        "SCALE": scene.accessor([[1, 1, 1], [2, 2, 2], [3, 3, 3]], "VEC3", "float32"),
        "_ID": scene.accessor([0, 1, 2], "SCALAR", "float32"),
    }
    scene.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    scene.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    return scene


def skinned(weights: list[float]) -> Gltf:
    """The box on two joints, one of them below the other: twice as large, and shifted by 5 from there."""
    scene = box_scene()
    scene.tree["nodes"] = [{"mesh": 0, "skin": 0, "scale": [10] * 3}, {"scale": [2] * 3, "children": [2]}]
    scene.tree["nodes"].append({"translation": [5, 0, 0]})
    scene.tree["scenes"][0]["nodes"] = [0, 1]
    scene.tree["skins"] = [{"joints": [2, 1]}]
    attributes = scene.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = scene.accessor([[0, 1, 0, 0]] * 8, "VEC4", "uint8")
    attributes["WEIGHTS_0"] = scene.accessor([[*weights, 0, 0]] * 8, "VEC4", "float32")
    return scene


def with_unused_vertex() -> Gltf:
    """The box on its first joint, with one vertex more, which nothing uses."""
    scene = skinned([1, 0])
    attributes = scene.tree["meshes"][0]["primitives"][0]["attributes"]
    for name, rows, kind, dtype in (
        ("POSITION", [*BOX_VERTICES, [99, 99, 99]], "VEC3", "float32"),
        ("JOINTS_0", [[0] * 4] * 9, "VEC4", "uint8"),
        ("WEIGHTS_0", [[1, 0, 0, 0]] * 8 + [[0] * 4], "VEC4", "float32"),
    ):
        attributes[name] = scene.accessor(rows, kind, dtype)
    return scene


def bound() -> Gltf:
    """The box on two joints as it was bound to them: where it was."""
    scene = skinned([0.25, 0.75])
    inverse = [np.diag([0.5, 0.5, 0.5, 1.0]) for _ in range(2)]
    inverse[0][0, 3] = -5.0
    columns = np.array([matrix.T.ravel() for matrix in inverse])
    scene.tree["skins"][0]["inverseBindMatrices"] = scene.accessor(columns, "MAT4", "float32")
    return scene


def morphed(*, of_node: bool) -> Gltf:
    """The box with a target of twice its size, a quarter of the way there, and one that is not used."""
    scene = box_scene()
    mesh = scene.tree["meshes"][0]
    targets = [{"POSITION": scene.accessor(BOX_VERTICES * factor, "VEC3", "float32")} for factor in (1, 99)]
    mesh["primitives"][0]["targets"] = [*targets, {"NORMAL": 0}]
    mesh["weights"] = [0.25 if not of_node else 7, 0, 1]
    if of_node:
        scene.tree["nodes"][0]["weights"] = [0.25, 0, 0]
    return scene


def quantised(dtype: str) -> Gltf:
    """The box with its coordinates as fractions of the largest integer, and a node that undoes that."""
    scene = box_scene()
    most = np.iinfo(dtype).max
    rows = np.zeros((8, 4 if dtype.endswith("int8") else 3))
    rows[:, :3] = BOX_VERTICES / [1, 2, 4] * most
    position = scene.accessor(rows, "VEC3", dtype)
    scene.tree["bufferViews"][-1]["byteStride"] = rows.shape[1] * np.dtype(dtype).itemsize
    scene.tree["accessors"][position]["normalized"] = True
    scene.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position
    scene.tree["nodes"][0]["scale"] = [1, 2, 4]
    scene.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    return scene


def sparse(*, is_new: bool) -> Gltf:
    """The box with its last corners, or all, in place of other numbers or of none."""
    scene, rows = box_scene(), [0, *range(7, 0, -1)] if is_new else [7, 3]
    places = [scene.accessor(rows, "SCALAR", "uint16"), scene.accessor(BOX_VERTICES[rows], "VEC3", "float32")]
    position = scene.accessor([*BOX_VERTICES[:3], [9, 9, 9], *BOX_VERTICES[4:7], [9, 9, 9]], "VEC3", "float32")
    accessors = scene.tree["accessors"]
    accessors[position]["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": places[0], "componentType": accessors[places[0]]["componentType"]},
        "values": {"bufferView": places[1]},
    }
    if is_new:
        del accessors[position]["bufferView"]
    scene.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position
    return scene


# Scenes, and the area and the upper corner of what they show before any animation.
SHOWN: dict[str, tuple[Gltf, float, list[float]]] = {
    "instances": (instanced(), 14 * 28, [9, 46, 12]),
    "a joint below another": (skinned([1, 0]), 4 * 28, [12, 4, 8]),
    "between two joints": (skinned([0.5, 0.5]), 4 * 28, [7, 4, 8]),
    "weights that add to less than 1": (skinned([0.25, 0.25]), 4 * 28, [7, 4, 8]),
    "a vertex that no joint and no triangle holds": (with_unused_vertex(), 4 * 28, [12, 4, 8]),
    "bound": (bound(), 28, [1, 2, 4]),
    "places in place of others": (sparse(is_new=False), 28, [1, 2, 4]),
    "places in place of none": (sparse(is_new=True), 28, [1, 2, 4]),
    "weights of the mesh": (morphed(of_node=False), 1.25**2 * 28, [1.25, 2.5, 5]),
    "weights of the node": (morphed(of_node=True), 1.25**2 * 28, [1.25, 2.5, 5]),
    **{dtype: (quantised(dtype), 28, [1, 2, 4]) for dtype in ("int8", "uint8", "int16", "uint16")},
}


@pytest.mark.parametrize("name", SHOWN)
def test_gltf_scenes_are_read_as_they_stand(read: Read, name: str) -> None:
    scene, area, upper = SHOWN[name]
    mesh = read(".glb", scene.glb())
    assert mesh.area == pytest.approx(area, rel=1e-6)
    assert mesh.extent.box[1] == pytest.approx(upper, abs=1e-5)


def changed(scene: Gltf, change: Callable[[dict[str, Any]], object]) -> Gltf:
    change(scene.tree)
    return scene


def with_a_short(kind: str) -> Gltf:
    """A scene with a target, or weights of joints, of one vertex, which must not count for all."""
    scene = morphed(of_node=False) if kind == "POSITION" else skinned([1, 0])
    primitive = scene.tree["meshes"][0]["primitives"][0]
    if kind == "POSITION":
        primitive["targets"][0][kind] = scene.accessor([[1, 0, 0]], "VEC3", "float32")
    else:
        primitive["attributes"][kind] = scene.accessor([[1, 0, 0, 0]], "VEC4", "float32")
    return scene


def with_one_bind() -> Gltf:
    scene = skinned([1, 0])
    scene.tree["skins"][0]["inverseBindMatrices"] = scene.accessor(2 * np.eye(4).reshape(1, 16), "MAT4", "float32")
    return scene


def with_negative(kind: str) -> Gltf:
    """A scene whose corners, joints or sparse places are bytes with a sign, and one of them is -1."""
    scene = {"corners": box_scene(), "joints": skinned([1, 0]), "places": sparse(is_new=False)}[kind]
    primitive = scene.tree["meshes"][0]["primitives"][0]
    if kind == "corners":
        primitive["indices"] = scene.accessor([0, 1, -1, *np.ravel(BOX_TRIANGLES)], "SCALAR", "int8")
    elif kind == "joints":
        primitive["attributes"]["JOINTS_0"] = scene.accessor([[-1, 0, 0, 0]] * 8, "VEC4", "int8")
    else:
        places = scene.tree["accessors"][-1]["sparse"]["indices"]
        places.update(bufferView=scene.accessor([-1, 3], "SCALAR", "int8"), componentType=5120)
    return scene


def with_mode(mode: int) -> Gltf:
    scene = box_scene()
    primitives = scene.tree["meshes"][0]["primitives"]
    primitives.append({**primitives[0], "mode": mode})
    return scene


# Documents that contradict themselves, and what is said of them.
WRONG: dict[str, tuple[Gltf, str]] = {
    "a joint outside of the scene": (
        changed(skinned([1, 0]), lambda tree: tree["scenes"][0].update(nodes=[0])),
        "joint 2, which is no node of the scene",
    ),
    "a joint that is not there": (
        changed(skinned([1, 0]), lambda tree: tree["skins"][0].update(joints=[2, 99])),
        "joint 99, which is no node",
    ),
    "a mesh from the end": (
        changed(box_scene(), lambda tree: tree["nodes"][0].update(mesh=-1)),
        "entry -1 of its meshes, of which it has 1",
    ),
    "a truth for a mesh": (
        changed(box_scene(), lambda tree: tree["nodes"][0].update(mesh=False)),
        "entry False of",
    ),
    "a skin that is not there": (
        changed(skinned([1, 0]), lambda tree: tree["nodes"][0].update(skin=1)),
        "entry 1 of its skins, of which it has 1",
    ),
    "no count": (
        changed(box_scene(), lambda tree: tree["accessors"][0].pop("count")),
        "lacks .*count",
    ),
    "a target of one vertex": (with_a_short("POSITION"), "has 1 entries, expected 8"),
    "weights of one vertex": (with_a_short("WEIGHTS_0"), "has 1 entries, expected 8"),
    "a vertex that no joint holds": (skinned([0, 0]), "vertices that no joint holds"),
    "no data": (
        changed(box_scene(), lambda tree: tree["accessors"][0].pop("bufferView")),
        "accessor 0 has no data, as in compressed files.*gltf-transform/cli copy",
    ),
    "sparse data alone, of too many": (
        changed(sparse(is_new=True), lambda tree: tree["accessors"][-1].update(count=10**9)),
        "has no data",
    ),
    **{
        f"{kind} that count from the end": (with_negative(kind), r"outside 0\.\.7|do not fit together")
        for kind in ("corners", "joints", "places")
    },
    "a mode below that of points": (with_mode(-1), "no whole triangles of the mode -1"),
    "fewer matrices than joints": (with_one_bind(), "2 joints and 1 matrices"),
}


@pytest.mark.parametrize("name", WRONG)
def test_gltf_that_contradicts_itself_is_refused_with_the_reason(read: Read, name: str) -> None:
    scene, reason = WRONG[name]
    with pytest.raises(MeshError, match=reason):
        read(".glb", scene.glb())


@pytest.mark.parametrize(
    "damaged", [b"{'nodes': []}", b"{", b'{"nodes": [\xff]}', b'{"nodes": [' + b"9" * 5000 + b"]}"]
)
def test_gltf_that_is_no_json_is_named_in_words(read: Read, damaged: bytes) -> None:
    with pytest.raises(MeshError, match=r"its JSON is damaged|damaged, or not in UTF-8|do not fit together") as refusal:
        read(".gltf", damaged)
    assert "Error" not in str(refusal.value)


def test_gltf_instances_without_places_do_not_vanish(read: Read) -> None:
    scene = instanced()
    attributes = scene.tree["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]["attributes"]
    scene.tree["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]["attributes"] = {"_ID": attributes["_ID"]}
    scene.tree["nodes"].append({"mesh": 0})
    scene.tree["scenes"][0]["nodes"].append(1)
    with pytest.raises(MeshError, match=r"instances .* without places"):
        read(".glb", scene.glb())


@pytest.mark.parametrize(
    "extension",
    [
        "EXT_texture_webp",
        "KHR_texture_basisu",
        "MSFT_texture_dds",
        "KHR_materials_ior",
        "KHR_techniques_webgl",
        "EXT_mesh_features",
    ],
)
def test_gltf_materials_do_not_matter(read: Read, extension: str) -> None:
    scene = box_scene()
    scene.tree["extensionsRequired"] = [extension]
    assert read(".glb", scene.glb()).area == BOX_AREA


def test_gltf_may_fill_up_its_document_with_zeros(read: Read) -> None:
    content = box_scene().glb()
    size = int.from_bytes(content[12:16], "little")
    head = struct.pack("<4s3I", b"glTF", 2, len(content) + 4, size + 4)
    assert read(".glb", head + content[16 : 20 + size] + bytes(4) + content[20 + size :]).area == BOX_AREA


@pytest.mark.parametrize("named", [{"asset": {"version": "1.0"}}, {"meshes": {"box": {}}, "asset": {}}])
def test_gltf_of_the_first_version_is_named(read: Read, named: dict[str, Any]) -> None:
    scene = box_scene()
    scene.tree.update(named)
    with pytest.raises(MeshError, match=r"is of version 1.* of glTF, expected 2\.0"):
        read(".gltf", scene.gltf())


def test_gltf_buffers_may_lie_in_the_same_folder(tmp_path: Path) -> None:
    scene = box_scene()
    path, inner, outer = tmp_path / "scan.gltf", tmp_path / "of scan" / "1.bin", tmp_path.parent / "outer.bin"
    inner.parent.mkdir()
    for part in (inner, outer):
        part.write_bytes(scene.blob)
    path.write_bytes(scene.gltf("of%20scan/1.bin"))
    assert soup(sb.read_mesh(path)) == soup(box())
    member = FileMember("scan", -1, path)
    before = member.fingerprint()
    assert member.expected_size().projected_bytes > 0
    inner.write_bytes(scene.blob[::-1])
    assert member.fingerprint() != before
    inner.unlink()
    inner.symlink_to(outer)
    for uri in ("nowhere.bin", "of%20scan/1.bin", "../outer.bin", outer.as_posix(), f"file://{outer}"):
        path.write_bytes(scene.gltf(uri))
        with pytest.raises(MeshError, match=r"scan\.gltf: it needs '.*', which is no file in its folder"):
            sb.read_mesh(path)
    assert [*member.fingerprint()] == ["file", "format"]


def test_gltf_vertices_may_be_interleaved_with_others(read: Read) -> None:
    scene = box_scene()
    wide = np.column_stack([BOX_VERTICES, np.full((8, 3), 7.0)]).astype(np.float32)
    position = scene.accessor(wide, "VEC3", "float32")
    scene.tree["bufferViews"][-1]["byteStride"] = 24
    scene.tree["accessors"][position]["count"] = 8
    scene.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position
    assert soup(read(".glb", scene.glb())) == soup(box())
