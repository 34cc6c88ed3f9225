"""GIFTI: surfaces of brains in XML.

The library at hand expands the entities of XML, unpacks data of any size, believes any counts, and only warns of
missing arrays; here they are refused. Source: "GIFTI surface data format" 1.0 (2011), https://www.nitrc.org/projects/gifti.
"""

import base64
import math
import zlib
from typing import Any, Literal
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import BYTE_ORDERS, typed, xml_tree
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
    root = xml_tree(data, "GIFTI")
    arrays = [*root.iter("DataArray")]
    announced = next((one.get("NumberOfDataArrays") for one in root.iter("GIFTI")), None)
    if announced is not None and whole(announced, "the GIFTI header") != len(arrays):
        raise MeshError(f"the GIFTI header announces {announced[:20]} arrays, found {len(arrays)}")
    # Others hold normals, or values at vertices.
    points, faces = ([one for one in arrays if one.get("Intent") == intent] for intent in (_POINTS, _FACES))
    if len(points) != 1 or len(faces) != 1:
        raise MeshError(f"a surface has one point set and one triangle array, found {len(points)} and {len(faces)}")
    matrices = [reals((one.text or "").split(), "its transform") for one in points[0].iter("MatrixData")]
    is_placed = any(not np.array_equal(matrix, np.eye(4).ravel()) for matrix in matrices)
    note = "the file has a transform to another frame of coordinates, which is not applied"
    most, numbers = unpacked_limit(len(data)), (1 + arrays.index(one) for one in (*points, *faces))
    vertices, triangles = (_decoded(arrays[number - 1], number, most) for number in numbers)
    return Raw(vertices, triangles, (note,) * is_placed)


def _decoded(array: Element, number: int, most_bytes: int) -> NDArray[Any]:
    """Return the data of a DataArray, which is the file's array of that number, from 1."""
    attributes = {key: _CALLED.get(value, value) for key, value in array.items()}
    text = array.findtext("Data") or ""
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
