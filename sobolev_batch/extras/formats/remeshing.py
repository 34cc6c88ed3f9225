"""Medit's and Gmsh's meshes: the triangles and quadrilaterals beside cells with volume.

Sources: P. Frey, "MEDIT: An interactive mesh visualization software" (2001); C. Geuzaine and J.-F. Remacle, "Gmsh
Reference Manual", https://gmsh.info/doc/texinfo/gmsh.html, with the formats MSH 2 and MSH 4.1.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import SURFACE, beside_volume
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, reals, whole
from sobolev_batch.geometry.formats.plain_formats import text_rows
from sobolev_batch.geometry.formats.polygons import cut_polygons
from sobolev_batch.geometry.mesh import Mesh

# Medit's cells with volume, and words of sections that have no part in a surface.
_MEDIT_VOLUMES = ("Tetrahedra", "Prisms", "Pyramids", "Hexahedra")
_MEDIT_SKIPPED = re.compile(
    "MeshVersionFormatted|Dimension|Vertices|Triangles|Quadrilaterals|Edges|Corners|Ridges|BoundingBox|Geometry|"
    "Identifier|Time|AngleOfCornerBound|Iterations|End|(Required|Normal|Tangent|SubDomain|Parallel|[DI]?SolAt)[A-Za-z]*|"
    "[A-Za-z]+OnGeometric[A-Za-z]+"
)
_MEDIT_UNREAD = re.compile(rb'(?<!\S)#[^\r\n]*|"[^"\n]*"')
# How Gmsh's meshes begin: perhaps with comments, then the format, whether it is binary, and how that orders bytes.
_START = re.compile(
    rb"(?s)\s*(?:\$Comments\s.*?\$EndComments\s+)?\$MeshFormat\s+((?:2(?:\.[0-2])?|4\.1)\s+[01])\s+8[ \t]*\r?\n(.{4})"
)
# Gmsh's numbers of cells: their corners, and which have an area or a volume.
_CORNERS = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 15: 1}
_WITH_AREA, _WITH_VOLUME = (2, 3), (4, 5, 6, 7)
_SAVED = "gmsh scan.msh -save -format msh{} -o surface.msh"


def parse_medit(data: bytes) -> Raw:
    """Return the vertices and triangles of a Medit mesh in text."""
    # Words begin with a letter and have three or more, unlike numbers. Names stand between quotes. Millions of pieces
    # at once would take a hundred times the bytes of the file.
    plain = b"".join(_MEDIT_UNREAD.sub(b"", part) for part in re.findall(rb"(?s).{1,65536}[^\n]{0,1048576}", data))
    start, *words = re.split(rb"(?<!\S)(?!(?i:nan|inf|infinity)(?!\S))([A-Za-z][A-Za-z0-9]{2,})", plain)
    names = [word.decode("ascii") for word in words[::2]]
    sections = dict(zip(names, words[1::2], strict=True))
    if start.strip() or names[:1] != ["MeshVersionFormatted"] or len(sections) < len(names):
        raise MeshError("it does not begin with MeshVersionFormatted, as Medit's text does, or repeats a section")
    if sections.get("Dimension", b"").split() != [b"3"]:
        raise MeshError("it is not of dimension 3")
    if curved := [name for name in names if re.match("(Triangles|Quadrilaterals)[PQ]", name)]:
        raise MeshError(f"it has {curved[0]}, which are curved; save it with flat faces")
    if unknown := [name for name in names if name not in _MEDIT_VOLUMES and not _MEDIT_SKIPPED.fullmatch(name)]:
        raise MeshError(f"it has a section {unknown[0][:40]!r}, which is not read and may hold faces; save it without")
    vertices, *faces = (
        _medit_rows(name, sections.get(name, b"0"), width)[:, :-1]
        for name, width in (("Vertices", 4), ("Triangles", 4), ("Quadrilaterals", 5))
    )
    volumes = sum(int(_numbers(sections[name], name)[0]) for name in _MEDIT_VOLUMES if name in sections)
    return _surface(vertices, [corners - 1 for corners in faces], volumes, ".mesh")


def write_medit(mesh: Mesh) -> bytes:
    """Return a Medit mesh in text, all digits kept."""
    vertices, triangles = text_rows("%.17g %.17g %.17g 0", mesh.vertices), text_rows("%d %d %d 0", mesh.triangles + 1)
    head = b"MeshVersionFormatted 2\nDimension 3\nVertices %d\n" % len(mesh.vertices)
    return head + vertices + b"Triangles %d\n" % len(mesh.triangles) + triangles + b"End\n"


def parse_gmsh(data: bytes) -> Raw:
    """Return the vertices and triangles of a Gmsh mesh of the format 2.2 or 4.1."""
    head = _START.match(data)
    if head is None:
        raise MeshError(f"it is no Gmsh mesh of the format 2.2 or 4.1; Gmsh converts others: {_SAVED.format(41)}")
    order = "" if head[1].endswith(b"0") else "<" if head[2] == b"\1\0\0\0" else ">"
    nodes, cells = (_Numbers(data, name, order) for name in (b"Nodes", b"Elements"))
    read = _of_second_format if head[1].startswith(b"2") else _of_fourth_format
    numbered, rows = read(nodes, cells)
    if nodes.has_more() or cells.has_more():
        raise MeshError("a section has more numbers than it announces, or bytes too few")
    # The old format repeats a cell of several physical groups, with another number.
    kept = [some[np.sort(np.unique(some, axis=0, return_index=True)[1])] for kind, some in rows if kind in _WITH_AREA]
    faces, repeated = [some[:, 1:] for some in kept], sum(len(some) for kind, some in rows if kind in _WITH_AREA)
    repeated -= sum(map(len, kept))
    volumes = sum(len(corners) for kind, corners in rows if kind in _WITH_VOLUME)
    if volumes and b"$PartitionedEntities" in data:
        raise MeshError(f"it has partitions, and the faces between them are inside; save it whole: {_SAVED.format(22)}")
    # Nodes have any numbers, in any order.
    order_of_nodes = np.argsort(numbered[:, 0])
    known = numbered[order_of_nodes, 0]
    places = [np.searchsorted(known, corners) for corners in faces]
    for corners, place in zip(faces, places, strict=True):
        if (place == len(known)).any() or (known[place] != corners).any():
            raise MeshError("it has a face with a node that is not there")
    raw = _surface(numbered[:, 1:], [order_of_nodes[place] for place in places], volumes, ".msh")
    note = f"{repeated:,} faces are repeated, as for several physical groups, and count once"
    return raw._replace(notes=(*raw.notes, note)) if repeated else raw


class _Numbers:
    """The numbers of a section of a Gmsh mesh, one after the other: in text, or in binary of some order of bytes."""

    def __init__(self, data: bytes, name: bytes, order: str) -> None:
        # One pattern for both ends would look for the last one behind each first one.
        end = data.rfind(b"$End" + name)
        start = re.compile(rb"\$%s[ \t]*\r?\n" % name).search(data, 0, end)
        if start is None:
            raise MeshError(f"it has no section ${name.decode()} that ends")
        self.order, self.place, section = order, 0, data[start.end() : end]
        self.values: Any = section if order else np.array(_numbers(section, name.decode()))
        self.lines = [] if order else [size for line in section.splitlines() if (size := len(line.split()))]

    def take(self, count: int, code: str = "u8") -> NDArray[Any]:
        """Return so many numbers more, in binary of a type of NumPy."""
        start = self.place
        if self.order:
            dtype = np.dtype(self.order + code)
            self.place += count * dtype.itemsize
            held = max(0, min(count, (len(self.values) - start) // dtype.itemsize))
            found = np.frombuffer(self.values, dtype, held, min(start, len(self.values)))
        else:
            self.place += count
            found = self.values[start : self.place]
        if not 0 <= count <= len(found):
            raise MeshError("a section breaks off, or has wrong counts before")
        return found

    def count(self) -> int:
        """Return the next number, which counts others."""
        return int(self.take(1)[0])

    def has_more(self) -> bool:
        """Tell whether anything is left, or in binary not just the end of the line, since bytes are lost or added."""
        left = self.values[self.place :]
        return left not in (b"\n", b"\r\n") if self.order else len(left) > 0

    def line(self) -> int:
        """Return a count that is a line of its own, as in binary of the format 2.2."""
        end = self.values.find(b"\n", self.place) + 1
        text, self.place = self.values[self.place : end].decode("ascii", "replace").strip(), end
        return whole(text, "a section")


# What is read of nodes and cells: the number and the coordinates of each node (n, 4), and kinds with rows (m, 1 + k) of
# corners, behind a number that repetitions share: that of the part of the model, or that of the cell, below zero.
_Read = tuple[Reals, list[tuple[int, NDArray[Any]]]]


def _of_second_format(nodes: _Numbers, cells: _Numbers) -> _Read:
    if nodes.order:
        return _of_second_binary(nodes, cells)
    numbered = nodes.take(4 * nodes.count()).reshape(-1, 4)
    rows: dict[int, list[list[float]]] = {kind: [] for kind in _CORNERS}
    count, numbers, cells.place = cells.count(), cells.values.tolist(), len(cells.values)
    for place, end in pairwise(accumulate(cells.lines)):
        # Its number, its kind, and a count of tags, which come before its corners.
        number, kind, tags = map(int, numbers[place : place + 3])
        # A number too many or too few would make other cells of all that follow.
        if tags < 0 or end != place + 3 + tags + _corners(kind):
            raise MeshError("its cells are not the lines of $Elements: a line has a number too many or too few")
        rows[kind].append([(tags > 1 and numbers[place + 4]) or -number, *numbers[place + 3 + tags : end]])
    if cells.lines[0] != 1 or len(cells.lines) != 1 + count:
        raise MeshError("a section breaks off, or has wrong counts before")
    return numbered, [(kind, np.array(found)) for kind, found in rows.items() if found]


def _of_second_binary(nodes: _Numbers, cells: _Numbers) -> _Read:
    count = nodes.line()
    # A number of four bytes and three coordinates of eight.
    records = nodes.take(28 * count, "u1").reshape(count, 28)
    numbers, places = (np.ascontiguousarray(part) for part in np.split(records, [4], axis=1))
    rows: dict[int, list[NDArray[Any]]] = {kind: [] for kind in _CORNERS}
    left = cells.line()
    while left > 0:
        kind, count, tags = cells.take(3, "i4").tolist()
        width = 1 + tags + _corners(kind)
        if tags < 0 or not 0 < count <= left:
            raise MeshError("a section breaks off, or has wrong counts before")
        block = cells.take(count * width, "i4").reshape(count, width)
        part = block[:, 2] if tags > 1 else np.zeros(count, np.int64)
        rows[kind].append(np.column_stack([np.where(part, part, -block[:, 0]), block[:, 1 + tags :]]))
        left -= count
    numbered = np.column_stack([numbers.view(f"{nodes.order}i4"), places.view(f"{nodes.order}f8")])
    return numbered, [(kind, np.concatenate(found)) for kind, found in rows.items() if found]


def _of_fourth_format(nodes: _Numbers, cells: _Numbers) -> _Read:
    numbered, rows = [np.zeros((0, 4))], []
    for _ in range(int(nodes.take(4)[0])):
        dimension, _, has_parameters = nodes.take(3, "i4").tolist()
        count = nodes.count()
        width = 3 + int(dimension) * int(has_parameters)
        numbers = nodes.take(count)
        numbered.append(np.column_stack([numbers, nodes.take(count * width, "f8").reshape(count, width)[:, :3]]))
    for _ in range(int(cells.take(4)[0])):
        kind, count = int(cells.take(3, "i4")[2]), cells.count()
        rows.append((kind, cells.take(count * (1 + _corners(kind))).reshape(count, -1)))
    return np.concatenate(numbered), rows


def _corners(kind: int) -> int:
    if kind not in _CORNERS:
        raise MeshError(f"it has cells of Gmsh's type {kind}, which are curved or rare; save it with linear ones")
    return _CORNERS[kind]


def _medit_rows(name: str, section: bytes, width: int) -> Reals:
    """Return the rows (n, width) of a section of a Medit mesh."""
    count, *values = _numbers(section, name) or [-1.0]
    if len(values) != count * width:
        raise MeshError(f"its section {name} announces {count:g} rows of {width} numbers, and has {len(values)}")
    return np.array(values).reshape(-1, width)


def _numbers(section: bytes, name: str) -> array[float]:
    return reals(section.decode("ascii", "replace").split(), f"its section {name}")


def _surface(vertices: Reals, faces: Sequence[NDArray[Any]], volumes: int, suffix: str) -> Raw:
    """Return the surface of faces (m, k) of each number of corners, beside so many cells with volume."""
    corners = np.concatenate([np.zeros(0), *(some.ravel() for some in faces)])
    sizes = np.repeat([some.shape[1] for some in faces], [len(some) for some in faces])
    if not len(sizes) and volumes:
        command = f"pip install pyvista meshio; {SURFACE.format(suffix)}"
        raise MeshError(f"it has {volumes:,} cells with volume and no faces; take its surface: {command}")
    if (corners != np.floor(corners)).any():
        raise MeshError("it has indices that are not integers")
    raw = cut_polygons(vertices, corners.astype(np.int64), sizes)
    return raw._replace(notes=(*raw.notes, *beside_volume(volumes, len(sizes))))


FORMATS = (Format((".mesh",), parse_medit, 40, 360, write_medit), Format((".msh",), parse_gmsh, 48, 460))
