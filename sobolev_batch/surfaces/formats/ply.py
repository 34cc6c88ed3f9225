"""PLY files, parsed by the library plyfile."""

from __future__ import annotations

import io
import os
import re
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyElementParseError

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.parsing import Raw, triangle_fans_of_lists
from sobolev_batch.surfaces.formats.text_formats import LONGEST_LINE
from sobolev_batch.surfaces.shapes.mesh import Mesh

# A header ends within this many bytes: room for a thousand lines, and quick to look through.
HEADER_BYTES = 1 << 16

_END = b"end_header"
_LINE = re.compile(rb"\S[^\r\n]*")
_CORNERS = ("vertex_indices", "vertex_index")
_MOST_DIGITS = 18
_SHORT, _LONG = (b"short", b"ushort", b"int16", b"uint16"), (b"int", b"uint", b"float", b"int32", b"uint32", b"float32")
_TYPE_BYTES = dict.fromkeys(_SHORT, 2) | dict.fromkeys(_LONG, 4) | dict.fromkeys((b"double", b"float64"), 8)
# A digit and the character that ends it.
_TEXT_BYTES = 2


def parse_ply(data: bytes) -> Raw:
    """Return the vertices and triangles of a PLY file, in its own precision.

    Raises:
        MeshError: There are no vertices or faces, or the counts do not fit the contents.
    """
    counts, is_text = _checked_counts(data)
    if is_text:
        ply = _parsed(data)
    else:
        # A real file: the library reads other streams row by row.
        with TemporaryFile() as stream:
            stream.write(data)
            del data
            ply = _parsed(stream)
            read = stream.tell()
            unread = stream.seek(0, os.SEEK_END) - read
        if unread:
            raise MeshError(f"the PLY header announces {counts}, but {unread} bytes more follow")
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1)
    return vertices, _triangles(ply["face"])


def write_ply(mesh: Mesh) -> bytes:
    """Return a binary PLY file, all digits kept."""
    vertices = np.empty(len(mesh.vertices), dtype=[(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", mesh.vertices.T, strict=True):
        vertices[axis] = column
    faces = np.empty(len(mesh.triangles), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.triangles
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    file = io.BytesIO()
    PlyData(elements, text=False, byte_order="<").write(file)
    return file.getvalue()


def announced_sizes(header: bytes) -> tuple[int, int, bool]:
    """Return the numbers of vertices and faces that a header announces, 0 where it does not, and whether it is text.

    Raises:
        MeshError: A count is no integer.
    """
    counts, _, is_text = _announced(header.partition(_END)[0])
    return counts.get("vertex", 0), counts.get("face", 0), is_text


def _announced(header: bytes) -> tuple[dict[str, int], int, bool]:
    """Return the number of entries of each element, their smallest possible length, and whether they are text.

    The library complains of malformed lines.
    """
    counts: dict[str, int] = {}
    row_bytes: dict[str, int] = {}
    element, is_text = "", False
    for line in header.splitlines():
        match line.split():
            case [b"format", kind, *_]:
                is_text = kind == b"ascii"
            case [b"element", name, count, *_]:
                element = name.decode("ascii", errors="replace")
                if not count.isdigit() or len(count) > _MOST_DIGITS:
                    raise MeshError(f"the PLY header announces {count[:40]!r} entries of {element[:40]!r}")
                counts[element], row_bytes[element] = int(count), 0
            case [b"property", b"list", kind, _, _] | [b"property", kind, _] if element:
                row_bytes[element] += _TEXT_BYTES if is_text else _TYPE_BYTES.get(kind, 1)
    # The last number of a text need not be followed by anything.
    least_bytes = sum(count * max(row_bytes[name], 1) for name, count in counts.items()) - is_text
    return counts, least_bytes, is_text


def _checked_counts(data: bytes) -> tuple[dict[str, int], bool]:
    """Return the counts that a header announces, which its contents can have, and whether they are text."""
    start = data.find(_END, 0, HEADER_BYTES)
    length = len(data) - start - len(_END)
    counts, least_bytes, is_text = _announced(data[: max(start, 0)])
    if counts.get("vertex") and not counts.get("face"):
        raise MeshError(
            f"the PLY file has {counts['vertex']} vertices and no faces: it holds points and no surface; make a mesh "
            "of them first"
        )
    if start < 0 or not {"vertex", "face"} <= set(counts):
        raise MeshError(f"no PLY header announces vertices and faces in the first {HEADER_BYTES} bytes")
    # The library would reserve memory for any count.
    if least_bytes > length:
        raise MeshError(f"the PLY header announces {counts}, but only {length} bytes follow")
    if is_text and data.find(b"_", start + len(_END)) >= 0:
        raise MeshError("the PLY file has a number with an underscore, which is Python's spelling and not that of PLY")
    entries = sum(counts.values())
    lines = _line_count(data, start) if is_text else entries
    if lines != entries:
        raise MeshError(f"the PLY header announces {entries} entries, found {lines}")
    return counts, is_text


def _line_count(data: bytes, start: int) -> int:
    """Return the number of lines of a text that are not empty, after the one that begins at a place."""
    count = 0
    # From the first visible character of each line on: no list of all lines, and no line looked through twice.
    for line in _LINE.finditer(data, start):
        if line.end() - line.start() > LONGEST_LINE:
            raise MeshError(f"a line of the PLY file has more than {LONGEST_LINE} characters; cut its polygon")
        count += 1
    return count - 1


def _parsed(source: bytes | IO[bytes]) -> PlyData:
    try:
        # Reads all faces at once; the library refuses where one of them is no triangle.
        return _read(source, {"face": dict.fromkeys(_CORNERS, 3)})
    except (PlyElementParseError, KeyError):
        return _read(source, {})


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
    return triangle_fans_of_lists(corners)
