"""Schema of study files: their syntax, sections, keys and limits."""

from __future__ import annotations

import codecs
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pandas as pd
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from sobolev_batch.batch.study.refusals import dotted_key
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.parameters import byte_count
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.formats.parsing import open_regular
from sobolev_batch.surfaces.proximity import DEFAULT_POINTS, MOST_POINTS
from sobolev_batch.surfaces.shapes.surface import Similarity
from sobolev_batch.surfaces.sources.names import name_problem, quoted
from sobolev_batch.surfaces.sources.registry import at_most

# "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]

# Deeper tables and longer texts are mistakes, or made to keep the validation busy.
_DEEPEST = 20
_MOST_VALUES = 1_000_000
_LONGEST_TEXT = 10_000
_MOST_ORDERS = 100
MOST_OCTAVES = 24
_LONGEST_NAME, _LONGEST_TITLE = 100, 1000
# Larger study files are mistakes, or made to keep the parser busy.
_LARGEST_FILE_BYTES = 4 << 20
# The parser takes time that is quadratic in the number of dotted parts of a key.
_LONG_KEY = re.compile(rb"""(?<![\w-])(?:(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){100}""")
# The range of TOML's integers.
_LARGEST_INTEGER = (1 << 63) - 1


def _name(text: str) -> str:
    """Check a name. Names become labels in the store, and never paths or keys."""
    problem = name_problem(text, _LONGEST_NAME, "/\\")
    if problem is not None:
        raise ValueError(
            f"a name is 1 to {_LONGEST_NAME} visible characters, blanks only between them, without / and \\; {problem}"
        )
    return text


def _title(text: str) -> str:
    problem = name_problem(text, _LONGEST_TITLE) if text else None
    if problem is not None:
        raise ValueError(f"a title is one line of up to {_LONGEST_TITLE} visible characters and blanks; {problem}")
    return text


def _memory(value: Any) -> float:
    try:
        return float(byte_count(value))
    except InputError as error:
        raise ValueError(str(error)) from error


def _orders(orders: tuple[float, ...]) -> tuple[float, ...]:
    """Return valid orders, each once."""
    try:
        return tuple(dict.fromkeys(check_orders(orders)))
    except InputError as error:
        positive = next((s for s in orders if s > 0.5), None)
        raise ValueError(f"{error}; did you mean {-positive:g}?" if positive else str(error)) from error


Name = Annotated[str, AfterValidator(_name)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Orders = Annotated[
    tuple[Number, ...], Field(min_length=1, strict=False), at_most(_MOST_ORDERS), AfterValidator(_orders)
]


class Section(BaseModel):
    """A section of a study file: frozen, of strict types, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Header(Section):
    name: Name
    title: Annotated[str, AfterValidator(_title)] = ""


class _LatticeSection(Section):
    xi_max: Number
    M: int
    octaves: Annotated[int, Field(ge=0, le=MOST_OCTAVES)] = 0

    def settings(self) -> Lattice:
        return Lattice(self.xi_max, self.M)


class _AccuracySection(Section):
    rtol: Number
    memory: Annotated[float | None, BeforeValidator(_memory)] = None
    best_effort: bool = False

    def settings(self) -> Accuracy:
        accuracy = Accuracy(self.rtol, best_effort=self.best_effort)
        return accuracy if self.memory is None else replace(accuracy, allowed_bytes=self.memory)


class _NormSection(Section):
    orders: Orders
    pairs: Literal["all", "reference"] = "all"


class _TransformSection(Section):
    eps: Number | None = None
    dtype: ComplexDtype | None = None
    quadrature: str | int = "auto"
    backend: Backends = "auto"

    def settings(self) -> TransformSettings:
        return TransformSettings(self.eps, self.dtype or "complex128", Quadrature(self.quadrature))


class _ScalingSection(Section):
    mode: Literal["reference", "none", "fixed"] = "reference"
    scale: Number | None = None
    origin: Annotated[tuple[Number, Number, Number] | None, Field(strict=False)] = None

    def settings(self) -> Similarity | None:
        if self.mode == "reference":
            return None
        return Similarity(1.0 if self.scale is None else self.scale, self.origin or (0.0, 0.0, 0.0))

    @model_validator(mode="after")
    def _values_where_needed(self) -> Self:
        given = self.scale is not None or self.origin is not None
        if given != (self.mode == "fixed"):
            raise ValueError("scale and origin belong to mode = 'fixed', which needs at least one of them")
        return self


class _ProximitySection(Section):
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = DEFAULT_POINTS


class FamilyReference(Section):
    """A reference that is a member of one of the study's families: its finest unless named."""

    family: str
    member: str | None = None


class FamilySection(Section):
    """Keys of a family that are not those of its source."""

    name: Name
    order_by: Literal["triangles", "names"] | None = None


class StudyDocument(Section):
    """All sections of a study file. Families and sources are validated by their own schemas."""

    study: _Header
    lattice: _LatticeSection | None = None
    accuracy: _AccuracySection | None = None
    norm: _NormSection
    transform: _TransformSection = _TransformSection()
    reference: dict[str, Any]
    family: Annotated[list[dict[str, Any]], Field(min_length=1)]
    scaling: _ScalingSection = _ScalingSection()
    proximity: _ProximitySection | None = None

    @model_validator(mode="after")
    def _lattice_or_accuracy(self) -> Self:
        if (self.lattice is None) == (self.accuracy is None):
            raise ValueError("either a [lattice] or an [accuracy] is needed, and not both")
        if self.accuracy is not None and (self.transform.eps is not None or self.transform.quadrature != "auto"):
            raise ValueError("an [accuracy] chooses eps and quadrature; take them out of [transform]")
        return self


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a study file.

    Raises:
        StudyError: It cannot be read, is too large, or is not TOML. The message does not name it.
    """
    try:
        with open_regular(path) as file:
            length = os.fstat(file.fileno()).st_size
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise StudyError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_FILE_BYTES:
        raise StudyError(
            f"a study file has at most {_LARGEST_FILE_BYTES} bytes, found {max(length, len(data))}; "
            "globs name many meshes in few words"
        )
    if data.startswith(codecs.BOM_UTF8):
        raise StudyError("not a TOML file: it begins with a byte order mark; save it as UTF-8 without one")
    if _LONG_KEY.search(data):
        raise StudyError("a key has 100 dotted parts or more; those of a study have two")
    try:
        text = data.decode("utf-8")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        raise StudyError(f"not a TOML file: {error}{_line_at(str(error), text)}") from error


def _line_at(message: str, text: str) -> str:
    """Return the line where the parser stopped."""
    position = re.search(r"\(at line (\d+), ", message)
    return f": {quoted(text.splitlines()[int(position[1]) - 1].strip())}" if position else ""


def plain_tables(value: Any) -> Any:
    """Return tables as dictionaries, DataFrames as lists of rows, values of NumPy as Python's, and paths as texts."""
    if isinstance(value, Mapping):
        return {key: plain_tables(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain_tables(entry) for entry in value]
    if isinstance(value, pd.DataFrame):
        return _rows_of(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _rows_of(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a frame, without what it does not know; dates become texts."""
    repeated = frame.columns[frame.columns.duplicated()]
    if len(repeated):
        raise StudyError(f"a DataFrame has the column {quoted(repeated[0])} twice; rename one")
    return [
        {
            str(key): value.isoformat() if isinstance(value, date) else plain_tables(value)
            for key, value in row.items()
            if not (pd.api.types.is_scalar(value) and pd.isna(value))
        }
        for row in frame.to_dict(orient="records")
    ]


def require_modest(table: object) -> None:
    """Refuse tables whose validation or messages would take too long: too deep, too long, or too many values."""
    waiting: list[tuple[object, tuple[object, ...]]] = [(table, ())]
    count = 0
    while waiting:
        value, path = waiting.pop()
        count += 1
        if len(path) > _DEEPEST:
            raise StudyError(f"{dotted_key(path)}: nested more than {_DEEPEST} deep")
        if count > _MOST_VALUES:
            raise StudyError(f"{dotted_key(path)}: the study has more than {_MOST_VALUES} values")
        if isinstance(value, Mapping):
            if not all(isinstance(key, str) for key in value):
                raise StudyError(f"{dotted_key(path)}: keys must be strings")
            waiting += ((entry, (*path, key)) for key, entry in value.items())
        elif isinstance(value, list | tuple):
            waiting += ((entry, (*path, index)) for index, entry in enumerate(value))
        elif isinstance(value, str) and len(value) > _LONGEST_TEXT:
            raise StudyError(f"{dotted_key(path)}: at most {_LONGEST_TEXT} characters are allowed, found {len(value)}")
        elif isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
            raise StudyError(f"{dotted_key(path)}: integers go up to {_LARGEST_INTEGER}, found {quoted(value)}")
