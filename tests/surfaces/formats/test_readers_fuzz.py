"""Readers under random bytes and random damage: they end in a mesh or a MeshError, in silence and in time."""

from __future__ import annotations

import gzip
import math
import re
import time
import warnings
from pathlib import Path
from random import Random

import numpy as np
import pytest

from sobolev_batch import MeshError, read_mesh
from sobolev_batch.surfaces.formats.readers import expected_size
from tests.support.mesh_files import BOXES, LITTLE, Content, ply
from tests.support.shapes import BOX_MIXED, BOX_VERTICES

# Of this process alone. Reading the box takes milliseconds.
_LONGEST_SECONDS = 5.0
_KINDS: dict[str, Content] = {
    **BOXES,
    "ply little polygons": (".ply", ply(BOX_VERTICES, BOX_MIXED, LITTLE)),
    "ply gzipped": (".ply.gz", gzip.compress(BOXES["ply ascii float"][1], mtime=0)),
}
_PLY_HEADERS = [
    content[: content.index(b"end_header\n") + len(b"end_header\n")] for end, content in BOXES.values() if end == ".ply"
]
# What a format begins with, so that random bytes get past the first look.
_STARTS: dict[str, tuple[bytes, ...]] = {
    ".ply": (b"", *_PLY_HEADERS),
    ".obj": (b"", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf "),
    ".off": (b"", b"OFF\n", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n"),
    ".stl": (b"", b"solid\n", b"solid\nfacet normal 0 0 0\nouter loop\nvertex ", bytes(80) + b"\1\0\0\0"),
    ".gltf": (b"", b"{", b'{"nodes": [{"mesh": 0}], "meshes": '),
    ".glb": (b"", BOXES["glb"][1][:20]),
    ".gii": (b"", b"<GIFTI>", BOXES["gifti ascii"][1].partition(b"<Data>")[0] + b"<Data>"),
    "_lh.pial": (b"", b"\xff\xff\xfe", b"\xff\xff\xff", b"\xff\xff\xfed\n\n\0\0\0\3\0\0\0\1"),
    ".ply.gz": (b"", b"\x1f\x8b", gzip.compress(b"", mtime=0)),
}
# Numbers that have broken readers before.
_NUMBERS = ["-1", "0", "1", "2", "7", "8", "9", "255", "256", "65536", "-2147483648", "2147483648", "4294967295"]
_NUMBERS += ["9223372036854775807", "18446744073709551616", "9" * 40, "9" * 400, "9" * 5000, "1e300", "1e999", "nan"]
_NUMBERS += ["-inf", "1_0", "0x10", "1.5", "", "-", "²", "１"]
_WORDS = [*_NUMBERS, "v", "f", "facet", "vertex", "endloop", "solid", "3", "0 1 2", "\n", "\n3 "]
_TOKENS = [b"\0", b"\n", b" ", b'"', b"\xff", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", b"[", b"{}"]
_TOKENS += [b"end_header\n", b"element face 9\n", b"property list int double vertex_indices\n", b"f 1 2 3 4 5\n", b"#"]
_TOKENS += [b"<", b"null", b'"byteStride":0,', b"<Data>", b"</DataArray>", b"&a;", b'Dim0="99"', b"\xf0\x9f\x98\x80"]


def _ends_well(path: Path, content: bytes) -> None:
    """Read a file and estimate its size: nothing but a mesh or a MeshError, no warning, no lie believed."""
    path.write_bytes(content)
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        triangles, memory_bytes = expected_size(path)
        try:
            mesh = read_mesh(path)
        except MeshError as error:
            assert str(error).startswith(f"{path}: ")  # noqa: PT017
            assert len(str(error)) < len(str(path)) + 400  # noqa: PT017
            # A warning that an "except Exception" swallowed.
            assert not re.search(r"Warning\b", str(error))  # noqa: PT017
        else:
            assert np.isfinite(mesh.vertices).all()
            assert mesh.triangles.min() >= 0
            assert mesh.triangles.max() < len(mesh.vertices)
            assert math.isfinite(mesh.area)
            assert mesh.area > 0
            assert mesh.counts["zero_area_triangles"] < len(mesh.triangles)
            assert math.isfinite(mesh.edge_length_range[1])
    assert time.process_time() - start < _LONGEST_SECONDS
    held_bytes = len(content) * (4 if path.suffix == ".gz" else 1)
    assert isinstance(triangles, int)
    assert 0 <= triangles <= held_bytes
    assert 0 <= memory_bytes <= 1300 * held_bytes


def _damaged(content: bytes, random: Random) -> bytes:
    """A valid file after a few accidents."""
    for _ in range(random.randint(1, 4)):
        start, end = random.randint(0, len(content)), random.randint(0, len(content))
        new = random.choice([b"", *_TOKENS, random.randbytes(random.randint(0, 12))])
        accident = random.choice(["flip", "cut", "insert", "splice", "number", "number", "word"])
        if accident == "flip":
            end, new = start + 1, bytes(byte ^ (1 << random.randint(0, 7)) for byte in content[start : start + 1])
        elif accident == "cut":
            end, new = len(content), b""
        elif accident == "insert":
            end = start
        elif accident != "splice":
            pattern = rb"-?\d+(?:\.\d+)?" if accident == "number" else rb"[A-Za-z_]+"
            found = [match.span() for match in re.finditer(pattern, content)]
            start, end = random.choice(found[:40] or [(0, 0)])
            new = random.choice(_NUMBERS).encode() if accident == "number" else random.randbytes(random.randint(0, 8))
        # The end may come before the start: then a part is repeated.
        content = content[:start] + new + content[end:]
    return content


def _made_up(ending: str, random: Random) -> bytes:
    """The beginning of a file, perhaps a header that lies, and bytes, tokens or words and numbers behind it."""
    start = random.choice(_STARTS[ending])
    if ending == ".ply" and random.randrange(2):
        vertices, faces, kind = random.choice(_NUMBERS), random.choice(_NUMBERS), random.choice(["ascii", LITTLE])
        lines = ["ply", f"format {kind} 1.0", f"element vertex {vertices}", *[f"property float {x}" for x in "xyz"]]
        lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header", ""]
        start = "\n".join(lines).encode()
    match random.randrange(3):
        case 0:
            return start + random.randbytes(random.randrange(300))
        case 1:
            return start + b" ".join(random.choices(_TOKENS, k=random.randrange(30)))
        case _:
            return start + " ".join(random.choices(_WORDS, k=random.randrange(40))).encode()


EXAMPLES = pytest.mark.parametrize("examples", [15, pytest.param(300, marks=pytest.mark.all)])


@pytest.mark.slow
@EXAMPLES
@pytest.mark.parametrize("name", _KINDS)
def test_damaged_files_end_in_a_mesh_or_a_mesh_error(tmp_path: Path, name: str, examples: int) -> None:
    ending, content = _KINDS[name]
    random = Random(name)
    for _ in range(examples):
        _ends_well(tmp_path / f"scan{ending}", _damaged(content, random))


@pytest.mark.slow
@EXAMPLES
@pytest.mark.parametrize("ending", _STARTS)
def test_any_bytes_end_in_a_mesh_or_a_mesh_error(tmp_path: Path, ending: str, examples: int) -> None:
    random = Random(ending)
    for _ in range(examples):
        _ends_well(tmp_path / f"scan{ending}", _made_up(ending, random))
