"""FreeSurfer's surfaces of triangles, such as lh.pial.

Source: FreeSurfer wiki, "Surface file format", https://surfer.nmr.mgh.harvard.edu/fswiki/FileFormats.
"""

import math
import re

import numpy as np

from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, reals

# Names of surfaces: lh.pial, rh.white, sub-01.lh.sphere.reg, inner_skull.surf; lh.aparc.annot has values at vertices.
_NAME = re.compile(r"(?:^|[._-])[lr]h\.[^.].*(?<!\.annot)(?<!\.label)(?<!\.mgh)(?<!\.mgz)$|.\.surf$")
_MAGIC = b"\xff\xff\xfe"
# The two lines after the number of the format: who made the file and when, and an empty one.
_HEADER_LINES = re.compile(rb"[^\n]{0,1000}\n[^\n]{0,1000}\n")
# Behind the triangles there may be the geometry of the volume, which begins with one of these. The last one says that
# the coordinates are those of the scanner already.
_VOLUME = (b"\0\0\0\x14", b"\0\0\0\2\0\0\0\0\0\0\0\x14", _AT_SCANNER := b"\0\0\0\2\0\0\0\1\0\0\0\x14")
# The middle of that volume, where the coordinates of the surface have their origin, within some hundred bytes.
_MIDDLE = re.compile(rb"valid = 1\b.*\ncras\s{0,9}=([^\n]{1,200})", re.DOTALL)
_VOLUME_BYTES = 4096


def parse_freesurfer(data: bytes) -> Raw:
    """Return the vertices and triangles of a FreeSurfer surface."""
    if len(data) >= 15 and len(data) == 15 + 4 * math.prod(np.frombuffer(data, ">i4", 3, 3)[[0, 2]].tolist()):
        raise MeshError("it holds values at vertices, such as thickness; give the surface, such as lh.pial")
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
        raise MeshError(f"it announces {vertices} vertices and {triangles} triangles, but has {len(data)} bytes")
    if end < len(data) and not data[end : end + 12].startswith(_VOLUME):
        raise MeshError(f"the file has {len(data) - end} bytes behind its {triangles} triangles")
    coordinates = np.frombuffer(data, ">f4", 3 * vertices, start)
    corners = np.frombuffer(data, ">i4", 3 * triangles, start + coordinates.nbytes)
    middle = not data.startswith(_AT_SCANNER, end) and _MIDDLE.search(data[end : end + _VOLUME_BYTES])
    shift = middle[1].decode("ascii", errors="replace").split() if middle else []
    is_shifted = any(reals(shift, "c_ras"))
    notes = (f"the file has the shift c_ras = ({' '.join(shift)}) to the frame of the scanner, which is not applied",)
    return Raw(coordinates.reshape(-1, 3), corners.reshape(-1, 3), notes if is_shifted else ())


FORMATS = (Format(("freesurfer",), parse_freesurfer, 18, 80, is_name=lambda name: bool(_NAME.search(name))),)
