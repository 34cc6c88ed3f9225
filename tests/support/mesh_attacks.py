"""Files made to hang a reader, to exhaust its memory or to lead it elsewhere; none of them is a mesh.

Each is small on disk, so that what it costs to refuse it can be held against its size. Those that take a second
to make are made when they are first written.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
import struct
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.mesh_files import (
    LITTLE,
    Gltf,
    box_scene,
    gifti,
    gmsh,
    model,
    obj,
    object_3mf,
    package_3mf,
    ply,
    stl_text,
)
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

# Writes an attack into a folder, and returns the path of the file to read.
Attack = Callable[[Path], Path]

_MEGABYTE = 1 << 20
_INT_TRIANGLES = np.array(BOX_TRIANGLES, dtype=np.int32)
_GIFTI = gifti(BOX_VERTICES, _INT_TRIANGLES)


def _special(ending: str, make: Callable[[Path], object]) -> Attack:
    def write(folder: Path) -> Path:
        path = folder / f"scan{ending}"
        make(path)
        return path

    return write


def _file(ending: str, content: bytes | Callable[[], bytes]) -> Attack:
    return _special(ending, lambda path: path.write_bytes(content() if callable(content) else content))


def _link(ending: str, target: str) -> Attack:
    return _special(ending, lambda path: path.symlink_to(target))


def _ply_header(*lines: str, encoding: str = LITTLE) -> bytes:
    return "".join(f"{line}\n" for line in ("ply", f"format {encoding} 1.0", *lines, "end_header")).encode()


def _vertices(count: int) -> list[str]:
    return [f"element vertex {count}", *[f"property float {axis}" for axis in "xyz"]]


def _lying_list(kind: str, length: bytes, items: str = "double") -> bytes:
    """A binary PLY file whose one face says that it has so many corners."""
    header = _ply_header(*_vertices(3), "element face 1", f"property list {kind} {items} vertex_indices")
    return header + bytes(36) + length + bytes(64)


def _wide_rows(encoding: str, kind: str) -> bytes:
    """Rows of 900 properties announced, in a file that holds a byte or two of each."""
    wide = [f"property {kind} p{i}" for i in range(900)]
    body = b"1\n" * 500_000 if encoding == "ascii" else bytes(500_000)
    header = _ply_header(*_vertices(1), *wide, "element face 400000", *wide, encoding=encoding)
    return header.replace(b"vertex 1\n", b"vertex 100000\n") + body


def _sharing_parts(parts: int, nodes: int) -> bytes:
    """A scene in which so many parts of so many nodes are one and the same large array."""
    scene = Gltf([[(np.zeros((19_998, 3)), None, None)]], [{"mesh": 0}] * nodes, range(nodes))
    scene.tree["meshes"][0]["primitives"] *= parts
    return scene.glb()


def _sharing_nodes(count: int, **node: Any) -> bytes:
    """As many nodes that share a mesh and a skin, of as many parts without triangles and joints."""
    tree = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, **node}] * count,
        "meshes": [{"primitives": [{"mode": 0 if not node else 4, "attributes": {"POSITION": 0}}] * count}],
        "skins": [{"joints": [*range(count)]}],
        "accessors": [{"count": 0, "componentType": 5126, "type": "VEC3", "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 0}],
        "buffers": [{"byteLength": 0, "uri": "data:,"}],
    }
    return json.dumps(tree).encode()


def _scene(part: str, **entries: Any) -> bytes:
    scene = box_scene()
    scene.tree[part][0].update(entries)
    return scene.glb()


def _entities() -> bytes:
    """XML whose entities contain each other, ten levels deep."""
    lines = ['<!ENTITY a0 "boom">', *(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))]
    return f'<?xml version="1.0"?>\n<!DOCTYPE GIFTI [{"".join(lines)}]>\n<GIFTI>&a9;</GIFTI>'.encode()


def _gifti_data(data: bytes) -> bytes:
    """The box with other bytes in place of its coordinates."""
    before, _, rest = _GIFTI.partition(b"<Data>")
    return before + b"<Data>" + data + b"</Data>" + rest.partition(b"</Data>")[2]


def _of_components(number: int, inner: int) -> str:
    """An object that holds another one ten times."""
    return f'<object id="{number}"><components>{f"""<component objectid="{inner}"/>""" * 10}</components></object>'


def _changed_length(content: bytes) -> bytes:
    """An archive whose last entry says that it unpacks to a terabyte, which no file of this length does."""
    place = content.rindex(b"PK\1\2") + 24
    return content[:place] + b"\xfe\xff\xff\xff" + content[place + 4 :]


def _gmsh_with(order: str, what: str, number: int) -> bytes:
    """A Gmsh mesh that announces so many blocks, nodes of a block, or cells of one."""
    before, count = {"blocks": ((), 2), "nodes": ((2, 1, 1), 7), "cells": ((2, 1, 2), 12)}[what]
    old, new = (
        struct.pack(f"<{len(before)}iQ", *before, some)
        if order
        else (b"%d %d %d\n%d\n" % (*before, some) if before else b"$Nodes\n%d " % some)
        for some in (count, number)
    )
    return _changed(gmsh(BOX_VERTICES, BOX_TRIANGLES, order), old, new)


@cache
def _bomb(content: bytes) -> bytes:
    """Two hundred megabytes of one byte, packed a thousandfold."""
    packer = zlib.compressobj(9, wbits=31)
    megabyte = content * _MEGABYTE
    return b"".join([*(packer.compress(megabyte) for _ in range(200)), packer.flush()])


def _packed_zeros(megabytes: int) -> bytes:
    return base64.b64encode(zlib.compress(bytes(megabytes * _MEGABYTE), 9))


def _packed(ending: str, content: Callable[[], bytes]) -> Attack:
    """A packed file that unpacks to no more than the harmless size, or to less than a hundredfold."""
    return _file(f"{ending}.gz", lambda: gzip.compress(content(), 6, mtime=0))


def _with_noise(start: bytes, end: bytes) -> bytes:
    """A hundred megabytes of ones in XML, beside so much that cannot be packed that they are not refused as a bomb."""
    noise = np.random.default_rng(1).bytes(3 * _MEGABYTE // 2).hex().encode()
    return start + b"1" * (100 * _MEGABYTE) + end + noise


def _sparse(ending: str, start: bytes) -> Attack:
    """A file that seems to have a terabyte and takes no room on the disk."""

    def make(path: Path) -> None:
        path.write_bytes(start)
        os.truncate(path, 1 << 40)

    return _special(ending, make)


def _changed(content: bytes, old: bytes, new: bytes) -> bytes:
    assert old in content
    return content.replace(old, new, 1)


_OBJ, _PLY = obj(BOX_VERTICES, BOX_TRIANGLES), ply(BOX_VERTICES, BOX_TRIANGLES)
_DIGITS = b"9" * 5000
_FORMATS = (".ply", ".obj", ".stl", ".off", ".gltf", ".glb", ".gii", "_lh.pial", ".mesh", ".msh", ".3mf")

ATTACKS: dict[str, Attack] = {
    # What is no file.
    **{f"FIFO {ending}": _special(ending, os.mkfifo) for ending in (*_FORMATS, ".ply.gz")},
    **{f"endless device {ending}": _link(ending, "/dev/zero") for ending in (*_FORMATS, ".ply.gz")},
    "link to itself": _link(".ply", "scan.ply"),
    "NUL in the name": lambda folder: folder / "a\0b.ply",
    # Packed.
    **{f"bomb {ending}.gz": _file(f"{ending}.gz", partial(_bomb, b"\0")) for ending in _FORMATS},
    "bomb of newlines .obj.gz": _file(".obj.gz", partial(_bomb, b"\n")),
    "many empty gzip members": _file(".ply.gz", gzip.compress(b"") * 20_000),
    # One line, many lines, many digits.
    **{f"one long line {ending}": _file(ending, b"1 " * _MEGABYTE) for ending in _FORMATS},
    **{f"one long word {ending}": _file(ending, b"9" * 2 * _MEGABYTE) for ending in _FORMATS},
    **{f"newlines {ending}": _file(ending, b"\n" * 2 * _MEGABYTE) for ending in _FORMATS},
    "obj, face of many corners": _file(".obj", b"v 0 0 0\nv 1 0 0\nf" + b" 1" * _MEGABYTE + b" 0\n"),
    "obj, a face that goes around and around": _file(
        ".obj", _OBJ + b"v nan 0 0\nf 1 2 -1\nf" + b" 1 2 3" * 100_000 + b"\n"
    ),
    "obj, a face that goes around and around, and back elsewhere": _file(
        ".obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 3 0 0\nv 2 1 0\nv nan 0 0\nf 1 2 7\n"
        + b"f%s%s\n" % (b" 1 2 3" * 4000, b" 6 5 4" * 3999),
    ),
    "obj, continued lines": _file(".obj", b"v 0 0 0\nf 1 \\\n" + b"1 \\\n" * 500_000),
    "obj, long index": _file(".obj", _OBJ + b"f 1 2 " + _DIGITS + b"\n"),
    "obj, huge index": _file(".obj", _OBJ + b"f 1 2 9223372036854775808\n"),
    "obj, huge coordinate": _file(".obj", obj(BOX_VERTICES * 1e300, BOX_TRIANGLES)),
    "obj, one wide character": _file(".obj", "\U0001f600\n".encode() + b"#" * 2 * _MEGABYTE),
    "off, long counts": _file(".off", b"OFF\n" + _DIGITS + b" 1 0\n0 0 0\n3 0 0 0\n"),
    "off, other digits": _file(".off", "OFF\n² 1 0\n0 0 0\n".encode()),
    "stl ascii, long name": _file(".stl", stl_text(BOX_VERTICES * 1e300, BOX_TRIANGLES, "x" * _MEGABYTE)),
    "stl ascii, unknown long word": _file(".stl", b"solid\n" + b"y" * _MEGABYTE),
    "stl, sparse": _sparse(".stl", b"\0" * 84),
    # PLY.
    "ply, many digits": _file(".ply", _ply_header(f"element vertex {'9' * 5000}", "element face 1")),
    "ply, list of 2^32 - 1": _file(".ply", _lying_list("uint", b"\xff" * 4)),
    "ply, list of -1": _file(".ply", _lying_list("int", b"\xff" * 4)),
    "ply, list of NaN": _file(".ply", _lying_list("float", b"\xff" * 4)),
    **{
        f"ply {encoding}, wide rows of {kind}": _file(".ply", partial(_wide_rows, encoding, kind))
        for encoding in ("ascii", LITTLE)
        for kind in ("double", "list uchar double")
    },
    "ply, endless header": _file(".ply", b"ply\nformat ascii 1.0\n" + b"comment\n" * 250_000),
    "ply, many elements": _file(".ply", _ply_header(*[f"element e{i} 0" for i in range(100_000)], encoding="ascii")),
    "ply, many properties": _file(
        ".ply",
        _ply_header(
            *_vertices(0), *[f"property char p{i}" for i in range(100_000)], "element face 0", encoding="ascii"
        ),
    ),
    "ply ascii, rows of nothing": _file(".ply", _ply_header("element nothing 100000000", encoding="ascii") + b"1\n"),
    "ply, sparse": _sparse(".ply", _ply_header(*_vertices(10**9), "element face 0")),
    "ply ascii, float overflow": _file(".ply", ply(BOX_VERTICES * 1e300, BOX_TRIANGLES)),
    "ply ascii, index that overflows": _file(".ply", _changed(_PLY, b"3 4 6 7", b"3 4 6 99999999999")),
    "ply, indices with fractions": _file(".ply", ply(BOX_VERTICES, [[0, 1, 2.5]], LITTLE, index="float")),  # type: ignore[list-item]
    # glTF.
    "gltf, deep lists": _file(".gltf", b"[" * 200_000),
    "gltf, millions of nodes unpacked": _packed(
        ".gltf", lambda: b'{"asset":{"version":"2.0"},"nodes":[' + b"{}," * (5 * _MEGABYTE // 4) + b"{}]}"
    ),
    "gltf, many nodes in a row": _file(
        ".gltf", json.dumps({"nodes": [{"children": [i + 1]} for i in range(30_000)]}).encode()
    ),
    "glb, stride 0": _file(".glb", _scene("bufferViews", byteStride=0)),
    "glb, count of many digits": _file(".glb", _scene("accessors", count=10**400)),
    "glb, one array in many parts": _file(".glb", partial(_sharing_parts, 10_000, 1)),
    "glb, one part in many nodes": _file(".glb", partial(_sharing_parts, 1, 10_000)),
    "gltf, points in many nodes": _file(".gltf", partial(_sharing_nodes, 20_000)),
    "gltf, empty parts in many nodes": _file(".gltf", partial(_sharing_nodes, 2000, name="node")),
    "gltf, a skin of many nodes": _file(".gltf", partial(_sharing_nodes, 300, skin=0)),
    "glb, huge matrix": _file(".glb", _scene("nodes", scale=[1e308, 1e308, 1e308])),
    "glb, rotation of strings": _file(".glb", _scene("nodes", rotation=["1"] * 4)),
    "glb, chunk that lies": _file(".glb", struct.pack("<4sIIII", b"glTF", 2, 20, 2**32 - 1, 0)),
    **{
        f"gltf, buffer {uri}": _file(".gltf", box_scene().gltf(uri))
        for uri in ("data.bin", "../data.bin", "/dev/zero", "http://127.0.0.1:9/data.bin", "a%00b.bin")
    },
    # GIFTI.
    "gifti, a billion laughs": _file(".gii", _entities()),
    "gifti, entity of a file": _file(
        ".gii", b'<!DOCTYPE GIFTI [<!ENTITY a SYSTEM "file:///etc/hostname">]>' + _gifti_data(b"&a;")[21:]
    ),
    "gifti, entities in UTF-16": _file(".gii", _entities().decode().encode("utf-16")),
    "gifti, bomb": _file(".gii", lambda: _gifti_data(_packed_zeros(200))),
    "gifti, bomb that is announced": _file(
        ".gii", lambda: _changed(_gifti_data(_packed_zeros(240)), b'Dim0="8"', b'Dim0="%d"' % (20 * _MEGABYTE))
    ),
    "gifti, text without end": _file(
        ".gii",
        gifti(BOX_VERTICES, _INT_TRIANGLES, "GIFTI_ENCODING_ASCII").replace(
            b"<Data>", b"<Data>" + b"1 " * _MEGABYTE, 1
        ),
    ),
    "gifti, many dimensions": _file(".gii", _changed(_GIFTI, b'Dimensionality="2"', b'Dimensionality="99999999"')),
    "gifti, dimensions that overflow": _file(".gii", _changed(_GIFTI, b'Dim0="8"', b'Dim0="' + b"9" * 4000 + b'"')),
    "gifti, deep elements": _file(".gii", b"<GIFTI>" + b"<MetaData>" * 100_000),
    "gifti, long attribute": _file(".gii", b'<GIFTI Version="' + b"1" * 2 * _MEGABYTE + b'">'),
    "gifti, data of another file": _file(
        ".gii",
        _changed(_GIFTI, b'Encoding="GZipBase64Binary"', b'Encoding="ExternalFileBinary"').replace(
            b'ExternalFileName=""', b'ExternalFileName="/etc/passwd"', 1
        ),
    ),
    # Small on the disk, and long once they are unpacked.
    "gifti, long attribute unpacked": _packed(".gii", lambda: _with_noise(b'<GIFTI Version="', b'">')),
    "gifti, long comment unpacked": _packed(".gii", lambda: _with_noise(b"<GIFTI><!--", b"-->")),
    "gifti, deep elements unpacked": _packed(".gii", lambda: b"<GIFTI>" + b"<a>" * 5 * _MEGABYTE),
    "gifti, many elements unpacked": _packed(
        ".gii", lambda: _GIFTI.replace(b"<DataArray", b"<MD/>" * 3 * _MEGABYTE + b"<DataArray", 1)
    ),
    "obj, short lines unpacked": _packed(".obj", lambda: b"v\n" * 7 * _MEGABYTE),
    "obj, long line unpacked": _packed(".obj", lambda: b"f" + b" 11" * 5 * _MEGABYTE + b"\n"),
    "obj, continued lines unpacked": _packed(".obj", lambda: b"f" + b" 11\\\n" * 3 * _MEGABYTE),
    "obj, faces unpacked": _packed(".obj", lambda: b"v 0 0 0\n" + b"f 1 1 1\n" * (3 * _MEGABYTE // 2)),
    "off, short lines unpacked": _packed(".off", lambda: b"OFF\n" + b"1\n" * 7 * _MEGABYTE),
    "stl ascii, short lines unpacked": _packed(".stl", lambda: b"solid\n" + b"facet\n" * 2 * _MEGABYTE),
    "ply ascii, short lines unpacked": _packed(
        ".ply", lambda: _ply_header(*_vertices(3), "element face 1", encoding="ascii") + b"1\n" * 7 * _MEGABYTE
    ),
    "ply ascii, long line unpacked": _packed(
        ".ply",
        lambda: (
            _ply_header("element vertex 1", "property list uint uchar x", "element face 1", encoding="ascii")
            + b"5242880"
            + b" 11" * 5 * _MEGABYTE
            + b"\n1\n"
        ),
    ),
    # 3MF.
    "3mf, bomb": _file(".3mf", lambda: package_3mf(model("") + b" " * 200 * _MEGABYTE)),
    "3mf, bomb in another part": _file(
        ".3mf",
        lambda: package_3mf(model("", '<item objectid="1" p:path="/a"/>'), a=model("") + b" " * 200 * _MEGABYTE),
    ),
    "3mf, entities": _file(".3mf", package_3mf(_entities().replace(b"GIFTI", b"model"))),
    "3mf, a part outside": _file(".3mf", package_3mf(model("", '<item objectid="1" p:path="../../etc/passwd"/>'))),
    "3mf, an object of itself": _file(".3mf", package_3mf(model(_of_components(1, 1) * 2))),
    "3mf, objects of objects": _file(
        ".3mf", package_3mf(model("".join(_of_components(i, i + 1) for i in range(1, 25))))
    ),
    "3mf, supports of supports": _file(
        ".3mf",
        package_3mf(
            model("".join(_of_components(i, i + 1) for i in range(1, 25)) + object_3mf([], [], 25, 'type="support"'))
        ),
    ),
    "3mf, many items": _file(".3mf", package_3mf(model(object_3mf([], []), '<item objectid="1"/>' * 300_000))),
    "3mf, a length that lies": _file(".3mf", lambda: _changed_length(package_3mf(model("") + b" " * 9999))),
    # Medit and Gmsh.
    "medit, a count of many digits": _file(".mesh", b"MeshVersionFormatted 2 Dimension 3 Vertices " + _DIGITS),
    "medit, comments unpacked": _packed(".mesh", lambda: b"MeshVersionFormatted 2\n" + b"#\n" * 7 * _MEGABYTE),
    "medit, names unpacked": _packed(".mesh", lambda: b"MeshVersionFormatted 2\n" + b'"a' * 7 * _MEGABYTE),
    "medit, many sections": _file(".mesh", b"MeshVersionFormatted 2 Dimension 3 " + b"Aaa 1 " * 300_000),
    "medit, many cells": _file(".mesh", b"MeshVersionFormatted 2 Dimension 3 Triangles 9e18 Vertices 1e300"),
    "gmsh, blocks that go back": _file(
        ".msh",
        gmsh(BOX_VERTICES, BOX_TRIANGLES).replace(
            b"$Nodes\n2 8 3 80\n2 1 1\n7\n", b"$Nodes\n999999999999999 8 3 80\n2 1 1\n-4\n"
        ),
    ),
    **{
        f"gmsh {order or 'text'}, {what} of {number}": _file(".msh", _gmsh_with(order, what, number))
        for order in ("", "<")
        for what in ("blocks", "nodes", "cells")
        for number in (2**31, 2**62, 2**64 - 1)
    },
    "gmsh, sections that begin again": _file(".msh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n" + b"$Nodes\n" * 100_000),
    # VTK.
    "vtk, many pieces": _file(".vtp", b'<VTKFile type="PolyData">' + b"<Piece/>" * 30_000 + b"</VTKFile>"),
    # FreeSurfer.
    "freesurfer, endless line": _file("_lh.pial", b"\xff\xff\xfe" + b"x" * 2 * _MEGABYTE),
    "freesurfer, sparse": _sparse("_lh.pial", b"\xff\xff\xfe\n\n" + b"\x7f\xff\xff\xff" * 2),
}
