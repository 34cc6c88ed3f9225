"""STL files, binary and text: a record or a few lines per triangle, read here with every count checked."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.polygons import merge_coincident
from sobolev_batch.surfaces.formats.text_formats import parsed_numbers, text_lines

Raw = tuple[NDArray[np.floating], NDArray[np.int64]]

_HEADER_BYTES = 84
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def parse_stl(data: bytes) -> Raw:
    """Return the vertices and triangles of an STL file; corners that coincide exactly are merged.

    Raises:
        MeshError: The size does not fit the announced count, or the text is malformed.
    """
    announced = int.from_bytes(data[80:_HEADER_BYTES], "little")
    if len(data) >= _HEADER_BYTES and len(data) == _HEADER_BYTES + _RECORD.itemsize * announced:
        corners = np.frombuffer(data, _RECORD, offset=_HEADER_BYTES)["corners"].reshape(-1, 3)
    elif data.lstrip()[:5].lower() == b"solid":
        corners = _text_corners(data)
    else:
        count = (len(data) - _HEADER_BYTES) / _RECORD.itemsize
        raise MeshError(
            f"a binary STL file of {len(data)} bytes holds {count:.2f} triangles, but its header announces {announced}"
        )
    if not len(corners):
        raise MeshError("the file has no faces")
    return merge_coincident(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


def _text_corners(data: bytes) -> NDArray[np.float64]:
    corners = array("d")
    facet, facet_corners, in_solid = 0, 0, False
    for line in text_lines(data):
        words = line.split()
        match words[0].lower() if words else "":
            case "":
                continue
            case "solid" | "endsolid" as word:
                in_solid = word == "solid"
            case "facet":
                facet, facet_corners = facet + 1, 0
            case "vertex":
                if len(words) != 4:
                    raise MeshError(f"facet {facet} has a vertex of {len(words) - 1} coordinates, expected three")
                corners.extend(parsed_numbers(words[1:], f"facet {facet}"))
                facet_corners += 1
            case "endfacet":
                if facet_corners != 3:
                    raise MeshError(f"facet {facet} has {facet_corners} vertices, expected three")
                facet_corners = 0
            case "outer" | "endloop":
                continue
            case other:
                raise MeshError(f"after facet {facet}: {other[:40]!r} is no word of an STL file")
    if in_solid or facet_corners:
        raise MeshError(f"the file breaks off after facet {facet}: its last solid does not end")
    return np.array(corners).reshape(-1, 3)
