"""Damaged and dishonest mesh files: they are refused by name, and never pass for a mesh."""

from __future__ import annotations

import gzip
import os
import pickle
import re
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.readers import read_mesh_by
from tests.support.mesh_files import (
    BIG,
    BOXES,
    WRITERS,
    Gltf,
    box_scene,
    freesurfer,
    gifti,
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
)

# Warnings are let through here, as they are in real runs: an error must not rest on one.
pytestmark = pytest.mark.filterwarnings("ignore")

FORMATS = [".ply", ".obj", ".stl", ".off", ".gltf", ".glb", ".gii", "_lh.pial", ".mesh", ".msh", ".3mf"]
NAN_AT_3 = BOX_VERTICES.copy()
NAN_AT_3[3, 1] = np.nan
INDEX_MINUS_1, INDEX_8 = [*BOX_TRIANGLES, [0, 1, -1]], [*BOX_TRIANGLES, [0, 1, 8]]
TWO_CORNERS = [*BOX_TRIANGLES, [0, 1]]
INT_TRIANGLES = np.array(BOX_TRIANGLES, dtype=np.int32)
MANY = 10**15
# Bad meshes, and the formats that can hold them.
POLYGONS = [".ply", ".obj", ".off"]
INDEXED = [*POLYGONS, ".glb", ".gii", "_lh.pial", ".mesh", ".msh", ".3mf"]
MESHES: dict[str, tuple[Any, Any, list[str]]] = {
    "NaN": (NAN_AT_3, BOX_TRIANGLES, FORMATS),
    "no faces": (BOX_VERTICES, [], FORMATS),
    "index -1": (BOX_VERTICES, INDEX_MINUS_1, INDEXED),
    "index 8": (BOX_VERTICES, INDEX_8, INDEXED),
    "two corners": (BOX_VERTICES, TWO_CORNERS, [*POLYGONS, ".stl ascii"]),
    "two corners among quads": (BOX_VERTICES, [*BOX_MIXED, [0, 1]], POLYGONS),
    "lengths 3, 4 and 2": (BOX_VERTICES, [[3, 2, 6], [0, 1, 2, 4], [0, 4]], POLYGONS),
}
# What is announced of vertices and faces, besides what there is.
COUNTS = [(0, 1), (0, -1), (1, 0), (1, -1), (-1, 1), (0, MANY), (MANY, 0), (-16, 0)]
# Lines that stand for others in text: for the coordinates of a vertex, and for the corners of a face.
COORDINATES = [b"0.0 2.0", b"0.0 2.0 x", b"0.0 2_0 4.0", b"0.0 inf 4.0"]
CORNERS = [b"4 4 6 7", b"3 4 6", b"3 4 6 0_7", b"2 4 6", b"3 4 6 -1", b"3 4 6 8", b"3 4 6 2.5", b"0"]


def changed(content: bytes, *edits: tuple[bytes, bytes]) -> bytes:
    for old, new in edits:
        assert old in content
        content = content.replace(old, new, 1)
    return content


def glb_of(vertices: Any, indices: Any, **nodes: Any) -> bytes:
    return Gltf([[(vertices, indices, None)]], **{"nodes": [{"mesh": 0}], **nodes}).glb()


def glb_with(accessor: int | None = None, **entries: Any) -> bytes:
    """A scene with other entries in an accessor, or in the document itself."""
    scene = box_scene()
    (scene.tree if accessor is None else scene.tree["accessors"][accessor]).update(entries)
    return scene.glb()


WHOLE = {name: write(BOX_VERTICES, BOX_TRIANGLES) for name, (_, write) in WRITERS.items()}
PLY_BOX, PLY_BINARY, OBJ_BOX, OFF_BOX = (WHOLE[name] for name in ("ply ascii", "ply little", "obj", "off"))
GLTF_BOX, GII_BOX, STL_BOX = box_scene().gltf(), WHOLE["gifti"], WHOLE["stl ascii"]
OFF_QUADS = off(BOX_VERTICES, BOX_QUADS)

# By form or format: what is wrong, and the bytes.
BAD: dict[str, dict[str, bytes]] = {
    **{
        name: {
            bad: write(vertices, faces)
            for bad, (vertices, faces, formats) in MESHES.items()
            if ending in formats or f"{ending} {name.split()[-1]}" in formats
        }
        for name, (ending, write) in WRITERS.items()
    },
    ".ply": {
        "bytes left over": PLY_BINARY + b"\0",
        "binary, a length above the corners": PLY_BINARY[:-13] + b"\4" + PLY_BINARY[-12:],
        "binary, a length below the corners": PLY_BINARY[:-13] + b"\2" + PLY_BINARY[-12:],
        "index 2^32 - 1": ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, 2**32 - 1]], BIG, index="uint"),
        "a coordinate too many": changed(PLY_BOX, (b"0.0 2.0 4.0", b"0.0 2.0 4.0 1.0")),
        "no coordinate z": changed(PLY_BOX, (b"property float z\n", b"property float w\n")),
        "no end of header": changed(PLY_BOX, (b"end_header\n", b"")),
        "a number on the line of a neighbour": changed(PLY_BOX, (b"0.0 2.0 4.0\n", b"0.0 2.0\n4.0 ")),
        "two formats": changed(PLY_BOX, (b"comment", b"format ascii 1.0\ncomment")),
        "two elements of one name": changed(PLY_BOX, (b"end_header", b"element face 0\nend_header")),
        "two properties of one name": changed(PLY_BOX, (b"property float y", b"property float x\nproperty float y")),
        "a property of no element": changed(PLY_BOX, (b"element vertex", b"property int a\nelement vertex")),
        "a type that PLY lacks": changed(PLY_BOX, (b"float z", b"half z")),
        "coordinates in lists": changed(PLY_BOX, (b"property float z", b"property list uchar float z")),
        "indices in no list": changed(PLY_BOX, (b"list uchar int", b"int")),
        "a strip of two corners": ply(BOX_VERTICES, [[0, 1, 2, -1, 3, 4]], BIG).replace(b"face 1", b"tristrips 1"),
        "strips without corners": ply(BOX_VERTICES, [[-1, -1]], BIG).replace(b"face 1", b"tristrips 1"),
        "an index beyond its type": ply(BOX_VERTICES, [*BOX_TRIANGLES, [0, 1, 258]], index="uchar"),
    },
    ".obj": {
        **{
            f"the face {corners}": OBJ_BOX + f"f {corners}\n".encode()
            for corners in ("1/1 2/1 0/1", "1 2 -0", "-1 -2 -9", "1 2 2.5", "1 2 x", "1 2 0_3", "")
        },
        "index beyond the line it stands on": b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 0 1 0\nv 0 0 1\n",
        "cut in a face": OBJ_BOX[:-3],
        "no vertices": b"f 1 2 3\n",
        "a vertex of five numbers": OBJ_BOX + b"v 0 0 0 1 1\n",
    },
    ".off": {
        "homogeneous coordinates": b"4OFF\n3 1 0\n0 0 0 2\n2 0 0 2\n0 2 0 2\n3 0 1 2\n",
        "no counts": b"OFF\n",
        "cut in a quad": OFF_QUADS[:-3],
    },
    ".stl": {
        **{f"{count} triangles": stl_binary(BOX_VERTICES, BOX_TRIANGLES, count=count) for count in (13, 11, 2**32 - 1)},
        "starts with solid and announces one more": stl_binary(BOX_VERTICES, BOX_TRIANGLES, b"solid", count=13),
        "ascii, no end": changed(STL_BOX, (b"endsolid box\n", b"")),
        "ascii, two corners here and four there": stl_text(BOX_VERTICES, [[0, 1, 3, 2], [0, 4], *BOX_TRIANGLES[2:]]),
    },
    ".glb": {
        **{
            f"{count} of accessor {accessor}": glb_with(accessor, count=count)
            for accessor, count in ((1, 39), (1, 35), (0, 9), (0, 7))
        },
        "sparse": glb_with(0, sparse={"count": 1}),
        "normalized": glb_with(0, normalized=True),
        "compressed": glb_with(extensionsRequired=["KHR_draco_mesh_compression"]),
        "no nodes": glb_of(BOX_VERTICES, BOX_TRIANGLES, nodes=[]),
        "points alone": Gltf([[(BOX_VERTICES, None, 0)]], [{"mesh": 0}]).glb(),
        "a node that is its own child": glb_of(
            BOX_VERTICES, BOX_TRIANGLES, nodes=[{"children": [1]}, {"mesh": 0, "children": [0]}], roots=[0]
        ),
        "a node that is not there": glb_of(BOX_VERTICES, BOX_TRIANGLES, roots=[1]),
        "first version": changed(WHOLE["glb"], (b"glTF\2", b"glTF\1")),
    },
    ".gltf": {
        "a buffer that is not there": box_scene().gltf("missing.bin"),
        "a buffer that is shorter than announced": re.sub(rb"base64,[^\"]{40}", b"base64,", GLTF_BOX),
        "cut": GLTF_BOX[:-5],
        "no JSON": b"not JSON",
        "an empty document": b"{}",
    },
    ".gii": {
        **{
            f"{new.decode()} for {old.decode()}": changed(GII_BOX, (old, new))
            for old, new in (
                (b'Dim0="12"', b'Dim0="13"'),
                (b'Dim0="12"', b'Dim0="11"'),
                (b'Dim0="8"', b'Dim0="7"'),
                (b'Dim0="8"', b'Dim0="8000000000000"'),
                (b'NumberOfDataArrays="2"', b'NumberOfDataArrays="3"'),
            )
        },
        "no triangles": gifti(BOX_VERTICES, None),
        "no points": gifti(None, INT_TRIANGLES),
        "two point sets": gifti(BOX_VERTICES, INT_TRIANGLES, points=2),
        "indices with fractions": gifti(BOX_VERTICES, INT_TRIANGLES.astype(np.float32)),
        "other XML": b"<svg><path/></svg>",
    },
    "_lh.pial": {
        **{
            f"{vertices} vertices, {triangles} triangles": freesurfer(
                BOX_VERTICES, BOX_TRIANGLES, counts=(vertices, triangles)
            )
            for vertices, triangles in ((8, 13), (8, 11), (2**31 - 1, 8), (-8, 28))
        },
        "quadrilaterals": b"\xff\xff\xfd" + WHOLE["freesurfer"][3:],
        "thickness": b"\xff\xff\xff" + np.array([8, 12, 1], ">i4").tobytes() + bytes(32),
        "text": b"#!ascii version of lh.pial\n",
    },
}
ZIPPED = gzip.compress(PLY_BOX, mtime=0)
BAD[".ply.gz"] = {
    "checksum": ZIPPED[:-8] + bytes([ZIPPED[-8] ^ 1]) + ZIPPED[-7:],
    "length": ZIPPED[:-4] + bytes([ZIPPED[-4] ^ 1]) + ZIPPED[-3:],
    "trailing bytes": ZIPPED + b"more",
    "inside": ZIPPED[:40] + bytes([ZIPPED[40] ^ 255]) + ZIPPED[41:],
}
for form in ("ply ascii", "ply little", "ply big", "off"):
    BAD[form] |= {
        f"{more[0]:+} vertices, {more[1]:+} faces": WRITERS[form][1](
            BOX_VERTICES, BOX_TRIANGLES, vertex_count=8 + more[0], face_count=12 + more[1]
        )
        for more in COUNTS
    }
for form in ("ply ascii", "obj", "off", "stl ascii"):
    BAD[form] |= {
        f"the vertex {line!r}": changed(WHOLE[form], (b"0.0 2.0 4.0\n", line + b"\n")) for line in COORDINATES
    }
for form in ("ply ascii", "off"):
    BAD[form] |= {f"the face {line!r}": changed(WHOLE[form], (b"3 4 6 7\n", line + b"\n")) for line in CORNERS}
    quads = WRITERS[form][1](BOX_VERTICES, BOX_QUADS)
    BAD[form]["two corners missing among quads"] = changed(quads, (b"4 4 6 7 5\n", b"4 4 6\n"))
CASES = [(form, name) for form, cases in BAD.items() for name in cases]


def refusal(path: Path) -> str:
    """The reason that follows the path in the error of reading a file."""
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.count(str(path)) == 1
    assert len(message) < len(str(path)) + 400
    assert str(pickle.loads(pickle.dumps(caught.value))) == message
    return message.removeprefix(f"{path}: ")


@pytest.mark.parametrize(("form", "name"), CASES)
def test_bad_files_are_refused_by_name(tmp_path: Path, form: str, name: str) -> None:
    path = tmp_path / f"scan{WRITERS[form][0] if form in WRITERS else form}"
    path.write_bytes(BAD[form][name])
    assert refusal(path)


def test_a_negative_dimension_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scan.gii"
    path.write_bytes(changed(GII_BOX, (b'Dim0="8"', b'Dim0="-8"')))
    assert "negative dimension: [-8, 3]" in refusal(path)


# Formats whose vertices and triangles keep their numbers.
@pytest.mark.parametrize("form", ["ply ascii", "off", "gifti", "freesurfer"])
@pytest.mark.parametrize(("name", "entry"), [("NaN", "#3"), ("index 8", r"#12 = \[0, 1, 8\]")])
def test_bad_entries_are_numbered_also_in_zipped_files(tmp_path: Path, form: str, name: str, entry: str) -> None:
    path = tmp_path / f"scan{WRITERS[form][0]}.gz"
    path.write_bytes(gzip.compress(BAD[form][name]))
    assert re.match(f"1 of .*{entry}", refusal(path))


NO_MESHES = [b"\0", b"\n", bytes(range(256)) * 8, b"\xff\xfe\0\0" * 100, b"solid", b"ply", b"OFF", b"glTF", b"<"]


@pytest.mark.parametrize("ending", FORMATS)
def test_content_that_is_no_mesh_or_that_of_another_format_is_refused(tmp_path: Path, ending: str) -> None:
    # The two forms of glTF can be told apart by their first bytes.
    own = {".gltf", ".glb"} if ending in (".gltf", ".glb") else {ending, ".rh.white" if ending == "_lh.pial" else ""}
    others = [content for other, content in BOXES.values() if other not in own]
    zipped = [gzip.compress(content) for other, content in BOXES.values() if other == ending]
    path = tmp_path / f"scan{ending}"
    for content in (*NO_MESHES, *others, *zipped):
        path.write_bytes(content)
        assert refusal(path)


@pytest.mark.parametrize("ending", [*FORMATS, ".ply.gz"])
def test_empty_and_missing_files_and_folders_are_told_apart(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"scan{ending}"
    assert refusal(path) == "cannot be read: No such file or directory"
    path.mkdir()
    assert refusal(path) == "cannot be read: it is a folder; name the files in it"
    assert refusal(tmp_path) == "it is a folder; name the files in it"
    path.rmdir()
    for content in (b"", gzip.compress(b""))[: 1 + ending.endswith(".gz")]:
        path.write_bytes(content)
        assert refusal(path) == "the file is empty"


@pytest.mark.parametrize("length", [len(OBJ_BOX) + 9, len(OBJ_BOX) // 2])
def test_a_file_that_changes_while_it_is_read_is_refused(tmp_path: Path, length: int) -> None:
    path = tmp_path / "scan.obj"
    path.write_bytes(OBJ_BOX)

    def read(file: BufferedReader, wanted: int) -> bytes:
        os.truncate(path, length)
        return file.read(wanted)

    with pytest.raises(MeshError, match=r"scan\.obj: .*it changed while it was read"):
        read_mesh_by(path, read)


@pytest.mark.parametrize(
    "name",
    ["scan.pts", "scan", "scan.gz", "ply", ".ply", "scan.ply.gz.gz", "scan.blend", "scan.xyz.gz", "lh.aparc.annot"],
)
def test_names_without_a_known_format_are_refused_with_the_page_that_converts(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(PLY_BOX)
    assert re.search(r"known are \.ply, .*docs/formats\.md", refusal(tmp_path / name))


# Forms in which a cut shows wherever it falls, and how many bytes at the end mean nothing.
# The last line of text may lose its end, but no corner.
SPARE = dict.fromkeys(("ply little", "stl binary", "glb", "gifti", "freesurfer", "3mf"), 0)
SPARE |= {"stl ascii": 5, "ply ascii": 1, "off": 1, "gmsh 2.2": 1, "gmsh 4.1": 1, "gmsh 4.1 little": 1, "medit": 6}
TETRAHEDRON = TETRAHEDRON_VERTICES, TETRAHEDRON_TRIANGLES
CUTTABLE: dict[str, tuple[str, bytes, int]] = {
    **{name: (WRITERS[name][0], WRITERS[name][1](*TETRAHEDRON), spare) for name, spare in SPARE.items()},
    "gltf": (".gltf", Gltf([[(*TETRAHEDRON, None)]], [{"mesh": 0}]).gltf(), 0),
    "gzip": (".ply.gz", gzip.compress(ply(*TETRAHEDRON), mtime=0), 0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CUTTABLE)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    ending, whole, spare = CUTTABLE[name]
    path = tmp_path / f"whole{ending}"
    path.write_bytes(whole)
    assert read_mesh(path).area == pytest.approx(1.5 + np.sqrt(0.75), rel=1e-6)
    # Parsers of large libraries take milliseconds for each.
    for length in range(0, len(whole) - spare, 1 if len(whole) < 500 else 7):
        path = tmp_path / f"{length}{ending}"
        path.write_bytes(whole[:length])
        assert refusal(path)
