"""VTK's XML files of polygon data (.vtp) and of unstructured grids of polygons (.vtu).

They are read here because VTK's own reader ends the process on damaged files, and meshio knows no polygon data.
Source: Kitware, "VTK XML file formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.raw_files import parse_xml
from sobolev_batch.surfaces.formats.text_formats import parsed_integers, parsed_numbers
from sobolev_batch.surfaces.formats.vtk.arrays import Encoded, Packing
from sobolev_batch.surfaces.formats.vtk.cells import POLYGON, STRIP, cell_triangles, sizes_between

Raw = tuple[NDArray[Any], NDArray[np.int64]]
Indices = NDArray[np.int64]

_RAW_DATA = re.compile(rb"<AppendedData[^>]{0,200}encoding\s{0,9}=\s{0,9}[\"']raw[\"'][^>]{0,200}>\s{0,99}_")
_END = b"</VTKFile>"
_SIZES = {"8": "1", "16": "2", "32": "4", "64": "8"}
_TYPES = {f"{name}{bits}": code + size for bits, size in _SIZES.items() for name, code in (("Int", "i"), ("UInt", "u"))}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
# Sections of a piece that are read, and the numbers of cells that it announces for them.
_SECTIONS = {"Points": "NumberOfPoints", "Polys": "NumberOfPolys", "Strips": "NumberOfStrips", "Cells": "NumberOfCells"}
_GHOSTS = "vtkGhostType"


def parse_vtk_xml(data: bytes, dataset: str) -> Raw:
    """Return the vertices and triangles of all pieces of an XML file.

    Args:
        data: Contents of the file.
        dataset: VTK's name for what the file should hold, "PolyData" or "UnstructuredGrid".

    Raises:
        MeshError: The file holds another data set, is compressed in a way that is not known, or its counts do
            not fit its contents.
    """
    document = _Document(data, dataset)
    points, triangles, before = [], [], 0
    for piece in document.pieces:
        own_points, own_triangles = document.points(piece), document.triangles(piece)
        outside = np.flatnonzero(((own_triangles < 0) | (own_triangles >= len(own_points))).any(axis=1))
        if outside.size:
            raise MeshError(
                f"{outside.size} of {len(own_triangles)} triangles of a piece have indices outside "
                f"0..{len(own_points) - 1}"
            )
        points.append(own_points)
        triangles.append(own_triangles + before)
        before += len(own_points)
    if not any(map(len, triangles)):
        raise MeshError("the file has no faces")
    return np.concatenate(points), np.concatenate(triangles)


@dataclass
class _Piece:
    """A piece of the data set.

    Attributes:
        counts: Announced number of entries of each section.
        arrays: Attributes and texts of the arrays, by section and name.
    """

    counts: dict[str, int]
    arrays: dict[tuple[str, str], tuple[dict[str, str], list[str]]] = field(default_factory=dict)


class _Document:
    """The arrays of a file, decoded when they are asked for.

    Attributes:
        pieces: Pieces of the data set.
    """

    def __init__(self, data: bytes, dataset: str) -> None:
        self.pieces: list[_Piece] = []
        self._dataset, self._path = dataset, [""]
        self._texts: list[str] | None = None
        self._file: dict[str, str] = {}
        self._appended: list[str] = []
        raw = _RAW_DATA.search(data)
        if not data.rstrip().endswith(_END):
            raise MeshError(f"the file breaks off: it does not end with {_END.decode()}")
        # Raw bytes are no XML.
        document = data if raw is None else data[: raw.end()] + b"</AppendedData>" + _END
        parse_xml(document, "VTK", self._start, self._end, self._text)
        if raw is None:
            text = "".join("".join(self._appended).split())
            self._far = Encoded(text.partition("_")[2].encode(), is_base64=True)
        else:
            self._far = Encoded(data[raw.end() :], is_base64=False)
        self._packing = Packing.of(self._file, len(data))

    def points(self, piece: _Piece) -> NDArray[Any]:
        """Return the points of a piece (n, 3)."""
        names = [name for section, name in piece.arrays if section == "Points"]
        if len(names) != 1:
            raise MeshError(f"a piece of the file has {len(names)} arrays of points, expected one")
        return self._array(piece, "Points", names[0], 3 * piece.counts["Points"]).reshape(-1, 3)

    def triangles(self, piece: _Piece) -> Indices:
        """Return the triangles of a piece (m, 3)."""
        if ("CellData", _GHOSTS) in piece.arrays and self._array(piece, "CellData", _GHOSTS).any():
            raise MeshError(
                "the file has ghost cells, which belong to other parts of a surface; remove them: in PyVista by "
                "mesh.remove_ghost_cells()"
            )
        if self._dataset == "UnstructuredGrid":
            corners, sizes = self._cells(piece, "Cells")
            kinds = self._indices(piece, "Cells", "types", len(sizes))
        else:
            parts = [(kind, self._cells(piece, name)) for kind, name in ((POLYGON, "Polys"), (STRIP, "Strips"))]
            kinds = np.concatenate([np.full(len(sizes), kind) for kind, (_, sizes) in parts])
            corners, sizes = (np.concatenate(arrays) for arrays in zip(*(part for _, part in parts), strict=True))
        return cell_triangles(kinds, corners, sizes) if len(sizes) else np.empty((0, 3), dtype=np.int64)

    def _cells(self, piece: _Piece, section: str) -> tuple[Indices, Indices]:
        """Return corners and sizes of the cells of a section."""
        count = piece.counts[section]
        if not count:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        ends = self._indices(piece, section, "offsets", count)
        corners = self._indices(piece, section, "connectivity")
        return corners, sizes_between(np.concatenate([[0], ends]), len(corners))

    def _indices(self, piece: _Piece, section: str, name: str, count: int | None = None) -> Indices:
        indices = self._array(piece, section, name, count)
        if indices.dtype.kind not in "iu":
            raise MeshError(f"the array {name} of {section} holds {indices.dtype}, expected integers")
        return indices.astype(np.int64)

    def _array(self, piece: _Piece, section: str, name: str, count: int | None = None) -> NDArray[Any]:
        """Return the values of an array, as many as there should be if that is known."""
        if (section, name) not in piece.arrays:
            raise MeshError(f"a piece of the file has no array {name} of {section}")
        attributes, texts = piece.arrays[section, name]
        code = _TYPES.get(attributes.get("type", ""))
        if code is None:
            raise MeshError(f"the array {name[:40]} of {section} has the unknown type {attributes.get('type')!r}")
        match attributes.get("format"):
            case "ascii":
                words = "".join(texts).split()
                parsed = parsed_numbers if code[0] == "f" else parsed_integers
                values = np.array(parsed(words, f"the array {name[:40]}"), dtype=code)
            case "binary":
                inside = Encoded("".join("".join(texts).split()).encode(), is_base64=True)
                values = self._packing.values(inside, 0, code)
            case "appended":
                values = self._packing.values(self._far, int(attributes["offset"]), code)
            case other:
                raise MeshError(f"the array {name[:40]} of {section} has the unknown format {other!r}")
        if count is not None and len(values) != count:
            raise MeshError(f"the array {name[:40]} of {section} has {len(values)} values, expected {count}")
        return values

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        section = self._path[-1]
        self._path.append(name)
        self._texts = None
        if name == "VTKFile":
            if attributes.get("type") != self._dataset:
                raise MeshError(
                    f"the file holds {attributes.get('type')!r}, expected {self._dataset!r} by its name; name it after "
                    "what it holds: PolyData .vtp, UnstructuredGrid .vtu"
                )
            self._file = attributes
        elif name == "Piece":
            self.pieces.append(_Piece({key: int(attributes.get(count, 0)) for key, count in _SECTIONS.items()}))
        elif name == "AppendedData":
            self._texts = self._appended
        elif name == "DataArray" and self.pieces:
            key = section, attributes.get("Name", "")
            if section in _SECTIONS or key == ("CellData", _GHOSTS):
                if key in self.pieces[-1].arrays:
                    raise MeshError(f"a piece of the file has two arrays {key[1][:40]} of {section}")
                self._texts = []
                self.pieces[-1].arrays[key] = attributes, self._texts

    def _end(self, name: str) -> None:
        self._path.pop()
        self._texts = None

    def _text(self, text: str) -> None:
        if self._texts is not None:
            self._texts.append(text)
