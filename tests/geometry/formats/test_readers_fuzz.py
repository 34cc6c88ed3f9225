"""Readers under random damage: they end in a mesh or a MeshError, in silence and in time."""

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

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.readers import expected_size
from tests.support.mesh_files import BOXES, LITTLE, Content, ply
from tests.support.shapes import BOX_MIXED, BOX_VERTICES

# Of this process alone. Reading the box takes milliseconds.
_LONGEST_SECONDS = 5.0
_KINDS: dict[str, Content] = {
    **BOXES,
    "ply little polygons": (".ply", ply(BOX_VERTICES, BOX_MIXED, LITTLE)),
    "ply gzipped": (".ply.gz", gzip.compress(BOXES["ply ascii float"][1], mtime=0)),
}


# Numbers that have broken readers before.
_NUMBERS = ["-1", "0", "1", "2", "7", "8", "9", "255", "256", "65536", "-2147483648", "2147483648", "4294967295"]
_NUMBERS += ["9223372036854775807", "18446744073709551616", "9" * 40, "9" * 400, "9" * 5000, "1e300", "1e999", "nan"]
_NUMBERS += ["-inf", "1_0", "0x10", "1.5", "", "-", "²", "１"]

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


@pytest.mark.slow
@pytest.mark.parametrize("examples", [15, pytest.param(300, marks=pytest.mark.all)])
@pytest.mark.parametrize("name", _KINDS)
def test_damaged_files_end_in_a_mesh_or_a_mesh_error(tmp_path: Path, name: str, examples: int) -> None:
    ending, content = _KINDS[name]
    random = Random(name)
    for _ in range(examples):
        _ends_well(tmp_path / f"scan{ending}", _damaged(content, random))
