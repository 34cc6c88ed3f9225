"""GIFTI: surfaces of brains in XML.

The library at hand expands the entities of XML, unpacks data of any size, believes any counts, and only warns of
missing arrays; here they are refused. Source: "GIFTI surface data format" 1.0 (2011), https://www.nitrc.org/projects/gifti.
"""

import base64
import math
import zlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import BYTE_ORDERS, typed, xml_events
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, reals, unpacked_limit, whole

_MOST_DIMENSIONS = 6
_GIFTI_TYPES = {
    f"NIFTI_TYPE_{name}": np.dtype(name.lower())
    for name in ("UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT32", "FLOAT64")
}
_INDEXING: dict[str, Literal["C", "F"]] = {"RowMajorOrder": "C", "ColumnMajorOrder": "F"}
# What older writers call encodings and orders of bytes.
_CALLED = {"GIFTI_ENCODING_ASCII": "ASCII", "GIFTI_ENCODING_B64BIN": "Base64Binary"}
_CALLED |= {"GIFTI_ENCODING_B64GZ": "GZipBase64Binary", "GIFTI_ENDIAN_BIG": "BigEndian"}
_CALLED |= {"GIFTI_ENDIAN_LITTLE": "LittleEndian"}
_POINTS, _FACES = "NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE"


def parse_gifti(data: bytes) -> Raw:
    """Return the vertices and triangles of a GIFTI surface."""
    arrays: dict[str, list[NDArray[Any]]] = {_POINTS: [], _FACES: []}
    announced, found = None, 0
    attributes: Mapping[str, str] = {}
    texts: list[str] | None = None
    notes: tuple[str, ...] = ()
    for event, name, values in xml_events(data, "GIFTI"):
        match event, name:
            case "start", "GIFTI":
                announced = values.get("NumberOfDataArrays")
            case "start", "DataArray":
                attributes, found = {key: _CALLED.get(value, value) for key, value in values.items()}, found + 1
            case "start", "MatrixData" if attributes.get("Intent") == _POINTS:
                texts = []
            case "end", "MatrixData" if texts is not None:
                if not np.array_equal(reals("".join(texts).split(), "its transform"), np.eye(4).ravel()):
                    notes = ("the file has a transform to another frame of coordinates, which is not applied",)
                texts = None
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
        if announced is not None and whole(announced, "the GIFTI header") != found:
            raise MeshError(f"the GIFTI header announces {announced[:20]} arrays, found {found}")
    points, faces = arrays.values()
    if len(points) != 1 or len(faces) != 1:
        raise MeshError(f"a surface has one point set and one triangle array, found {len(points)} and {len(faces)}")
    return Raw(points[0], faces[0], notes)


def _decoded(text: str, attributes: Mapping[str, str], number: int, most_bytes: int) -> NDArray[Any]:
    """Return the data of a DataArray, which is the file's array of that number, from 1."""
    encoding = attributes.get("Encoding", "")
    if attributes.get("ExternalFileName") or "External" in encoding:
        raise MeshError("its data lie in another file; write it with them inside")
    owner = f"array {number} of the file"
    dtype = _GIFTI_TYPES.get(kind := attributes.get("DataType", ""))
    if dtype is None:
        raise MeshError(f"{owner} is of the type {kind[:40]!r}, expected {', '.join(_GIFTI_TYPES)}")
    count = whole(attributes.get("Dimensionality", ""), owner)
    if not 1 <= count <= _MOST_DIMENSIONS:
        raise MeshError(f"{owner} has {count} dimensions, expected 1 to {_MOST_DIMENSIONS}")
    shape = [whole(attributes.get(f"Dim{axis}", ""), owner) for axis in range(count)]
    if min(shape) < 0:
        raise MeshError(f"{owner} has a negative dimension: {shape}")
    size = math.prod(shape) * dtype.itemsize
    order, endian = attributes.get("ArrayIndexingOrder", ""), attributes.get("Endian", "")
    if order not in _INDEXING or endian not in BYTE_ORDERS:
        raise MeshError(f"{owner} has the orders {order[:40]!r} and {endian[:40]!r}, which GIFTI does not have")
    if encoding == "ASCII":
        if not text.strip():
            raise MeshError(f"{owner} is empty")
        # The library at hand writes a text row by row, whatever order it declares.
        order = "RowMajorOrder" if len(text.strip().splitlines()) == shape[0] else order
        values = typed(text.split(), dtype, owner)
    else:
        decoded = base64.b64decode(text)
        if encoding == "GZipBase64Binary":
            if size > most_bytes:
                raise MeshError(f"its arrays unpack to more than {most_bytes} bytes: no mesh file shrinks that far")
            # One byte more shows whether there are more.
            decoded = zlib.decompressobj().decompress(decoded, size + 1)
        elif encoding != "Base64Binary":
            raise MeshError(f"{owner} has the encoding {encoding[:40]!r}, which GIFTI does not have")
        if len(decoded) != size:
            wrong = "more" if len(decoded) > size else "fewer"
            raise MeshError(f"{owner} unpacks to {wrong} than the {size} bytes announced")
        values = np.frombuffer(decoded, dtype.newbyteorder(BYTE_ORDERS[endian]))
    return np.asarray(values.reshape(shape, order=_INDEXING[order]))


FORMATS = (Format((".gii",), parse_gifti, 10, 90),)
