"""Files of points: PLY, and text of one line for each point."""

from __future__ import annotations

import csv
import itertools
import textwrap
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.ply import parse_ply_points
from sobolev_batch.surfaces.formats.raw_files import is_gzipped, read_unpacked
from sobolev_batch.surfaces.formats.readers import expected_size, mesh_format
from sobolev_batch.surfaces.formats.text_formats import text_lines
from sobolev_batch.surfaces.shapes.point_cloud import PointCloud

Raw = tuple[NDArray[Any], NDArray[Any] | None]

_TEXT_FORMATS = (".xyz", ".txt", ".csv")
# Bytes of memory while a byte of a file is read, and those that a packed byte unpacks to.
_MEMORY_FACTOR, _PACKING = 7.0, 4
# Of a line with three numbers and a weight, and of a binary point with colours or normals.
_POINT_BYTES = 32
_LONGEST_REASON, _LONGEST_CELL = 250, 50


def read_points(path: str | Path, *, weight: str | int | None = None, area: float | None = None) -> PointCloud:
    """Read a point cloud from a PLY, XYZ, TXT or CSV file, gzipped or not.

    A text file has a line for each point: x, y, z and any further columns, with commas between them, or blanks where a
    line has no commas. The first line may name the columns: x, y and z, in either case, are then found by their names.
    What follows a # is left out. Of a PLY file the vertices are read; faces may be there, and do not count.

    Args:
        path: Path of the file.
        weight: Area of each point, in squared units of length: the name of a vertex property or of a column, or the
            number of a column, counted from 1.
        area: Total area in place of ``weight``, for points that all stand for the same area.

    Raises:
        MeshError: The file is missing, of no known format, damaged, or holds no valid points or weights; or neither
            ``weight`` nor ``area`` is given, or both. The message starts with the path.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sobolev_batch as sb
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "scan.csv")
    ...     with path.open("w") as file:
    ...         print("x,y,z,area", "0,0,0,0.5", "1,0,0,0.25", sep=chr(10), file=file)
    ...     sb.read_points(path, weight="area").weights.tolist()
    [0.5, 0.25]
    """
    path = Path(path)
    if weight is not None and area is not None:
        raise MeshError(f"{path}: both weight and area are given; give one of them")
    if weight is None and area is None:
        raise MeshError(
            f"{path}: points need areas: give weight, the property or column with the area of each, or area, the total "
            "area of points that all stand for the same"
        )
    suffix = mesh_format(path).removesuffix(".gz")
    if suffix not in (".ply", *_TEXT_FORMATS):
        known = ", ".join((".ply", *_TEXT_FORMATS))
        raise MeshError(f"{path}: no format of points has this name; known are {known}, each also with .gz")
    data = read_unpacked(path, _MEMORY_FACTOR)
    try:
        with np.errstate(all="ignore"):
            points, weights = _parsed_ply(data, weight) if suffix == ".ply" else _parsed_text(data, weight)
            return PointCloud(points, weights) if area is None else PointCloud.uniform(points, area)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except MemoryError as error:
        raise MeshError(f"{path}: reading it takes more memory than there is: {error}") from error
    except Exception as error:
        # On damaged input parsers raise anything.
        reason = " ".join(str(error).split())[:_LONGEST_REASON]
        raise MeshError(f"{path}: not a readable {suffix} file of points: {type(error).__name__}: {reason}") from error


def holds_points(path: Path) -> bool:
    """Tell whether a file has points and no triangles, by its name or the header of a PLY file."""
    suffix = mesh_format(path).removesuffix(".gz")
    if suffix != ".ply":
        return suffix in _TEXT_FORMATS
    triangles, memory_bytes = expected_size(path)
    # Without memory the file cannot be read.
    return triangles == 0 and memory_bytes > 0


def expected_bytes(path: Path) -> float:
    """Estimate the memory that reading a file takes, from its length; zero where there is none."""
    return _MEMORY_FACTOR * _unpacked_bytes(path)


def expected_points(path: Path) -> int:
    """Estimate the number of points of a file from its length; zero where there is none."""
    return _unpacked_bytes(path) // _POINT_BYTES


def _unpacked_bytes(path: Path) -> int:
    try:
        return path.stat().st_size * (_PACKING if is_gzipped(path) else 1)
    except (OSError, ValueError):
        return 0


def _parsed_ply(data: bytes, weight: str | int | None) -> Raw:
    if isinstance(weight, int):
        raise MeshError(f"a PLY file has named properties; give the name of the weight, not the number {weight}")
    return parse_ply_points(data, weight)


def _parsed_text(data: bytes, weight: str | int | None) -> Raw:
    """Return the columns x, y and z of a text, and one as weights."""
    lines = _numbered_cells(data)
    start, first = next(lines, (1, []))
    if len(first) < 3:
        raise MeshError(f"the first line has {len(first)} columns, expected x, y, z and maybe more")
    names = first if _are_names(first) else []
    columns = _columns_of_points(names)
    if weight is not None:
        columns = (*columns, _column_of_weight(names, len(first), weight))
    numbers = array("d")
    for number, cells in lines if names else itertools.chain([(start, first)], lines):
        if len(cells) != len(first):
            raise MeshError(
                f"line {number} has {len(cells)} columns, the first line {len(first)}; write every column in each "
                "line, with commas between them where one is empty or has blanks"
            )
        numbers.extend(_number_in(cells, column, number) for column in columns)
    if not numbers:
        raise MeshError("the file has no points")
    rows = np.frombuffer(numbers).reshape(-1, len(columns))
    return rows[:, :3], None if weight is None else rows[:, 3]


def _numbered_cells(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each line that is not empty, counted from 1, and its cells."""
    for number, line in enumerate(text_lines(data, errors="strict"), 1):
        # CloudCompare writes two slashes before the names.
        content = line.partition("#")[0].strip().removeprefix("//")
        if content:
            cells = next(csv.reader([content], skipinitialspace=True)) if "," in content else content.split()
            yield number, [cell.strip(" \t\"'") for cell in cells]


def _are_names(cells: list[str]) -> bool:
    return set("xyz") <= {cell.lower() for cell in cells} or not any(map(_is_number, cells))


def _columns_of_points(names: list[str]) -> tuple[int, ...]:
    """Return the columns of x, y and z, counted from 0: those of these names, or the first three of no names."""
    if not names:
        return 0, 1, 2
    lower = [name.lower() for name in names]
    wrong = next((axis for axis in "xyz" if lower.count(axis) != 1), None)
    if wrong is not None:
        raise MeshError(
            f"the first line names the columns {_listed(names)}, {lower.count(wrong) or 'none'} of them {wrong}; name "
            "the coordinates x, y and z there, once each, or leave that line out if they come first"
        )
    return tuple(map(lower.index, "xyz"))


def _listed(names: list[str]) -> str:
    return textwrap.shorten(", ".join(names), _LONGEST_REASON)


def _column_of_weight(names: list[str], count: int, weight: str | int) -> int:
    """Return the column of the weights, counted from 0."""
    if isinstance(weight, int):
        if not 1 <= weight <= count:
            raise MeshError(f"the file has {count} columns and no column {weight}")
        return weight - 1
    if weight not in names:
        listed = f"; its columns are {_listed(names)}" if names else " and does not name its columns"
        raise MeshError(f"the file has no column {weight!r}{listed}")
    if names.count(weight) > 1:
        raise MeshError(f"{names.count(weight)} columns are named {weight!r}; give the number of one of them")
    return names.index(weight)


def _number_in(cells: list[str], column: int, line: int) -> float:
    try:
        return float(cells[column])
    except ValueError as error:
        found = repr(cells[column][:_LONGEST_CELL]) if cells[column] else "empty"
        raise MeshError(
            f"line {line}: column {column + 1} is {found}, expected a number; mend it, or leave the line out"
        ) from error


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
