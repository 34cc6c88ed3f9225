"""Surfaces of brains: GIFTI files and those of FreeSurfer, parsed by the library nibabel after a check.

The library expands the entities of XML, unpacks data of any size, believes any counts, and only warns of missing
arrays. Sources: "GIFTI surface data format" 1.0 (2011), https://www.nitrc.org/projects/gifti; FreeSurfer wiki,
"Surface file format", https://surfer.nmr.mgh.harvard.edu/fswiki/FileFormats.
"""

from __future__ import annotations

import base64
import math
import re
import zlib
from tempfile import NamedTemporaryFile

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.raw_files import Raw, parse_xml, unpacked_limit

_MOST_DIMENSIONS = 6
# Arrays of a file; the library makes objects of kilobytes for each.
_MOST_ARRAYS = 10_000
_CHUNK_BYTES = 1 << 20
# lh.pial, rh.white, sub-01.lh.sphere.reg, inner_skull.surf; but lh.aparc.annot has values at vertices.
_NAME = re.compile(r"(?:^|[._-])[lr]h\.[^.].*(?<!\.annot)(?<!\.label)(?<!\.mgh)(?<!\.mgz)$|.\.surf$")
_TRIANGLES, _QUADS, _OLD_QUADS = b"\xff\xff\xfe", b"\xff\xff\xfd", b"\xff\xff\xff"
# The two lines after the number of the format: who made the file and when, and an empty one.
_HEADER_LINES = re.compile(rb"[^\n]{0,1000}\n[^\n]{0,1000}\n")
# Behind the triangles there may be the geometry of the volume, which begins with one of these.
_VOLUME = (b"\0\0\0\x14", b"\0\0\0\2\0\0\0\0\0\0\0\x14")


def parse_gifti(data: bytes) -> Raw:
    """Return the vertices and triangles of a GIFTI surface.

    Raises:
        MeshError: The file has not exactly one point set and one triangle array, or its data do not fit
            their announced sizes.
    """
    from nibabel import GiftiImage

    _XmlCheck(data)
    image = GiftiImage.from_bytes(data)
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if len(points) != 1 or len(triangles) != 1:
        raise MeshError(
            f"a GIFTI surface has one point set and one triangle array, found {len(points)} and {len(triangles)}"
        )
    return np.asarray(points[0].data), np.asarray(triangles[0].data)


class _XmlCheck:
    """One pass over the XML, which refuses what would harm the library and keeps nothing.

    Raises:
        MeshError: The file has entities, data in another file, odd dimensions, another number of arrays than
            announced, or packed data that are larger than announced or than `unpacked_limit`.
    """

    def __init__(self, data: bytes) -> None:
        self._limit, self._unpacked = unpacked_limit(len(data)), 0
        self._announced: int | None = None
        self._arrays = 0
        self._encoding, self._bytes = "", 0
        self._texts: list[str] | None = None
        parse_xml(data, "GIFTI", self._start, self._end, self._text)
        if self._announced is not None and self._announced != self._arrays:
            raise MeshError(f"the GIFTI header announces {self._announced} arrays, found {self._arrays}")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        # The library also takes the text before an inner element as all of the data.
        self._flush()
        if name == "GIFTI" and "NumberOfDataArrays" in attributes:
            self._announced = int(attributes["NumberOfDataArrays"])
        elif name == "DataArray":
            self._arrays += 1
            if self._arrays > _MOST_ARRAYS:
                raise MeshError(f"the file has more than {_MOST_ARRAYS} arrays; save it with the surface alone")
            self._encoding = attributes.get("Encoding", "")
            if attributes.get("ExternalFileName") or "External" in self._encoding:
                raise MeshError("its data lie in another file; write it with them inside")
            self._bytes = _array_bytes(attributes)
        elif name == "Data":
            self._texts = []

    def _end(self, name: str) -> None:
        self._flush()
        if name == "Data":
            self._texts = None

    def _text(self, text: str) -> None:
        if self._texts is not None:
            self._texts.append(text)

    def _flush(self) -> None:
        if not self._texts:
            return
        text = "".join(self._texts)
        self._texts = []
        if "GZip" in self._encoding or "GZ" in self._encoding:
            self._unpack(text)
        elif self._encoding.upper().endswith("ASCII") and not text.strip():
            raise MeshError(f"array {self._arrays} of the file is empty")

    def _unpack(self, text: str) -> None:
        """Count the bytes that data unpack to, a megabyte at a time, without keeping them."""
        packer, packed, total = zlib.decompressobj(), base64.b64decode(text), 0
        while packed and not packer.eof:
            total += len(packer.decompress(packed, _CHUNK_BYTES))
            packed = packer.unconsumed_tail
            if total > self._bytes:
                raise MeshError(
                    f"array {self._arrays} of the file unpacks to more than the {self._bytes} bytes announced"
                )
            if self._unpacked + total > self._limit:
                raise MeshError(f"its arrays unpack to more than {self._limit} bytes: no mesh file shrinks that far")
        self._unpacked += total


def _array_bytes(attributes: dict[str, str]) -> int:
    """Return the size that a DataArray announces."""
    from nibabel.nifti1 import data_type_codes

    count = int(attributes.get("Dimensionality", 0))
    if not 1 <= count <= _MOST_DIMENSIONS:
        raise MeshError(f"an array of the file has {count} dimensions, expected 1 to {_MOST_DIMENSIONS}")
    sizes = [int(attributes[f"Dim{axis}"]) for axis in range(count)]
    if min(sizes) < 0:
        raise MeshError(f"an array of the file has a negative dimension: {sizes}")
    dtype = data_type_codes.dtype[attributes.get("DataType", "NIFTI_TYPE_FLOAT32")]
    return math.prod(sizes) * int(np.dtype(dtype).itemsize)


def is_freesurfer_name(name: str) -> bool:
    """Return whether a file's name, without .gz, is one that FreeSurfer gives to surfaces.

    >>> [is_freesurfer_name(name) for name in ("lh.pial", "sub-01_rh.white", "inner_skull.surf", "ball.pial")]
    [True, True, True, False]
    """
    return _NAME.search(name.lower()) is not None


def parse_freesurfer(data: bytes) -> Raw:
    """Return the vertices and triangles of a FreeSurfer surface; quadrilaterals are cut as FreeSurfer cuts them.

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
    lines = _HEADER_LINES.match(data, len(_TRIANGLES))
    if lines is None or len(data) < lines.end() + 8:
        raise MeshError("the file breaks off before the counts of its vertices and triangles")
    vertices, triangles = (_integer_at(data, lines.end() + place, 4) for place in (0, 4))
    end = lines.end() + 8 + 12 * (vertices + triangles)
    if min(vertices, triangles) < 0 or end > len(data):
        raise MeshError(
            f"the header announces {vertices} vertices and {triangles} triangles, but the file has {len(data)} bytes"
        )
    if end < len(data) and not data[end : end + 12].startswith(_VOLUME):
        raise MeshError(f"the file has {len(data) - end} bytes behind its {triangles} triangles")


def _check_quads(data: bytes, vertex_bytes: int) -> None:
    if len(data) >= 15 and len(data) == 15 + 4 * _integer_at(data, 3, 4) * _integer_at(data, 11, 4):
        raise MeshError(
            "it holds values at vertices, such as thickness or curvature; give the surface, such as lh.pial"
        )
    vertices, quads = (_integer_at(data, place, 3, signed=False) for place in (3, 6))
    if len(data) != 9 + vertex_bytes * vertices + 12 * quads:
        raise MeshError(
            f"the header announces {vertices} vertices and {quads} quadrilaterals, but the file has {len(data)} bytes"
        )


def _integer_at(data: bytes, place: int, size: int, *, signed: bool = True) -> int:
    return int.from_bytes(data[place : place + size], "big", signed=signed)
