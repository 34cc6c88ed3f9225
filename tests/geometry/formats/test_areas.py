"""Files as people write them: the right area, known by hand, or the true reason why they are refused."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from tests.support.mesh_files import (
    BIG,
    LITTLE,
    VOLUME,
    Gltf,
    Read,
    archive,
    box_scene,
    freesurfer,
    gifti,
    gmsh,
    gmsh_first,
    gmsh_first_binary,
    medit,
    model,
    numbers,
    obj,
    object_3mf,
    off,
    off_binary,
    package_3mf,
    ply,
    stl_binary,
    stl_text,
    vtk_legacy,
)
from tests.support.shapes import BOX_AREA, BOX_MIXED, BOX_QUADS, BOX_TRIANGLES, BOX_VERTICES

# Of each case: the end of the file's name, its bytes, and its area or the reason of its refusal.
Case = tuple[str, bytes, float | str]


def replaced(content: bytes, *edits: tuple[bytes, bytes]) -> bytes:
    """The content with some words in place of others, each of which occurs."""
    for old, new in edits:
        assert old in content
        content = content.replace(old, new)
    return content


BOM = b"\xef\xbb\xbf"
PLY_BOX, PLY_LITTLE = ply(BOX_VERTICES, BOX_TRIANGLES), ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE)
PLY_FACES = b"element face 12\n"


def ply_with(kind: str, code: str, order: str) -> bytes:
    """The box in binary, with a list and a number of some type in front of its faces, as an element of their own."""
    header, end, body = ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE if order == "<" else BIG).partition(b"end_header\n")
    more = f"element more 2\nproperty list {kind} {kind} ref\nproperty {kind} one\n".encode()
    rows = struct.pack(f"{order}4{code}", 2, 7, 7, 5) + struct.pack(f"{order}2{code}", 0, 1)
    header = header.replace(b"element vertex 8", more + b"element vertex 8")
    return header + end + rows + body


OFF_BOX, STL_TEXT = off(BOX_VERTICES, BOX_TRIANGLES), stl_text(BOX_VERTICES, BOX_TRIANGLES)
STL_BINARY, STL_SOLID = (stl_binary(BOX_VERTICES, BOX_TRIANGLES, start) for start in (b"box", b"solid box"))


def off_with(kind: str, more: str, faces: list[list[int]] = BOX_TRIANGLES) -> bytes:
    """The box with further numbers behind each vertex."""
    rows = [f"{numbers(row)} {more}" for row in BOX_VERTICES] + [f"{len(f)} {' '.join(map(str, f))}" for f in faces]
    return "\n".join([f"{kind}OFF", f"8 {len(faces)} 0", *rows, ""]).encode()


CASES: dict[str, Case] = {
    **{
        f"stl, {what}": (".stl", content, expected)
        for what, content, expected in (
            ("a byte-order mark", BOM + STL_TEXT, BOX_AREA),
            ("solid in a binary header", STL_SOLID, BOX_AREA),
            ("solid in a binary header and a byte more", STL_SOLID + b"\0", BOX_AREA),
            (
                "three facets without their ends",
                re.sub(rb"vertex[^v]*endfacet\n", b"", STL_TEXT, count=3),
                "facet 1 has 2 vertices, expected three",
            ),
            ("blanks in the words that end something", re.sub(rb"\bend\B", b"END ", STL_TEXT), BOX_AREA),
            ("a byte behind the triangles", STL_BINARY + b"\0", BOX_AREA),
            ("bytes behind the triangles", STL_BINARY + b"\n" * 49, BOX_AREA),
            ("as many bytes as a triangle has", STL_BINARY + bytes(50), "holds 13.00 triangles, .* announces 12"),
            ("solid in a binary header and a triangle more", STL_SOLID + bytes(50), "holds 13.00 triangles"),
            ("cut in its header", STL_BINARY[:83], "of 83 bytes holds 0.00 triangles"),
            ("another text", b"v 0 0 0\n" * 20, "a text that does not begin with solid"),
            ("solid in a binary header of a cut file", STL_SOLID[:-1], "holds 11.98 triangles, .* announces 12"),
        )
    },
    **{
        f"off, {what}": (".off", content, expected)
        for what, content, expected in (
            ("colours of three numbers", off_with("C", "255 0 0"), BOX_AREA),
            ("colours of four numbers", off_with("C", "1 0.5 0 1"), BOX_AREA),
            ("normals and colours", off_with("NC", "0 0 1 255 0 0 255"), BOX_AREA),
            ("colours and normals", off_with("CN", "255 0 0 255 0 0 1"), BOX_AREA),
            ("texture and all", off_with("STCN", "0 0 1 1 1 0 0 0 1"), BOX_AREA),
            ("no magic word", OFF_BOX.removeprefix(b"OFF\n"), BOX_AREA),
            ("no edge count and no magic word", replaced(OFF_BOX, (b"OFF\n8 12 0\n", b"8 12\n")), BOX_AREA),
            ("a count at once", replaced(OFF_BOX, (b"OFF\n8", b"OFF8")), BOX_AREA),
            ("in lower case", replaced(OFF_BOX, (b"OFF", b"off")), BOX_AREA),
            ("faces over two lines", re.sub(rb"(?m)^(3 \d) ", rb"\1\n", OFF_BOX), BOX_AREA),
            ("a number on each line", b"OFF\n8 12 0\n" + b"\n".join(OFF_BOX.split()[4:]), BOX_AREA),
            ("one line", b" ".join(off(BOX_VERTICES, BOX_MIXED).split()), BOX_AREA),
            ("one line with colours", b" ".join(off_with("C", "1 0 0 1").split()), BOX_AREA),
            ("one line and a count at once", b" ".join(OFF_BOX.split()).replace(b"OFF ", b"OFF"), BOX_AREA),
            (
                "one line behind two counts",
                b" ".join(OFF_BOX.split()).replace(b"8 12 0", b"8 12\n0"),
                "vertex 1 has 73 numbers, expected 3",
            ),
            # As a stream, the last 4 of the vertices begins the first face.
            (
                "a number more",
                replaced(OFF_BOX.replace(b".0", b""), (b"\n0 0 0\n", b"\n0 0 0 0\n")),
                "vertex 1 has 4 numbers, expected 3",
            ),
            ("two vertices a line", re.sub(rb"(?m)^(\d\.\d.*)\n(.*)\n", rb"\1 \2\n", OFF_BOX), BOX_AREA),
            ("colours that no word announces", off_with("", "255 0 0"), BOX_AREA),
            (
                "colours of vertices and faces",
                re.sub(rb"(?m)^(3 .*)", rb"\1 4 1 0 0 1", off_with("", "1 0 0 1")),
                BOX_AREA,
            ),
            (
                "a colour of one vertex",
                OFF_BOX.replace(b"0.0\n", b"0.0 255 0 0\n", 1),
                "vertex 2 has 3 numbers, expected 6",
            ),
            ("a number behind each vertex", off_with("", "1"), "vertex 1 has 4 numbers, expected 3"),
            ("binary", off_binary(BOX_VERTICES, BOX_TRIANGLES), BOX_AREA),
            ("binary with colours", off_binary(BOX_VERTICES, BOX_TRIANGLES, "C", 4, 3), BOX_AREA),
            ("binary with normals", off_binary(BOX_VERTICES, BOX_TRIANGLES, "N", 3), BOX_AREA),
            ("four dimensions", b"4" + OFF_BOX, "does not begin with OFF.*but with '4OFF'"),
            (
                "any dimensions",
                replaced(OFF_BOX, (b"OFF\n", b"nOFF\n3\n")),
                "begins with 'nOFF' and then '3', expected",
            ),
            ("normals of two numbers", off_with("N", "0 1"), "vertex 1 has 10 numbers, expected 6"),
            ("colours of five numbers", off_with("C", "1 1 1 1 1"), "vertex 1 has 8 numbers"),
            ("a corner missing", replaced(OFF_BOX, (b"\n3 4 6 7", b"\n3 4 6")), "face 3 has 7 numbers, expected 4"),
            ("a face more", OFF_BOX + b"3 0 1 2\n", "but more follows: '3 0 1 2'"),
            ("a face less", OFF_BOX.removesuffix(b"3 1 7 3\n"), "face 12 has 0 numbers"),
            ("binary and cut", off_binary(BOX_VERTICES, BOX_TRIANGLES)[:-1], "breaks off in face 12 of 12"),
            ("binary and a byte more", off_binary(BOX_VERTICES, BOX_TRIANGLES) + b"\n", "has 1 bytes behind"),
        )
    },
    **{
        f"ply, {what}": (".ply", content, BOX_AREA)
        for what, content in {
            "a byte-order mark": BOM + PLY_BOX,
            "a byte-order mark before binary": BOM + PLY_LITTLE,
            "a newline behind binary": PLY_LITTLE + b"\n",
            "a newline of two bytes behind binary": PLY_LITTLE + b"\r\n",
            "a last line that ends unlike the first": replaced(PLY_LITTLE, (b"ply\n", b"ply\r\n")),
            "a first line that ends unlike the last": replaced(PLY_LITTLE, (b"end_header\n", b"end_header\r\n")),
            "mixed line ends": replaced(PLY_BOX, (b"float x\n", b"float x\r\n"), (b"float y\n", b"float y\r")),
            "control characters in a comment": replaced(PLY_BOX, (b"element vertex 77", b"a\x0bb\x0cc\x1cd")),
            "X for x": re.sub(rb"(float) (.)\n", lambda found: found[0].upper().replace(b"FLOAT", b"float"), PLY_BOX),
            "lengths in single precision": replaced(PLY_BOX, (b"list uchar", b"list float")),
            "references of 64 bits": replaced(
                re.sub(rb"(\n3 \d \d \d)", rb"\1 9007199254740993", PLY_BOX),
                (b"vertex_indices\n", b"vertex_indices\nproperty int64 medit:ref\n"),
            ),
            "the vertices on a line": re.sub(rb"(?m)(\.0)\n(?=\d\.)", rb"\1 ", PLY_BOX),
            "a number on each line": PLY_BOX.partition(b"end_header\n")[0]
            + b"end_header\n"
            + PLY_BOX.partition(b"end_header\n")[2].replace(b" ", b"\n"),
            **{
                f"{kind} in order {order}": ply_with(kind, code, order)
                for kind, code in {"int64": "q", "uint64": "Q", "float16": "e", "double": "d", "int8": "b"}.items()
                for order in "<>"
            },
        }.items()
    },
    # Two sides of 2 by 4, with a break between them and one at the end.
    "ply, strips": (
        ".ply",
        replaced(
            ply(BOX_VERTICES, [[0, 1, 2, 3, -1, 4, 6, 5, 7, -1]], length="int"), (b"element face", b"element tristrips")
        ),
        16.0,
    ),
    "ply, two bytes behind binary": (".ply", PLY_LITTLE + b"\n\0", "but 2 bytes more follow"),
    "ply, three bytes behind binary": (".ply", PLY_LITTLE + b"\n\n\n", "but 3 bytes more follow"),
    "ply, a length with a fraction": (
        ".ply",
        replaced(PLY_BOX, (b"list uchar", b"list float"), (b"\n3 4 6 7", b"\n3.5 4 6 7")),
        "breaks off in face 3 of 12",
    ),
    "ply, x and X": (".ply", ply(BOX_VERTICES, BOX_TRIANGLES, more="X"), "has the line 'property float x'"),
    "ply, points": (
        ".ply",
        replaced(ply(BOX_VERTICES, []), (PLY_FACES.replace(b"12", b"0"), b"element range_grid 0\n")),
        "its 8 vertices are points or lines",
    ),
}


# Faces that are not convex, with their areas; the last has a hole, which a bridge joins to its outline.
OUTLINES: dict[str, tuple[list[tuple[float, float]], float]] = {
    "arrow": ([(0, 0), (4, 0), (4, 4), (3, 1)], 4.0),
    "L": ([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], 5.0),
    "hole": ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], 12.0),
}


for _name, (_outline, _area) in OUTLINES.items():
    _vertices, _face = [(x, 1.0, y) for x, y in _outline], [*range(len(_outline))]
    CASES |= {
        f"obj, {_name}": (".obj", obj(_vertices, [_face]), _area),
        f"off, {_name}": (".off", off(_vertices, [_face]), _area),
        f"ply, {_name}": (".ply", ply(_vertices, [_face], LITTLE), _area),
        f"vtk, {_name}": (".vtk", vtk_legacy(_vertices, [_face]), _area),
    }

OBJ_BOX = obj(BOX_VERTICES, BOX_QUADS)
CASES |= {
    **{
        f"obj, {what}": (".obj", content, BOX_AREA)
        for what, content in {
            "words in upper case": OBJ_BOX.upper() + b"VN 0 0 1\nG box\n",
            "fo for some faces": OBJ_BOX.replace(b"f 1", b"fo 1"),
            "paths that end in a backslash": re.sub(
                rb"(?m)^(v|f)", rb"# C:\\a\\\n\1", OBJ_BOX.replace(b"\nf", b" # C:\\\no C:\\a\\\nusemtl C:\\\nf")
            ),
            "blanks behind a backslash": OBJ_BOX.replace(b" 4", b" \\ \t\n4"),
            "words without area": b"mtllib a.mtl\no b\ng c\ns 1\nusemtl d\nvp 0.5\nvt 0 0\nvn 0 0 1\nlod 1\n"
            + OBJ_BOX
            + b"l 1 2 3\np 1\ncstype bspline\ndeg 2\nparm u 0 1\nend\n",
        }.items()
    },
    "obj, a free-form surface": (
        ".obj",
        OBJ_BOX + b"surf 0 1 0 1 1 2 3 4\n",
        "line 15 begins with 'surf', which is not",
    ),
    "obj, a free-form curve": (".obj", OBJ_BOX + b"CURV 0 1 1 2\n", "line 15 begins with 'CURV', which is not read"),
    "obj, a name over two lines": (".obj", b"g a \\\nb c\n" + OBJ_BOX, "line 2 begins with 'b', no word of the OBJ"),
    "obj, strips": (".obj", OBJ_BOX + b"f 1 \\\n2 3\nts 1 2 3\n", "line 17 begins with 'ts', no word of the OBJ"),
    "obj, a word cut short": (".obj", OBJ_BOX + b"vq 1 2 3\n", "begins with 'vq', no word of the OBJ format"),
}

# What is no mesh file, whatever its name says.
CASES |= {
    f"{ending}, {what}": (ending, content, reason)
    for ending in (".obj", ".off", ".stl", ".ply", ".vtk", ".gltf")
    for what, content, reason in (
        ("web page", b"\n<!DOCTYPE HTML><html>404</html>", "or a web page"),
        (
            "message of a server",
            b'<?xml version="1.0"?>\n<Error><Code>AccessDenied</Code></Error>',
            "message of a server",
        ),
        ("pointer", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "git lfs pull"),
        ("UTF-16", OBJ_BOX.decode().encode("utf-16"), "save it in UTF-8"),
        ("compressed", gzip.compress(OBJ_BOX), "unpack it, or let its name end in .gz"),
        ("compressed by bzip2", bz2.compress(OBJ_BOX), "is packed; unpack it"),
        ("compressed by LZMA", lzma.compress(OBJ_BOX), "is packed; unpack it"),
        (
            "in an archive of tar",
            b"scan.obj".ljust(257, b"\0") + b"ustar  \0" + OBJ_BOX,
            "an archive; unpack it by tar",
        ),
        ("in an archive", archive({"scan.obj": OBJ_BOX}), "begins as a .3mf or other zip file"),
    )
}
CASES |= {
    "gz, unpacked already": (".ply.gz", PLY_BOX, BOX_AREA),
    "gz, in two parts": (".ply.gz", gzip.compress(PLY_BOX[:99]) + gzip.compress(PLY_BOX[99:]) + bytes(9), BOX_AREA),
    "gz, other bytes behind": (".ply.gz", gzip.compress(PLY_BOX) + b"more", "packed data .*other bytes follow them"),
    "gz, web page": (".ply.gz", b"<!DOCTYPE HTML><html>404</html>", "or a web page"),
    "gz, pointer": (".gii.gz", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", "git lfs pull"),
}
CASES |= {
    f"obj, {suffix} by its contents": (".obj", content, f"it begins as a {suffix} file; name it so")
    for suffix, content in {
        ".ply": PLY_BOX,
        ".off": off_with("N", "0 0 1"),
        ".stl": STL_TEXT,
        ".vtk": vtk_legacy(BOX_VERTICES, BOX_QUADS[:1]),
        ".glb": b"glTF\2\0\0\0",
    }.items()
}


GIFTI_BOX = gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32))
TETRAHEDRA = "Tetrahedra 2 1 2 3 5 0 2 3 4 8 0"
HALVED = "0.5 0 0 0 0.5 0 0 0 0.5 7 7 7"
BOX_3MF = object_3mf(BOX_VERTICES, BOX_TRIANGLES)
DOUBLED = (
    '<object id="2"><components><component objectid="1"/><component objectid="1" transform="{}"/></components></object>'
)
PARTITIONS = b"$PartitionedEntities\n2\n0\n0 0 0 0\n$EndPartitionedEntities\n"
LINEAR, GMSH_OLD = gmsh(BOX_VERTICES, BOX_QUADS), gmsh_first_binary(BOX_VERTICES, BOX_MIXED)
CASES |= {
    "medit, quadrilaterals": (".mesh", medit(BOX_VERTICES, BOX_QUADS), BOX_AREA),
    "medit, both": (".mesh", medit(BOX_VERTICES, BOX_MIXED), BOX_AREA),
    "medit, more sections": (
        ".mesh",
        medit(BOX_VERTICES, BOX_TRIANGLES, f"RequiredTriangles 1 1 {TETRAHEDRA}"),
        BOX_AREA,
    ),
    "medit, one line": (
        ".mesh",
        b" ".join(medit(BOX_VERTICES, BOX_MIXED).replace(b"# by hand", b"").split()),
        BOX_AREA,
    ),
    "medit, a vertex of no numbers": (
        ".mesh",
        replaced(medit([*BOX_VERTICES, (7, 7, 7)], BOX_QUADS), (b"7.0 7.0 7.0", b"NaN Inf -NaN")),
        BOX_AREA,
    ),
    "medit, names": (
        ".mesh",
        medit(BOX_VERTICES, BOX_QUADS, 'Identifier "Box of Mine" Geometry "Box.geo"'),
        BOX_AREA,
    ),
    "medit, tetrahedra alone": (".mesh", medit(BOX_VERTICES, [], TETRAHEDRA), r"2 cells with volume .*scan.mesh"),
    "medit, plane": (".mesh", medit(BOX_VERTICES, BOX_QUADS).replace(b"\n3\n", b"\n2\n", 1), "not of dimension 3"),
    "medit, like no number": (".mesh", medit(BOX_VERTICES, BOX_QUADS, "Corners 1 1 Infos 1 1"), "a section 'Infos'"),
    "medit, a comment that ends as its line does not": (
        ".mesh",
        replaced(medit(BOX_VERTICES, BOX_MIXED), (b"Quad", b"# more\rQuad")),
        BOX_AREA,
    ),
    "medit, curved": (".mesh", medit(BOX_VERTICES, BOX_QUADS, "TrianglesP2 1"), "has TrianglesP2, which are curved"),
    "medit, a face too few": (
        ".mesh",
        medit(BOX_VERTICES, BOX_TRIANGLES, face_count=13),
        "announces 13 rows of 4 numbers",
    ),
    "medit, two sections of faces": (".mesh", medit(BOX_VERTICES, BOX_TRIANGLES, "Triangles 0"), "repeats a section"),
    "medit, binary": (".mesh", b"\1\0\0\0\3\0\0\0", "does not begin with MeshVersionFormatted"),
    "gmsh, quadrilaterals": (".msh", LINEAR, BOX_AREA),
    "gmsh, both": (".msh", gmsh(BOX_VERTICES, BOX_MIXED), BOX_AREA),
    "gmsh, both in the old format": (".msh", gmsh_first(BOX_VERTICES, BOX_MIXED), BOX_AREA),
    "gmsh, comments, and the old format's first version": (
        ".msh",
        b"$Comments\nby hand\n$EndComments\n" + replaced(gmsh_first(BOX_VERTICES, BOX_MIXED), (b"2.2 0 8", b"2 0 8")),
        BOX_AREA,
    ),
    "gmsh, both in binary": (".msh", gmsh(BOX_VERTICES, BOX_MIXED, ">"), BOX_AREA),
    "gmsh, curved": (".msh", replaced(LINEAR, (b"2 1 3\n", b"2 1 10\n")), "cells of Gmsh's type 10"),
    "gmsh, a node that is not there": (
        ".msh",
        replaced(LINEAR, (b"\n2 10 20", b"\n2 10 25")),
        "a node that is not there",
    ),
    "gmsh, a node beyond the last": (
        ".msh",
        replaced(LINEAR, (b"\n2 10 20", b"\n2 10 99")),
        "a node that is not there",
    ),
    "gmsh, a format that nobody writes": (".msh", b"$MeshFormat\n4 0 8\n$EndMeshFormat\n", "-save -format msh41"),
    **{
        f"gmsh, both in the old format, binary of order {order}": (
            ".msh",
            gmsh_first_binary(BOX_VERTICES, BOX_MIXED, order),
            BOX_AREA,
        )
        for order in "<>"
    },
    "gmsh, the old format in binary, cut": (
        ".msh",
        replaced(GMSH_OLD, (GMSH_OLD[-60:-40], b"")),
        "breaks off, or has wrong counts|Gmsh's type 20",
    ),
    **{
        f"medit, {spelling.decode()} for 4": (
            ".mesh",
            replaced(medit(BOX_VERTICES, BOX_MIXED), (b"4.0", spelling)),
            BOX_AREA,
        )
        for spelling in (b"4.0D+00", b"4D0", b".4d1", b"400.d-2")
    },
    "gmsh, partitions of a volume": (
        ".msh",
        replaced(gmsh(BOX_VERTICES, BOX_MIXED), (b"\n2 1 3\n", b"\n3 1 4\n")) + PARTITIONS,
        "partitions, and the faces between them .*-format msh22",
    ),
    "gmsh, partitions of a surface": (".msh", LINEAR + PARTITIONS, BOX_AREA),
    "gmsh, no cells": (".msh", LINEAR.partition(b"$Elements")[0], "no section .Elements"),
    "3mf, placed twice": (
        ".3mf",
        package_3mf(model(BOX_3MF, f'<item objectid="1"/><item objectid="1" transform="{HALVED}"/>')),
        1.25 * BOX_AREA,
    ),
    "3mf, components": (
        ".3mf",
        package_3mf(model(BOX_3MF + DOUBLED.format(HALVED), f'<item objectid="2" transform="{HALVED}"/>')),
        1.25 * BOX_AREA / 4,
    ),
    "3mf, a turn and a stretch": (
        ".3mf",
        # The x axis becomes y, twice as long: sides of 2, 2 and 4.
        package_3mf(model(BOX_3MF, '<item objectid="1" transform="0 2 0 -1 0 0 0 0 1 5 0 0"/>')),
        40.0,
    ),
    "3mf, an object in another part": (
        ".3mf",
        package_3mf(
            model(
                DOUBLED.format(HALVED).replace('objectid="1"', 'objectid="1" p:path="/3D/a.model"'),
                '<item objectid="2"/>',
            ),
            # What another part builds does not count.
            **{"3D/a.model": model(BOX_3MF)},
        ),
        1.25 * BOX_AREA,
    ),
    "3mf, names of parts in other cases": (".3mf", package_3mf(model(BOX_3MF)).replace(b"main", b"MAIN"), BOX_AREA),
    "3mf, names of parts with backslashes": (
        ".3mf",
        replaced(package_3mf(model(BOX_3MF)), (b"3D/main.model", rb"3D\main.model"), (b"_rels/.rels", rb"_rels\.rels")),
        BOX_AREA,
    ),
    "3mf, names with a prefix": (
        ".3mf",
        package_3mf(re.sub(rb"(</?)(?=\w)", rb"\1c:", model(BOX_3MF))),
        BOX_AREA,
    ),
    "3mf, some names with another prefix": (
        ".3mf",
        package_3mf(
            re.sub(
                rb"(</?)(?=object|vert)",
                rb"\1c:",
                model(BOX_3MF, attributes='xmlns="http://x/core/2015/02" xmlns:c="http://x/core/2015/02"'),
            )
        ),
        BOX_AREA,
    ),
    "3mf, supports": (
        ".3mf",
        package_3mf(
            model(
                BOX_3MF + object_3mf(BOX_VERTICES, BOX_TRIANGLES, 2, 'type="support"'),
                '<item objectid="1"/><item objectid="2"/>',
            )
        ),
        BOX_AREA,
    ),
    "3mf, not built": (".3mf", package_3mf(model(BOX_3MF, "")), "builds no faces"),
    "3mf, an extension": (
        ".3mf",
        package_3mf(model(BOX_3MF, attributes='requiredextensions="b p" xmlns:b="http://x/beamlattice/2017/02"')),
        "requires the 3MF extension http://x/beamlattice/2017/02",
    ),
    "3mf, several units": (
        ".3mf",
        package_3mf(model(BOX_3MF, '<item objectid="1" p:path="/a"/>'), a=model(BOX_3MF, "", attributes='unit="inch"')),
        "several units of length: inch, millimeter",
    ),
    "3mf, an index beyond the last": (
        ".3mf",
        package_3mf(model(object_3mf(BOX_VERTICES, [[0, 1, 8]]))),
        r"object 1 has an index outside 0\.\.7",
    ),
    "3mf, a number of two objects": (".3mf", package_3mf(model(BOX_3MF * 2)), "two objects of the number 1"),
    "3mf, no archive": (".3mf", b"PK", "no whole zip archive"),
    "lightwave": (".lwo", b"FORM", "format LightWave.*assimp export scan.lwo scan.ply"),
    "draco": (".drc", b"DRACO", "format Draco.*draco_decoder -i scan.drc -o scan.ply"),
    "freesurfer's text": (".lh.pial.asc", b"#!ascii version of lh.pial\n3 1\n", "mris_convert lh.asc lh.gii"),
    "collada": (".dae", b"<COLLADA/>", "format COLLADA.*assimp export scan.dae scan.ply"),
    "vrml": (".wrl", b"#VRML", r"format VRML.*load_new_mesh\('scan\.wrl'\)"),
    "abaqus": (".inp", b"*Heading", "format Abaqus.*meshio convert scan.inp scan.vtu  # .* noPartsInputFile=ON"),
    "nastran": ("lh.bdf", b"BEGIN BULK", "format Nastran.*meshio convert scan.bdf scan.vtu"),
    "step": (".STEP", b"ISO-10303-21;", "format STEP.*gmsh scan.step -2 -o scan.stl"),
    "medit in binary": (".meshb", b"\1\0\0\0", "Medit in binary.*meshio convert scan.meshb scan.vtu"),
    "med": (".med", b"\x89HDF", "format MED.*gmsh scan.med -save -format msh41 -o surface.msh"),
    "a zip archive": (".obj.zip", archive({"scan.obj": OBJ_BOX}), "format zip.*unzip scan.zip"),
    "an archive of tar": (".tar.gz", gzip.compress(bytes(10240)), "format tar.*tar -xf scan.tar"),
    "a collection": (".vtm", b"<VTKFile/>", r"VTK collection.*read\('scan.vtm'\).combine\(\).extract"),
}

# The ends of lines and of texts on old systems.
CASES |= {
    f"{ending}, {what}": (ending, content.rstrip().replace(b"\n", end) + last, BOX_AREA)
    for ending, content in {
        ".obj": b"# a box\n" + OBJ_BOX,
        ".off": OFF_BOX,
        ".stl": STL_TEXT,
        ".ply": PLY_BOX,
        ".vtk": vtk_legacy(BOX_VERTICES, BOX_QUADS),
        ".mesh": replaced(medit(BOX_VERTICES, BOX_MIXED), (b"Quad", b"# more\nQuad")),
        ".msh": gmsh_first(BOX_VERTICES, BOX_MIXED),
    }.items()
    for what, end, last in (("carriage returns", b"\r", b"\r"), ("control-Z", b"\n", b"\n\x1a"))
}

# What stands before texts, and means nothing; and what Windows calls no number, where it is not used.
CASES |= {
    f"{ending}, a byte-order mark": (ending, BOM + content, BOX_AREA)
    for ending, content in {
        ".obj": OBJ_BOX,
        ".off": OFF_BOX,
        ".vtk": vtk_legacy(BOX_VERTICES, BOX_QUADS),
        ".mesh": medit(BOX_VERTICES, BOX_QUADS),
        ".msh": gmsh_first(BOX_VERTICES, BOX_MIXED),
        ".gltf": box_scene().gltf(),
    }.items()
}
CASES |= {
    f"{ending}, {spelling} for no number": (ending, re.sub(rb"\b9\.0", spelling.encode(), content), BOX_AREA)
    for ending, content in {
        ".obj": OBJ_BOX + b"v 9.0 9.0 9.0\n",
        ".ply": replaced(ply(BOX_VERTICES, BOX_TRIANGLES, more="q"), (b" 0.5\n", b" 9.0\n")),
        ".stl": replaced(STL_TEXT, (b"normal 0 0 0", b"normal 9.0 9.0 9.0")),
        ".vtk": vtk_legacy([*BOX_VERTICES, [9, 9, 9]], BOX_QUADS),
    }.items()
    for spelling in ("-nan(ind)", "1.#QNAN", "-1.#IND00")
}
# Numbers that Python reads and no format has: with underscores, and digits of other scripts.
_SPELLED = {
    ".obj": obj(BOX_VERTICES, BOX_TRIANGLES),
    ".off": OFF_BOX,
    ".stl": STL_TEXT,
    ".ply": PLY_BOX,
    ".mesh": medit(BOX_VERTICES, BOX_TRIANGLES),
    ".msh": gmsh_first(BOX_VERTICES, BOX_TRIANGLES),
    ".gii": gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_ASCII"),
    ".vtk": vtk_legacy(BOX_VERTICES, BOX_QUADS[:1]),
}
CASES |= {
    f"{ending}, {spelling} for a number": (ending, re.sub(rb"\b4\.0+\b", spelling.encode(), content), "not a number")
    for ending, content in _SPELLED.items()
    for spelling in ("4_0", "\uff14", "0x4", "4e")
}
CASES |= {
    f"3mf, {spelling} for a number": (
        ".3mf",
        package_3mf(model(BOX_3MF.replace("4.0", spelling))),
        "a vertex has a word that is not a number",
    )
    for spelling in ("4_0", "\uff14", "0x4")
}
CASES |= {
    "3mf, an index with an underscore": (
        ".3mf",
        package_3mf(model(BOX_3MF.replace('v1="4"', 'v1="0_4"'))),
        "a triangle has '0_4' for an integer",
    ),
    "obj, decimal commas": (
        ".obj",
        OBJ_BOX.replace(b".", b","),
        r"vertex 1 has a word that is not a number: '0,0'; write decimals with a point",
    ),
    "obj, lines": (
        ".obj",
        obj(BOX_VERTICES, []) + b"p 1 2\nl 3 4 5\n",
        "no faces: its 8 vertices are points",
    ),
    "off, points": (".off", off(BOX_VERTICES, []), "no faces: its 8 vertices are points"),
    **{
        f"{ending}, {codec}": (ending, content.decode().encode(codec), "a text in UTF-16; save it in UTF-8")
        for ending, content in {**_SPELLED, ".gltf": box_scene().gltf()}.items()
        for codec in ("utf-16-le", "utf-16-be")
    },
    # What would shift all that follows, or lose a part in silence.
    "obj, a blank in a number": (
        ".obj",
        OBJ_BOX.replace(b"v 1.0 2.0 0.0", b"v 1 .0 2.0 0.0"),
        "has the weight 0.0",
    ),
    "obj, a comment within a word": (".obj", OBJ_BOX.replace(b"f 1 ", b"f 1# ", 1), "has '1#' for an integer"),
    "obj, a comment behind a face": (".obj", OBJ_BOX.replace(b"\nf", b" # 9\nf"), BOX_AREA),
    "stl, a byte more between triangles": (".stl", STL_BINARY[:333] + b"\0" + STL_BINARY[333:], "lie between them"),
    # Read as a stream, it has as many numbers as it needs, and a face of five corners.
    "ply, a line more": (
        ".ply",
        replaced(ply(BOX_VERTICES, BOX_MIXED), (b"\n3 1 5 7", b"\n3 4\n3 1 5 7")),
        "row 16 below the PLY header does not end with its line",
    ),
    "medit, a word cut short": (
        ".mesh",
        replaced(medit(BOX_VERTICES, BOX_MIXED), (b"Quadrilaterals", b"Quadrilat")),
        "a section 'Quadrilat', which is not read",
    ),
    "medit, a word cut short at its beginning, behind a section that is not read": (
        ".mesh",
        replaced(medit(BOX_VERTICES, BOX_MIXED), (b"Quadrilaterals", b"Corners 0 uadrilaterals")),
        "a section 'uadrilaterals', which is not read",
    ),
    "gmsh, a corner twice": (
        ".msh",
        re.sub(rb"(\d+)(\n\$EndElements)", rb"\1 \1\2", gmsh_first(BOX_VERTICES, BOX_MIXED)),
        "a line has a number too many or too few",
    ),
    # As a stream, the next triangle becomes a line, and all numbers are used up.
    "gmsh, a number lost": (
        ".msh",
        replaced(
            gmsh_first(BOX_VERTICES, BOX_TRIANGLES), (b" 3 0 1 2 ", b" 2 1 1 "), (b" 1 1 10 20 40", b" 1 1 10 20")
        ),
        "a line has a number too many or too few",
    ),
    "gmsh, a byte lost": (
        ".msh",
        replaced(gmsh(BOX_VERTICES, BOX_MIXED, "<"), (b"\n$EndNodes", b"$EndNodes")),
        "or bytes too few",
    ),
    # Its library writes such a text row by row.
    "gifti, text in columns": (
        ".gii",
        gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_ASCII", ordering="F"),
        BOX_AREA,
    ),
    "gifti, columns in lines": (
        ".gii",
        re.sub(
            rb"(?s)(<Data>)([^<]*)(</Data>)",
            lambda found: (
                found[1]
                + b"\n".join(map(b" ".join, zip(*map(bytes.split, found[2].strip().splitlines()), strict=True)))
                + found[3]
            ),
            gifti(BOX_VERTICES, np.array(BOX_TRIANGLES, np.int32), "GIFTI_ENCODING_ASCII", ordering="F"),
        ),
        BOX_AREA,
    ),
    **{
        f"gifti, the words of older writers for {old.decode()}": (".gii", replaced(content, (old, new)), BOX_AREA)
        for content, old, new in (
            (GIFTI_BOX, b"GZipBase64Binary", b"GIFTI_ENCODING_B64GZ"),
            (GIFTI_BOX, b"LittleEndian", b"GIFTI_ENDIAN_LITTLE"),
            (_SPELLED[".gii"], b"ASCII", b"GIFTI_ENCODING_ASCII"),
        )
    },
    "gifti, an order that does not exist": (
        ".gii",
        replaced(GIFTI_BOX, (b"RowMajorOrder", b"RowmajorOrder")),
        "'RowmajorOrder' and .*, which GIFTI does not have",
    ),
    "gifti, fractions for indices": (
        ".gii",
        re.sub(rb"\b6 7\b", b"6.0 7", _SPELLED[".gii"]),
        "fractions or other",
    ),
    "obj, an archive": (".obj", package_3mf(model(BOX_3MF)), "begins as a .3mf or other zip file; name it so"),
}


@pytest.mark.parametrize("name", CASES)
def test_files_have_their_area_or_the_reason_of_a_refusal(tmp_path: Path, name: str) -> None:
    ending, content, expected = CASES[name]
    path = tmp_path / f"scan{ending}"
    path.write_bytes(content)
    if isinstance(expected, str):
        with pytest.raises(MeshError, match=f"scan{re.escape(ending)}: .*{expected}"):
            read_mesh(path)
    else:
        assert read_mesh(path).area == pytest.approx(expected, rel=1e-6)


def frame_of_volume(middle: str, valid: int = 1) -> bytes:
    return freesurfer(
        BOX_VERTICES, BOX_TRIANGLES, VOLUME.replace(b"valid = 1", b"valid = %d" % valid) + middle.encode()
    )


def hidden_gltf() -> bytes:
    hiding = {"children": [2], "extensions": {"KHR_node_visibility": {"visible": False}}}
    scene = Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}, hiding, {"mesh": 0}], [0, 1])
    scene.tree["extensionsRequired"] = ["KHR_node_visibility"]
    return scene.glb()


MOVED = "the file has a transform to another frame"
# Of each case: the end of the file's name, its bytes, and how its only note begins; none where that is empty.
NOTED: dict[str, tuple[str, bytes, str]] = {
    "freesurfer, away from the scanner": (
        "_lh.pial",
        frame_of_volume("cras   = 5.5 -18.0 1e1\n"),
        "the file has the shift c_ras = (5.5 -18.0 1e1) to",
    ),
    "freesurfer, at the scanner": ("_lh.pial", frame_of_volume("cras   = 0 0.0 -0\n"), ""),
    "freesurfer, in the scanner's frame": (
        "_lh.pial",
        replaced(frame_of_volume("cras   = 5.5 -18.0 1e1\n"), (b"\0\0\0\2\0\0\0\0", b"\0\0\0\2\0\0\0\1")),
        "",
    ),
    "freesurfer, no valid volume": ("_lh.pial", frame_of_volume("cras   = 5 1 1\n", 0), ""),
    "gifti, moved": (".gii", GIFTI_BOX.replace(b"1.000000   0.000000", b"1.000000   0.5", 1), MOVED),
    "gifti, matrix of four numbers": (
        ".gii",
        re.sub(rb"(?s)(<MatrixData>).*?(</)", rb"\1 1 0 0 1\2", GIFTI_BOX),
        MOVED,
    ),
    "gifti, not moved": (".gii", GIFTI_BOX, ""),
    "off, a colour of one face": (
        ".off",
        replaced(OFF_BOX, (b"\n3 4 6 7\n", b"\n3 4 6 7 5\n")),
        "1 of 12 faces have numbers behind their corners",
    ),
    "off, colours of all faces": (".off", re.sub(rb"(?m)^(3 .*)", rb"\1 5", OFF_BOX), ""),
    "medit, tetrahedra": (
        ".mesh",
        medit(BOX_VERTICES, BOX_QUADS, TETRAHEDRA),
        "2 cells with volume are left out beside 6 faces",
    ),
    **{
        f"gmsh, a face of two groups in the form {write.__name__}": (
            ".msh",
            write(BOX_VERTICES, [*BOX_MIXED, BOX_MIXED[0]]).replace(*without),
            "1 faces are repeated, as for several physical groups",
        )
        # The tetrahedra of the binary form become points.
        for write, without in (
            (gmsh_first, (b"", b"")),
            (gmsh_first_binary, (struct.pack("<3i", 4, 1, 0), struct.pack("<3i", 15, 1, 3))),
        )
    },
    "3mf, in inches": (".3mf", package_3mf(model(BOX_3MF, attributes='unit="inch"')), "its unit of length is the inch"),
    **{
        f"3mf, a {kind} of {program}": (
            ".3mf",
            package_3mf(model(BOX_3MF), **{f"Metadata/{program}.config": setting.encode()}),
            f"{count} parts that the slicer calls modifiers" * (count > 0),
        )
        for program, kind, setting, count in (
            ("Slic3r_PE_model", "modifier", '<metadata key="volume_type" value="ParameterModifier"/>' * 2, 2),
            ("model_settings", "negative part", '<part id="1" subtype="negative_part">', 1),
            ("model_settings", "usual part", '<part id="1" subtype="normal_part">', 0),
        )
    },
    "3mf, beams that it does not require": (
        ".3mf",
        package_3mf(model(BOX_3MF.replace("</mesh>", '<b:beamlattice radius="1" xmlns:b="http://x"/></mesh>'))),
        "shapes of the kind beamlattice are left out",
    ),
    "3mf, not to be printed": (
        ".3mf",
        package_3mf(model(BOX_3MF, '<item objectid="1" printable="0"/>')),
        "1 items that the slicer does not print count",
    ),
    "gltf, two scenes": (
        ".glb",
        Gltf([[(BOX_VERTICES, BOX_TRIANGLES, None)]], [{"mesh": 0}, {"mesh": 0}, {}], [0]).glb(),
        "1 nodes with meshes are outside of the scene that is shown",
    ),
    "gltf, hidden below a hidden node": (".glb", hidden_gltf(), "1 nodes with meshes are outside of the scene"),
    "3mf, in millimetres": (".3mf", package_3mf(model(BOX_3MF, attributes="")), ""),
}


@pytest.mark.parametrize("name", NOTED)
def test_what_is_left_out_is_noted(read: Read, name: str) -> None:
    ending, content, note = NOTED[name]
    mesh = read(ending, content)
    assert mesh.area == BOX_AREA
    assert [found[: len(note)] for found in mesh.notes] == ([note] if note else [])
