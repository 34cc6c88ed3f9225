"""PLY files: text and both byte orders, polygons and strips of triangles, beside properties of any kind.

Format: G. Turk, "The PLY polygon file format" (1994). Programs have added the element ``tristrips``, lines ``obj_info``
and names of types such as ``float32``. A text is read as a stream of numbers, as C programs read it, so that its lines
may break anywhere, and then parsed as a binary file of doubles.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Indices
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.parsing import MOST_LINES, Raw, as_declared, reals, triangle_strips, whole
from sobolev_batch.geometry.formats.polygons import cut_polygons
from sobolev_batch.geometry.mesh import Mesh

# A header ends within this many bytes: room for a thousand lines, and quick to look through.
HEADER_BYTES = 1 << 16
# The last line ends as the first one does, where it can: behind a lone carriage return, a line feed may be data.
_HEADER = re.compile(rb"(?s)ply[ \t]*(\r\n|\r|\n)(.*?)(?<=[\r\n])end_header[ \t]*(?:\1|\r\n|\n|\r)")
# What some programs write behind binary data.
_LAST_LINE = (b"", b"\n", b"\r\n")
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# The codes that NumPy and the module struct have for the types.
_CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
_CODES |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
_CODES |= {"int64": "q", "uint64": "Q", "float16": "e", "float32": "f", "float64": "d"}
_TEXT = "=d"
_CORNERS = ("vertex_indices", "vertex_index")
_WANTED = {"vertex": ("x", "y", "z"), "face": _CORNERS, "tristrips": _CORNERS}
# Bytes of a number in text: a digit and the character that ends it.
_TEXT_BYTES = 2
# Bytes of text that become words at a time, which take some twenty times as many.
_CHUNK_BYTES = 1 << 18
_SPACE = re.compile(rb"\s")
# NumPy has no types of 2 GiB; longer rows are read one by one.
_LONGEST_ROW = 1 << 30
# Usual bytes of a corner in a file that is not read yet.
_CORNER_BYTES = 4
# Measured peak of reading, for each triangle of a binary file of triangles or other polygons, each face of a text, and
# each vertex beyond one for two triangles.
_TRIANGLE_MEMORY, _POLYGON_MEMORY, _TEXT_MEMORY, _VERTEX_MEMORY = 110, 150, 330, 70

# By the names of properties: values in all rows, one after the other; and the lengths of lists.
_Values = dict[str, NDArray[Any]]
_Sizes = dict[str, Indices]


@dataclass(frozen=True)
class _Property:
    """A property: its type in the header, and the types of its values, and of the lengths of its lists, in the body."""

    declared: str
    stored: str
    length: str | None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: dict[str, _Property]

    def least_bytes(self, is_text: bool) -> int:
        """Return the fewest bytes that a row takes."""
        columns = self.properties.values()
        return sum(_TEXT_BYTES if is_text else struct.calcsize(one.length or one.stored) for one in columns)


def parse_ply(data: bytes) -> Raw:
    """Return the vertices and triangles of a PLY file, in its own precision."""
    elements, start, is_text = _parsed_header(data[:HEADER_BYTES])
    counts = {name: element.count for name, element in elements.items()}
    left = len(data) - start
    # The last number of a text need not be followed by anything.
    if sum(one.count * one.least_bytes(is_text) for one in elements.values()) - is_text > left:
        raise MeshError(f"the PLY header announces {counts}, but only {left} bytes follow")
    numbers, lines = _numbers(data, start, sum(counts.values())) if is_text else (data, array("I"))
    body, place = memoryview(numbers).cast("B"), 0 if is_text else start
    columns, rows = dict[str, tuple[_Values, _Sizes]](), [np.zeros(0, np.int64)]
    for name, element in elements.items():
        values, sizes, place = _columns(element, _WANTED.get(name, ()), body, place)
        columns[name] = values, sizes
        # Rows of nothing take no room in a file, which may announce any number of them.
        if element.properties:
            rows.append(np.broadcast_to(len(element.properties) + sum(sizes.values()), element.count))
    if is_text:
        _require_aligned(np.frombuffer(lines, np.uintc), rows)
    if body[place : place + 3].tobytes() not in _LAST_LINE:
        more = f"{(len(body) - place) // 8} numbers" if is_text else f"{len(body) - place} bytes"
        raise MeshError(f"the PLY header announces {counts}, but {more} more follow")
    values, sizes = columns.get("vertex", ({}, {}))
    axes = [values[name] for name in values if name not in sizes]
    if len(axes) < 3:
        raise MeshError("the PLY header declares no vertices with the numbers x, y and z")
    vertices = np.stack(axes, axis=1)
    found = [cut_polygons(vertices, *_corners("face", *columns["face"]))] if counts.get("face") else []
    if counts.get("tristrips"):
        found.append(Raw(vertices, triangle_strips(*_corners("tristrips", *columns["tristrips"]))))
    if not found:
        found.append(cut_polygons(vertices, *np.zeros((2, 0), np.int64)))
    return found[0]._replace(triangles=np.concatenate([one.triangles for one in found])) if found[1:] else found[0]


def announced_size(header: bytes, length: int) -> tuple[int, float]:
    """Estimate the triangles of a file of some length from its beginning, and the peak of the memory to read it.

    A header may announce anything; no more is expected than a file of this length can hold.
    """
    elements, start, is_text = _parsed_header(header)
    held = {name: min(one.count, length // max(one.least_bytes(is_text), 1)) for name, one in elements.items()}
    vertices, faces, strips = (held.get(name, 0) for name in _WANTED)
    # The length of a binary file shows how many corners its faces have, which are indices of mostly four bytes.
    least_bytes = sum(held[name] * one.least_bytes(is_text) for name, one in elements.items())
    corners = (length - start - least_bytes) // _CORNER_BYTES
    triangles = faces if is_text else min(max(faces, corners - 2 * faces), 2 * faces)
    triangles += max(0, corners) if strips else 0
    memory = _TEXT_MEMORY if is_text else _TRIANGLE_MEMORY if triangles == faces else _POLYGON_MEMORY
    return triangles, memory * triangles + _VERTEX_MEMORY * max(0.0, vertices - triangles / 2)


def write_ply(mesh: Mesh, values: Mapping[str, NDArray[Any]] | None = None, comments: Sequence[str] = ()) -> bytes:
    """Return a binary PLY file, all digits kept, with further values (n,) of the vertices by their names."""
    columns = {**dict(zip("xyz", mesh.vertices.T, strict=True)), **(values or {})}
    vertices = np.empty(len(mesh.vertices), [(name, f"<f{one.dtype.itemsize}") for name, one in columns.items()])
    for name, column in columns.items():
        vertices[name] = column
    faces = np.empty(len(mesh.triangles), [("length", "u1"), ("corners", "<i4", 3)])
    faces["length"], faces["corners"] = 3, mesh.triangles
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertices)}",
        *(f"property {'float' if one.dtype.itemsize == 4 else 'double'} {name}" for name, one in columns.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return "".join(f"{line}\n" for line in lines).encode("ascii") + vertices.tobytes() + faces.tobytes()


def _parsed_header(data: bytes) -> tuple[dict[str, _Element], int, bool]:
    """Return the elements that a header announces, the place where it ends, and whether text follows."""
    header = _HEADER.match(data)
    if header is None:
        raise MeshError(f"no PLY header begins the file and ends in its first {HEADER_BYTES:,} bytes; is it cut off?")
    elements: dict[str, _Element] = {}
    order = ""
    # Some programs write X for x.
    for row in re.sub(rb"\s[XYZ]\s", lambda axis: axis[0].lower(), header[2]).splitlines():
        line = row.decode("ascii", "replace")
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = _ORDERS[name]
            case ["element", name, count] if order and name not in elements:
                elements[name] = element = _Element(name, whole(count, "the PLY header"), {})
                if element.count < 0:
                    raise MeshError(f"the PLY header announces {count} entries of {name[:40]!r}")
            case ["property", *words, name] if elements and name not in element.properties:
                is_list = words[:1] == ["list"]
                codes = [_CODES.get(word, "") for word in words[is_list:]]
                if "" in codes or len(codes) != 1 + is_list:
                    raise MeshError(f"the PLY header declares {name[:40]!r} by {line[:80]!r}, of no type of PLY")
                stored = [_TEXT if order == "=" else order + code for code in codes]
                element.properties[name] = _Property(codes[-1], stored[-1], stored[0] if is_list else None)
            case _:
                raise MeshError(f"the PLY header has the line {line[:80]!r}, which the format does not have there")
    return elements, header.end(), order == "="


def _numbers(data: bytes, start: int, rows: int) -> tuple[array[float], array[int]]:
    """Return all numbers of a text from a place on, and how many the first lines have that have some."""
    numbers, sizes, carried = array("d"), array("I"), 0
    while start < len(data):
        space = _SPACE.search(data, start + _CHUNK_BYTES)
        end = space.end() if space else len(data)
        lines = [line.split() for line in data[start:end].decode("ascii", "replace").split("\n")]
        numbers.extend(reals([*chain.from_iterable(lines)], "the PLY file"))
        first, *others = map(len, lines)
        # The last line goes on in the next chunk.
        *whole_lines, carried = first + carried, *others
        sizes.extend(filter(None, whole_lines))
        del sizes[2 * rows + 1 :]
        start = end
    sizes.extend(filter(None, [carried]))
    return numbers, sizes


def _require_aligned(lines: NDArray[np.uintc], rows: Sequence[Indices]) -> None:
    """Refuse a text where most rows, but not all, are lines, or that has as many lines as rows and other ones.

    A number too many or too few would shift all that follow.
    """
    sizes = np.concatenate(rows)
    ends, lines_end = np.cumsum(sizes[sizes > 0]), np.cumsum(lines)
    is_whole = np.isin(ends, lines_end)
    wrong = np.flatnonzero(~is_whole & (ends <= lines_end[-1:]))
    is_by_row = len(lines) > MOST_LINES * len(ends) and 2 * np.count_nonzero(is_whole) > len(ends)
    if wrong.size and (len(lines) == len(ends) or is_by_row):
        row = f"row {wrong[0] + 1} below the PLY header"
        raise MeshError(f"{row} does not end with its line: a line has a number too many or too few")


def _columns(element: _Element, wanted: Sequence[str], body: memoryview, start: int) -> tuple[_Values, _Sizes, int]:
    """Return the values of an element that are wanted, the lengths of all its lists, and the place where it ends."""
    count, wanted = element.count, [name for name in wanted if name in element.properties]
    _, sizes, end = _walked(element, (), min(count, 1), body, start)
    # All rows are read at once if their lists are as long as those of the first one.
    first = {name: int(size.sum()) for name, size in sizes.items()}
    rows = None
    if end - start <= min(_LONGEST_ROW, (len(body) - start) // max(count, 1)):
        fields: list[Any] = []
        for name, one in element.properties.items():
            fields += [(f"length of {name}", one.length)] if one.length else []
            fields += [(name, one.stored, (first[name],) if one.length else ())]
        rows = np.ndarray(count, fields, body, start)
    if rows is not None and all((rows[f"length of {name}"] == size).all() for name, size in first.items()):
        values = {name: rows[name].reshape(-1) for name in wanted}
        sizes, end = {name: np.broadcast_to(size, count) for name, size in first.items()}, start + rows.nbytes
    else:
        values, sizes, end = _walked(element, wanted, count, body, start)
    for name in wanted:
        owner = f"the PLY property {element.name} {name}"
        values[name] = as_declared(values[name], element.properties[name].declared, owner)
    return values, sizes, end


def _walked(
    element: _Element, wanted: Sequence[str], count: int, body: memoryview, place: int
) -> tuple[_Values, _Sizes, int]:
    """Read rows one by one, and return the values of properties, the lengths of lists, and the place of the end."""
    steps = [
        (one.length and struct.Struct(one.length), struct.calcsize(one.stored), array("q"), bytearray(), name in wanted)
        for name, one in element.properties.items()
    ]
    for number in range(count):
        for head, width, sizes, values, is_wanted in steps:
            if head:
                size = head.unpack_from(body, place)[0] if place + head.size <= len(body) else -1
                # What cannot be a length ends beyond the file. A text may have any number there.
                size = int(size) if 0 <= size <= len(body) and size == int(size) else len(body) + 1
                sizes.append(size)
                place, width = place + head.size, width * size
            if is_wanted:
                values += body[place : place + width]
            place += width
        if place > len(body):
            entry = f"{element.name} {number + 1} of {count}"
            raise MeshError(f"the file breaks off in {entry}; it is cut, or has wrong counts before")
    found = dict(zip(element.properties, steps, strict=True))
    of_lists = {name: np.array(sizes, np.int64) for name, (head, _, sizes, *_) in found.items() if head}
    return {name: np.frombuffer(found[name][3], element.properties[name].stored) for name in wanted}, of_lists, place


def _corners(element: str, values: _Values, sizes: _Sizes) -> tuple[Indices, Indices]:
    """Return the vertex indices of all lists of an element, and the lengths of these."""
    name = next(iter(values), "")
    if name not in sizes or values[name].dtype.kind == "f":
        wrong = f"no list {_CORNERS[0]}" if name not in sizes else "indices that are not integers"
        raise MeshError(f"the PLY element {element} has {wrong}")
    return values[name].astype(np.int64), sizes[name]
