"""Surfaces of brains: GIFTI files and those of FreeSurfer.

They are read here because the library at hand expands the entities of XML, unpacks data of any size, believes any
counts, and only warns of missing arrays. Sources: "GIFTI surface data format" 1.0 (2011),
https://www.nitrc.org/projects/gifti; FreeSurfer wiki, "Surface file format",
https://surfer.nmr.mgh.harvard.edu/fswiki/FileFormats.
"""

from __future__ import annotations

import base64
import io
import math
import re
import zlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.parsing import Raw, unpacked_limit, xml_events

_MOST_DIMENSIONS = 6
_GIFTI_TYPES = {
    f"NIFTI_TYPE_{name}": np.dtype(name.lower())
    for name in ("UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT32", "FLOAT64")
}
_POINTS, _FACES = "NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE"
# lh.pial, rh.white, sub-01.lh.sphere.reg, inner_skull.surf; but lh.aparc.annot has values at vertices.
_NAME = re.compile(r"(?:^|[._-])[lr]h\.[^.].*(?<!\.annot)(?<!\.label)(?<!\.mgh)(?<!\.mgz)$|.\.surf$")
_MAGIC = b"\xff\xff\xfe"
# The two lines after the number of the format: who made the file and when, and an empty one.
_HEADER_LINES = re.compile(rb"[^\n]{0,1000}\n[^\n]{0,1000}\n")
# Behind the triangles there may be the geometry of the volume, which begins with one of these.
_VOLUME = (b"\0\0\0\x14", b"\0\0\0\2\0\0\0\0\0\0\0\x14")


def parse_gifti(data: bytes) -> Raw:
    """Return the vertices and triangles of a GIFTI surface."""
    arrays: dict[str, list[NDArray[Any]]] = {_POINTS: [], _FACES: []}
    announced, found = None, 0
    attributes: Mapping[str, str] = {}
    texts: list[str] | None = None
    for event, name, values in xml_events(data, "GIFTI"):
        match event, name:
            case "start", "GIFTI":
                announced = values.get("NumberOfDataArrays")
            case "start", "DataArray":
                attributes, found = values, found + 1
            case "start", "Data":
                # Others hold normals, or values at vertices.
                texts = [] if attributes.get("Intent") in arrays else None
            case "text", piece if texts is not None:
                texts.append(piece)
            case "end", "Data" if texts is not None:
                of_kind = arrays[attributes["Intent"]]
                of_kind.append(_decoded("".join(texts), attributes, found, unpacked_limit(len(data))))
                texts = None
                if len(of_kind) > 1:
                    break
    else:
        if announced is not None and int(announced) != found:
            raise MeshError(f"the GIFTI header announces {announced[:20]} arrays, found {found}")
    points, faces = arrays.values()
    if len(points) != 1 or len(faces) != 1:
        raise MeshError(
            f"a GIFTI surface has one point set and one triangle array, found {len(points)} and {len(faces)}"
        )
    return points[0], faces[0]


def _decoded(text: str, attributes: Mapping[str, str], number: int, most_bytes: int) -> NDArray[Any]:
    """Return the data of a DataArray, which is the file's array of that number, from 1."""
    encoding = attributes.get("Encoding", "")
    if attributes.get("ExternalFileName") or "External" in encoding:
        raise MeshError("its data lie in another file; write it with them inside")
    dtype = _GIFTI_TYPES.get(kind := attributes.get("DataType", ""))
    if dtype is None:
        raise MeshError(f"array {number} of the file is of the type {kind[:40]!r}, expected {', '.join(_GIFTI_TYPES)}")
    count = int(attributes.get("Dimensionality", 0))
    if not 1 <= count <= _MOST_DIMENSIONS:
        raise MeshError(f"array {number} of the file has {count} dimensions, expected 1 to {_MOST_DIMENSIONS}")
    shape = [int(attributes[f"Dim{axis}"]) for axis in range(count)]
    if min(shape) < 0:
        raise MeshError(f"array {number} of the file has a negative dimension: {shape}")
    size = math.prod(shape) * dtype.itemsize
    order: Literal["C", "F"] = "F" if attributes.get("ArrayIndexingOrder") == "ColumnMajorOrder" else "C"
    if encoding == "ASCII":
        if not text.strip():
            raise MeshError(f"array {number} of the file is empty")
        values: NDArray[Any] = np.loadtxt(io.StringIO(text), dtype, comments=None, ndmin=1)
    else:
        decoded = base64.b64decode(text)
        if encoding == "GZipBase64Binary":
            if size > most_bytes:
                raise MeshError(f"its arrays unpack to more than {most_bytes} bytes: no mesh file shrinks that far")
            # One byte more shows whether there are more.
            decoded = zlib.decompressobj().decompress(decoded, size + 1)
        elif encoding != "Base64Binary":
            raise MeshError(f"array {number} of the file has the encoding {encoding[:40]!r}, which GIFTI does not have")
        if len(decoded) != size:
            wrong = "more" if len(decoded) > size else "fewer"
            raise MeshError(f"array {number} of the file unpacks to {wrong} than the {size} bytes announced")
        values = np.frombuffer(decoded, dtype.newbyteorder(">" if attributes.get("Endian") == "BigEndian" else "<"))
    return np.asarray(values.reshape(shape, order=order))


def is_freesurfer_name(name: str) -> bool:
    """Return whether a file's name, without .gz, is one that FreeSurfer gives to surfaces.

    >>> [is_freesurfer_name(name) for name in ("lh.pial", "sub-01_rh.white", "inner_skull.surf", "ball.pial")]
    [True, True, True, False]
    """
    return _NAME.search(name.lower()) is not None


def parse_freesurfer(data: bytes) -> Raw:
    """Return the vertices and triangles of a FreeSurfer surface."""
    if len(data) >= 15 and len(data) == 15 + 4 * math.prod(np.frombuffer(data, ">i4", 3, 3)[[0, 2]].tolist()):
        raise MeshError(
            "it holds values at vertices, such as thickness or curvature; give the surface, such as lh.pial"
        )
    if not data.startswith(_MAGIC):
        raise MeshError(
            f"it begins with the bytes {data[:3].hex(' ')} and is no FreeSurfer surface of triangles, which begins "
            f"with {_MAGIC.hex(' ')}; give a surface such as lh.pial, or a name with the suffix of its own format"
        )
    lines = _HEADER_LINES.match(data, len(_MAGIC))
    if lines is None or len(data) < lines.end() + 8:
        raise MeshError("the file breaks off before the counts of its vertices and triangles")
    vertices, triangles = np.frombuffer(data, ">i4", 2, lines.end()).tolist()
    start = lines.end() + 8
    end = start + 12 * (vertices + triangles)
    if min(vertices, triangles) < 0 or end > len(data):
        raise MeshError(
            f"the header announces {vertices} vertices and {triangles} triangles, but the file has {len(data)} bytes"
        )
    if end < len(data) and not data[end : end + 12].startswith(_VOLUME):
        raise MeshError(f"the file has {len(data) - end} bytes behind its {triangles} triangles")
    coordinates = np.frombuffer(data, ">f4", 3 * vertices, start)
    corners = np.frombuffer(data, ">i4", 3 * triangles, start + coordinates.nbytes)
    return coordinates.reshape(-1, 3), corners.reshape(-1, 3)
