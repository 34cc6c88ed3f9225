"""Files as people write them: the right area, known by hand, or the true reason why they are refused."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from tests.support.mesh_files import BIG, LITTLE, ply
from tests.support.shapes import BOX_AREA, BOX_TRIANGLES, BOX_VERTICES

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


CASES: dict[str, Case] = {
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
            "X for x": re.sub(rb"(float) (.)\n", lambda found: found[0].upper().replace(b"FLOAT", b"float"), PLY_BOX),
            "lengths in single precision": replaced(PLY_BOX, (b"list uchar", b"list float")),
            "references of 64 bits": replaced(
                re.sub(rb"(\n3 \d \d \d)", rb"\1 9007199254740993", PLY_BOX),
                (b"vertex_indices\n", b"vertex_indices\nproperty int64 medit:ref\n"),
            ),
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
        "holds points and no surface",
    ),
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
