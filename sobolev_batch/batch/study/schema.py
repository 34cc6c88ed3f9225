"""Schema of study files: sections, keys, limits, and messages that name every offender."""

from __future__ import annotations

import codecs
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.parameters import byte_count
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.formats.raw_files import open_regular
from sobolev_batch.surfaces.proximity import DEFAULT_POINTS, MOST_POINTS
from sobolev_batch.surfaces.sources.names import name_problem, quoted
from sobolev_batch.surfaces.sources.registry import at_most

# "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]

# Larger study files and deeper tables are mistakes, or made to keep the parser busy.
_LARGEST_FILE_BYTES = 4 << 20
_DEEPEST = 20
_MOST_VALUES = 1_000_000
_LONGEST_TEXT = 10_000
_MOST_ORDERS = 100
MOST_OCTAVES = 24
_MOST_OFFENDERS = 10
_LONGEST_NAME, _LONGEST_TITLE = 100, 1000
# The range of TOML's integers.
_LARGEST_INTEGER = (1 << 63) - 1
# The parser takes time that is quadratic in the number of dotted parts of a key.
_LONG_KEY = re.compile(rb"""(?<![\w-])(?:(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){100}""")


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


Name = Annotated[str, AfterValidator(_name)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Orders = Annotated[tuple[Number, ...], Field(min_length=1, strict=False), at_most(_MOST_ORDERS)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Header(_Section):
    name: Name
    title: Annotated[str, AfterValidator(_title)] = ""


class _LatticeSection(_Section):
    xi_max: Number
    M: int
    octaves: Annotated[int, Field(ge=0, le=MOST_OCTAVES)] = 0

    def settings(self) -> Lattice:
        return Lattice(self.xi_max, self.M)


class _AccuracySection(_Section):
    rtol: Number
    memory: Annotated[float | None, BeforeValidator(_memory)] = None
    memory_gb: Number | None = None

    @model_validator(mode="after")
    def _one_memory(self) -> Self:
        if self.memory is not None and self.memory_gb is not None:
            raise ValueError("memory_gb is the old name of memory; give memory alone")
        return self

    def settings(self) -> Accuracy:
        memory = self.memory if self.memory_gb is None else 1e9 * self.memory_gb
        return Accuracy(self.rtol) if memory is None else Accuracy(self.rtol, memory)


class _NormSection(_Section):
    orders: Orders
    pairs: Literal["all", "reference"] = "all"


class _TransformSection(_Section):
    eps: Number | None = None
    dtype: ComplexDtype | None = None
    quadrature: str | int = "auto"
    backend: Backends = "auto"

    def settings(self) -> TransformSettings:
        return TransformSettings(self.eps, self.dtype or "complex128", Quadrature(self.quadrature))


class _ScalingSection(_Section):
    mode: Literal["reference", "none", "fixed"] = "reference"
    scale: Number | None = None
    origin: Annotated[tuple[Number, Number, Number] | None, Field(strict=False)] = None

    @model_validator(mode="after")
    def _values_where_needed(self) -> Self:
        given = self.scale is not None or self.origin is not None
        if given != (self.mode == "fixed"):
            raise ValueError("scale and origin belong to mode = 'fixed', which needs at least one of them")
        return self


class _WitnessSection(_Section):
    orders: Annotated[tuple[Number, ...] | None, Field(strict=False), at_most(_MOST_ORDERS)] = None

    def settings(self, orders_of_norm: tuple[float, ...]) -> tuple[float, ...]:
        return orders_of_norm if self.orders is None else distinct_orders(self.orders)


class _ProximitySection(_Section):
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = DEFAULT_POINTS


class FamilyReferenceSection(_Section):
    """Reference that is a member of a family."""

    family: str
    member: str | None = None


class FamilyName(_Section):
    """Key of a family that is not one of its source."""

    name: Name


class StudyDocument(_Section):
    """All sections of a study file. Families and sources are validated by their own schemas."""

    study: _Header
    lattice: _LatticeSection | None = None
    accuracy: _AccuracySection | None = None
    norm: _NormSection
    transform: _TransformSection = _TransformSection()
    reference: dict[str, Any]
    family: Annotated[list[dict[str, Any]], Field(min_length=1)]
    scaling: _ScalingSection = _ScalingSection()
    witness: _WitnessSection | None = None
    proximity: _ProximitySection | None = None

    @model_validator(mode="after")
    def _lattice_or_accuracy(self) -> Self:
        if (self.lattice is None) == (self.accuracy is None):
            raise ValueError("either a [lattice] or an [accuracy] is needed, and not both")
        if self.accuracy is not None and (self.transform.eps is not None or self.transform.quadrature != "auto"):
            raise ValueError("an [accuracy] chooses eps and quadrature; take them out of [transform]")
        return self


def distinct_orders(orders: Sequence[float]) -> tuple[float, ...]:
    """Return valid orders, each once."""
    return tuple(dict.fromkeys(check_orders(orders)))


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
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        raise StudyError(f"not a TOML file: {error}") from error


def require_modest(table: object) -> None:
    """Refuse tables whose validation or messages would take too long: too deep, too long, or too many values."""
    waiting: list[tuple[object, tuple[object, ...]]] = [(table, ())]
    count = 0
    while waiting:
        value, path = waiting.pop()
        count += 1
        if len(path) > _DEEPEST:
            raise StudyError(f"{_key(path)}: nested more than {_DEEPEST} deep")
        if count > _MOST_VALUES:
            raise StudyError(f"{_key(path)}: the study has more than {_MOST_VALUES} values")
        if isinstance(value, Mapping):
            if not all(isinstance(key, str) for key in value):
                raise StudyError(f"{_key(path)}: keys must be strings")
            waiting += ((entry, (*path, key)) for key, entry in value.items())
        elif isinstance(value, list | tuple):
            waiting += ((entry, (*path, index)) for index, entry in enumerate(value))
        elif isinstance(value, str) and len(value) > _LONGEST_TEXT:
            raise StudyError(f"{_key(path)}: at most {_LONGEST_TEXT} characters are allowed, found {len(value)}")
        elif isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
            raise StudyError(f"{_key(path)}: integers go up to {_LARGEST_INTEGER}, found {quoted(value)}")


def _key(path: Sequence[object]) -> str:
    """Return the dotted key of a value, with unusual keys in quotes."""
    return ".".join(str(key) if name_problem(str(key), 40) is None else quoted(key) for key in path[:8]) or "study"


def explain(error: ValidationError) -> str:
    """Return one line that names each offender: its key, what was found, and what is expected."""
    lines = []
    for item in error.errors(include_url=False)[:_MOST_OFFENDERS]:
        key = _key(item["loc"])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown key {key}")
        elif item["type"] == "missing":
            lines.append(f"{key} is missing")
        else:
            message = item["msg"].removeprefix("Value error, ")
            lines.append(f"{key}: {message[0].lower() + message[1:]}, found {quoted(item['input'])}")
    more = error.error_count() - len(lines)
    return "; ".join(lines) + (f"; and {more} more" if more else "")
