"""PLY files, parsed by the library plyfile."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyElementParseError

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.polygons import fans_of_lists

Raw = tuple[NDArray[np.floating], NDArray[np.int64]]

# A header ends within so many bytes: room for a thousand lines, and no more to look through for a plan.
HEADER_BYTES = 1 << 16

_END = b"end_header"
_CORNERS = ("vertex_indices", "vertex_index")
_MOST_DIGITS = 18
_SHORT, _LONG = (b"short", b"ushort", b"int16", b"uint16"), (b"int", b"uint", b"float", b"int32", b"uint32", b"float32")
_TYPE_BYTES = dict.fromkeys(_SHORT, 2) | dict.fromkeys(_LONG, 4) | dict.fromkeys((b"double", b"float64"), 8)
# A digit and what ends it.
_TEXT_BYTES = 2


def parse_ply(data: bytes, path: Path) -> Raw:
    """Vertices and triangles of a PLY file, in its own precision.

    Args:
        data: the contents of the file.
        path: of the file; a PLY file refers to no others.

    Raises:
        MeshError: no vertices or faces, or counts that do not fit what follows.
    """
    start = data.find(_END, 0, HEADER_BYTES)
    header, length = _Header.of(data[: max(start, 0)]), len(data) - start - len(_END)
    counts = header.counts
    if start < 0 or "vertex" not in counts or "face" not in counts:
        raise MeshError(f"no PLY header announces vertices and faces in the first {HEADER_BYTES} bytes")
    # A count beyond what can follow would only reserve memory.
    if header.least_bytes > length:
        raise MeshError(f"the PLY header announces {counts}, but only {length} bytes follow")
    entries = sum(counts.values())
    lines = sum(1 for line in data[start:].splitlines()[1:] if line.strip()) if header.text else entries
    if lines != entries:
        raise MeshError(f"the PLY header announces {entries} entries, found {lines}")
    # A real file where it is binary, since of any other stream the library reads row by row.
    with TemporaryFile() as stream:
        source, total = (data, 0) if header.text else (stream, stream.write(data))
        del data
        try:
            # Reads all faces at once; the library refuses it where one of them is no triangle.
            ply = _read(source, {"face": dict.fromkeys(_CORNERS, 3)})
        except (PlyElementParseError, KeyError):
            ply = _read(source, {})
        # Of a text the lines were counted.
        left = 0 if header.text else total - stream.tell()
    if left:
        raise MeshError(f"the PLY header announces {counts}, but {left} bytes more follow")
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1)
    return vertices, _triangles(ply["face"])


def announced_sizes(header: bytes) -> tuple[int, int, bool]:
    """How many vertices and faces the beginning of a file announces, 0 where it does not, and whether it is a text.

    Raises:
        MeshError: a count that is none.
    """
    found = _Header.of(header.partition(_END)[0])
    return found.counts.get("vertex", 0), found.counts.get("face", 0), found.text


@dataclass(frozen=True)
class _Header:
    """What a header announces.

    Attributes:
        counts: of each element.
        least_bytes: the fewest that can follow it.
        text: whether what follows is text.
    """

    counts: dict[str, int]
    least_bytes: int
    text: bool

    @classmethod
    def of(cls, header: bytes) -> _Header:
        """The header of which these are the lines; the library complains of those that are malformed."""
        counts: dict[str, int] = {}
        row_bytes: dict[str, int] = {}
        element, text = "", False
        for line in header.splitlines():
            match line.split():
                case [b"format", kind, *_]:
                    text = kind == b"ascii"
                case [b"element", name, count, *_]:
                    element = name.decode("ascii", errors="replace")
                    if not count.isdigit() or len(count) > _MOST_DIGITS:
                        raise MeshError(f"the PLY header announces {count[:40]!r} entries of {element[:40]!r}")
                    counts[element], row_bytes[element] = int(count), 0
                case [b"property", b"list", kind, _, _] | [b"property", kind, _] if element:
                    row_bytes[element] += _TEXT_BYTES if text else _TYPE_BYTES.get(kind, 1)
        # The last number of a text need not be followed by anything.
        least = sum(count * max(row_bytes[name], 1) for name, count in counts.items()) - text
        return cls(counts, least, text)


def _read(source: bytes | IO[bytes], lengths: dict[str, dict[str, int]]) -> PlyData:
    # The library closes the stream of a text.
    stream = io.BytesIO(source) if isinstance(source, bytes) else source
    stream.seek(0)
    return PlyData.read(stream, known_list_len=lengths)


def _triangles(faces: PlyElement) -> NDArray[np.int64]:
    names = [name for name in _CORNERS if name in faces.data.dtype.names]
    if not names:
        raise MeshError("the PLY faces have no list vertex_indices")
    kind = faces.ply_property(names[0]).val_dtype
    if not kind.startswith(("i", "u")):
        raise MeshError(f"the PLY faces have indices that are not integers, but of the type {kind}")
    corners = faces[names[0]]
    if corners.ndim == 2:
        return np.asarray(corners, dtype=np.int64)
    return fans_of_lists(corners)
