"""PLY files, parsed by the library plyfile."""

from __future__ import annotations

import io
import re
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyElementParseError

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.polygons import fans_of_lists

Raw = tuple[NDArray[np.floating], NDArray[np.int64]]

_CORNERS = ("vertex_indices", "vertex_index")


def parse_ply(data: bytes) -> Raw:
    """Vertices and triangles of a PLY file, in its own precision.

    Raises:
        MeshError: no vertices or faces, or counts that do not fit what follows.
    """
    header, found, body = data.partition(b"end_header")
    counts = {name.decode(): int(count) for name, count in re.findall(rb"^element\s+(\w+)\s+(\d+)", header, re.M)}
    if not found or "vertex" not in counts or "face" not in counts:
        raise MeshError("the PLY header does not announce vertices and faces")
    # Every element takes at least a byte: a count beyond that would only reserve memory.
    if sum(counts.values()) > len(body):
        raise MeshError(f"the PLY header announces {counts}, but only {len(body)} bytes follow")
    text = re.search(rb"^format\s+ascii", header, re.M) is not None
    lines = sum(1 for line in body.splitlines()[1:] if line.strip()) if text else sum(counts.values())
    if lines != sum(counts.values()):
        raise MeshError(f"the PLY header announces {sum(counts.values())} entries, found {lines}")
    try:
        # Reads all faces at once; the library refuses it where one of them is no triangle.
        ply, left = _read(data, text, {"face": dict.fromkeys(_CORNERS, 3)})
    except (PlyElementParseError, KeyError):
        ply, left = _read(data, text, {})
    if left:
        raise MeshError(f"the PLY header announces {counts}, but {left} bytes more follow")
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1)
    return vertices, _triangles(ply["face"])


def _read(data: bytes, text: bool, lengths: dict[str, dict[str, int]]) -> tuple[PlyData, int]:
    """The parsed file, and how many bytes of a binary one were left over."""
    if text:
        # The library closes the stream of a text; there, lines are counted.
        return PlyData.read(io.BytesIO(data), known_list_len=lengths), 0
    # A real file, since of any other stream the library reads row by row.
    with TemporaryFile() as stream:
        stream.write(data)
        stream.seek(0)
        ply = PlyData.read(stream, known_list_len=lengths)
        return ply, len(data) - stream.tell()


def _triangles(faces: PlyElement) -> NDArray[np.int64]:
    names = [name for name in _CORNERS if name in faces.data.dtype.names]
    if not names:
        raise MeshError("the PLY faces have no list vertex_indices")
    corners = faces[names[0]]
    if corners.ndim == 2:
        return np.asarray(corners, dtype=np.int64)
    return fans_of_lists(corners)
