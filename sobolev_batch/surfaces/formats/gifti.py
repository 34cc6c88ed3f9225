"""GIFTI files, parsed by the library nibabel after a check of their XML.

The library expands entities, unpacks data of any size, believes any dimensions, and only warns of
missing arrays. Specification: "GIFTI surface data format" 1.0 (2011), https://www.nitrc.org/projects/gifti.
"""

from __future__ import annotations

import base64
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.raw_files import parse_xml, unpacked_limit

Raw = tuple[NDArray[Any], NDArray[Any]]

_MOST_DIMENSIONS = 6
# Arrays of a file, for each of which the library makes objects of kilobytes.
_MOST_ARRAYS = 10_000
_CHUNK_BYTES = 1 << 20


def parse_gifti(data: bytes, path: Path) -> Raw:
    """Return the vertices and triangles of a GIFTI surface.

    Args:
        data: Contents of the file.
        path: Path of the file; unused, since references to other files are refused.

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
        # The library, too, takes the text before an inner element as all of the data.
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
                raise MeshError(f"its arrays unpack to more than {self._limit} bytes: no mesh file shrinks so much")
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
