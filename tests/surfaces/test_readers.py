"""Readers of mesh files: what each format holds is what comes out, and damage never passes for a mesh."""

from __future__ import annotations

import gzip
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sobolev_batch import Mesh, MeshError, icosphere, read_mesh
from sobolev_batch.surfaces.mesh import MeshCounts
from tests.surfaces.formats import Gltf, gifti, obj, off, ply, stl_binary, stl_text
from tests.surfaces.shapes import (
    AWKWARD_VERTICES,
    BOX_AREA,
    BOX_QUADS,
    BOX_TRIANGLES,
    BOX_VERTICES,
    TETRAHEDRON_TRIANGLES,
    TETRAHEDRON_VERTICES,
    Reals,
    box,
    soup,
)

LITTLE, BIG = "binary_little_endian", "binary_big_endian"
CLOSED = MeshCounts(zero_area=0, duplicate=0, boundary_edges=0, nonmanifold_edges=0)

# Each as the end of the file's name and its bytes.
Content = tuple[str, bytes]


def box_scene() -> Gltf:
    return Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}])


BOXES: dict[str, Content] = {
    "ply ascii float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES)),
    "ply ascii double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, real="double")),
    "ply little float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE)),
    "ply little double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, real="double", index="uint")),
    "ply big float": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, index="ushort")),
    "ply big double": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, real="double", length="int")),
    "obj": (".obj", obj(BOX_VERTICES, BOX_TRIANGLES)),
    "off": (".off", off(BOX_VERTICES, BOX_TRIANGLES)),
    "stl ascii": (".stl", stl_text(BOX_VERTICES, BOX_TRIANGLES)),
    "stl binary": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES)),
    "stl binary that starts with solid": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES, b"solid box")),
    "gltf": (".gltf", box_scene().gltf()),
    "glb": (".glb", box_scene().glb()),
    "gifti gzipped": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, dtype=np.int32))),
    "gifti base64": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_B64BIN")),
    "gifti ascii": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_ASCII")),
    "gifti by columns": (".gii", gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), ordering="F")),
}


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str, bytes], Mesh]:
    """Write a file and read it."""

    def write_and_read(ending: str, content: bytes) -> Mesh:
        path = tmp_path / f"mesh{ending}"
        path.write_bytes(content)
        return read_mesh(path)

    return write_and_read


Read = Callable[[str, bytes], Mesh]


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzipped"])
def test_every_format_gives_the_box(read: Read, name: str, zipped: bool) -> None:
    ending, content = BOXES[name]
    mesh = read(f"{ending}.gz", gzip.compress(content)) if zipped else read(ending, content)
    assert mesh.area == BOX_AREA
    assert mesh.counts == CLOSED
    assert mesh.vertices.shape == (8, 3)
    assert soup(mesh) == soup(box())


@pytest.mark.parametrize("ending", [".OFF", ".Off", ".off.GZ", ".scan 2.off", ".tar.off"])
def test_only_the_last_endings_of_a_name_matter(read: Read, ending: str) -> None:
    content = off(BOX_VERTICES, BOX_TRIANGLES)
    assert read(ending, gzip.compress(content) if ending.endswith("GZ") else content).area == BOX_AREA


def test_a_path_may_be_text(tmp_path: Path) -> None:
    path = tmp_path / "box.off"
    path.write_bytes(off(BOX_VERTICES, BOX_TRIANGLES))
    assert read_mesh(str(path)).digest == read_mesh(path).digest


@pytest.mark.parametrize(
    ("ending", "content"),
    [
        (".ply", ply(AWKWARD_VERTICES, BOX_TRIANGLES, real="double")),
        (".ply", ply(AWKWARD_VERTICES, BOX_TRIANGLES, LITTLE, real="double")),
        (".ply", ply(AWKWARD_VERTICES, BOX_TRIANGLES, BIG, real="double")),
        (".obj", obj(AWKWARD_VERTICES, BOX_TRIANGLES)),
        (".off", off(AWKWARD_VERTICES, BOX_TRIANGLES)),
    ],
    ids=["ply ascii", "ply little", "ply big", "obj", "off"],
)
def test_double_precision_is_kept_to_the_last_bit(read: Read, ending: str, content: bytes) -> None:
    mesh = read(ending, content)
    assert mesh.vertices.tolist() == AWKWARD_VERTICES.tolist()
    assert mesh.triangles.tolist() == BOX_TRIANGLES


def test_ascii_stl_keeps_double_precision(read: Read) -> None:
    mesh = read(".stl", stl_text(AWKWARD_VERTICES, BOX_TRIANGLES))
    assert soup(mesh) == soup(Mesh(AWKWARD_VERTICES, BOX_TRIANGLES))


@pytest.mark.parametrize(
    ("ending", "content"),
    [
        (".ply", ply(AWKWARD_VERTICES, BOX_TRIANGLES, LITTLE)),
        (".stl", stl_binary(AWKWARD_VERTICES, BOX_TRIANGLES)),
        (".glb", Gltf([[(AWKWARD_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}]).glb()),
        (".gii", gifti(AWKWARD_VERTICES, np.array(BOX_TRIANGLES, dtype=np.int32))),
    ],
    ids=["ply", "stl", "glb", "gifti"],
)
def test_single_precision_is_widened_and_not_touched(read: Read, ending: str, content: bytes) -> None:
    single = AWKWARD_VERTICES.astype(np.float32).astype(np.float64)
    assert soup(read(ending, content)) == soup(Mesh(single, BOX_TRIANGLES))


# A house in the plane z = 0: a pentagon of area 3 on a rectangle of area 2, with a buttress of area 1/2.
# The numbers of corners, 4, 3 and 5, have the mean of the first, so that a reader which takes all
# faces to be like the first one finds as many bytes as it expects.
HOUSE_VERTICES: Reals = np.array(
    [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (0, -1, 0), (2, -1, 0), (3, 0, 0)], dtype=np.float64
)
HOUSE_FACES = [[5, 6, 1, 0], [1, 7, 2], [0, 1, 2, 3, 4]]
MIXED_BOX = [*BOX_QUADS[:3], *BOX_TRIANGLES[6:]]

POLYGON_WRITERS: dict[str, tuple[str, Callable[[Any, Any], bytes]]] = {
    "ply ascii": (".ply", ply),
    "ply little": (".ply", lambda v, f: ply(v, f, LITTLE)),
    "ply little bytes": (".ply", lambda v, f: ply(v, f, LITTLE, index="uchar")),
    "ply big": (".ply", lambda v, f: ply(v, f, BIG)),
    "obj": (".obj", obj),
    "obj with texture": (".obj", lambda v, f: b"vt 0 0\n" + obj(v, f, lambda vertex, _: f"{vertex}/1")),
    "obj with normals": (".obj", lambda v, f: b"vn 0 0 1\n" + obj(v, f, lambda vertex, _: f"{vertex}//1")),
    "off": (".off", off),
}


@pytest.mark.parametrize("name", POLYGON_WRITERS)
@pytest.mark.parametrize("faces", [BOX_QUADS, MIXED_BOX, MIXED_BOX[::-1]], ids=["quads", "mixed", "mixed reversed"])
def test_quadrilaterals_are_cut_in_two(read: Read, name: str, faces: list[list[int]]) -> None:
    ending, write = POLYGON_WRITERS[name]
    mesh = read(ending, write(BOX_VERTICES, faces))
    assert mesh.area == BOX_AREA
    assert mesh.triangles.shape == (12, 3)
    assert mesh.vertices.tolist() == BOX_VERTICES.tolist()
    assert mesh.counts == CLOSED


@pytest.mark.parametrize("name", POLYGON_WRITERS)
def test_polygons_of_all_sizes_are_cut_into_fans(read: Read, name: str) -> None:
    ending, write = POLYGON_WRITERS[name]
    mesh = read(ending, write(HOUSE_VERTICES, HOUSE_FACES))
    assert mesh.area == pytest.approx(5.5, rel=1e-15)
    assert mesh.triangles.shape == (6, 3)
    assert mesh.vertices.tolist() == HOUSE_VERTICES.tolist()
    assert mesh.counts == MeshCounts(zero_area=0, duplicate=0, boundary_edges=8, nonmanifold_edges=0)
    pentagon = read(ending, write(HOUSE_VERTICES, HOUSE_FACES[2:]))
    assert pentagon.area == pytest.approx(3, rel=1e-15)


# What the formats allow beside plain lists of vertices and faces.


def insert(content: bytes, before: bytes, line: bytes) -> bytes:
    assert content.count(before) == 1
    return content.replace(before, line + before)


@pytest.mark.parametrize("encoding", ["ascii", LITTLE, BIG])
@pytest.mark.parametrize("more", ["abc", "st", "uv"], ids=["plain", "st", "uv"])
def test_ply_vertices_may_have_more_properties(read: Read, encoding: str, more: str) -> None:
    # s, t and u, v are names of texture coordinates. The last vertex is not in use.
    vertices = [*BOX_VERTICES.tolist(), [9.0, 9.0, 9.0]]
    mesh = read(".ply", ply(vertices, BOX_TRIANGLES, encoding, more=more))
    assert mesh.vertices.tolist() == vertices
    assert mesh.triangles.tolist() == BOX_TRIANGLES


@pytest.mark.parametrize("faces", [BOX_TRIANGLES, BOX_QUADS], ids=["triangles", "quads"])
def test_ply_faces_may_have_colors(read: Read, faces: list[list[int]]) -> None:
    colors = b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    content = insert(ply(BOX_VERTICES, faces), b"end_header\n", colors)
    lines = content.splitlines()
    content = b"\n".join([*lines[: -len(faces)], *[line + b" 255 0 7" for line in lines[-len(faces) :]], b""])
    assert soup(read(".ply", content)) == soup(box())


def test_ply_faces_may_have_texture_coordinates(read: Read) -> None:
    content = insert(ply(BOX_VERTICES, BOX_TRIANGLES), b"end_header\n", b"property list uchar float texcoord\n")
    lines = content.splitlines()
    faces = [b"%s 6 %d 0 1 0 1 1" % (line, number) for number, line in enumerate(lines[-12:])]
    mesh = read(".ply", b"\n".join([*lines[:-12], *faces, b""]))
    assert soup(mesh) == soup(box())
    # Texture seams do not cut the surface.
    assert mesh.counts == CLOSED


@pytest.mark.parametrize("encoding", ["ascii", LITTLE])
def test_ply_files_may_have_more_elements(read: Read, encoding: str) -> None:
    edges = b"element edge 2\nproperty int vertex1\nproperty int vertex2\n"
    content = insert(ply(BOX_VERTICES, BOX_TRIANGLES, encoding), b"end_header\n", edges)
    content += b"0 1\n1 2\n" if encoding == "ascii" else np.array([0, 1, 1, 2], dtype="<i4").tobytes()
    assert soup(read(".ply", content)) == soup(box())


def test_ply_faces_may_come_first(read: Read) -> None:
    lines = ply(BOX_VERTICES, BOX_TRIANGLES).splitlines(keepends=True)
    vertex_header, face_header = lines[3:7], lines[7:9]
    assert (vertex_header[0], face_header[0]) == (b"element vertex 8\n", b"element face 12\n")
    content = [*lines[:3], *face_header, *vertex_header, lines[9], *lines[18:], *lines[10:18]]
    assert soup(read(".ply", b"".join(content))) == soup(box())


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".stl"])
def test_lines_may_end_as_on_windows(read: Read, ending: str) -> None:
    content = next(content for found, content in BOXES.values() if found == ending)
    assert soup(read(ending, content.replace(b"\n", b"\r\n"))) == soup(box())


def test_obj_corners_may_count_backwards_from_the_line_they_stand_on(read: Read) -> None:
    triangle = b"v 0 0 %d\nv %d 0 %d\nv 0 %d %d\nf -3 -2 -1\n"
    mesh = read(".obj", triangle % (0, 1, 0, 1, 0) + triangle % (5, 2, 5, 2, 5))
    assert mesh.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert mesh.areas.tolist() == [0.5, 2.0]
    assert mesh.counts == MeshCounts(zero_area=0, duplicate=0, boundary_edges=6, nonmanifold_edges=0)


@pytest.mark.parametrize("rest", ["", "/-1", "/-1/-1", "//-1"])
def test_obj_corners_may_count_backwards_at_the_end_of_the_file(read: Read, rest: str) -> None:
    content = obj(BOX_VERTICES, BOX_TRIANGLES, lambda vertex, _: f"{vertex - 9}{rest}")
    mesh = read(".obj", b"vt 0 0\nvn 0 0 1\n" + content)
    assert mesh.vertices.tolist() == BOX_VERTICES.tolist()
    assert mesh.triangles.tolist() == BOX_TRIANGLES


@pytest.mark.parametrize("divider", [b"o second\n", b"g second\n", b"usemtl second\n", b"s 2\n"])
def test_obj_parts_share_their_vertices(read: Read, divider: bytes) -> None:
    start = divider.replace(b"second", b"first").replace(b"2", b"1")
    content = obj(BOX_VERTICES, BOX_TRIANGLES)
    content = insert(content, b"f 1 2 4\n", b"mtllib missing.mtl\n" + start)
    third = b"f " + b" ".join(b"%d" % (vertex + 1) for vertex in BOX_TRIANGLES[4]) + b"\n"
    content = insert(content, third, divider)
    mesh = read(".obj", content)
    assert soup(mesh) == soup(box())
    assert mesh.vertices.shape == (8, 3)
    assert mesh.counts == CLOSED


def test_obj_texture_seams_do_not_cut_the_surface(read: Read) -> None:
    texture = "".join(f"vt {i / 36} 0\n" for i in range(36)).encode()
    numbers = iter(range(1, 37))
    content = obj(BOX_VERTICES, BOX_TRIANGLES, lambda vertex, _: f"{vertex}/{next(numbers)}")
    mesh = read(".obj", texture + content)
    assert soup(mesh) == soup(box())
    assert mesh.vertices.shape == (8, 3)
    assert mesh.counts == CLOSED


OBJ_BOX = obj(BOX_VERTICES, BOX_TRIANGLES)


@pytest.mark.parametrize(
    "content",
    [
        b"# made by hand\n\n" + OBJ_BOX + b"\n# end",
        OBJ_BOX.replace(b"f 1 2 4\n", b"f 1 2 4 # the first\n"),
        OBJ_BOX.replace(b"v 0.0 0.0 0.0\n", b"v 0.0 0.0 0.0 # the origin\n"),
        OBJ_BOX.replace(b" ", b"  "),
        OBJ_BOX.replace(b" ", b"\t"),
        OBJ_BOX.replace(b"f 1 2 4\n", b"f 1 2 \\\n4\n"),
        OBJ_BOX.replace(b"f 1 2 4\n", b"f 1 2 \\\n4\n").replace(b"\n", b"\r\n"),
        re.sub(rb"(v .*)\n", rb"\1 1.0\n", OBJ_BOX),
        re.sub(rb"(v .*)\n", rb"\1 0.5 0.5 1\n", OBJ_BOX),
        OBJ_BOX.replace(b"v 1.0 2.0 4.0\n", b"v 1.0 2.0 4.0 1.0\n"),
        OBJ_BOX.replace(b"v 1.0 2.0 4.0\n", b"v 1e+0 20.E-1 .4e1\n"),
        OBJ_BOX + b"p 1\nl 1 2 8\n",
        b"".join(sorted(OBJ_BOX.splitlines(keepends=True)[8:])) + b"".join(OBJ_BOX.splitlines(keepends=True)[:8]),
        OBJ_BOX.rstrip(),
    ],
    ids=[
        "comments",
        "comment after a face",
        "comment after a vertex",
        "two spaces",
        "tabs",
        "continued line",
        "continued line as on Windows",
        "weights",
        "colors",
        "one weight",
        "exponents",
        "points and lines",
        "faces first",
        "no newline at the end",
    ],
)
def test_obj_files_may_look_like_this(read: Read, content: bytes) -> None:
    assert soup(read(".obj", content)) == soup(box())


OFF_BOX = off(BOX_VERTICES, BOX_TRIANGLES)


@pytest.mark.parametrize(
    "content",
    [
        off(BOX_VERTICES, BOX_TRIANGLES, "OFF "),
        OFF_BOX.replace(b"OFF\n8 12 0\n", b"# one\nOFF # two\n\n# three\n8 12 0 # four\n# five\n"),
        OFF_BOX.replace(b"8 12 0\n", b"8 12\n"),
        re.sub(rb"^(3 .*)\n", rb"\1 3 255 0 0\n", OFF_BOX, flags=re.MULTILINE),
        re.sub(rb"^(\S+ \S+ \S+)\n", rb"\1 1 2 3\n", OFF_BOX, flags=re.MULTILINE)
        .replace(b"8 12 0 1 2 3", b"8 12 0")
        .replace(b"OFF", b"NOFF"),
        OFF_BOX.rstrip(),
    ],
    ids=["counts beside the keyword", "comments", "no edge count", "face colors", "normals", "no newline at the end"],
)
def test_off_files_may_look_like_this(read: Read, content: bytes) -> None:
    assert soup(read(".off", content)) == soup(box())


@pytest.mark.parametrize("names", [("one", "two"), ("same", "same"), ("", "")])
def test_stl_files_may_hold_several_solids(read: Read, names: tuple[str, str]) -> None:
    content = stl_text(BOX_VERTICES, BOX_TRIANGLES[:6], names[0]) + stl_text(BOX_VERTICES, BOX_TRIANGLES[6:], names[1])
    mesh = read(".stl", content)
    assert soup(mesh) == soup(box())
    assert mesh.counts == CLOSED


@pytest.mark.parametrize("name", ["", "a solid box", "vertex", "facet", "facet normal"])
def test_stl_solids_may_have_any_name(read: Read, name: str) -> None:
    assert soup(read(".stl", stl_text(BOX_VERTICES, BOX_TRIANGLES, name))) == soup(box())


def test_stl_text_may_be_indented_and_in_capitals(read: Read) -> None:
    content = stl_text(BOX_VERTICES, BOX_TRIANGLES)
    assert soup(read(".stl", content.upper())) == soup(box())
    assert soup(read(".stl", b"\n  " + content.replace(b"\n", b"\n\t "))) == soup(box())


def test_stl_vertices_are_merged_where_they_coincide_and_nowhere_else(read: Read) -> None:
    content = stl_text(BOX_VERTICES, BOX_TRIANGLES)
    negative = content.replace(b"vertex 0.0 0.0 0.0", b"vertex -0.0 0.0 -0.0", 1)
    assert read(".stl", negative).counts == CLOSED
    moved = content.replace(b"vertex 0.0 0.0 0.0", b"vertex 1e-300 0.0 0.0", 1)
    mesh = read(".stl", moved)
    assert mesh.vertices.shape == (9, 3)
    assert mesh.counts.boundary_edges > 0


ROTATION = [0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]  # by a right angle about z


@pytest.mark.parametrize(
    ("nodes", "roots", "area", "upper"),
    [
        ([{"mesh": 0, "scale": [2, 2, 2]}], None, 4 * 28, [2, 4, 8]),
        ([{"mesh": 0, "scale": [3, 1, 1]}], None, 2 * (6 + 12 + 8), [3, 2, 4]),
        ([{"mesh": 0, "scale": [-1, 1, 1]}], None, 28, [0, 2, 4]),
        ([{"mesh": 0, "translation": [5, 6, 7]}], None, 28, [6, 8, 11]),
        ([{"mesh": 0, "rotation": ROTATION}], None, 28, [0, 1, 4]),
        # Scaled, then rotated, then shifted.
        ([{"mesh": 0, "scale": [3, 1, 1], "rotation": ROTATION, "translation": [9, 0, 0]}], None, 52, [9, 3, 4]),
        # Column by column: the same rotation, with lengths doubled and a shift.
        ([{"mesh": 0, "matrix": [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 9, 0, 0, 1]}], None, 4 * 28, [9, 2, 8]),
        ([{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "translation": [1, 0, 0]}], [0], 4 * 28, [4, 4, 8]),
        ([{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}], None, 5 * 28, [2, 4, 8]),
        ([{"mesh": 0, "name": "a"}, {"mesh": 0, "name": "a", "translation": [9, 0, 0]}], None, 2 * 28, [10, 2, 4]),
        ([{"mesh": 0, "name": "world"}, {"mesh": 0, "translation": [9, 0, 0]}], None, 2 * 28, [10, 2, 4]),
        # The second node belongs to no scene.
        ([{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}], [0], 28, [1, 2, 4]),
        # A camera at a mesh, and a mesh that hangs on a camera.
        ([{"mesh": 0, "camera": 0}, {"mesh": 0, "translation": [9, 0, 0]}], None, 2 * 28, [10, 2, 4]),
        ([{"camera": 0, "children": [1], "translation": [9, 0, 0]}, {"mesh": 0}], [0], 28, [10, 2, 4]),
    ],
    ids=[
        "scaled",
        "stretched",
        "mirrored",
        "shifted",
        "rotated",
        "all three",
        "matrix",
        "child",
        "two nodes",
        "two of a name",
        "named world",
        "outside the scene",
        "camera beside",
        "camera above",
    ],
)
def test_gltf_nodes_place_their_meshes(
    read: Read, nodes: list[dict[str, Any]], roots: list[int] | None, area: float, upper: list[float]
) -> None:
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], nodes, roots)
    if "camera" in nodes[0]:
        scene.tree["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1, "aspectRatio": 1}}]
    mesh = read(".glb", scene.glb())
    assert mesh.area == pytest.approx(area, rel=1e-14)
    assert mesh.bounds[1] == pytest.approx(upper, abs=1e-14)
    embedded = read(".gltf", scene.gltf())
    assert soup(embedded) == soup(mesh)


def test_gltf_meshes_may_have_several_primitives(read: Read) -> None:
    halves = [(BOX_VERTICES, BOX_TRIANGLES[:6], None), (BOX_VERTICES, BOX_TRIANGLES[6:], 4)]
    mesh = read(".glb", Gltf([halves], [{"mesh": 0}]).glb())
    assert soup(mesh) == soup(box())
    assert mesh.counts == CLOSED
    twice = read(".glb", Gltf([halves], [{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}]).glb())
    assert twice.area == 5 * BOX_AREA


def test_gltf_primitives_may_go_without_indices(read: Read) -> None:
    corners = BOX_VERTICES[np.array(BOX_TRIANGLES)].reshape(-1, 3)
    mesh = read(".glb", Gltf([[(corners, None, None)]], [{"mesh": 0}]).glb())
    assert soup(mesh) == soup(box())
    assert mesh.counts == CLOSED


@pytest.mark.parametrize("index", ["uint8", "uint16", "uint32"])
def test_gltf_parts_with_many_vertices_do_not_run_into_each_other(read: Read, index: str) -> None:
    # 162 vertices fit one byte; the second part's come after the first's, and no longer do.
    ball = icosphere(2)
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    mesh = read(".glb", Gltf([[(ball.vertices, ball.triangles, None)]], nodes, index=index).glb())
    assert mesh.area == pytest.approx(2 * ball.area, rel=1e-6)
    assert mesh.vertices.shape == (324, 3)
    assert mesh.counts == CLOSED


def test_gltf_parts_beyond_16_bits_do_not_run_into_each_other(read: Read) -> None:
    ball = icosphere(6)
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    mesh = read(".glb", Gltf([[(ball.vertices, ball.triangles, None)]], nodes, index="uint16").glb())
    assert mesh.area == pytest.approx(2 * ball.area, rel=1e-6)


@pytest.mark.parametrize(("mode", "area"), [(0, 28.0), (1, 28.0), (2, 28.0), (3, 28.0), (5, 28.0 + 2), (6, 28.0 + 2)])
def test_gltf_primitives_of_other_kinds_are_never_dropped_unless_they_have_no_area(
    read: Read, mode: int, area: float
) -> None:
    # Points, lines, loops and open lines have none; a strip of triangles and a fan, of 2 here, do.
    around = [[0, 0, 9], [1, 0, 9], [1, 2, 9], [0, 2, 9]]
    corners = [around[i] for i in (0, 1, 3, 2)] if mode == 5 else around
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None), (corners, [0, 1, 2, 3], mode)]], [{"mesh": 0}])
    assert read(".glb", scene.glb()).area == area


def test_gltf_buffers_may_be_files_beside(tmp_path: Path) -> None:
    scene = box_scene()
    (tmp_path / "box.gltf").write_bytes(scene.gltf("box data.bin"))
    (tmp_path / "box data.bin").write_bytes(scene.blob)
    assert soup(read_mesh(tmp_path / "box.gltf")) == soup(box())
    (tmp_path / "zipped.gltf.gz").write_bytes(gzip.compress(scene.gltf("box data.bin")))
    assert soup(read_mesh(tmp_path / "zipped.gltf.gz")) == soup(box())


def test_gltf_vertices_may_be_interleaved_with_others(read: Read) -> None:
    scene = box_scene()
    wide = np.column_stack([BOX_VERTICES, np.full((8, 3), 7.0)]).astype(np.float32)
    position = scene.accessor(wide, "VEC3", "float32")
    scene.tree["bufferViews"][-1]["byteStride"] = 24
    scene.tree["accessors"][position]["count"] = 8
    scene.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = position
    assert soup(read(".glb", scene.glb())) == soup(box())


def right_or_refused(path: Path, expected: Mesh) -> None:
    """Read a file that needs what a reader need not have; it must not come out as something else."""
    try:
        mesh = read_mesh(path)
    except MeshError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
        return
    assert soup(mesh) == soup(expected)


def test_gltf_sparse_accessors_are_not_ignored(tmp_path: Path) -> None:
    scene = box_scene()
    indices = scene.accessor([7], "SCALAR", "uint16")
    values = scene.accessor([[9.0, 9.0, 9.0]], "VEC3", "float32")
    views = [scene.tree["accessors"].pop()["bufferView"] for _ in (values, indices)][::-1]
    scene.tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": views[0], "componentType": 5123},
        "values": {"bufferView": views[1]},
    }
    (tmp_path / "sparse.glb").write_bytes(scene.glb())
    right_or_refused(tmp_path / "sparse.glb", Mesh([*BOX_VERTICES.tolist()[:7], [9, 9, 9]], BOX_TRIANGLES))


def test_gltf_normalized_coordinates_are_not_taken_for_lengths(tmp_path: Path) -> None:
    unit = BOX_VERTICES > 0
    scene = Gltf([[(unit * 127, BOX_TRIANGLES, None)]], [{"mesh": 0}], real="int8", index="uint16")
    scene.tree["accessors"][0]["normalized"] = True
    scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    (tmp_path / "normalized.glb").write_bytes(scene.glb())
    right_or_refused(tmp_path / "normalized.glb", Mesh(unit.astype(float), BOX_TRIANGLES))


def test_gltf_compressed_primitives_are_not_left_out(tmp_path: Path) -> None:
    halves = [(BOX_VERTICES, BOX_TRIANGLES[:6], None), (BOX_VERTICES, BOX_TRIANGLES[6:], None)]
    scene = Gltf([halves], [{"mesh": 0}])
    draco = "KHR_draco_mesh_compression"
    scene.tree["extensionsUsed"] = scene.tree["extensionsRequired"] = [draco]
    primitive = scene.tree["meshes"][0]["primitives"][1]
    primitive["extensions"] = {draco: {"bufferView": 0, "attributes": {"POSITION": 0}}}
    for accessor in (primitive["indices"], primitive["attributes"]["POSITION"]):
        del scene.tree["accessors"][accessor]["bufferView"]
    (tmp_path / "draco.glb").write_bytes(scene.glb())
    with pytest.raises(MeshError, match=r"draco\.glb: "):
        read_mesh(tmp_path / "draco.glb")


@pytest.mark.parametrize("content", [b"{", b"not JSON", box_scene().gltf()[:-50]])
def test_a_damaged_gltf_file_is_not_replaced_by_its_neighbour(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "model.gltf").write_bytes(box_scene().gltf())
    (tmp_path / "damaged.gltf").write_bytes(content)
    with pytest.raises(MeshError, match=r"damaged\.gltf: "):
        read_mesh(tmp_path / "damaged.gltf")


def test_other_vertices_that_coincide_stay_apart(read: Read) -> None:
    corners = BOX_VERTICES[np.array(BOX_TRIANGLES)].reshape(-1, 3)
    faces = np.arange(36).reshape(-1, 3)
    apart = [
        (".ply", ply(corners, faces.tolist())),
        (".ply", ply(corners, faces.tolist(), LITTLE)),
        (".obj", obj(corners, faces.tolist())),
        (".off", off(corners, faces.tolist())),
        (".gii", gifti(corners, faces.astype(np.int32))),
    ]
    for ending, content in apart:
        mesh = read(ending, content)
        assert mesh.vertices.tolist() == corners.tolist()
        assert mesh.counts.boundary_edges == 36


@pytest.mark.parametrize("name", ["ply", "obj", "off", "gii"])
def test_degenerate_and_duplicate_faces_are_kept(read: Read, name: str) -> None:
    faces = [*BOX_TRIANGLES, [0, 0, 1], [0, 1, 3], [3, 1, 0]]
    write: dict[str, Callable[[], bytes]] = {
        "ply": lambda: ply(BOX_VERTICES, faces),
        "obj": lambda: obj(BOX_VERTICES, faces),
        "off": lambda: off(BOX_VERTICES, faces),
        "gii": lambda: gifti(BOX_VERTICES, np.array(faces, dtype=np.int32)),
    }
    mesh = read(f".{name}", write[name]())
    assert mesh.triangles.tolist() == faces
    assert (mesh.counts.zero_area, mesh.counts.duplicate) == (1, 2)
    assert mesh.area == BOX_AREA + 2 * 4


# Files of other writers.


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".ply", {"encoding": "ascii"}),
        (".ply", {"encoding": "binary"}),
        (".obj", {"digits": 17}),
        (".off", {"digits": 17}),
        (".stl", {}),
        (".glb", {}),
    ],
)
def test_files_of_trimesh_are_read(read: Read, ending: str, options: dict[str, Any]) -> None:
    ball = icosphere(2)
    made = trimesh.Trimesh(ball.vertices, ball.triangles, process=False)
    content = made.export(file_type=ending[1:], **options)
    mesh = read(ending, content if isinstance(content, bytes) else content.encode())
    assert mesh.area == pytest.approx(ball.area, rel=1e-14 if "digits" in options else 1e-6)
    assert mesh.triangles.shape == ball.triangles.shape
    assert mesh.vertices.shape == ball.vertices.shape
    assert mesh.counts == CLOSED


def test_scenes_of_trimesh_are_read(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 2, 4)), transform=trimesh.transformations.scale_matrix(2))
    scene.add_geometry(trimesh.creation.icosphere(2), transform=trimesh.transformations.translation_matrix((9, 9, 9)))
    for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "scene.glb").write_bytes(scene.export(file_type="glb"))
    for name in ("model.gltf", "scene.glb"):
        mesh = read_mesh(tmp_path / name)
        assert mesh.area == pytest.approx(4 * BOX_AREA + icosphere(2).area, rel=1e-6)
        assert mesh.counts == CLOSED


# Damage. Warnings are let through here, as they are in real runs: an error must not rest on one.


def nan_at(row: int) -> Reals:
    vertices = BOX_VERTICES.copy()
    vertices[row, 1] = np.nan
    return vertices


def changed(content: bytes, old: bytes, new: bytes) -> bytes:
    assert old in content
    return content.replace(old, new, 1)


def first_length(content: bytes, length: int) -> bytes:
    """The binary PLY box with another corner count at its last face."""
    return content[:-13] + bytes([length]) + content[-12:]


def without_faces(content: bytes) -> bytes:
    return content.split(b"\nf ")[0] + b"\n"


PLY_BOX, PLY_QUADS = ply(BOX_VERTICES, BOX_TRIANGLES), ply(BOX_VERTICES, BOX_QUADS)
PLY_BINARY = ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE)
OFF_QUADS = off(BOX_VERTICES, BOX_QUADS)
STL_TEXT, STL_BINARY = stl_text(BOX_VERTICES, BOX_TRIANGLES), stl_binary(BOX_VERTICES, BOX_TRIANGLES)
GLB_BOX, GLTF_BOX = box_scene().glb(), box_scene().gltf()
INT_TRIANGLES = np.array(BOX_TRIANGLES, dtype=np.int32)
GII_BOX = gifti(BOX_VERTICES, INT_TRIANGLES)
GII_TEXT = gifti(BOX_VERTICES, INT_TRIANGLES, "GIFTI_ENCODING_ASCII")


def glb_with(indices: Any, vertices: Any = BOX_VERTICES) -> bytes:
    return Gltf([[(vertices, indices, None)]], [{"mesh": 0}]).glb()


def glb_count(accessor: int, count: int) -> bytes:
    scene = box_scene()
    scene.tree["accessors"][accessor]["count"] = count
    return scene.glb()


BAD: dict[str, tuple[str, bytes, str]] = {
    # PLY: headers that lie.
    "ply, a face too many": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, face_count=13), "announces|length"),
    "ply, a face too few": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, face_count=11), "announces|length"),
    "ply, a vertex for a face": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, vertex_count=9, face_count=11), ""),
    "ply, a face for a vertex": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, vertex_count=7, face_count=13), ""),
    "ply, very many faces": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, face_count=10**15), "announces"),
    "ply, very many vertices": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, vertex_count=10**15), "announces"),
    "ply binary, a face too many": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, face_count=13), ""),
    "ply binary, a face too few": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, face_count=11), ""),
    "ply binary, a vertex too many": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, vertex_count=9), ""),
    "ply binary, very many faces": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, face_count=10**15), "announces"),
    "ply binary, very many vertices": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, BIG, vertex_count=10**15), "announces"),
    "ply binary, bytes left over": (".ply", PLY_BINARY + b"\0", ""),
    # PLY: faces.
    "ply, a length above the corners": (".ply", changed(PLY_BOX, b"3 4 6 7\n", b"4 4 6 7\n"), ""),
    "ply, a length below the corners": (".ply", changed(PLY_BOX, b"3 4 6 7\n", b"2 4 6 7\n"), ""),
    "ply binary, a length above the corners": (".ply", first_length(PLY_BINARY, 4), ""),
    "ply binary, a length below the corners": (".ply", first_length(PLY_BINARY, 2), ""),
    "ply, a corner missing": (".ply", changed(PLY_BOX, b"3 4 6 7\n", b"3 4 6\n"), ""),
    "ply, a corner missing among quads": (".ply", changed(PLY_QUADS, b"4 4 6 7 5\n", b"4 4 6 7\n"), ""),
    "ply, two corners missing among quads": (".ply", changed(PLY_QUADS, b"4 4 6 7 5\n", b"4 4 6\n"), ""),
    "ply, two corners": (".ply", ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1]]), ""),
    "ply, two corners among quads": (".ply", ply(BOX_VERTICES, [*MIXED_BOX, [0, 1]]), ""),
    "ply binary, two corners": (".ply", ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1]], LITTLE), ""),
    "ply binary, lengths 3, 4 and 2": (".ply", ply(BOX_VERTICES, [[3, 2, 6], [0, 1, 2, 4], [0, 4]], LITTLE), ""),
    "ply bytes, lengths 3, 4 and 2": (
        ".ply",
        ply(BOX_VERTICES, [[3, 2, 6], [0, 1, 2, 4], [0, 4]], LITTLE, index="uchar"),
        "",
    ),
    "ply, index -1": (".ply", ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, -1]]), "-1"),
    "ply binary, index -1": (".ply", ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, -1]], LITTLE), "-1"),
    "ply, index -1 beside texture coordinates": (
        ".ply",
        ply([*BOX_VERTICES, (9, 9, 9)], [*BOX_TRIANGLES, [0, 1, -1]], more="st"),
        "",
    ),
    "ply binary, index -1 beside texture coordinates": (
        ".ply",
        ply([*BOX_VERTICES, (9, 9, 9)], [*BOX_TRIANGLES, [0, 1, -1]], LITTLE, more="uv"),
        "",
    ),
    "ply, index 8": (".ply", ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, 8]]), r"indices outside 0\.\.7.*\[0, 1, 8\]"),
    "ply binary, index 2^32 - 1": (
        ".ply",
        ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, 2**32 - 1]], BIG, index="uint"),
        "",
    ),
    "ply, index with a fraction": (".ply", changed(PLY_BOX, b"3 0 1 3\n", b"3 0 1 2.5\n"), ""),
    "ply, index that is no number": (".ply", changed(PLY_BOX, b"3 0 1 3\n", b"3 0 1 x\n"), ""),
    "ply, no faces": (".ply", ply(BOX_VERTICES, []), "no faces|no triangles"),
    "ply binary, no faces": (".ply", ply(BOX_VERTICES, [], LITTLE), "no faces|no triangles"),
    # PLY: vertices.
    "ply, NaN": (".ply", ply(nan_at(3), BOX_TRIANGLES), r"1 of 8 vertices have NaN .*#3 = \[0\.0, nan, 4\.0\]"),
    "ply binary, NaN": (".ply", ply(nan_at(3), BOX_TRIANGLES, LITTLE), r"1 of 8 vertices have NaN .*#3"),
    "ply, infinity": (".ply", changed(PLY_BOX, b"0.0 2.0 4.0", b"0.0 inf 4.0"), "infinite"),
    "ply, a coordinate missing": (".ply", changed(PLY_BOX, b"0.0 2.0 4.0", b"0.0 2.0"), ""),
    "ply, a coordinate too many": (".ply", changed(PLY_BOX, b"0.0 2.0 4.0", b"0.0 2.0 4.0 1.0"), ""),
    "ply, a coordinate that is no number": (".ply", changed(PLY_BOX, b"0.0 2.0 4.0", b"0.0 2.0 x"), ""),
    "ply, no coordinate z": (".ply", changed(PLY_BOX, b"property float z\n", b"property float w\n"), ""),
    "ply, no end of header": (".ply", changed(PLY_BOX, b"end_header\n", b""), "header"),
    "ply, no face element": (".ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "header"),
    # OBJ.
    "obj, index 0": (".obj", OBJ_BOX + b"f 0 1 2\n", "face 13 has the vertex index 0; OBJ counts from 1"),
    "obj, index 0 with texture": (".obj", b"vt 0 0\n" + OBJ_BOX + b"f 1/1 2/1 0/1\n", "face 13 .* index 0"),
    "obj, index -0": (".obj", OBJ_BOX + b"f 1 2 -0\n", "face 13 .* index 0"),
    "obj, index 9": (".obj", OBJ_BOX + b"f 1 2 9\n", ""),
    "obj, index -9": (".obj", OBJ_BOX + b"f -1 -2 -9\n", ""),
    "obj, index beyond the line it stands on": (".obj", b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 0 1 0\nv 0 0 1\n", ""),
    "obj, index with a fraction": (".obj", OBJ_BOX + b"f 1 2 2.5\n", ""),
    "obj, index that is no number": (".obj", OBJ_BOX + b"f 1 2 x\n", ""),
    "obj, two corners": (".obj", OBJ_BOX + b"f 1 2\n", "face 13 has 2 vertices, expected three or more"),
    "obj, no corners": (".obj", OBJ_BOX + b"f \n", "face 13 has 0 vertices"),
    "obj, NaN": (".obj", obj(nan_at(3), BOX_TRIANGLES), r"1 of 8 vertices have NaN .*#3"),
    "obj, a coordinate missing": (".obj", changed(OBJ_BOX, b"v 0.0 2.0 4.0\n", b"v 0.0 2.0\n"), ""),
    "obj, a coordinate here instead of there": (
        ".obj",
        changed(changed(OBJ_BOX, b"v 0.0 2.0 4.0\n", b"v 0.0 2.0\n"), b"v 1.0 0.0 0.0\n", b"v 1.0 0.0 0.0 1.0\n"),
        "",
    ),
    "obj, a coordinate that is no number": (".obj", changed(OBJ_BOX, b"v 0.0 2.0 4.0\n", b"v 0.0 2.0 x\n"), ""),
    "obj, two coordinates": (".obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", ""),
    "obj, no faces": (".obj", without_faces(OBJ_BOX), "no faces|no triangles"),
    "obj, no vertices": (".obj", b"f 1 2 3\n", ""),
    "obj, cut in a face": (".obj", OBJ_BOX[:-3], "face 12 has 2 vertices"),
    # OFF.
    "off, a face too many": (".off", off(BOX_VERTICES, BOX_TRIANGLES, face_count=13), "announces 21 .*found 20"),
    "off, a face too few": (".off", off(BOX_VERTICES, BOX_TRIANGLES, face_count=11), "announces 19 .*found 20"),
    "off, a vertex for a face": (".off", off(BOX_VERTICES, BOX_QUADS, vertex_count=9, face_count=5), ""),
    "off, a face for a vertex": (".off", off(BOX_VERTICES, BOX_QUADS, vertex_count=7, face_count=7), ""),
    "off, very many vertices": (".off", off(BOX_VERTICES, BOX_QUADS, vertex_count=10**15), "announces"),
    "off, negative counts": (".off", off(BOX_VERTICES, BOX_QUADS, vertex_count=-8), ""),
    "off, a length above the corners": (".off", changed(OFF_BOX, b"3 4 6 7\n", b"4 4 6 7\n"), ""),
    "off, a corner missing": (".off", changed(OFF_BOX, b"3 4 6 7\n", b"3 4 6\n"), ""),
    "off, two corners missing among quads": (".off", changed(OFF_QUADS, b"4 4 6 7 5\n", b"4 4 6\n"), ""),
    "off, two corners": (".off", off(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1]]), ""),
    "off, two corners among quads": (".off", off(BOX_VERTICES, [*MIXED_BOX, [0, 1]]), ""),
    "off, no corners": (".off", off(BOX_VERTICES, [*BOX_TRIANGLES, []]), ""),
    "off, index -1": (".off", off(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, -1]]), ""),
    "off, index 8": (".off", off(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, 8]]), ""),
    "off, index with a fraction": (".off", changed(OFF_BOX, b"3 0 1 3\n", b"3 0 1 2.5\n"), ""),
    "off, NaN": (".off", off(nan_at(3), BOX_TRIANGLES), r"1 of 8 vertices have NaN .*#3"),
    "off, a coordinate missing": (".off", changed(OFF_BOX, b"0.0 2.0 4.0", b"0.0 2.0"), ""),
    "off, a coordinate that is no number": (".off", changed(OFF_BOX, b"0.0 2.0 4.0", b"0.0 2.0 x"), ""),
    "off, homogeneous coordinates": (
        ".off",
        b"4OFF\n3 1 0\n0 0 0 2\n2 0 0 2\n0 2 0 2\n3 0 1 2\n",
        "",
    ),
    "off, no faces": (".off", off(BOX_VERTICES, []), "no faces|no triangles"),
    "off, no counts": (".off", b"OFF\n", "header"),
    "off, cut in a quad": (".off", OFF_QUADS[:-3], ""),
    # STL.
    "stl, announces one more": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES, count=13), "announces 13"),
    "stl, announces one less": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES, count=11), "announces 11"),
    "stl, announces very many": (".stl", stl_binary(BOX_VERTICES, BOX_TRIANGLES, count=2**32 - 1), "4294967295"),
    "stl, starts with solid and announces one more": (
        ".stl",
        stl_binary(BOX_VERTICES, BOX_TRIANGLES, b"solid", count=13),
        "",
    ),
    "stl, bytes left over": (".stl", STL_BINARY + b"\0", "685 bytes"),
    "stl, no triangles": (".stl", stl_binary(BOX_VERTICES, []), "no faces|no triangles"),
    "stl, NaN": (".stl", stl_binary(nan_at(3), BOX_TRIANGLES), "NaN"),
    "stl ascii, NaN": (".stl", stl_text(nan_at(3), BOX_TRIANGLES), "NaN"),
    "stl ascii, no triangles": (".stl", b"solid box\nendsolid box\n", "no faces|no triangles"),
    "stl ascii, no end": (".stl", changed(STL_TEXT, b"endsolid box\n", b""), ""),
    "stl ascii, two corners": (".stl", stl_text(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1]]), ""),
    "stl ascii, two corners here and four there": (
        ".stl",
        stl_text(BOX_VERTICES, [[0, 1, 3, 2], [0, 4], *BOX_TRIANGLES[2:]]),
        "",
    ),
    "stl ascii, a coordinate here instead of there": (
        ".stl",
        changed(
            changed(STL_TEXT, b"vertex 0.0 2.0 4.0\n", b"vertex 0.0 2.0\n"),
            b"vertex 1.0 0.0 0.0\n",
            b"vertex 1.0 0.0 0.0 1.0\n",
        ),
        "",
    ),
    "stl ascii, a coordinate that is no number": (
        ".stl",
        changed(STL_TEXT, b"vertex 0.0 2.0 4.0\n", b"vertex 0.0 2.0 x\n"),
        "",
    ),
    # glTF.
    "glb, more indices than bytes": (".glb", glb_count(1, 39), ""),
    "glb, indices that make no whole triangles": (".glb", glb_count(1, 35), ""),
    "glb, more vertices than bytes": (".glb", glb_count(0, 9), ""),
    "glb, fewer vertices than indices need": (".glb", glb_count(0, 7), r"indices outside 0\.\.6"),
    "glb, index 8": (".glb", glb_with([*BOX_TRIANGLES, [0, 1, 8]]), r"indices outside 0\.\.7"),
    "glb, index -1": (".glb", glb_with([*BOX_TRIANGLES, [0, 1, 65535]]), r"indices outside 0\.\.7"),
    "glb, NaN": (".glb", glb_with(BOX_TRIANGLES, nan_at(3)), "NaN"),
    "glb, no nodes": (".glb", Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], []).glb(), "no part|no faces|no triangles"),
    "glb, points alone": (".glb", Gltf([[(BOX_VERTICES, None, 0)]], [{"mesh": 0}]).glb(), "no faces|no triangles"),
    "glb, a node that is its own child": (
        ".glb",
        Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"children": [1]}, {"mesh": 0, "children": [0]}], [0]).glb(),
        "",
    ),
    "glb, a node that is not there": (
        ".glb",
        Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}], [1]).glb(),
        "",
    ),
    "glb, first version": (".glb", changed(GLB_BOX, b"glTF\2", b"glTF\1"), ""),
    "gltf, a buffer that is not there": (".gltf", box_scene().gltf("missing.bin"), r"missing\.bin"),
    "gltf, a buffer that is shorter than announced": (
        ".gltf",
        re.sub(rb"base64,[^\"]{40}", b"base64,", GLTF_BOX),
        "",
    ),
    "gltf, cut": (".gltf", GLTF_BOX[:-5], ""),
    "gltf, an empty document": (".gltf", b"{}", "no faces|no triangles"),
    "gltf, a list": (".gltf", b"[]", ""),
    # GIFTI.
    "gifti, a triangle too many": (".gii", changed(GII_BOX, b'Dim0="12"', b'Dim0="13"'), ""),
    "gifti, a triangle too few": (".gii", changed(GII_BOX, b'Dim0="12"', b'Dim0="11"'), ""),
    "gifti, a vertex too few": (".gii", changed(GII_BOX, b'Dim0="8"', b'Dim0="7"'), ""),
    "gifti, very many vertices": (".gii", changed(GII_BOX, b'Dim0="8"', b'Dim0="8000000000000"'), ""),
    "gifti text, a triangle too many": (".gii", changed(GII_TEXT, b'Dim0="12"', b'Dim0="13"'), ""),
    "gifti, pairs of indices": (
        ".gii",
        gifti(BOX_VERTICES, INT_TRIANGLES.reshape(-1, 2)),
        r"\(18, 2\)",
    ),
    "gifti, an array that is not there": (
        ".gii",
        changed(GII_BOX, b'NumberOfDataArrays="2"', b'NumberOfDataArrays="3"'),
        "",
    ),
    "gifti, no triangles": (".gii", gifti(BOX_VERTICES, None), "found 1 and 0"),
    "gifti, no points": (".gii", gifti(None, INT_TRIANGLES), "found 0 and 1"),
    "gifti, two point sets": (".gii", gifti(BOX_VERTICES, INT_TRIANGLES, points=2), "found 2 and 1"),
    "gifti, index -1": (".gii", gifti(BOX_VERTICES, np.array([[0, 1, -1]], np.int32)), r"#0 = \[0, 1, -1\]"),
    "gifti, index 8": (".gii", gifti(BOX_VERTICES, np.array([[0, 1, 8]], np.int32)), r"#0 = \[0, 1, 8\]"),
    "gifti, indices with fractions": (".gii", gifti(BOX_VERTICES, INT_TRIANGLES.astype(np.float32)), "integer"),
    "gifti, NaN": (".gii", gifti(nan_at(3), INT_TRIANGLES), r"1 of 8 vertices have NaN .*#3"),
    "gifti, no data": (".gii", b"<GIFTI/>", "found 0 and 0"),
    "gifti, other XML": (".gii", b"<svg><path/></svg>", ""),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzipped"])
def test_bad_files_are_refused_by_name(tmp_path: Path, name: str, zipped: bool) -> None:
    ending, content, reason = BAD[name]
    path = tmp_path / f"scan{ending}"
    if zipped:
        path = tmp_path / f"scan{ending}.gz"
        content = gzip.compress(content)
    path.write_bytes(content)
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.count(str(path)) == 1
    assert re.search(reason, message.removeprefix(f"{path}: "))
    assert len(message) < len(str(path)) + 400
    assert str(pickle.loads(pickle.dumps(caught.value))) == message


FORMATS = [".ply", ".obj", ".stl", ".off", ".gltf", ".glb", ".gii"]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize(
    "content",
    [b"\0", b"\n", b"hello\n", bytes(range(256)) * 8, b"\xff\xfe\0\0" * 100, b"solid", b"ply", b"OFF", b"glTF", b"<"],
    ids=["zero", "newline", "hello", "all bytes", "not UTF-8", "solid", "ply", "OFF", "glTF", "angle"],
)
def test_content_that_is_no_mesh_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"scan{ending}"
    path.write_bytes(content)
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", BOXES)
def test_a_mesh_under_another_format_s_name_is_refused(tmp_path: Path, name: str) -> None:
    own, content = BOXES[name]
    # The two forms of glTF can be told apart by their first bytes.
    for ending in set(FORMATS) - ({".gltf", ".glb"} if own in (".gltf", ".glb") else {own}):
        path = tmp_path / f"scan{ending}"
        path.write_bytes(content)
        with pytest.raises(MeshError) as caught:
            read_mesh(path)
        assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("ending", [*FORMATS, ".ply.gz", ".off.gz"])
def test_empty_and_missing_files_are_told_apart(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"scan{ending}"
    with pytest.raises(MeshError, match=re.escape(f"{path}: cannot be read: No such file or directory")):
        read_mesh(path)
    path.touch()
    with pytest.raises(MeshError, match=re.escape(f"{path}: the file is empty")):
        read_mesh(path)
    if ending.endswith(".gz"):
        path.write_bytes(gzip.compress(b""))
        with pytest.raises(MeshError, match=re.escape(f"{path}: the file is empty")):
            read_mesh(path)


@pytest.mark.parametrize("name", ["scan.xyz", "scan", "scan.gz", "ply", ".ply", "scan.ply.bak", "scan.ply.gz.gz"])
def test_names_without_a_known_format_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(PLY_BOX)
    with pytest.raises(MeshError, match=r"known are \.ply, \.obj, \.stl, \.off, \.gltf, \.glb, \.gii") as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_folders_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.mkdir()
    for bad in (path, path / "missing" / "scan.ply"):
        with pytest.raises(MeshError, match=re.escape(f"{bad}: cannot be read: ")):
            read_mesh(bad)


def test_damaged_gzip_files_are_refused(tmp_path: Path) -> None:
    whole = gzip.compress(PLY_BOX, mtime=0)
    damaged = {
        "not zipped": PLY_BOX,
        "checksum": whole[:-8] + bytes([whole[-8] ^ 1]) + whole[-7:],
        "length": whole[:-4] + bytes([whole[-4] ^ 1]) + whole[-3:],
        "trailing bytes": whole + b"more",
        "inside": whole[:40] + bytes([whole[40] ^ 255]) + whole[41:],
    }
    for name, content in damaged.items():
        path = tmp_path / f"{name}.ply.gz"
        path.write_bytes(content)
        with pytest.raises(MeshError, match=re.escape(f"{path}: cannot be read: ")):
            read_mesh(path)


def test_zipped_content_under_a_plain_name_is_refused(tmp_path: Path) -> None:
    for ending, content in BOXES.values():
        path = tmp_path / f"scan{ending}"
        path.write_bytes(gzip.compress(content))
        with pytest.raises(MeshError, match=re.escape(f"{path}: ")):
            read_mesh(path)


TETRAHEDRON = TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES
# Formats in which a cut shows wherever it falls; the number says how many bytes at the end mean nothing.
CUTTABLE: dict[str, tuple[str, bytes, int]] = {
    "ply binary": (".ply", ply(*TETRAHEDRON, LITTLE), 0),
    "stl binary": (".stl", stl_binary(*TETRAHEDRON), 0),
    "stl ascii": (".stl", stl_text(*TETRAHEDRON, name="x"), len("endsolid x\n") - len("endsolid")),
    # The last line of these may lose its end, but no corner.
    "ply ascii": (".ply", ply(*TETRAHEDRON), 1),
    "off": (".off", off(*TETRAHEDRON), 1),
    "glb": (".glb", Gltf([[(*TETRAHEDRON, None)]], [{"mesh": 0}]).glb(), 0),
    "gltf": (".gltf", Gltf([[(*TETRAHEDRON, None)]], [{"mesh": 0}]).gltf(), 0),
    "gifti": (".gii", gifti(TETRAHEDRON_VERTICES, np.array(TETRAHEDRON_TRIANGLES, dtype=np.int32)), 0),
    "gzip": (".ply.gz", gzip.compress(ply(*TETRAHEDRON), mtime=0), 0),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CUTTABLE)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    ending, whole, spare = CUTTABLE[name]
    path = tmp_path / f"scan{ending}"
    path.write_bytes(whole)
    assert read_mesh(path).area == pytest.approx(1.5 + np.sqrt(0.75), rel=1e-6)
    accepted = []
    for length in range(len(whole) - spare):
        path.write_bytes(whole[:length])
        try:
            read_mesh(path)
        except MeshError as error:
            assert str(error).startswith(f"{path}: ")  # noqa: PT017
        else:
            accepted.append(length)
    assert not accepted, f"of {len(whole)} bytes"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", BOXES)
@settings(derandomize=True, deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_random_damage_raises_nothing_but_mesh_errors(tmp_path: Path, name: str, data: st.DataObject) -> None:
    ending, content = BOXES[name]
    path = tmp_path / f"scan{ending}"
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        # Digits into digits would make counts of many gigabytes, which are another test's matter.
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(
            st.integers(0, 255).filter(lambda x: not 48 <= x < 58)
        )
    path.write_bytes(bytes(changed))
    try:
        mesh = read_mesh(path)
    except MeshError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
    else:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.triangles.min() >= 0
        assert mesh.triangles.max() < len(mesh.vertices)
