"""Damaged and dishonest mesh files: they are refused by name, and never pass for a mesh."""

from __future__ import annotations

import gzip
import pickle
import re
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sobolev_batch import MeshError, read_mesh
from tests.support.mesh_files import (
    BIG,
    BOXES,
    LITTLE,
    Gltf,
    box_scene,
    freesurfer,
    freesurfer_quads,
    gifti,
    obj,
    off,
    ply,
    stl_binary,
    stl_text,
)
from tests.support.shapes import (
    BOX_MIXED,
    BOX_QUADS,
    BOX_TRIANGLES,
    BOX_VERTICES,
    TETRAHEDRON_TRIANGLES,
    TETRAHEDRON_VERTICES,
    Reals,
)

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
OBJ_BOX, OFF_BOX = obj(BOX_VERTICES, BOX_TRIANGLES), off(BOX_VERTICES, BOX_TRIANGLES)
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
    "ply, points alone": (".ply", ply(BOX_VERTICES, []), "8 vertices and no faces: it holds points and no surface"),
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
    "ply, two corners among quads": (".ply", ply(BOX_VERTICES, [*BOX_MIXED, [0, 1]]), ""),
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
    "obj, a coordinate in Python's spelling": (".obj", changed(OBJ_BOX, b"v 0.0 2.0 4.0\n", b"v 0.0 2_0 4.0\n"), ""),
    "obj, an index in Python's spelling": (".obj", OBJ_BOX + b"f 1 2 0_3\n", "index"),
    "obj, two coordinates": (".obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", ""),
    "obj, cut in a corner": (".obj", OBJ_BOX + b"f 1//2 2//3 8", "breaks off in its last line"),
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
    "off, an index in Python's spelling": (".off", changed(OFF_BOX, b"3 4 6 7\n", b"3 4 6 0_7\n"), "index"),
    "off, two corners": (".off", off(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1]]), ""),
    "off, two corners among quads": (".off", off(BOX_VERTICES, [*BOX_MIXED, [0, 1]]), ""),
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
    "stl ascii, a coordinate in Python's spelling": (
        ".stl",
        changed(STL_TEXT, b"vertex 0.0 2.0 4.0\n", b"vertex 0.0 2_0 4.0\n"),
        "not a number",
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
    # FreeSurfer.
    "freesurfer, a triangle too many": (
        "_lh.pial",
        freesurfer(BOX_VERTICES, BOX_TRIANGLES, counts=(8, 13)),
        "announces",
    ),
    "freesurfer, a triangle too few": (
        "_lh.pial",
        freesurfer(BOX_VERTICES, BOX_TRIANGLES, counts=(8, 11)),
        "12 bytes behind",
    ),
    "freesurfer, very many": ("_lh.pial", freesurfer(BOX_VERTICES, BOX_TRIANGLES, counts=(2**31 - 1, 8)), "2147483647"),
    "freesurfer, negative": ("_lh.pial", freesurfer(BOX_VERTICES, BOX_TRIANGLES, counts=(-8, 28)), "announces -8"),
    "freesurfer, index -1": ("_lh.pial", freesurfer(BOX_VERTICES, [[0, 1, -1]]), r"#0 = \[0, 1, -1\]"),
    "freesurfer, index 8": ("_lh.pial", freesurfer(BOX_VERTICES, [[0, 1, 8]]), r"#0 = \[0, 1, 8\]"),
    "freesurfer, NaN": ("_lh.pial", freesurfer(nan_at(3), BOX_TRIANGLES), r"1 of 8 vertices have NaN .*#3"),
    "freesurfer, no triangles": ("_lh.pial", freesurfer(BOX_VERTICES, np.zeros((0, 3))), "no triangles"),
    "freesurfer, a quadrilateral too many": (
        "_lh.pial",
        freesurfer_quads(BOX_VERTICES, BOX_QUADS, counts=(8, 7)),
        "8 vertices and 7 quadrilaterals",
    ),
    "freesurfer, thickness": (
        "_lh.thickness",
        b"\xff\xff\xff" + np.array([8, 12, 1], ">i4").tobytes() + bytes(32),
        "values at vertices",
    ),
    "freesurfer, text": ("_lh.pial", b"#!ascii version of lh.pial\n", "begins with the bytes 23 21 61"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(tmp_path: Path, name: str) -> None:
    ending, content, reason = BAD[name]
    path = tmp_path / f"scan{ending}"
    path.write_bytes(content)
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.count(str(path)) == 1
    assert re.search(reason, message.removeprefix(f"{path}: "))
    assert len(message) < len(str(path)) + 400
    assert str(pickle.loads(pickle.dumps(caught.value))) == message


@pytest.mark.parametrize("name", [name for name in BAD if name.endswith(", NaN")])
def test_bad_files_are_refused_by_name_when_zipped(tmp_path: Path, name: str) -> None:
    ending, content, reason = BAD[name]
    path = tmp_path / f"scan{ending}.gz"
    path.write_bytes(gzip.compress(content))
    with pytest.raises(MeshError, match=reason) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")


FORMATS = [".ply", ".obj", ".stl", ".off", ".gltf", ".glb", ".gii", "_lh.pial"]


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
    for ending in set(FORMATS) - (
        {".gltf", ".glb"} if own in (".gltf", ".glb") else {own, "_lh.pial" if own == ".rh.white" else own}
    ):
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


@pytest.mark.parametrize(
    "name",
    ["scan.pts", "scan", "scan.gz", "ply", ".ply", "scan.ply.gz.gz", "scan.step", "scan.xyz.gz", "lh.aparc.annot"],
)
def test_names_without_a_known_format_are_refused_with_the_page_that_converts(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(PLY_BOX)
    with pytest.raises(MeshError, match=r"known are \.ply, .*docs/formats\.md") as caught:
        read_mesh(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")


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


@pytest.mark.parametrize("ending", [".ply", ".ply.gz"])
def test_files_beyond_the_bound_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    path = tmp_path / f"scan{ending}"
    path.write_bytes(gzip.compress(PLY_BOX) if ending.endswith(".gz") else PLY_BOX)
    monkeypatch.setattr("sobolev_batch.surfaces.formats.raw_files._LARGEST_BYTES", len(PLY_BOX))
    assert read_mesh(path).area == 28.0
    monkeypatch.setattr("sobolev_batch.surfaces.formats.raw_files._LARGEST_BYTES", len(PLY_BOX) - 1)
    with pytest.raises(MeshError, match=re.escape(f"{path}: larger than {len(PLY_BOX) - 1} bytes")):
        read_mesh(path)


@pytest.mark.parametrize("ending", [".ply", ".ply.gz"])
def test_small_files_take_little_memory(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"scan{ending}"
    path.write_bytes(gzip.compress(PLY_BOX) if ending.endswith(".gz") else PLY_BOX)
    read_mesh(path)
    tracemalloc.start()
    try:
        read_mesh(path)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 16 << 20


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
    "freesurfer": ("_lh.pial", freesurfer(*TETRAHEDRON), 0),
    "gzip": (".ply.gz", gzip.compress(ply(*TETRAHEDRON), mtime=0), 0),
}


@pytest.mark.slow
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
