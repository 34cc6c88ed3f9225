"""Lists of mesh files with what is known of each mesh: a CSV file, or tables of a study.

Each mesh has a ``path``, relative to the CSV file or to the study file. It may have a ``name`` and a ``time``. All else
are its metadata, numbers or texts, which the tables of a store repeat.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import pandas as pd

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.formats.raw_files import open_regular
from sobolev_batch.surfaces.shapes.surface import is_finite_number
from sobolev_batch.surfaces.sources.names import label_problem, name_problem, quoted
from sobolev_batch.surfaces.sources.registry import Metadata

MOST_MESHES = 100_000
_MOST_COLUMNS = 100
_LONGEST_TEXT = 1000
_LARGEST_FILE_BYTES = 64 << 20
# Columns of names, which may look like numbers.
_TEXTS = ("path", "name", "object", "method")
_EXAMPLE = '{ path = "a.ply", method_seconds = 3.5 }'


@dataclass(frozen=True)
class ListedMesh:
    """A mesh file in a list.

    Attributes:
        path: Path of the file.
        name: Name of the mesh; None for the stem of the file.
        time: Time of the mesh, if it has one.
        metadata: All else that the list says of it.
    """

    path: str
    name: str | None = None
    time: float | None = None
    metadata: Metadata = ()

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> ListedMesh:
        """Return the mesh that a table describes; empty texts and NaN say nothing.

        Raises:
            ValueError: The table has no path, or a value of another type than it should be.
        """
        known = {key: value for key, value in table.items() if not _is_nothing(value)}
        path, name, time = known.pop("path", None), known.pop("name", None), known.pop("time", None)
        if not isinstance(path, str):
            raise ValueError(f"each mesh needs a path, as in {_EXAMPLE}; found {quoted(dict(table))}")
        if "\0" in path:
            raise ValueError(f"no file can have the name {quoted(path)}, which holds the character NUL")
        if name is not None:
            name = number_as_text(name) if is_finite_number(name) else name
            problem = label_problem(name) if isinstance(name, str) else "it is no text"
            if problem is not None:
                raise ValueError(f"{quoted(path)} has the name {quoted(name)}, which is no label: {problem}")
        if time is not None and not is_finite_number(time):
            raise ValueError(f"{quoted(path)} has the time {quoted(time)}; a time is a number")
        metadata = tuple((_checked_key(key), _checked_value(path, key, value)) for key, value in known.items())
        return cls(path, name, None if time is None else float(time), metadata)


def checked_list(value: object) -> str | tuple[ListedMesh, ...] | None:
    """Return the key ``meshes`` of a study: the path of a CSV file, or a list of meshes.

    Raises:
        ValueError: It is neither.
    """
    if value is None or (isinstance(value, str) and value):
        return value
    if not isinstance(value, list | tuple) or not value or not all(isinstance(table, Mapping) for table in value):
        raise ValueError(
            f'must be the path of a CSV file, such as "meshes.csv", or a list of tables such as {_EXAMPLE}'
        )
    return _listed(value)


def read_mesh_list(path: Path) -> tuple[ListedMesh, ...]:
    """Return the meshes that a CSV file lists. Its first line has the names of the columns.

    Raises:
        StudyError: The file cannot be read, is no CSV file of this kind, or is too large.
    """
    try:
        with open_regular(path) as file:
            length = os.fstat(file.fileno()).st_size
            if length > _LARGEST_FILE_BYTES:
                raise StudyError(f"a list has at most {_LARGEST_FILE_BYTES} bytes, found {length}")
            # As texts: a name such as 007 stays what it is. Without a header pandas refuses lines that are longer than
            # the first one, and gives no other name to a column that is there twice.
            cells = pd.read_csv(
                file, header=None, dtype=str, keep_default_na=False, encoding="utf-8-sig", skipinitialspace=True
            )
    except (OSError, ValueError) as error:
        raise StudyError(f"meshes: the list {quoted(path.name)} cannot be read: {str(error).strip()}") from error
    header = cells.iloc[0].fillna("").str.strip()
    frame = cells.iloc[1:].fillna("").set_axis(header, axis=1)
    repeated = header[header.duplicated()]
    if len(repeated):
        raise StudyError(f"meshes: the list {quoted(path.name)} has the column {quoted(repeated.iloc[0])} twice")
    if "path" not in frame or frame.empty:
        raise StudyError(
            f"meshes: the list {quoted(path.name)} needs a column path and a line for each mesh; found "
            f"{len(frame)} lines of the columns {quoted(list(frame.columns))}"
        )
    for key in frame.columns.difference(_TEXTS):
        numbers = pd.to_numeric(frame[key].str.strip(), errors="coerce")
        is_number = numbers.notna() | (frame[key].str.strip() == "")
        # A column is one of numbers only if all that it says are; times that are none are named one by one.
        if is_number.all() or key == "time":
            frame[key] = numbers.astype(object).where(is_number, frame[key])
    try:
        return _listed(frame.to_dict(orient="records"))
    except ValueError as error:
        raise StudyError(f"meshes: the list {quoted(path.name)}: {error}") from error


def number_as_text(number: float) -> str:
    """Return a number that stands for a name, with all its digits.

    >>> number_as_text(7.0), number_as_text(1234567), number_as_text(0.5)
    ('7', '1234567', '0.5')
    """
    return str(int(number)) if number == int(number) else repr(float(number))


def _listed(tables: Any) -> tuple[ListedMesh, ...]:
    if len(tables) > MOST_MESHES:
        raise ValueError(f"at most {MOST_MESHES} meshes are allowed, found {len(tables)}")
    widest = max(map(len, tables))
    if widest > _MOST_COLUMNS:
        raise ValueError(f"at most {_MOST_COLUMNS} columns are allowed, found {widest}")
    return tuple(map(ListedMesh.from_table, tables))


def _checked_key(key: object) -> str:
    problem = name_problem(key, 100, "/\\") if isinstance(key, str) else "it is no text"
    if problem is not None:
        raise ValueError(f"{quoted(key)} cannot name metadata: {problem}")
    return str(key)


def _checked_value(path: str, key: str, value: object) -> float | str:
    if isinstance(value, Real) and is_finite_number(value):
        return float(value)
    if not isinstance(value, str) or name_problem(value, _LONGEST_TEXT) is not None:
        raise ValueError(f"{key} of {quoted(path)} must be a number or a line of text, found {quoted(value)}")
    return value


def _is_nothing(value: object) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))
