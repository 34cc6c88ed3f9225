"""VTK's files: polygons and strips of triangles, also in unstructured grids.

They are parsed here because VTK itself ends the process, or fills the memory, on some damaged files, and returns the
rest of others. Source: Kitware, "VTK File Formats", https://docs.vtk.org/en/latest/vtk_file_formats.
"""

import base64
import re
import zlib
from functools import partial
from io import BytesIO
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices
from sobolev_batch.errors import MeshError
from sobolev_batch.extras.formats.shared import BYTE_ORDERS, SURFACE, beside_volume, typed, xml_tree
from sobolev_batch.geometry.formats.by_name import Format
from sobolev_batch.geometry.formats.parsing import Raw, triangle_strips, unpacked_limit, whole
from sobolev_batch.geometry.formats.polygons import cut_polygons

# VTK's numbers for types of cells: vertices and lines, those with area, of two corners at most, and those with flat
# faces around a volume.
_WITHOUT_AREA, _VTK_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = (0, 1, 2, 3, 4, 21), 5, 6, 7, 8, 9
_OF_TWO, _WITH_VOLUME = (0, 1, 3), (*range(10, 17), 41, 42)
_PACKED_ANEW = "python -c \"import pyvista; pyvista.read('scan.vtp').save('new.vtp')\""
_KINDS, _FACES = ("polydata", "unstructuredgrid", "unstructured_grid"), ("polys", "strips", "cells")
# The codes that NumPy has for the types of numbers in XML and in legacy files, and what these call cells.
_TYPES = {f"{kind}{bits}": f"{kind[0]}{bits // 8}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)}
_LEGACY = {"char": "i1", "short": "i2", "int": "i4", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4"}
_LEGACY |= {f"unsigned_{name}": f"u{_LEGACY[name][1]}" for name in ("char", "short", "int", "long")}
_LEGACY |= {f"vtktype{name}": code for name, code in _TYPES.items()}
_CELLS = {"polygons": "polys", "triangle_strips": "strips", "cells": "cells", "vertices": "verts", "lines": "lines"}
_START = re.compile(
    rb"\s*# vtk datafile version +(\d+)\.\d[^\n]*\n[^\n]*\n\s*(ascii|binary)\s+dataset\s+(\w+)[ \t\r]*\n", re.IGNORECASE
)
_LINE = re.compile(rb"\s*([^\n]{0,1000})\n?")
# What ends the values of a file, which stand before its points, and what is told of an array.
_SKIPPED = {"field": re.compile(rb"\s(?=(?i:points)\s+\d+\s+\w+\s)"), "metadata": re.compile(rb"\n[ \t\r]*\n|\Z")}
_GHOSTS = re.compile(
    rb"(COLOR_SCALARS )?vtkGhostType(?: 1 \d+)?(?: unsigned_char)?(?: 1)?[ \r]*\n(?:LOOKUP_TABLE \w+[ \r]*\n)?"
)
# What arrays in XML hold, by their names; old versions of VTK use the second one.
_SECTIONS = ("Points", "Polys", "Strips", "Cells", "CellData")
_NAMES = {"celldata vtkghosttype": "ghosts", "celldata vtkghostlevels": "ghosts", "cells types": "types"}
_APPENDED = re.compile(rb"<AppendedData[^>]{0,200}encoding\s{0,9}=\s{0,9}[\"'](raw|base64)[\"'][^>]{0,200}>\s{0,99}_")
_END, _END_OF_DATA = b"</VTKFile>", b"</AppendedData>"
_PACKERS = "vtkZLibDataCompressor", "vtkLZMADataCompressor"
# Memory that a block packed by LZMA may take: VTK's own take 9 MB, and a damaged one asks for gigabytes.
_LZMA_BYTES = 1 << 27
# The arrays of a part of a data set: "points", "ghosts", "types", and "polys offsets" and "polys connectivity" or such.
_Arrays = dict[str, NDArray[Any]]
_NONE = np.zeros(0, np.int64)


def parse_vtk(data: bytes, suffix: str) -> Raw:
    """Return the vertices and triangles of a VTK file, legacy (.vtk) or XML (.vtp, .vtu)."""
    kind, pieces = _of_legacy(data) if suffix == ".vtk" else _of_xml(data)
    if kind.lower() not in _KINDS:
        raise MeshError(f"the file holds {kind[:40]}, no polygons; take its surface: {SURFACE.format(suffix)}")
    if any(piece.get("ghosts", _NONE).any() for piece in pieces):
        raise MeshError("it has ghost cells, which belong to other parts; remove them by PyVista's remove_ghost_cells")
    cells, points, before = [(_NONE, _NONE, _NONE)], [np.zeros((0, 3), np.float32)], 0
    for piece in pieces:
        coordinates = piece.get("points", points[0])
        for name, cell_type in zip(_FACES, (_POLYGON, _STRIP, None), strict=True):
            corners = piece.get(f"{name} connectivity", _NONE).astype(np.int64)
            offsets = piece.get(f"{name} offsets", _NONE).astype(np.int64)
            sizes = np.diff(offsets, prepend=0)
            if (sizes < 0).any() or sizes.sum() != len(corners):
                raise MeshError(f"the offsets of its {name} do not run from 0 up to their {len(corners)} corners")
            kinds = piece.get("types", _NONE) if cell_type is None else np.full(len(sizes), cell_type)
            if len(kinds) != len(sizes):
                raise MeshError(f"it has {len(sizes)} cells and the types of {len(kinds)}")
            if len(pieces) > 1 and corners.size and not 0 <= corners.min() <= corners.max() < len(coordinates) // 3:
                raise MeshError(f"a piece has an index outside 0..{len(coordinates) // 3 - 1}")
            cells.append((kinds, corners + before, sizes))
        points.append(coordinates.reshape(-1, 3))
        before += len(points[-1])
    kinds, corners, sizes = map(np.concatenate, zip(*cells, strict=True))
    corners, sizes, notes = _faces(kinds, corners, sizes, suffix)
    raw = cut_polygons(np.concatenate(points), corners, sizes)
    return raw._replace(notes=raw.notes + notes)


class _Legacy:
    """The lines and arrays of a legacy file, one after the other."""

    def __init__(self, data: bytes, place: int, is_text: bool) -> None:
        self.data, self.place, self.is_text = data, place, is_text

    def line(self) -> list[str]:
        """Return the words of the next line that has some; none at the end."""
        found = _LINE.match(self.data, self.place)
        self.place = found.end() if found else len(self.data)
        return found[1].decode("ascii", "replace").split() if found else []

    def array(self, count: int, kind: str) -> NDArray[Any]:
        """Return so many numbers of a type."""
        if kind.lower() not in _LEGACY:
            raise MeshError(f"it has numbers of the type {kind[:40]!r}, which is none of {', '.join(_LEGACY)}")
        dtype, left = np.dtype(_LEGACY[kind.lower()]).newbyteorder(">"), len(self.data) - self.place
        if not 0 <= count <= left // (1 if self.is_text else dtype.itemsize):
            raise MeshError(f"the file breaks off: it announces {count} numbers, and has {left} bytes more")
        if not self.is_text:
            self.place += count * dtype.itemsize
            # Data that are shifted by a byte take the end of the line for a number.
            if count and self.data[self.place : self.place + 1] not in (b"", b"\n", b"\r"):
                raise MeshError("its data in binary do not end where a line does: bytes are missing, or too many")
            return np.frombuffer(self.data, dtype, count, self.place - count * dtype.itemsize)
        words = self.data[self.place :].decode("ascii", "replace").split(None, count)
        self.place = len(self.data) - sum(map(len, words[count:]))
        if len(words) < count:
            raise MeshError(f"the file breaks off: it announces {count} numbers, and has {len(words)}")
        return typed(words[:count], dtype.newbyteorder("="), "the file")

    def cells(self, counts: tuple[int, int], is_new: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the places where cells of a section end, and the corners of all, by the counts of its first line."""
        if is_new:
            found = []
            for name, count in zip(("OFFSETS", "CONNECTIVITY"), counts, strict=True):
                words = self.line()
                if len(words) != 2 or words[0].upper() != name:
                    raise MeshError(f"it has the line {' '.join(words)[:80]!r}, expected {name} and a type")
                found.append(self.array(count, words[1]))
            offsets, corners = found
            if offsets[:1].any():
                raise MeshError("the offsets of its cells do not begin with 0")
            return offsets[1:], corners
        numbers = self.array(counts[1], "int")
        places, place, values = list[int](), 0, numbers.tolist()
        while len(places) < counts[0] and place < len(values):
            places.append(place)
            place += 1 + (values[place] if values[place] >= 0 else len(values))
        if place != len(values) or len(places) != counts[0]:
            raise MeshError(f"a section announces {counts[0]} cells of {counts[1]} numbers, which it has not")
        return np.cumsum(numbers[places], dtype=np.int64), np.delete(numbers, places)


def _of_legacy(data: bytes) -> tuple[str, list[_Arrays]]:
    """Return what kind of data set a legacy file has, and the arrays of its one piece."""
    start = _START.match(data)
    if start is None:
        raise MeshError("it does not begin as a legacy file of VTK does, or names no data set")
    kind, found, done = start[3].decode("ascii", "replace"), _Arrays(), set[str]()
    file = _Legacy(data, start.end(), start[2].lower() == b"ascii")
    while kind.lower() in _KINDS and (words := file.line()):
        name = words[0].lower()
        if name in done and name not in _SKIPPED:
            raise MeshError(f"it repeats the section {name.upper()}")
        done.add(name)
        match [name, *words[1:]]:
            case ["points", count, number]:
                found["points"] = file.array(3 * whole(count, name), number)
            case [("polygons" | "triangle_strips" | "cells" | "vertices" | "lines"), first, second]:
                ends, corners = file.cells((whole(first, name), whole(second, name)), int(start[1][:9]) >= 5)
                found |= {f"{_CELLS[name]} offsets": ends, f"{_CELLS[name]} connectivity": corners}
            case ["cell_types", count]:
                found["types"] = file.array(whole(count, name), "int")
            case ["field" | "metadata", *_] if end := _SKIPPED[name].search(data, file.place):
                file.place = end.end()
            case ["cell_data", count]:
                # Only the values of ghost cells matter.
                last = data.find(b"POINT_DATA ", file.place)
                if ghosts := _GHOSTS.search(data, file.place, len(data) if last < 0 else last):
                    file.place = ghosts.end()
                    number = "double" if ghosts[1] and file.is_text else "unsigned_char"
                    found["ghosts"] = file.array(whole(count, name), number)
                break
            case ["point_data", _]:
                file.place = max(data.find(b"CELL_DATA ", file.place), 0) or len(data)
            case _:
                raise MeshError(f"it has the line {' '.join(words)[:80]!r} where legacy files have none")
    return kind, [found]


def _of_xml(data: bytes) -> tuple[str, list[_Arrays]]:
    """Return what kind of data set a file of XML has, and the arrays of its pieces."""
    if not data.rstrip().endswith(_END):
        raise MeshError(f"the file breaks off: it does not end with {_END.decode()}")
    # Data behind the XML need not be XML.
    start, end = _APPENDED.search(data), data.rfind(_END_OF_DATA)
    document = data if start is None else data[: start.end()] + _END_OF_DATA + _END
    behind = (data[start.end() : end], start[1] == b"base64") if start and end > 0 else (b"", False)
    root, pieces = xml_tree(document, "VTK"), list[_Arrays]()
    for piece in root.iter("Piece"):
        pieces.append(arrays := _Arrays())
        for section in piece:
            for one in section.iter("DataArray") if section.tag in _SECTIONS else ():
                key = "points" if section.tag == "Points" else f"{section.tag} {one.get('Name', '')}".lower()
                key = _NAMES.get(key, key)
                if key in arrays:
                    raise MeshError(f"a piece repeats the array {key[:40]!r}")
                if not key.startswith("celldata"):
                    arrays[key] = _decoded(one, behind, root, unpacked_limit(len(data)))
        _require_announced(piece, arrays)
    return root.get("type", "nothing"), pieces


def _require_announced(piece: Element, arrays: _Arrays) -> None:
    """Refuse a piece whose arrays have other numbers of entries than it announces."""
    lengths = {name: len(arrays.get(f"{name} offsets", _NONE)) for name in _FACES}
    for name, length in {**lengths, "points": len(arrays.get("points", _NONE)) / 3}.items():
        announced = whole(piece.get(f"NumberOf{name.capitalize()}", "0"), "a piece")
        if announced != length:
            raise MeshError(f"a piece announces {announced} {name}, and has {length:g}")


def _decoded(array: Element, behind: tuple[bytes, bool], root: Element, most: int) -> NDArray[Any]:
    """Return the values of a DataArray, from its text or from what lies behind the XML, as at most so many bytes."""
    kind, form = array.get("type", ""), array.get("format", "ascii")
    owner = f"its array {array.get('Name')!r}"
    # Elements within it have texts of their own.
    text = "".join([array.text or "", *(inner.tail or "" for inner in array)])
    if kind.lower() not in _TYPES or form not in ("ascii", "binary", "appended"):
        raise MeshError(f"{owner} has the type {kind[:40]!r} and the format {form[:40]!r}, which VTK does not have")
    order, head_kind = root.get("byte_order", "LittleEndian"), root.get("header_type", "UInt32").lower()
    if order not in BYTE_ORDERS or head_kind not in ("uint32", "uint64"):
        raise MeshError(f"it has the byte order {order[:40]!r} and counts in {head_kind[:40]!r}, unlike VTK's files")
    dtype = np.dtype(_TYPES[kind.lower()])
    if form == "ascii":
        return typed(text.split(), dtype, owner)
    head = np.dtype(_TYPES[head_kind]).newbyteorder(BYTE_ORDERS[order])
    source, is_base64 = behind if form == "appended" else ("".join(text.split()).encode(), True)
    place = whole(array.get("offset", ""), owner) if form == "appended" else 0

    def fetch(place: int, count: int) -> tuple[bytes, int]:
        """Return so many bytes from a place on, and the place behind them."""
        end = place + (-(-count // 3) * 4 if is_base64 else count)
        found = base64.b64decode(source[place:end], validate=True)[:count] if is_base64 else source[place:end]
        if len(found) < count or place < 0:
            raise MeshError(f"the data of {owner} break off")
        return found, end

    # The number of bytes that follow; of blocks in packed data.
    first, after = fetch(place, head.itemsize)
    count = int(np.frombuffer(first, head)[0])
    if packed := root.get("compressor"):
        if packed not in _PACKERS:
            raise MeshError(f"it is packed by {packed[:40]!r}; save it anew, as .vtp or .vtu: {_PACKED_ANEW}")
        header, after = fetch(place, head.itemsize * (3 + count))
        size, last, *lengths = np.frombuffer(header, head)[1:].tolist()
        sizes = [*[size] * (count - 1), last or size][:count]
        if sum(sizes) > most:
            raise MeshError(f"its arrays unpack to more than {most} bytes: no mesh file shrinks that far")
        blocks, end = fetch(after, sum(lengths))
        stream = BytesIO(blocks)
        # One byte more shows whether there are more.
        pairs = zip(lengths, sizes, strict=True)
        parts = [_unpacked(stream.read(length), expected + 1, packed) for length, expected in pairs]
        if [*map(len, parts)] != sizes:
            raise MeshError(f"{owner} unpacks to other sizes than announced")
        data = b"".join(parts)
    elif is_base64 and source[after - 1 : after] == b"=":
        # Some programs end the count as a text of its own.
        data, end = fetch(after, count)
    else:
        data, end = fetch(place, head.itemsize + count)
        data = data[head.itemsize :]
    if len(data) % dtype.itemsize:
        raise MeshError(f"{owner} has {len(data)} bytes, which are no whole numbers of {dtype.itemsize}")
    if form == "binary" and end != len(source):
        raise MeshError(f"{owner} has more data than it announces")
    return np.frombuffer(data, dtype.newbyteorder(BYTE_ORDERS[order]))


def _unpacked(block: bytes, most: int, packed: str) -> bytes:
    """Return at most so many bytes of a packed block."""
    if packed == _PACKERS[0]:
        return zlib.decompressobj().decompress(block, most)
    import lzma  # some builds of Python lack it

    try:
        return lzma.LZMADecompressor(memlimit=_LZMA_BYTES).decompress(block, most)
    except lzma.LZMAError as error:
        raise MeshError("its packed data are damaged") from error


def _faces(kinds: Indices, corners: Indices, sizes: Indices, suffix: str) -> tuple[Indices, Indices, tuple[str, ...]]:
    """Return the corners of faces, and their numbers, from those of all cells."""
    # What has more corners than a line is none, whatever its type.
    has_area = ~np.isin(kinds, _WITHOUT_AREA) | (np.isin(kinds, _OF_TWO) & (sizes > 2))
    has_volume = np.isin(kinds, _WITH_VOLUME)
    # Without any face beside them, they are refused.
    has_area &= ~has_volume | ~(has_area & ~has_volume).any()
    is_strip, is_pixel = kinds == _STRIP, kinds == _PIXEL
    known = [kinds == _VTK_TRIANGLE, (kinds == _QUAD) | is_pixel, (kinds == _POLYGON) | is_strip]
    wrong = np.flatnonzero(has_area & (sizes != np.select(known, [3, 4, sizes], -1)))
    if wrong.size:
        found = f"cell {wrong[0] + 1} is of VTK's type {kinds[wrong[0]]} with {sizes[wrong[0]]} corners"
        raise MeshError(f"{found}, no flat polygon; take the surface: {SURFACE.format(suffix)}")
    # The corners of a pixel lie row by row, and not around it.
    last = (np.cumsum(sizes) - sizes)[is_pixel, None] + [2, 3]
    corners[last] = corners[last[:, ::-1]]
    strips = triangle_strips(corners[np.repeat(is_strip, sizes)], sizes[is_strip])
    has_area &= ~is_strip
    corners = np.concatenate([corners[np.repeat(has_area, sizes)], strips.ravel()])
    sizes = np.concatenate([sizes[has_area], np.full(len(strips), 3)])
    return corners, sizes, beside_volume(int(has_volume.sum()), len(sizes))


FORMATS = (
    Format((".vtk",), partial(parse_vtk, suffix=".vtk"), 22, 290),
    *(Format((suffix,), partial(parse_vtk, suffix=suffix), 10, 215) for suffix in (".vtp", ".vtu")),
)
