"""Readers under random damage: they end in a mesh or a MeshError, in silence and in time.

A mutant may have another area than its file for one of three reasons. It has the words and the length of the file, with
other numbers, so that it is a file of another surface. Or a note says what is odd. Or another reader of the format
agrees, where the format has nothing that tells, such as a face of an OBJ file that is no longer there.
"""

from __future__ import annotations

import gzip
import math
import re
import resource
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import meshio
import nibabel
import numpy as np
import pytest
import pyvista
import trimesh
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from sobolev_batch import Mesh, read_mesh
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.readers import expected_size
from tests.support.mesh_files import (
    BOXES,
    LITTLE,
    Content,
    gmsh,
    gmsh_first_binary,
    obj,
    off,
    off_binary,
    ply,
    write_with,
)
from tests.support.shapes import BOX_MIXED, BOX_VERTICES

# Of this process alone. Reading the box takes milliseconds.
_LONGEST_SECONDS, _MOST_BYTES = 5.0, 500e6
_KINDS: dict[str, Content] = {
    **BOXES,
    "ply little polygons": (".ply", ply(BOX_VERTICES, BOX_MIXED, LITTLE)),
    "ply ascii polygons": (".ply", ply(BOX_VERTICES, BOX_MIXED)),
    "obj polygons": (".obj", obj(BOX_VERTICES, BOX_MIXED)),
    "off polygons": (".off", off(BOX_VERTICES, BOX_MIXED)),
    "off vertices on a line": (".off", off(BOX_VERTICES, BOX_MIXED).replace(b".0\n", b".0 ")),
    "off binary": (".off", off_binary(BOX_VERTICES, BOX_MIXED)),
    "gmsh 2.2 big polygons": (".msh", gmsh_first_binary(BOX_VERTICES, BOX_MIXED, ">")),
    "gmsh 4.1 polygons": (".msh", gmsh(BOX_VERTICES, BOX_MIXED)),
    "ply gzipped": (".ply.gz", gzip.compress(BOXES["ply ascii float"][1], mtime=0)),
}


def _of_vtk() -> Iterator[tuple[str, Content]]:
    """Yield the box as VTK writes it: both versions, in text and binary, and all forms of XML."""
    box = pyvista.PolyData(np.array(BOX_VERTICES, np.float64), [i for face in BOX_MIXED for i in (len(face), *face)])
    writers: list[tuple[str, str, Any]] = []
    for version in (42, 51):
        for is_binary in (0, 1):
            writer = vtkPolyDataWriter()
            writer.SetFileVersion(version)
            writer.SetFileType(1 + is_binary)
            writers.append((f"vtk {version}{' binary' * is_binary}", ".vtk", writer))
    for suffix, kind in ((".vtp", vtkXMLPolyDataWriter), (".vtu", vtkXMLUnstructuredGridWriter)):
        for name, mode, in_base64, is_packed in (
            ("text", 0, 0, 0),
            ("binary", 1, 0, 0),
            ("packed", 1, 0, 1),
            ("appended", 2, 0, 0),
            ("appended and packed", 2, 0, 1),
            ("appended in base64", 2, 1, 1),
        ):
            writer = kind()
            writer.SetDataMode(mode)
            writer.SetEncodeAppendedData(bool(in_base64))
            (writer.SetCompressorTypeToZLib if is_packed else writer.SetCompressorTypeToNone)()
            writers.append((f"{suffix[1:]} {name}", suffix, writer))
    with TemporaryDirectory() as folder:
        for name, suffix, writer in writers:
            path = Path(folder, f"box{suffix}")
            writer.SetInputData(box.cast_to_unstructured_grid() if suffix == ".vtu" else box)
            writer.SetFileName(str(path))
            write_with(writer)
            yield name, (suffix, path.read_bytes())


_KINDS |= dict(_of_vtk())


# Numbers that have broken readers before.
_NUMBERS = ["-1", "0", "1", "2", "7", "8", "9", "255", "256", "65536", "-2147483648", "2147483648", "4294967295"]
_NUMBERS += ["9223372036854775807", "18446744073709551616", "9" * 40, "9" * 400, "9" * 5000, "1e300", "1e999", "nan"]
_NUMBERS += ["-inf", "1_0", "0x10", "1.5", "", "-", "²", "１"]

_TOKENS = [b"\0", b"\n", b" ", b'"', b"\xff", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", b"[", b"{}"]
_TOKENS += [b"end_header\n", b"element face 9\n", b"property list int double vertex_indices\n", b"f 1 2 3 4 5\n", b"#"]
_TOKENS += [b"<", b"null", b'"byteStride":0,', b"<Data>", b"</DataArray>", b"&a;", b'Dim0="99"', b"\xf0\x9f\x98\x80"]


def _ends_well(path: Path, content: bytes) -> Mesh | None:
    """Read a file and estimate its size: nothing but a mesh or a MeshError, no warning, no lie believed."""
    path.write_bytes(content)
    mesh = None
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
    return mesh


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


_NICKS = [b"\0", b"\n", b"\r", b"\t", b"\xff", *(bytes([code]) for code in b' "#<0-.e/_$f[')]


def _nicked(content: bytes, random: Random) -> bytes:
    """A valid file after one small accident."""
    place, other = (random.randrange(len(content)) for _ in range(2))
    accident = random.choice(["flip", "cut", "lose", "insert", "number", "drop", "repeat", "swap", "drop", "repeat"])
    if accident == "flip":
        return content[:place] + bytes([content[place] ^ (1 << random.randrange(8))]) + content[place + 1 :]
    if accident == "cut":
        return content[:place]
    if accident == "lose":
        return content[:place] + content[place + random.choice([1, 1, 2, 4, 12]) :]
    if accident == "insert":
        return content[:place] + random.choice(_NICKS) + content[place:]
    if accident == "number":
        spans = [match.span() for match in re.finditer(rb"-?\d+(?:\.\d+)?", content)]
        start, end = random.choice(spans or [(0, 0)])
        return content[:start] + random.choice(_NUMBERS).encode() + content[end:]
    between = random.choice([b"\n", b" "])
    parts = content.split(between)
    place, other = place % len(parts), other % len(parts)
    if accident == "drop":
        del parts[place]
    elif accident == "repeat":
        parts.insert(place, parts[place])
    else:
        parts[place], parts[other] = parts[other], parts[place]
    return between.join(parts)


_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?")


def _holds_other_numbers(content: bytes, mutant: bytes) -> bool:
    """Tell whether a mutant differs from its file in nothing but numbers: in text, or in binary of the same length."""
    if b"\0" in content or b"base64" in content or b'format="binary"' in content:
        return len(mutant) == len(content)
    first, second = (_NUMBER.sub(b"#", text).split() for text in (content, mutant))
    return first == second


def _newell(vertices: Any, faces: Any) -> float:
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    return float(np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1), axis=1).sum()) / 2


def _by_trimesh(path: Path) -> float:
    mesh: Any = trimesh.load(path, process=False, force="mesh")
    return _newell(mesh.vertices, mesh.faces)


def _by_meshio(path: Path) -> float:
    mesh = meshio.read(path)
    return sum(
        _newell(mesh.points, cells.data) for cells in mesh.cells if cells.type in ("triangle", "quad", "polygon")
    )


def _by_nibabel(path: Path) -> float:
    if path.suffix == ".gii":
        return _newell(*nibabel.load(path).agg_data(("pointset", "triangle")))
    return _newell(*nibabel.freesurfer.read_geometry(path))


_PEERS: tuple[Callable[[Path], float], ...] = (_by_trimesh, _by_meshio, _by_nibabel)


def _agrees(peer: Callable[[Path], float], path: Path, area: float) -> bool:
    """Tell whether another reader finds the same area; where it fails, it does not."""
    try:
        return math.isclose(peer(path), area, rel_tol=1e-6)
    except (Exception, SystemExit):  # meshio ends the process on some files
        return False


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("examples", [15, pytest.param(1000, marks=pytest.mark.all)])
@pytest.mark.parametrize("name", _KINDS)
def test_a_mutant_has_another_area_only_with_a_reason(
    tmp_path: Path, record_property: Callable[[str, object], None], name: str, examples: int
) -> None:
    ending, content = _KINDS[name]
    path, random, counts = tmp_path / f"scan{ending}", Random(name), dict.fromkeys(("refused", "same", "other"), 0)
    path.write_bytes(content)
    area = read_mesh(path).area
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(examples):
        mutant = _nicked(content, random)
        mesh = _ends_well(path, mutant)
        is_other = mesh is not None and not math.isclose(mesh.area, area, rel_tol=1e-9)
        counts["refused" if mesh is None else "other" if is_other else "same"] += 1
        if mesh is not None and is_other and not mesh.notes and not _holds_other_numbers(content, mutant):
            assert any(_agrees(peer, path, mesh.area) for peer in _PEERS), (mesh.area, mutant)
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < _MOST_BYTES
    record_property("mutants", counts)
