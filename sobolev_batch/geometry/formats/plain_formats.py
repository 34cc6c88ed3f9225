"""OBJ, OFF and STL files, read with every line and every announced count checked, and written.

They are parsed here because the libraries at hand silently lose or change faces where a line is not what they expect.
"""

import io
import re
from array import array
from collections.abc import Iterator
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.parsing import MOST_LINES, Raw, reals, whole
from sobolev_batch.geometry.formats.polygons import cut_polygons
from sobolev_batch.geometry.mesh import Mesh, merge_coincident
from sobolev_batch.geometry.surface import normals

# Comments and names of OBJ files: where they end in a backslash, as a path does, they do not go on.
_PATHS = re.compile(r"\s*([og]\s|usemtl|mtllib)|.*(?<!\S)#", re.IGNORECASE)
# Numbers per vertex line: x y z, with a weight, a colour, or both.
_OBJ_VERTEX_SIZES = (3, 4, 6, 7)
# Words of lines without a surface of their own: those of the format, and two for values of vertices; then those of
# surfaces and curves of free form, and of other files.
_OBJ_SKIPPED = re.compile(
    "v[tnpcw]|[plgso]|mg|use(mtl|map)|m(tl|ap)lib|bevel|[cd]_interp|lod|(shadow|trace)_obj|[cs]tech|cstype|deg|bmat|"
    "step|parm|trim|hole|scrv|sp|end|con|res"
)
_OBJ_REFUSED = ("surf", "curv", "curv2", "bsp", "bzp", "cdc", "cdp", "call", "csh")
# Further numbers per face: a colour or its index, or how many it has and a colour.
_OFF_FACE_EXTRAS = (0, 1, 3, 4, 5)
_COUNT = re.compile("[0-9]{1,18}")
# Within a word it begins no comment.
_COMMENT = re.compile(r"(?<!\S)#")
# Characters of a line: a polygon of a hundred thousand corners.
_LONGEST_LINE = 1 << 20
_STL_HEADER_BYTES = 84
# A text has no zero byte; a binary file of fewer than 16 million triangles has one within this many.
_STL_START_BYTES = 1024
# The space before a statement of a facet. Some programs write several on a line.
_STL_STATEMENT = re.compile(rb"(?i)\s(?=(?:facet\s+normal|outer\s+loop|vertex|endloop|endfacet|endsolid)(?!\S))")
# The blank that some programs write within the words that end something.
_STL_BLANK = re.compile(rb"(?i)(?<=\send)[ \t]+(?=(?:loop|facet|solid)(?!\S))")
_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def parse_obj(data: bytes) -> Raw:
    """Return the vertices (n, 3) and triangles (m, 3) of an OBJ file, all its objects and groups together."""
    vertices, corners, sizes = array("d"), array("q"), array("q")
    for line_number, line in _joined_lines(data):
        words = (_COMMENT.split(line)[0] if "#" in line else line).split()
        kind = words[0].lower() if words else "g"
        if kind == "v":
            number = len(vertices) // 3 + 1
            if len(words) - 1 not in _OBJ_VERTEX_SIZES:
                raise MeshError(f"vertex {number} has {len(words) - 1} coordinates, expected three")
            vertices.extend(reals(words[1:4], f"vertex {number}"))
            if len(words) == 5 and words[4] != "1" and reals(words[4:], f"vertex {number}")[0] != 1:
                raise MeshError(f"vertex {number} has the weight {words[4][:40]}, which only curves have")
        elif kind in ("f", "fo"):
            corners.extend(_obj_corner(word, len(vertices) // 3, len(sizes) + 1) for word in words[1:])
            sizes.append(len(words) - 1)
        elif not _OBJ_SKIPPED.fullmatch(kind):
            problem = "which is not read; export polygons" if kind in _OBJ_REFUSED else "no word of the OBJ format"
            raise MeshError(f"line {line_number} begins with {words[0][:40]!r}, {problem}")
    # Files of millions of faces are hundreds of megabytes, and their arrays as many: neither is held twice.
    del data
    return cut_polygons(np.asarray(vertices).reshape(-1, 3), np.asarray(corners), np.asarray(sizes))


def parse_off(data: bytes) -> Raw:
    """Return the vertices (n, 3) and triangles (m, 3) of an OFF file, in text or binary."""
    lines = _off_lines(data)
    first = next(lines, [""])
    # The word may be missing, and the first count may follow it at once.
    word = re.fullmatch("((?:ST|C|N)*OFF)?([0-9]*)", first[0].upper())
    if word is None or not word[0]:
        raise MeshError(f"the file does not begin with OFF or such, nor with its counts, but with {first[0][:40]!r}")
    kind, counts = word[1] or "OFF", [*filter(None, word.groups()[1:]), *first[1:]]
    has_colors = "C" in kind
    least = 3 + 3 * ("N" in kind) + 2 * ("ST" in kind)
    if counts == ["BINARY"]:
        return _parsed_binary_off(data, least + 4 * has_colors)
    head = 1 if counts else 2
    counts = counts or next(lines, [])
    if len(counts) < 2 or not all(_COUNT.fullmatch(word) for word in counts[:3]):
        found = f"{first[0][:40]!r} and then {' '.join(counts)[:40]!r}"
        raise MeshError(f"the file begins with {found}, expected OFF or such and the counts of vertices and faces")
    vertex_count, face_count = int(counts[0]), int(counts[1])
    # Some programs write colours, or normals, without the letter.
    more = (0, 1) if has_colors else (0, 3, 4) if kind == "OFF" else (0,)
    rows = chain(filter(None, [counts[3:]]), lines)
    try:
        return _parsed_off(vertex_count, face_count, least + 3 * has_colors, more, rows)
    except MeshError:
        # The lines of some programs hold many rows each. Without a count of edges, numbers may be those of another row.
        if len(counts) < 3 or sum(1 for _ in _off_lines(data)) > MOST_LINES * (vertex_count + face_count):
            raise
        least += 4 * has_colors
        lines = chain([counts[3:]], islice(_off_lines(data), head, None))
        return _parsed_off(vertex_count, face_count, least, (0,), _off_rows(lines, vertex_count, least))


def _parsed_off(
    vertex_count: int, face_count: int, least: int, more: tuple[int, ...], rows: Iterator[list[str]]
) -> Raw:
    """Return what rows hold, whose vertices have the least count of numbers, or all the same one of some more."""
    vertices, corners, sizes, colored = array("d"), array("q"), array("q"), 0
    for number in range(1, vertex_count + 1):
        vertex = f"vertex {number}"
        words = _off_row(next(rows, []), rows, vertex, least, more)
        more = (len(words) - least,)
        vertices.extend(reals(words[:3], vertex))
    for number in range(1, face_count + 1):
        face, words = f"face {number}", next(rows, [])
        size = whole(words[0], face) if words else 0
        words = _off_row(words, rows, face, 1 + size, _OFF_FACE_EXTRAS)
        corners.extend(whole(word, face) for word in words[1 : 1 + size])
        sizes.append(size)
        colored += len(words) > 1 + size
    if words := next(rows, []):
        counted = f"{vertex_count} vertices and {face_count} faces"
        raise MeshError(f"the OFF header announces {counted}, but more follows: {' '.join(words)[:80]!r}")
    raw = cut_polygons(np.array(vertices).reshape(-1, 3), np.array(corners), np.array(sizes))
    note = f"{colored:,} of {face_count:,} faces have numbers behind their corners, which are taken for colours"
    return raw._replace(notes=(*raw.notes, note)) if 0 < colored < face_count else raw


def _off_lines(data: bytes) -> Iterator[list[str]]:
    """Yield the words of each line that has some, without comments."""
    return (words for line in _text_lines(data) if (words := _COMMENT.split(line)[0].split()))


def _off_rows(lines: Iterator[list[str]], vertex_count: int, width: int) -> Iterator[list[str]]:
    """Yield the rows of lines that hold several whole ones, those of vertices of a width."""
    for words in lines:
        place = 0
        while place < len(words):
            size = width if vertex_count > 0 else 1 + whole(words[place], "a face")
            if not 0 < size <= len(words) - place:
                raise MeshError(f"a line ends within a row, or a count is wrong: {' '.join(words[place:])[:80]!r}")
            yield words[place : place + size]
            place, vertex_count = place + size, vertex_count - 1


def _off_row(words: list[str], lines: Iterator[list[str]], owner: str, least: int, more: tuple[int, ...]) -> list[str]:
    """Return the words of a row, and of the lines on which it goes on until it has the least number of words.

    A row of one line may have more, such as a colour or its index.
    """
    first = len(words)
    while len(words) < least and (following := next(lines, [])):
        words += following
    if len(words) - least not in (more if len(words) == first else (0,)):
        raise MeshError(f"{owner} has {len(words)} numbers, expected {least + more[0]}, or the file breaks off there")
    return words


def _parsed_binary_off(data: bytes, width: int) -> Raw:
    """Return what a binary OFF file holds, whose vertices have so many numbers: all are of 32 bits, highest first."""
    start = data.index(b"\n") + 1
    words = np.frombuffer(data, ">i4", (len(data) - start) // 4, start)
    vertex_count, face_count = words[:2].tolist()
    place = 3 + width * vertex_count
    if min(vertex_count, face_count) < 0 or place > len(words):
        raise MeshError(f"the OFF header announces {vertex_count} vertices and {face_count} faces, more than there are")
    vertices = words[3:place].view(">f4").reshape(-1, width)[:, :3]
    faces = [words[:0]]
    for number in range(1, face_count + 1):
        size = words.item(place) if place < len(words) else -1
        end = place + 1 + size
        more = words.item(end) if size >= 0 and end < len(words) else -1
        if more not in _OFF_FACE_EXTRAS:
            raise MeshError(f"the file breaks off in face {number} of {face_count}, or has wrong counts before")
        faces.append(words[place + 1 : end])
        place = end + 1 + more
    if start + 4 * place != len(data):
        raise MeshError(f"the file has {len(data) - start - 4 * place} bytes behind its {face_count} faces")
    sizes = np.array([len(face) for face in faces[1:]])
    return cut_polygons(vertices.astype(np.float32), np.concatenate(faces).astype(np.int64), sizes)


def parse_stl(data: bytes) -> Raw:
    """Return the vertices and triangles of an STL file; corners that coincide exactly are merged."""
    start, announced = data[:_STL_START_BYTES], int.from_bytes(data[80:_STL_HEADER_BYTES], "little")
    # Fewer bytes than those of a triangle may follow.
    if len(data) >= _STL_HEADER_BYTES and (len(data) - _STL_HEADER_BYTES) // _STL_RECORD.itemsize == announced:
        records = np.frombuffer(data, _STL_RECORD, announced, _STL_HEADER_BYTES)
        if len(data) > _STL_HEADER_BYTES + records.nbytes and records["attribute"].any():
            raise MeshError("the file has more bytes than its triangles take, which may lie between them")
        corners = records["corners"].reshape(-1, 3)
    elif b"\0" not in start:
        if start.lstrip()[:5].lower() != b"solid":
            raise MeshError("the file is a text that does not begin with solid, as STL files in text do")
        try:
            corners = _stl_text_corners(data)
        except MeshError:
            corners = _stl_text_corners(_STL_STATEMENT.sub(b"\n", _STL_BLANK.sub(b"", data)))
    else:
        count = max(0, len(data) - _STL_HEADER_BYTES) / _STL_RECORD.itemsize
        raise MeshError(f"a file of {len(data)} bytes holds {count:.2f} triangles, but announces {announced}")
    if not len(corners):
        raise MeshError("the file has no faces")
    return Raw(*merge_coincident(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3)))


def text_rows(form: str, rows: NDArray[Any]) -> bytes:
    """Return rows of numbers as lines of a form; seventeen digits give every double back."""
    file = io.BytesIO()
    np.savetxt(file, rows, fmt=form)
    return file.getvalue()


def write_obj(mesh: Mesh) -> bytes:
    """Return an OBJ file, all digits kept."""
    return text_rows("v %.17g %.17g %.17g", mesh.vertices) + text_rows("f %d %d %d", mesh.triangles + 1)


def write_off(mesh: Mesh) -> bytes:
    """Return an OFF file, all digits kept."""
    head = b"OFF\n%d %d 0\n" % (len(mesh.vertices), len(mesh.triangles))
    return head + text_rows("%.17g", mesh.vertices) + text_rows("3 %d %d %d", mesh.triangles)


def write_stl(mesh: Mesh) -> bytes:
    """Return a binary STL file, which has single precision and no shared vertices."""
    across = normals(mesh.vertices, mesh.triangles)
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    records = np.zeros(len(across), _STL_RECORD)
    records["corners"] = mesh.vertices[mesh.triangles]
    # That of a triangle without an area is zero.
    records["normal"] = np.divide(across, lengths, where=lengths > 0, out=np.zeros_like(across))
    return bytes(_STL_HEADER_BYTES - 4) + len(across).to_bytes(4, "little") + records.tobytes()


def _text_lines(data: bytes) -> Iterator[str]:
    """Yield the lines of a text one by one, each with a line feed at its end, which the last may lack."""
    reader = io.TextIOWrapper(io.BytesIO(data), "utf-8", errors="replace")
    for number, line in enumerate(iter(partial(reader.readline, _LONGEST_LINE + 1), ""), 1):
        if len(line) > _LONGEST_LINE:
            raise MeshError(f"line {number} has more than {_LONGEST_LINE} characters; shorten it, or cut its polygon")
        yield line


def _joined_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Yield the lines of an OBJ file with the number of their last one; one that ends in a backslash goes on."""
    text, number = "", 0
    for number, line in enumerate(_text_lines(data), 1):
        is_continued = line.rstrip().endswith("\\") and not _PATHS.match(line)
        text += f"{line.rstrip()[:-1]} " if is_continued else line
        if len(text) > _LONGEST_LINE:
            raise MeshError(f"a line goes on for more than {_LONGEST_LINE} characters; shorten it, or cut its polygon")
        if not is_continued:
            yield number, text
            text = ""
    if text:
        yield number, text


def _obj_corner(word: str, vertices_so_far: int, face: int) -> int:
    """Return the index from 0 of a corner such as 7, 7/1, 7//3 or -1; negative ones count back from their line."""
    index = whole(word.partition("/")[0], f"face {face}")
    if index == 0:
        raise MeshError(f"face {face} has the vertex index 0; OBJ counts from 1")
    if index > 0:
        return index - 1
    if index < -vertices_so_far:
        raise MeshError(f"face {face} counts {-index} vertices back, but only {vertices_so_far} stand before it")
    return vertices_so_far + index


def _stl_text_corners(data: bytes) -> Reals:
    corners = array("d")
    facet, facet_corners, in_solid = 0, 0, False
    for line in _text_lines(data):
        words = line.split()
        match words[0].lower() if words else "":
            case "":
                continue
            case "vertex":
                if len(words) != 4:
                    raise MeshError(f"facet {facet} has a vertex of {len(words) - 1} coordinates, expected three")
                corners.extend(reals(words[1:], f"facet {facet}"))
                facet_corners += 1
            # A solid may have any of these words for its name.
            case _ if {"vertex", "endfacet"} <= {*line.lower().split()[1:]}:
                raise MeshError(f"after facet {facet}: a facet ends within a line")
            case "solid" | "endsolid" as word:
                in_solid = word == "solid"
            case "facet" | "endfacet" as word:
                # Where lines are lost, a facet need not end.
                if facet_corners not in (3, 3 * (word == "endfacet")):
                    raise MeshError(f"facet {facet} has {facet_corners} vertices, expected three")
                facet, facet_corners = facet + (word == "facet"), 0
            case "outer" | "endloop":
                continue
            case other:
                raise MeshError(f"after facet {facet}: {other[:40]!r} is no word of an STL file")
    if in_solid or facet_corners:
        raise MeshError(f"the file breaks off after facet {facet}: its last solid does not end")
    return np.array(corners).reshape(-1, 3)
