"""PLY files, parsed by the library plyfile."""

from __future__ import annotations

import io
import re
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyElementParseError

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.polygons import fans_of_lists

Raw = tuple[NDArray[np.floating], NDArray[np.int64]]

_END = b"end_header"
_CORNERS = ("vertex_indices", "vertex_index")


def parse_ply(data: bytes, path: Path) -> Raw:
    """Vertices and triangles of a PLY file, in its own precision.

    Args:
        data: the contents of the file.
        path: of the file; a PLY file refers to no others.

    Raises:
        MeshError: no vertices or faces, or counts that do not fit what follows.
    """
    start = data.find(_END)
    header, length = data[: max(start, 0)], len(data) - start - len(_END)
    counts = _announced(header)
    if start < 0 or "vertex" not in counts or "face" not in counts:
        raise MeshError("the PLY header does not announce vertices and faces")
    # Every element takes at least a byte: a count beyond that would only reserve memory.
    if sum(counts.values()) > length:
        raise MeshError(f"the PLY header announces {counts}, but only {length} bytes follow")
    text = _is_text(header)
    lines = sum(1 for line in data[start:].splitlines()[1:] if line.strip()) if text else sum(counts.values())
    if lines != sum(counts.values()):
        raise MeshError(f"the PLY header announces {sum(counts.values())} entries, found {lines}")
    # A real file where it is binary, since of any other stream the library reads row by row.
    with TemporaryFile() as stream:
        source, total = (data, 0) if text else (stream, stream.write(data))
        del data
        try:
            # Reads all faces at once; the library refuses it where one of them is no triangle.
            ply = _read(source, {"face": dict.fromkeys(_CORNERS, 3)})
        except (PlyElementParseError, KeyError):
            ply = _read(source, {})
        # Of a text the lines were counted.
        left = 0 if text else total - stream.tell()
    if left:
        raise MeshError(f"the PLY header announces {counts}, but {left} bytes more follow")
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1)
    return vertices, _triangles(ply["face"])


def announced_sizes(header: bytes) -> tuple[int, int, bool]:
    """How many vertices and faces the beginning of a file announces, 0 where it does not, and whether it is a text."""
    counts = _announced(header.partition(_END)[0])
    return counts.get("vertex", 0), counts.get("face", 0), _is_text(header)


def _announced(header: bytes) -> dict[str, int]:
    return {name.decode(): int(count) for name, count in re.findall(rb"^element\s+(\w+)\s+(\d+)", header, re.M)}


def _is_text(header: bytes) -> bool:
    return re.search(rb"^format\s+ascii", header, re.M) is not None


def _read(source: bytes | IO[bytes], lengths: dict[str, dict[str, int]]) -> PlyData:
    # The library closes the stream of a text.
    stream = io.BytesIO(source) if isinstance(source, bytes) else source
    stream.seek(0)
    return PlyData.read(stream, known_list_len=lengths)


def _triangles(faces: PlyElement) -> NDArray[np.int64]:
    names = [name for name in _CORNERS if name in faces.data.dtype.names]
    if not names:
        raise MeshError("the PLY faces have no list vertex_indices")
    corners = faces[names[0]]
    if corners.ndim == 2:
        return np.asarray(corners, dtype=np.int64)
    return fans_of_lists(corners)
