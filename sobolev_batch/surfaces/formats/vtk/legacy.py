"""VTK's legacy files, text and binary, of polygon data and of unstructured grids of polygons.

They are read here because VTK's own reader ends the process on damaged files, and meshio knows no polygon data.
Source: Kitware, "VTK file formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.text_formats import parsed_integers, parsed_numbers
from sobolev_batch.surfaces.formats.vtk.cells import POLYGON, STRIP, cell_triangles, sizes_between, split_counted

Raw = tuple[NDArray[Any], NDArray[np.int64]]
Indices = NDArray[np.int64]

_HEADER = re.compile(
    rb"# vtk DataFile Version (\d{1,3})\.\d{1,3}[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s+DATASET\s+(\w+)", re.IGNORECASE
)
_WORD = re.compile(rb"\s*(\S+)")
_LINE_END = re.compile(rb"[ \t\r]*\n")
_BLANK_LINE = re.compile(rb"\n[ \t\r]*\n")
_REALS = {"float": ">f4", "double": ">f8"}
_INTEGERS = {"char": ">i1", "unsigned_char": ">u1", "short": ">i2", "unsigned_short": ">u2"}
_INTEGERS |= {"int": ">i4", "unsigned_int": ">u4", "long": ">i8", "unsigned_long": ">u8"}
_INTEGERS |= {"vtkidtype": ">i4", "vtktypeint32": ">i4", "vtktypeint64": ">i8"}
# Sections of cells, by data set, with the kinds of their cells; None where a section of its own lists them.
_CELLS = {"POLYDATA": {"VERTICES": 2, "LINES": 4, "POLYGONS": POLYGON, "TRIANGLE_STRIPS": STRIP}}
_CELLS |= {"UNSTRUCTURED_GRID": {"CELLS": -1}}
_LONGEST_WORD, _MOST_DIGITS = 100, 18
# Text that a number takes at least, and that is looked through for it at first.
_LEAST_TEXT, _USUAL_TEXT = 2, 32
# Words of a text at a time.
_WORDS = 1 << 16
# Since this version offsets of cells stand in place of their sizes.
_OFFSETS_VERSION = 5


def parse_vtk(data: bytes, path: Path) -> Raw:
    """Return the vertices and triangles of a legacy VTK file.

    Args:
        data: Contents of the file.
        path: Path of the file; unused, since a VTK file refers to no others.

    Raises:
        MeshError: The file holds another data set, or its counts do not fit its contents.
    """
    header = _HEADER.match(data)
    if header is None:
        raise MeshError("the file does not begin with the header of a legacy VTK file")
    version, dataset = int(header[1]), header[3].decode().upper()
    if version > _OFFSETS_VERSION:
        raise MeshError(f"the file has the version {version} of the format, which is not known yet")
    if dataset not in _CELLS:
        raise MeshError(
            f"the file holds {dataset[:40]}, no polygons; take its surface first: in PyVista by "
            "mesh.extract_surface().triangulate(), then save it as .vtp"
        )
    sections = _Sections(_Cursor(data, header.end(), binary=header[2].upper() == b"BINARY"), version, dataset)
    if sections.points is None:
        raise MeshError("the file has no section POINTS")
    return sections.points, sections.triangles()


class _Cursor:
    """Words and numbers of a file, one after the other."""

    def __init__(self, data: bytes, place: int, *, binary: bool) -> None:
        self._data, self._place, self._binary = data, place, binary

    def word(self) -> str:
        """Return the next word, empty at the end of the file."""
        match = _WORD.match(self._data, self._place, self._place + 2 * _LONGEST_WORD)
        if match is None:
            if self._data[self._place :].strip():
                raise MeshError(f"there is no word after byte {self._place} of the file")
            return ""
        self._place = match.end()
        return match[1][:_LONGEST_WORD].decode("ascii", errors="replace")

    def count(self, section: str) -> int:
        """Return the next word as the count that a section announces."""
        word = self.word()
        if not (word.isascii() and word.isdigit()) or len(word) > _MOST_DIGITS:
            raise MeshError(f"the section {section} announces {word[:40]!r} entries")
        return int(word)

    def numbers(self, count: int, kind: str, section: str) -> NDArray[Any]:
        """Return the next numbers.

        Args:
            count: How many there should be.
            kind: VTK's name of their type.
            section: Section that they belong to, as messages name it.
        """
        code = (_REALS | _INTEGERS).get(kind.lower())
        if code is None:
            raise MeshError(
                f"the section {section} has values of the type {kind[:40]!r}; save it without them: in PyVista by "
                "mesh.clear_field_data(), then mesh.save"
            )
        dtype = np.dtype(code)
        left = len(self._data) - self._place
        if count * (dtype.itemsize if self._binary else _LEAST_TEXT) > left + 1:
            raise MeshError(f"the section {section} announces {count} numbers, but only {left} bytes follow")
        if self._binary:
            return self._packed(count, dtype, section)
        parsed = parsed_integers if kind.lower() in _INTEGERS else parsed_numbers
        values = np.empty(count, dtype=dtype.newbyteorder("="))
        # As words, all numbers at once would take forty times the memory of their text.
        for first in range(0, count, _WORDS):
            part = values[first : first + _WORDS]
            words = self._words(len(part))
            if len(words) < len(part):
                raise MeshError(f"the section {section} announces {count} numbers, found {first + len(words)}")
            part[:] = parsed(words, f"the section {section}")
        return values

    def skip_metadata(self) -> None:
        """Go to the next blank line."""
        match = _BLANK_LINE.search(self._data, self._place)
        self._place = len(self._data) if match is None else match.end()

    def _packed(self, count: int, dtype: np.dtype[Any], section: str) -> NDArray[Any]:
        line_end = _LINE_END.match(self._data, self._place)
        start = self._place if line_end is None else line_end.end()
        end = start + count * dtype.itemsize
        if line_end is None or end > len(self._data):
            raise MeshError(f"the section {section} announces {count} numbers, more than the file holds")
        self._place = end
        return np.frombuffer(self._data, dtype, count, start).astype(dtype.newbyteorder("="))

    def _words(self, count: int) -> list[str]:
        """Return so many words; fewer at the end of the file."""
        length = _USUAL_TEXT * (count + 1)
        while True:
            window = self._data[self._place : self._place + length]
            words = window.split(None, count)
            complete = len(words) > count
            if complete or length >= len(self._data) - self._place:
                break
            length *= 2
        rest = len(words.pop()) if complete else 0
        self._place += len(window) - rest
        if not complete and count and not self._data[-1:].isspace():
            raise MeshError("the file breaks off in its last line; if it is whole, end the line")
        return [word.decode("ascii", errors="replace") for word in words]


class _Sections:
    """The sections of a data set up to the values at its points and cells, which do not matter.

    Attributes:
        points: Vertices (n, 3); None where there are none.
    """

    def __init__(self, cursor: _Cursor, version: int, dataset: str) -> None:
        self.points: NDArray[Any] | None = None
        self._cells: dict[str, tuple[Indices, Indices]] = {}
        self._kinds: Indices | None = None
        self._has_offsets = version >= _OFFSETS_VERSION
        self._known = _CELLS[dataset]
        while (section := cursor.word().upper()) not in ("", "POINT_DATA", "CELL_DATA"):
            self._read(section, cursor)

    def triangles(self) -> Indices:
        """Return the triangles of all cells (m, 3)."""
        if not self._cells:
            raise MeshError("the file has no faces")
        corners, sizes = (np.concatenate(parts) for parts in zip(*self._cells.values(), strict=True))
        kinds = self._kinds
        if kinds is None:
            kinds = np.repeat([self._known[name] for name in self._cells], [len(s) for _, s in self._cells.values()])
        if len(kinds) != len(sizes):
            raise MeshError(f"the file has {len(sizes)} cells and {len(kinds)} types of cells")
        return cell_triangles(kinds, corners, sizes)

    def _read(self, section: str, cursor: _Cursor) -> None:
        if section == "METADATA":
            cursor.skip_metadata()
        elif section == "FIELD":
            self._skip_fields(cursor)
        elif section == "POINTS" and self.points is None:
            count = cursor.count(section)
            self.points = cursor.numbers(3 * count, cursor.word(), section).reshape(-1, 3)
        elif section in self._known and section not in self._cells:
            self._cells[section] = self._read_cells(section, cursor)
        elif section == "CELL_TYPES" and "CELLS" in self._known and self._kinds is None:
            self._kinds = cursor.numbers(cursor.count(section), "int", section).astype(np.int64)
        else:
            raise MeshError(f"the section {section!r} is there twice, or has no place in a file of polygons")

    def _read_cells(self, section: str, cursor: _Cursor) -> tuple[Indices, Indices]:
        """Return corners and sizes of the cells of a section."""
        count, total = cursor.count(section), cursor.count(section)
        if not self._has_offsets:
            return split_counted(cursor.numbers(total, "int", section).astype(np.int64), count)
        arrays = []
        for name, length in (("OFFSETS", count), ("CONNECTIVITY", total)):
            word, kind = cursor.word().upper(), cursor.word()
            if word != name or kind.lower() not in _INTEGERS:
                raise MeshError(f"the section {section} has {word!r} of {kind!r} where integer {name} were expected")
            arrays.append(cursor.numbers(length, kind, section).astype(np.int64))
        offsets, corners = arrays
        return corners, sizes_between(offsets, total)

    def _skip_fields(self, cursor: _Cursor) -> None:
        cursor.word()
        for _ in range(cursor.count("FIELD")):
            name = cursor.word()
            if name.upper() == "METADATA":
                cursor.skip_metadata()
                name = cursor.word()
            components, entries = cursor.count(name), cursor.count(name)
            cursor.numbers(components * entries, cursor.word(), f"FIELD {name}")
