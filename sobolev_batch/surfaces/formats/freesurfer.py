"""FreeSurfer's geometry files, such as lh.pial, parsed by the library nibabel after a check of their counts.

The library believes any counts. Source: FreeSurfer wiki, "Surface file format",
https://surfer.nmr.mgh.harvard.edu/fswiki/FileFormats.
"""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from numpy.typing import NDArray

from sobolev_batch.errors import MeshError

Raw = tuple[NDArray[Any], NDArray[Any]]

# lh.pial, rh.white, sub-01.lh.sphere.reg, inner_skull.surf
_NAME = re.compile(r"(?:^|[._-])[lr]h\.[^.].*$|.\.surf$")
_TRIANGLES, _QUADS, _OLD_QUADS = b"\xff\xff\xfe", b"\xff\xff\xfd", b"\xff\xff\xff"
# The two lines after the number of the format: who made the file and when, and an empty one.
_LINES = re.compile(rb"[^\n]{0,1000}\n[^\n]{0,1000}\n")
# Behind the triangles there may be the geometry of the volume, which begins with one of these.
_VOLUME = (b"\0\0\0\x14", b"\0\0\0\2\0\0\0\0\0\0\0\x14")


def is_freesurfer_name(name: str) -> bool:
    """Return whether a file's name, without .gz, is one that FreeSurfer gives to surfaces.

    >>> [is_freesurfer_name(name) for name in ("lh.pial", "sub-01_rh.white", "inner_skull.surf", "ball.pial")]
    [True, True, True, False]
    """
    return _NAME.search(name.lower()) is not None


def parse_freesurfer(data: bytes, path: Path) -> Raw:
    """Return the vertices and triangles of a FreeSurfer surface; quadrilaterals are cut as FreeSurfer cuts them.

    Args:
        data: Contents of the file.
        path: Path of the file; unused, since FreeSurfer's surfaces refer to no others.

    Raises:
        MeshError: The file is none, or its counts do not fit its length.
    """
    match data[:3]:
        case magic if magic == _TRIANGLES:
            _check_triangles(data)
        case magic if magic in (_QUADS, _OLD_QUADS):
            _check_quads(data, 12 if magic == _QUADS else 6)
        case magic:
            raise MeshError(
                f"it begins with the bytes {magic.hex(' ')} and is no surface of FreeSurfer's, which begin with "
                f"{_TRIANGLES.hex(' ')}; give a surface such as lh.pial, or a name with the suffix of its own format"
            )
    from nibabel.freesurfer import read_geometry

    # The library reads files by their names alone.
    with NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        vertices, triangles = read_geometry(file.name)
    return vertices, triangles


def _check_triangles(data: bytes) -> None:
    lines = _LINES.match(data, len(_TRIANGLES))
    if lines is None or len(data) < lines.end() + 8:
        raise MeshError("the file breaks off before the counts of its vertices and triangles")
    vertices, triangles = (_integer(data, lines.end() + place, 4) for place in (0, 4))
    end = lines.end() + 8 + 12 * (vertices + triangles)
    if min(vertices, triangles) < 0 or end > len(data):
        raise MeshError(
            f"the header announces {vertices} vertices and {triangles} triangles, but the file has {len(data)} bytes"
        )
    if end < len(data) and not data[end : end + 12].startswith(_VOLUME):
        raise MeshError(f"the file has {len(data) - end} bytes behind its {triangles} triangles")


def _check_quads(data: bytes, vertex_bytes: int) -> None:
    if len(data) >= 15 and len(data) == 15 + 4 * _integer(data, 3, 4) * _integer(data, 11, 4):
        raise MeshError(
            "it holds values at vertices, such as thickness or curvature; give the surface, such as lh.pial"
        )
    vertices, quads = (_integer(data, place, 3, signed=False) for place in (3, 6))
    if len(data) != 9 + vertex_bytes * vertices + 12 * quads:
        raise MeshError(
            f"the header announces {vertices} vertices and {quads} quadrilaterals, but the file has {len(data)} bytes"
        )


def _integer(data: bytes, place: int, size: int, *, signed: bool = True) -> int:
    return int.from_bytes(data[place : place + size], "big", signed=signed)
