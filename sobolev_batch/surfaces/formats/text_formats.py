"""Vertices and faces of OBJ and OFF files.

Both are read here because the libraries at hand silently lose or change faces where a line is not what
they expect. This reader checks every line and every announced count.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.polygons import triangle_fans

Raw = tuple[NDArray[np.float64], NDArray[np.int64]]

# Numbers per vertex line: x y z, with a weight, a colour, or both.
_OBJ_VERTEX_SIZES = (3, 4, 6, 7)
# Further numbers per vertex line, by the kind of file, and per face line: a colour or its index.
_OFF_EXTRAS = {"": 0, "N": 3, "C": 4, "CN": 7}
_OFF_FACE_EXTRAS = (0, 1, 3, 4)
# Digits of an index or count: all that fit into 64 bits.
_MOST_DIGITS = 18


def parse_obj(data: bytes) -> Raw:
    """Return the vertices (n, 3) and triangles (m, 3) of an OBJ file, all its objects and groups together.

    Raises:
        MeshError: A vertex or face line is malformed; the message counts them from 1.
    """
    vertices: list[list[float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    lines = decoded_text(data).replace("\\\n", " ").split("\n")
    # Without a line end, the last corner may have lost digits: then it seldom has as many slashes as the others.
    if lines[-1].startswith("f ") and len({word.count("/") for word in lines[-1].split()[1:]}) > 1:
        raise MeshError("the OBJ file breaks off in its last line")
    for line in lines:
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0] == "v":
            if len(words) - 1 not in _OBJ_VERTEX_SIZES:
                raise MeshError(f"vertex {len(vertices) + 1} has {len(words) - 1} coordinates, expected three")
            vertices.append(parsed_numbers(words[1:4], f"vertex {len(vertices) + 1}"))
        elif words[0] == "f":
            corners += (_obj_corner(word, len(vertices), len(sizes) + 1) for word in words[1:])
            sizes.append(len(words) - 1)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), triangle_fans(
        np.array(corners, dtype=np.int64), np.array(sizes, dtype=np.int64)
    )


def parse_off(data: bytes) -> Raw:
    """Return the vertices (n, 3) and triangles (m, 3) of an OFF file in text.

    Raises:
        MeshError: The counts do not fit the lines, or a line is malformed.
    """
    text = decoded_text(data)
    if text and not text.endswith("\n"):
        # Without a line end, the last number may have lost digits.
        last = text.rsplit("\n", 1)[-1].partition("#")[0].split()
        if last and not _complete_face(last):
            raise MeshError("the OFF file breaks off in its last line")
    lines = [words for line in text.split("\n") if (words := line.partition("#")[0].split())]
    kind = re.fullmatch(r"(C?N?)OFF", lines[0][0]) if lines else None
    if kind is None:
        raise MeshError("the file does not begin with OFF, COFF, NOFF or CNOFF")
    counts, rows = (lines[0][1:], lines[1:]) if len(lines[0]) > 1 else (lines[1] if lines[1:] else [], lines[2:])
    if len(counts) not in (2, 3) or not all(map(_is_count, counts)):
        raise MeshError("the OFF header does not announce vertices and faces")
    vertex_count, face_count = int(counts[0]), int(counts[1])
    if vertex_count + face_count != len(rows):
        raise MeshError(
            f"the OFF header announces {vertex_count + face_count} lines, {vertex_count} for vertices and "
            f"{face_count} for faces, found {len(rows)}"
        )
    vertices = [
        _off_vertex(words, number, 3 + _OFF_EXTRAS[kind[1]]) for number, words in enumerate(rows[:vertex_count], 1)
    ]
    polygons = [_off_polygon(words, number) for number, words in enumerate(rows[vertex_count:], 1)]
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    corners = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), triangle_fans(corners, sizes)


def decoded_text(data: bytes) -> str:
    """Return the text of a file with line feeds at the ends of its lines."""
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def _is_count(word: str) -> bool:
    # Other digits than these are digits to Python too.
    return word.isascii() and word.isdigit() and len(word) <= _MOST_DIGITS


def parsed_numbers(words: list[str], owner: str) -> list[float]:
    """Return words as numbers.

    Raises:
        MeshError: A word is no number; the message starts with the owner, such as "vertex 7".
    """
    try:
        if any("_" in word for word in words):
            raise ValueError("Python's spelling, not that of any mesh format")
        return [float(word) for word in words]
    except ValueError as error:
        raise MeshError(f"{owner} has a coordinate that is not a number: {' '.join(words)[:80]!r}") from error


def parsed_integers(words: list[str], owner: str) -> list[int]:
    """Return words as integers.

    Raises:
        MeshError: A word is no integer; the message starts with the owner, such as "the section POLYGONS".
    """
    return [_integer(word, owner) for word in words]


def _integer(word: str, owner: str) -> int:
    if len(word) > _MOST_DIGITS or "_" in word:
        raise MeshError(f"{owner} has an index that is no integer of up to {_MOST_DIGITS} digits: {word[:80]!r}")
    try:
        return int(word)
    except ValueError as error:
        raise MeshError(f"{owner} has an index that is not an integer: {word[:80]!r}") from error


def _obj_corner(word: str, vertices_so_far: int, face: int) -> int:
    """Return the index from 0 of a corner such as 7, 7/1, 7//3 or -1; negative ones count back from their line."""
    index = _integer(word.partition("/")[0], f"face {face}")
    if index == 0:
        raise MeshError(f"face {face} has the vertex index 0; OBJ counts from 1")
    if index > 0:
        return index - 1
    if index < -vertices_so_far:
        raise MeshError(f"face {face} counts {-index} vertices back, but only {vertices_so_far} stand before it")
    return vertices_so_far + index


def _off_vertex(words: list[str], number: int, expected: int) -> list[float]:
    if len(words) != expected:
        raise MeshError(f"vertex {number} has {len(words)} numbers, expected {expected}")
    return parsed_numbers(words, f"vertex {number}")[:3]


def _off_polygon(words: list[str], number: int) -> list[int]:
    size = _integer(words[0], f"face {number}")
    if size < 0 or len(words) - 1 - size not in _OFF_FACE_EXTRAS:
        raise MeshError(f"face {number} announces {size} corners, but {len(words) - 1} numbers follow")
    return [_integer(word, f"face {number}") for word in words[1 : 1 + size]]


def _complete_face(words: list[str]) -> bool:
    return _is_count(words[0]) and len(words) - 1 - int(words[0]) in _OFF_FACE_EXTRAS
