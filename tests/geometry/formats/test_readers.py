"""Readers of mesh files: what each format holds is what comes out."""

from __future__ import annotations

import codecs
import gzip
import os
import re
import struct
from collections.abc import Callable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import trimesh

import sobolev_batch as sb
from sobolev_batch import Mesh, read_mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.formats.by_name import mesh_format, mesh_stem
from sobolev_batch.shapes import icosphere
from tests.support.mesh_files import BIG, BOXES, LITTLE, OFF_BOX, WRITERS, Read, obj, off, ply, stl_text
from tests.support.shapes import (
    AWKWARD_VERTICES,
    BOX_AREA,
    BOX_MIXED,
    BOX_QUADS,
    BOX_TRIANGLES,
    BOX_VERTICES,
    CLOSED,
    box,
    mesh_counts,
    soup,
)
from tests.support.stores import full_disk

# Digits at both ends of the range, and vertices that no triangle uses.
VERTICES = np.array([[0.1, -2 / 3, 1e-300], [1e6 + 1 / 3, 3.0, np.pi], [0.0, 7.0, -1e-9], [5.0, 5.0, 5.0]])
MESH = sb.Mesh(VERTICES, [[0, 1, 2], [2, 1, 0]])


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzipped"])
def test_every_format_gives_the_box(read: Read, name: str, zipped: bool) -> None:
    ending, content = BOXES[name]
    mesh = read(f"{ending}.gz", gzip.compress(content)) if zipped else read(ending, content)
    assert mesh.area == BOX_AREA
    assert mesh.counts == CLOSED
    assert mesh.vertices.shape == (8, 3)
    assert soup(mesh) == soup(box())


@pytest.mark.parametrize(
    ("name", "options", "precision"),
    [
        *((name, {"real": "double"}, np.float64) for name in ("ply ascii", "ply little", "ply big")),
        *((name, {}, np.float64) for name in ("obj", "off", "stl ascii")),
        *((name, {}, np.float32) for name in ("ply little", "ply big", "stl binary", "glb", "gifti", "freesurfer")),
    ],
)
def test_every_digit_of_a_file_is_kept(read: Read, name: str, options: dict[str, Any], precision: Any) -> None:
    ending, write = WRITERS[name]
    mesh, expected = read(ending, write(AWKWARD_VERTICES, BOX_TRIANGLES, **options)), AWKWARD_VERTICES.astype(precision)
    assert soup(mesh) == soup(Mesh(expected, BOX_TRIANGLES))
    if ending != ".stl":
        assert mesh.vertices.tolist() == expected.tolist()
        assert mesh.triangles.tolist() == BOX_TRIANGLES


# A house in the plane z = 0: a pentagon of area 3 on a rectangle of area 2, with a buttress of area 1/2. It has as many
# corners as three faces like the first one.
HOUSE_VERTICES: Reals = np.array(
    [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (0, -1, 0), (2, -1, 0), (3, 0, 0)], dtype=np.float64
)
HOUSE_FACES = [[5, 6, 1, 0], [1, 7, 2], [0, 1, 2, 3, 4]]

POLYGON_WRITERS: dict[str, tuple[str, Callable[[Any, Any], bytes]]] = {
    **{name: WRITERS[name] for name in ("ply ascii", "ply little", "ply big", "obj", "off")},
    "ply little bytes": (".ply", lambda v, f: ply(v, f, LITTLE, index="uchar")),
    "obj with texture": (".obj", lambda v, f: b"vt 0 0\n" + obj(v, f, lambda vertex, _: f"{vertex}/1")),
}


@pytest.mark.parametrize("name", POLYGON_WRITERS)
@pytest.mark.parametrize(
    ("vertices", "faces", "area", "triangles", "boundary"),
    [
        *((BOX_VERTICES, faces, BOX_AREA, 12, 0) for faces in (BOX_QUADS, BOX_MIXED, BOX_MIXED[::-1])),
        (HOUSE_VERTICES, HOUSE_FACES, 5.5, 6, 8),
        (HOUSE_VERTICES, HOUSE_FACES[2:], 3.0, 3, 5),
    ],
    ids=["quads", "mixed", "mixed reversed", "house", "pentagon"],
)
def test_polygons_of_all_sizes_are_cut_into_fans(
    read: Read, name: str, vertices: Any, faces: list[list[int]], area: float, triangles: int, boundary: int
) -> None:
    ending, write = POLYGON_WRITERS[name]
    mesh = read(ending, write(vertices, faces))
    assert mesh.area == pytest.approx(area, rel=1e-15)
    assert len(mesh.triangles) == triangles
    assert mesh.vertices.tolist() == vertices.tolist()
    assert mesh.counts == mesh_counts(0, 0, boundary, 0, euler=1 if boundary else 2)


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


def with_colors() -> bytes:
    colors = b"property uchar red\nproperty uchar green\nproperty uchar blue\n"
    lines = insert(ply(BOX_VERTICES, BOX_TRIANGLES), b"end_header\n", colors).splitlines()
    return b"\n".join([*lines[:-12], *[line + b" 255 0 7" for line in lines[-12:]], b""])


def with_edges(encoding: str) -> bytes:
    header = b"element edge 2\nproperty int vertex1\nproperty int vertex2\n"
    content = insert(ply(BOX_VERTICES, BOX_TRIANGLES, encoding), b"end_header\n", header)
    return content + (b"0 1\n1 2\n" if encoding == "ascii" else np.array([0, 1, 1, 2], dtype="<i4").tobytes())


def relaid(separators: str) -> bytes:
    """The box in text, with other characters between its numbers, taken in turn."""
    header, end, body = ply(BOX_VERTICES, BOX_TRIANGLES).partition(b"end_header\n")
    words = [word + separators[i % len(separators)].encode() for i, word in enumerate(body.split())]
    return header + end + b"".join(words)


def with_header(*edits: tuple[bytes, bytes], encoding: str = "ascii", end: bytes = b"\n") -> bytes:
    """The box with changes in its header, whose lines end in some way."""
    header, line, body = ply(BOX_VERTICES, BOX_TRIANGLES, encoding).partition(b"end_header\n")
    for old, new in edits:
        assert old in header
        header = header.replace(old, new, 1)
    return (header + line).replace(b"\n", end) + body


FACES = b"element face 12\nproperty list uchar int vertex_indices\n"
# Two strips in the first list, which share no edge, beside one in the second.
STRIPS = [[0, 1, 2, 3, -1, 3, 2, 4], [4, 5, 6, 7, 8]]
STRIP_TRIANGLES = [[0, 1, 2], [2, 1, 3], [3, 2, 4], [4, 5, 6], [6, 5, 7], [6, 7, 8]]


@pytest.mark.parametrize("encoding", ["ascii", LITTLE, BIG])
@pytest.mark.parametrize(
    "lists", [STRIPS, STRIPS[:1], [[*STRIPS[0], -1, *STRIPS[1], -1]]], ids=["two", "one", "joined"]
)
def test_ply_strips_turn_every_second_triangle(read: Read, encoding: str, lists: list[list[int]]) -> None:
    vertices = np.random.default_rng(3).random((9, 3))
    content = ply(vertices, lists, encoding, real="double", length="int").replace(b"element face", b"element tristrips")
    mesh = read(".ply", content)
    assert mesh.triangles.tolist() == STRIP_TRIANGLES[: 3 if lists == STRIPS[:1] else 6]
    assert mesh.vertices.tolist() == vertices.tolist()


def ply_of_many_elements(encoding: str, lengths: Sequence[int]) -> bytes:
    """The box behind, between and before lists of some lengths in its vertices, its faces and elements of their own."""
    order = {"ascii": "", LITTLE: "<", BIG: ">"}[encoding]
    lists = cycle(lengths)

    def packed(*numbers: tuple[str, float]) -> bytes:
        if not order:
            return (" ".join(f"{number:g}" for _, number in numbers) + "\n").encode()
        return b"".join(struct.pack(order + code, number) for code, number in numbers)

    def noise(code: str) -> list[tuple[str, float]]:
        size = next(lists)
        return [("H", size), *[(code, 7)] * size]

    header = f"""ply
format {encoding} 1.0
comment end_header
obj_info made by hand
element before 2
property list ushort double a
property char b
element vertex 8
property double z
property list uint16 int8 y2
comment between
property float32 y
property uchar red
property double x
element none 5
element face 12
property float quality
property list int8 uint32 vertex_index
property list ushort short more
element after 1
property list uint16 float c
end_header
"""
    body = [packed(*noise("d"), ("b", 3)) for _ in range(2)]
    body += [packed(("d", z), *noise("b"), ("f", y), ("B", 255), ("d", x)) for x, y, z in BOX_VERTICES]
    body += [packed(("f", 0.5), ("b", 3), *[("I", i) for i in face], *noise("h")) for face in BOX_TRIANGLES]
    return header.encode() + b"".join(body) + packed(*noise("f"))


@pytest.mark.parametrize("encoding", ["ascii", LITTLE, BIG])
@pytest.mark.parametrize("lengths", [[0], [2], [0, 3, 1, 2]], ids=["empty", "even", "uneven"])
def test_ply_properties_and_elements_of_any_width_are_passed_over(
    read: Read, encoding: str, lengths: list[int]
) -> None:
    mesh = read(".ply", ply_of_many_elements(encoding, lengths))
    assert (mesh.vertices.tolist(), mesh.triangles.tolist()) == (BOX_VERTICES.tolist(), BOX_TRIANGLES)


def obj_in_parts() -> bytes:
    third = b"f " + b" ".join(b"%d" % (vertex + 1) for vertex in BOX_TRIANGLES[4]) + b"\n"
    content = insert(OBJ_BOX, b"f 1 2 4\n", b"mtllib missing.mtl\no first\n")
    return insert(content, third, b"o second\ng second\nusemtl second\ns 2\n")


def test_obj_corners_may_count_backwards_from_the_line_they_stand_on(read: Read) -> None:
    triangle = b"v 0 0 %d\nv %d 0 %d\nv 0 %d %d\nf -3//-1 -2/-1 -1/-1/-1\n"
    mesh = read(".obj", triangle % (0, 1, 0, 1, 0) + triangle % (5, 2, 5, 2, 5))
    assert mesh.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert mesh.areas.tolist() == [0.5, 2.0]


OBJ_BOX = obj(BOX_VERTICES, BOX_TRIANGLES)
STL_BOX = stl_text(BOX_VERTICES, BOX_TRIANGLES)
STL_FACETS, FAR = STL_BOX.split(b"facet normal", 3), b"\n" * 1024
VARIANTS: dict[str, dict[str, bytes]] = {
    ".ply": {
        "lines as on Windows": ply(BOX_VERTICES, BOX_TRIANGLES).replace(b"\n", b"\r\n"),
        "colors": with_colors(),
        "edges": with_edges("ascii"),
        "edges, binary": with_edges(LITTLE),
        "a number on each line": relaid("\n"),
        "one line": relaid(" "),
        "lines of any length": relaid(" \t  \n \r\n  \n\n"),
        "no newline at the end": ply(BOX_VERTICES, BOX_TRIANGLES).rstrip(),
        **{
            f"header lines end in {end!r}, {encoding}": with_header(encoding=encoding, end=end)
            for end in (b"\r", b"\r\n")
            for encoding in (LITTLE, BIG)
        },
        "comments everywhere": with_header(
            (b"format", b"comment end_header\nobj_info 1\nformat"), (b"property", b"comment\nproperty"), encoding=LITTLE
        ),
        "blanks in the header": with_header((b"element face", b"\n  element  face "), (b"ply", b"ply ")),
        "faces and strips": with_header(
            (FACES, FACES.replace(b"12", b"11") + FACES.replace(b"12", b"1").replace(b"face", b"tristrips")),
            encoding=LITTLE,
        ),
    },
    ".obj": {
        "parts": obj_in_parts(),
        "comments": b"# made by hand\n\n" + OBJ_BOX.replace(b"v 0.0 0.0 0.0\n", b"v 0.0 0.0 0.0 # 0\n") + b"\n# end",
        "tabs": OBJ_BOX.replace(b" ", b"\t"),
        "continued line as on Windows": OBJ_BOX.replace(b"f 1 2 4\n", b"f 1 2 \\\n4\n").replace(b"\n", b"\r\n"),
        "weights": re.sub(rb"(v .*)\n", rb"\1 1.0\n", OBJ_BOX),
        "colors": re.sub(rb"(v .*)\n", rb"\1 0.5 0.5 1\n", OBJ_BOX),
        "exponents": OBJ_BOX.replace(b"v 1.0 2.0 4.0\n", b"v 1e+0 20.E-1 .4e1\n"),
        "points and lines": OBJ_BOX + b"p 1\nl 1 2 8\n",
        "faces first": re.sub(rb"((?:v .*\n)+)((?:f .*\n)+)", rb"\2\1", OBJ_BOX),
        "no newline at the end": OBJ_BOX.rstrip(),
        "byte order mark": codecs.BOM_UTF8 + OBJ_BOX,
    },
    ".off": {
        "lines as on Windows": OFF_BOX.replace(b"\n", b"\r\n"),
        "counts beside the keyword": off(BOX_VERTICES, BOX_TRIANGLES, "OFF "),
        "comments": OFF_BOX.replace(b"OFF\n8 12 0\n", b"# one\nOFF # two\n\n# three\n8 12 0 # four\n# five\n"),
        "no edge count": OFF_BOX.replace(b"8 12 0\n", b"8 12\n"),
        "face colors": re.sub(rb"^(3 .*)\n", rb"\1 3 255 0 0\n", OFF_BOX, flags=re.MULTILINE),
        "normals": re.sub(rb"^(\S+ \S+ \S+)\n", rb"\1 1 2 3\n", OFF_BOX, flags=re.MULTILINE)
        .replace(b"8 12 0 1 2 3", b"8 12 0")
        .replace(b"OFF", b"NOFF"),
        "no newline at the end": OFF_BOX.rstrip(),
        "byte order mark": codecs.BOM_UTF8 + OFF_BOX,
    },
    ".stl": {
        "lines as on Windows": STL_BOX.replace(b"\n", b"\r\n"),
        "what ends a facet behind what ends its loop": STL_BOX.replace(b"endloop\n", b"endloop "),
        "a vertex behind its loop": STL_BOX.replace(b"loop\nvertex", b"loop vertex"),
        "the vertices on a line": re.sub(rb"\n(?=vertex.*\nendloop|vertex.*\nvertex.*\nendloop)", b" ", STL_BOX),
        "the end behind the last facet": STL_BOX.replace(b"facet\nends", b"facet ends"),
        "a name like a word": stl_text(BOX_VERTICES, BOX_TRIANGLES, "facet normal"),
        "a name like an end": stl_text(BOX_VERTICES, BOX_TRIANGLES, "endfacet"),
        "capitals": STL_BOX.upper(),
        "two zeros": STL_BOX.replace(b"vertex 0.0 0.0 0.0", b"vertex -0.0 0.0 -0.0", 1),
        "one line": STL_BOX.replace(b"\n", b" "),
        "one facet on a line, far from both ends": b"facet normal".join(
            (STL_FACETS[0], STL_FACETS[1] + FAR, STL_FACETS[2].replace(b"\n", b" ") + FAR, STL_FACETS[3])
        ),
        "one line for each facet": re.sub(rb"\n(?!\s*(facet|endsolid))", b" ", STL_BOX),
        "indented": b"\n  " + STL_BOX.replace(b"\n", b"\n\t "),
        "two solids": stl_text(BOX_VERTICES, BOX_TRIANGLES[:6], "") + stl_text(BOX_VERTICES, BOX_TRIANGLES[6:], ""),
    },
}


@pytest.mark.parametrize(("ending", "name"), [(ending, name) for ending in VARIANTS for name in VARIANTS[ending]])
def test_files_may_look_like_this(read: Read, ending: str, name: str) -> None:
    mesh = read(ending, VARIANTS[ending][name])
    assert (soup(mesh), mesh.counts, mesh.vertices.shape) == (soup(box()), CLOSED, (8, 3))


def test_stl_vertices_are_merged_where_they_coincide_and_nowhere_else(read: Read) -> None:
    moved = STL_BOX.replace(b"vertex 0.0 0.0 0.0", b"vertex 1e-300 0.0 0.0", 1)
    mesh = read(".stl", moved)
    assert mesh.vertices.shape == (9, 3)
    assert mesh.counts["boundary_edges"] > 0


@pytest.mark.parametrize("name", ["ply ascii", "ply little", "obj", "off", "gifti"])
def test_other_vertices_that_coincide_stay_apart_and_odd_faces_are_kept(read: Read, name: str) -> None:
    ending, write = WRITERS[name]
    corners = BOX_VERTICES[np.array(BOX_TRIANGLES)].reshape(-1, 3)
    mesh = read(ending, write(corners, np.arange(36).reshape(-1, 3).tolist()))
    assert mesh.vertices.tolist() == corners.tolist()
    assert mesh.counts["boundary_edges"] == 36
    faces = [*BOX_TRIANGLES, [0, 0, 1], [0, 1, 3], [3, 1, 0]]
    mesh = read(ending, write(BOX_VERTICES, faces))
    assert mesh.triangles.tolist() == faces
    assert (mesh.counts["zero_area_triangles"], mesh.counts["duplicate_triangles"]) == (1, 2)
    assert mesh.area == BOX_AREA + 2 * 4


@pytest.mark.parametrize(
    ("name", "form", "stem"),
    [
        ("lh.pial", "freesurfer", "lh.pial"),
        ("rh.sphere.reg.gz", "freesurfer", "rh.sphere.reg"),
        ("sub-01_LH.white", "freesurfer", "sub-01_LH.white"),
        ("inner_skull.surf", "freesurfer", "inner_skull.surf"),
        ("lh.pial.surf.gii", ".gii", "lh.pial.surf"),
        ("lh.aparc.annot", ".annot", "lh.aparc"),
        ("lh.asc", "freesurfer", "lh.asc"),
        ("scan.VTP.GZ", ".vtp", "scan"),
        ("scan 2.tar.Off", ".off", "scan 2.tar"),
        ("alh.pial", ".pial", "alh"),
    ],
)
def test_names_tell_formats_and_labels(name: str, form: str, stem: str) -> None:
    assert (mesh_format(Path(name)), mesh_stem(Path(name))) == (form, stem)


def test_files_of_nibabel_are_read(tmp_path: Path) -> None:
    ball = icosphere(3)
    nibabel.freesurfer.write_geometry(tmp_path / "lh.white", ball.vertices, ball.triangles, "a ball")
    mesh = read_mesh(tmp_path / "lh.white")
    assert (mesh.triangles == ball.triangles).all()
    assert (mesh.vertices == ball.vertices.astype(np.float32)).all()


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        *((".ply", {"encoding": encoding}) for encoding in ("ascii", "binary")),
        *((ending, {"digits": 17}) for ending in (".obj", ".off")),
        *((ending, {}) for ending in (".stl", ".glb")),
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


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".OBJ", ".stl"])
def test_written_digits_come_back_and_other_programs_read_them(suffix: str, tmp_path: Path) -> None:
    ball, path = sb.shapes.icosphere(2), tmp_path / f"mesh{suffix}"
    if suffix != ".stl":
        sb.write_mesh(MESH, path)
        assert sb.read_mesh(path).digest == MESH.digest
    sb.write_mesh(ball, str(path))
    found = trimesh.load_mesh(path)
    assert (len(found.vertices), len(found.faces)) == (162, 320)
    assert found.area == pytest.approx(ball.area, rel=1e-6)
    # STL has single precision.
    again = sb.read_mesh(path)
    np.testing.assert_allclose(again.vertices[again.triangles], ball.vertices[ball.triangles], rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        (
            "mesh.xyz",
            sb.errors.InputError,
            r"are written as \.ply, \.obj, \.stl, \.off.*; found the suffix '\.xyz'",
        ),
        ("nowhere/mesh.ply", sb.errors.InputError, "there is no folder"),
        ("folder.ply", sb.errors.InputError, "it exists already and is no file"),
        (f"{'x' * 300}.ply", sb.errors.MeshError, "cannot be written there: File name too long"),
    ],
)
def test_what_cannot_be_written_is_named(tmp_path: Path, name: str, error: type[Exception], message: str) -> None:
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(error, match=message):
        sb.write_mesh(MESH, tmp_path / name)
    assert os.listdir(tmp_path) == ["folder.ply"]


def test_an_old_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    sb.write_mesh(sb.shapes.icosphere(0), path)
    before = path.read_bytes()
    with (
        full_disk(len(before)),
        pytest.raises(sb.errors.MeshError, match=r"mesh\.ply: .* cannot be written .*: File too large"),
    ):
        sb.write_mesh(sb.shapes.icosphere(3), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
