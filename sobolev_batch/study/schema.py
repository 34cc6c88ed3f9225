"""Schema of study files: their syntax, sections, keys and limits, and the refusal of what is malformed.

A refusal has a message for each key that is wrong, with what was found and what is allowed.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import date
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
import pandas as pd
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticKnownError

from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import StudyError, refused_by_pydantic
from sobolev_batch.geometry.formats.parsing import open_regular
from sobolev_batch.geometry.proximity import DEFAULT_POINTS, METRICS, MOST_POINTS
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.parameters import byte_count
from sobolev_batch.reduction.searched import SearchedSource
from sobolev_batch.sources.command import function_version
from sobolev_batch.sources.files import MeshTable, checked_list
from sobolev_batch.sources.names import name_problem, node_problem, quoted
from sobolev_batch.sources.registry import Source, at_most, parse_source, source_type_of
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, check_orders

# "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]
Metric = Literal[
    "hausdorff", "mean", "rms", "bias", "percentiles", "chamfer", "fscore", "normals", "volume", "triangles"
]

# Deeper tables are mistakes.
_DEEPEST = 20
_MOST_ORDERS, _MOST_OBJECTS = 100, 100_000
MOST_OCTAVES = 24
# Larger study files are mistakes.
_LARGEST_FILE_BYTES = 4 << 20
# Most refusals of one study; longer keys are not compared with others.
_MOST_OFFENDERS, _LONGEST_KEY = 10, 40
# Sections that are lists; keys of a family that are none of its source, and those with which its meshes are searched.
_REPEATED, KEYS_OF_FAMILY, KEYS_OF_SEARCH = ("family", "object"), ("name", "order_by"), ("within", "order", "search")
# The place of a value in nested tables and lists.
_Key = tuple[int | str, ...]
# What a value must be in the words of TOML, by the type of pydantic's error or the first word of it.
_WORDS = {
    "list": "be a list",
    "tuple": "be a list",
    "dict": "be a table",
    "model": "be a table",
    "int": "be a whole number",
    "float": "be a number",
    "bool": "be true or false",
    "string_type": "be text in quotes",
}
# The label of a reference that is no member of a family.
REFERENCE_LABEL = "reference"
# Characters of globs and templates, which the names of objects and methods cannot have.
RESERVED = "*?[]{}/\\"
# Groups that lie beside those of objects.
_GROUPS = ("records", "meshes", "convergence", "proximity")


def _line_of_text(longest: int, forbidden: str = "") -> AfterValidator:
    """Return a validator of names and titles. Names become labels in the store, and never paths or keys."""
    without = f", without {' and '.join(forbidden)}" if forbidden else ""

    def check(text: str) -> str:
        problem = name_problem(text, longest, forbidden)
        if problem is not None:
            raise ValueError(
                f"1 to {longest} visible characters are needed, blanks only between them{without}; {problem}"
            )
        return text

    return AfterValidator(check)


def _study_name(name: str) -> str:
    if name in (".", ".."):
        raise ValueError("a folder has this name in every other one; choose a word")
    return name


def _object_name(name: str) -> str:
    if name.lower() in _GROUPS:
        raise ValueError(f"a group of the store is named {name.lower()}; name the object {name}_1, for example")
    if set(RESERVED) & set(name) or node_problem(name) is not None:
        raise ValueError(
            f"the name of an object is that of a folder in the store: it holds none of {' '.join(RESERVED)}, does not "
            "begin with . or __, and does not end with .json"
        )
    return name


Name = Annotated[str, _line_of_text(100, "/\\")]
Number = Annotated[float, Field(allow_inf_nan=False)]


class Section(BaseModel):
    """A section of a study file: frozen, of strict types, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def settings(self) -> Any:
        """Return what the section says, in the terms of the package."""
        return None

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        """Refuse values that are wrong together."""
        with refused_by_pydantic():
            self.settings()
        return self


class _Header(Section):
    name: Annotated[Name, AfterValidator(_study_name)]
    title: Annotated[str, _line_of_text(1000)] | None = None
    length_unit: Annotated[str, _line_of_text(20)] | None = None


class _LatticeSection(Section):
    xi_max: Number
    M: int
    octaves: Annotated[int, Field(ge=0, le=MOST_OCTAVES)] = 0

    def settings(self) -> Lattice:
        return Lattice(self.xi_max, self.M)


class _AccuracySection(Section):
    rtol: Number
    memory: float | str | None = None
    best_effort: bool = False

    def settings(self) -> Accuracy:
        accuracy = Accuracy(self.rtol, best_effort=self.best_effort)
        return accuracy if self.memory is None else replace(accuracy, allowed_bytes=float(byte_count(self.memory)))


class _NormSection(Section):
    orders: Annotated[tuple[Number, ...], Field(min_length=1, strict=False), at_most(_MOST_ORDERS)] = (DEFAULT_ORDER,)

    def settings(self) -> tuple[float, ...]:
        """Return the orders, each once."""
        return check_orders(self.orders)


class _CompareSection(Section):
    pairs: Literal["all", "reference"] = "reference"


class _TransformSection(Section):
    eps: Number | None = None
    dtype: ComplexDtype | None = None
    quadrature: str | int = "auto"
    backend: Backends = "auto"

    def settings(self) -> TransformSettings:
        return TransformSettings(self.eps, self.dtype or "complex128", self.quadrature)


class _ScalingSection(Section):
    mode: Literal["reference", "none", "fixed"] = "reference"
    scale: Number | None = None
    origin: Annotated[tuple[Number, Number, Number] | None, Field(strict=False)] = None

    def settings(self) -> Similarity | None:
        given = self.scale is not None or self.origin is not None
        if given != (self.mode == "fixed"):
            raise ValueError("scale and origin belong to mode = 'fixed', which needs at least one of them")
        if self.mode == "reference":
            return None
        return Similarity(1.0 if self.scale is None else self.scale, self.origin or (0.0, 0.0, 0.0))


class ProximitySection(Section):
    """The usual distances of meshes from the reference; docs/studies.md has the keys."""

    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = DEFAULT_POINTS
    threshold: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    metrics: Annotated[tuple[Metric, ...], Field(strict=False, min_length=1), at_most(len(METRICS))] = (
        "hausdorff",
        "chamfer",
    )


class FamilyReference(Section):
    """A reference that is a member of one of the study's families: its finest unless named."""

    family: str
    member: str | None = None


def with_named_meshes(table: Any, meshes: Mapping[str, Any], above: tuple[str, ...] = ()) -> Any:
    """Return the table of a source, or of a mesh by its name, with the tables of named meshes in place of their names.

    Meshes are tables by name, which may name others; those above are made from this one. ValueError where a name is
    unknown, or a mesh is made from itself.
    """
    if isinstance(table, str):
        if table in above or len(above) > _DEEPEST:
            raise ValueError(f"the mesh {quoted(table)} is made from itself, or from too many others")
        if table not in meshes:
            known = known_names(table, meshes) if meshes else "the study has no section [mesh.NAME]"
            raise ValueError(f"no mesh is named {quoted(table)}; {known}")
        return with_named_meshes(meshes[table], meshes, (*above, table))
    if not isinstance(table, dict):
        return table
    if "source" not in table and isinstance(table.get("mesh"), str):
        named = with_named_meshes(table["mesh"], meshes, above)
        others = {key: value for key, value in table.items() if key != "mesh"}
        return {**named, **others} if isinstance(named, dict) else named
    try:
        fields = source_type_of(table.get("source")).model_fields
    except StudyError:
        # Whoever parses the table says so.
        return table
    nested = {name for name, field in fields.items() if any(issubclass(m, Source) for m in models_in(field.annotation))}
    return {key: with_named_meshes(value, meshes, above) if key in nested else value for key, value in table.items()}


def _source(table: object, info: ValidationInfo) -> Source:
    """Return what the table of a source, or the name of a mesh, describes."""
    with refused_by_pydantic():
        table = with_named_meshes(table, info.context or {})
        if not isinstance(table, dict):
            raise PydanticKnownError("dict_type")
        return parse_source(table)


def _source_of_family(table: object, info: ValidationInfo) -> Source:
    """Return what the table of a family describes, which may be a search with its source."""
    # Sources may have an order of their own, and commands a parameter named search.
    if not isinstance(table, dict) or not ("within" in table or isinstance(table.get("search"), dict)):
        return _source(table, info)
    own = {key: table[key] for key in KEYS_OF_SEARCH if key in table}
    with refused_by_pydantic():
        others = with_named_meshes({key: table[key] for key in table if key not in own}, info.context or {})
        mesh = parse_source(others.pop("mesh")) if "mesh" in others else None
    return SearchedSource.model_validate({"template": others, "mesh": mesh, **own})


class Family(Section):
    """A named source of surfaces, or search for meshes within tolerances; a study file has its keys beside the others.

    Ordered by names, meshes are no sequence from coarse to fine and have no rates.
    """

    name: Name
    source: Annotated[SerializeAsAny[Source], BeforeValidator(_source_of_family)]
    order_by: Literal["triangles", "names"] | None = None

    @model_validator(mode="before")
    @classmethod
    def _gather_keys_of_source(cls, table: object) -> object:
        if not isinstance(table, dict):
            return table
        own = {key: table[key] for key in KEYS_OF_FAMILY if key in table}
        return {**own, "source": {key: value for key, value in table.items() if key not in own}}


def _reference(table: object, info: ValidationInfo) -> object:
    if isinstance(table, dict) and table.get("source") == "family":
        return FamilyReference.model_validate({key: value for key, value in table.items() if key != "source"})
    return None if table is None else _source(table, info)


class ObjectSection(Section):
    """One of the objects of a study that has several."""

    name: Annotated[Name, AfterValidator(_object_name)]
    reference: dict[str, Any] | str | None = None
    scaling: dict[str, Any] | None = None


class SurfaceSections(Section):
    """The sections of a study file that describe the surfaces of an object."""

    mesh: dict[Name, Annotated[SerializeAsAny[Source], BeforeValidator(_source)]] = {}
    reference: Annotated[FamilyReference | SerializeAsAny[Source] | None, BeforeValidator(_reference)]
    family: list[Family]
    scaling: _ScalingSection = _ScalingSection()

    @classmethod
    def from_tables(cls, values: Mapping[str, Any]) -> Self:
        """Validate the tables of a study, as `plain_tables` gives them; StudyError with a message for each key."""
        meshes = values.get("mesh")
        try:
            return cls.model_validate(values, context=meshes if isinstance(meshes, dict) else {})
        except ValidationError as error:
            messages = _refusals(error, values)
            more = len(messages) - _MOST_OFFENDERS
            shown = [*messages[:_MOST_OFFENDERS], *([f"and {more} more"] if more > 0 else [])]
            raise StudyError("; ".join(shown)) from error


class StudyDocument(SurfaceSections):
    """All sections of a study file, of one object or of several."""

    study: _Header
    lattice: _LatticeSection | None = None
    accuracy: _AccuracySection | None = None
    norm: _NormSection = _NormSection()
    compare: _CompareSection = _CompareSection()
    transform: _TransformSection = _TransformSection()
    proximity: ProximitySection | None = None
    object: Annotated[list[ObjectSection], Field(min_length=1, max_length=_MOST_OBJECTS)] | None = None
    objects: dict[Literal["meshes"], Annotated[str | tuple[MeshTable, ...], BeforeValidator(checked_list)]] = {}

    @model_validator(mode="after")
    def _lattice_or_accuracy(self) -> Self:
        if (self.lattice is None) == (self.accuracy is None):
            raise ValueError("either a [lattice] or an [accuracy] is needed, and not both")
        if self.accuracy is not None and (self.transform.eps is not None or self.transform.quadrature != "auto"):
            raise ValueError("an [accuracy] chooses eps and quadrature; take them out of [transform]")
        return self


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a study file; StudyError, which does not name it, where it is no readable TOML."""
    try:
        with open_regular(path) as file:
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise StudyError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > _LARGEST_FILE_BYTES:
        raise StudyError(f"a study file has at most {_LARGEST_FILE_BYTES} bytes; globs name many meshes in few words")
    try:
        # Some editors begin a file with a byte order mark.
        text = data.decode("utf-8-sig")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        position = re.search(r"\(at line (\d+), ", str(error))
        line = f": {quoted(text.splitlines()[int(position[1]) - 1].strip())}" if position else ""
        raise StudyError(f"not a TOML file: {error}{line}") from error


def plain_tables(table: object) -> dict[str, Any]:
    """Return a study with DataFrames as lists of rows, NumPy's values as Python's, paths as texts; or StudyError."""
    if not isinstance(table, Mapping):
        raise StudyError(f"a study is a mapping of sections, such as {{'study': ...}}, found {shown_value(table)}")
    return {str(key): _plain(value, (key,)) for key, value in table.items()}


def _plain(value: Any, key: tuple[object, ...]) -> Any:
    if len(key) > _DEEPEST:
        raise StudyError(f"{_dotted(key)}: nested more than {_DEEPEST} deep")
    if isinstance(value, Mapping):
        if not all(isinstance(name, str) for name in value):
            raise StudyError(f"{_dotted(key)}: keys must be strings")
        if callable(value.get("source")):
            function = value["source"]
            known = {} if "version" in value else {"version": function_version(function)}
            value = {**known, **value, "source": "function", "function": function}
        return {name: _plain(entry, (*key, name)) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry, (*key, number)) for number, entry in enumerate(value)]
    if isinstance(value, pd.DataFrame):
        repeated = value.columns[value.columns.duplicated()]
        if len(repeated):
            raise StudyError(f"{_dotted(key)}: a DataFrame has the column {quoted(repeated[0])} twice; rename one")
        known = value.astype(object).where(value.notna(), None)
        return _plain(known.to_dict(orient="records"), key)
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, int) and value.bit_length() > 63:
        raise StudyError(f"{_dotted(key)}: an integer of TOML has 64 bits, found {quoted(value)}")
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _refusals(error: ValidationError, values: Mapping[str, Any]) -> list[str]:
    """Return what is wrong in the tables of a study, a message for each key."""
    messages: list[str] = []
    allowed: dict[_Key, list[str]] = {}
    items = error.errors(include_url=False)
    # What is wrong with a named mesh is wrong wherever it is named.
    for item in [item for item in items if item["loc"][:1] == ("mesh",)] or items:
        kind, key = item["type"], _key_in(values, item)
        name = _named(key, values)
        if kind == "extra_forbidden":
            messages.append(f"{name} is unknown; {known_names(str(key[-1]), _known_keys(values, key[:-1]))}")
        elif kind == "missing":
            messages.append(f"{name} is missing")
        elif kind == "value_error":
            said, value = str(item["ctx"]["error"]), _value_at(values, key)
            is_said = isinstance(value, Mapping) or "found " in said or shown_value(value) in said
            found = "" if is_said else f", found {shown_value(value)}"
            messages.append(": ".join(filter(None, (name, said + found))))
        # Wrong entries are not counted; the list may be long enough with them.
        elif kind != "too_short" or _value_at(values, key) == []:
            allowed.setdefault(key, []).append(_demand(item))
    for key, demands in allowed.items():
        text = " or ".join(dict.fromkeys(demands)).replace(" or be ", " or ")
        messages.append(f"{_named(key, values)} must {text}, found {shown_value(_value_at(values, key))}")
    return messages


@contextmanager
def within(what: str) -> Iterator[None]:
    """Name in a StudyError what it is about, unless that is empty."""
    try:
        yield
    except StudyError as error:
        raise StudyError(f"{what}: {error}" if what else str(error)) from error


def known_names(name: str, known: Iterable[str]) -> str:
    """Return the name that an unknown one is probably meant to be, or else all that are known."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1) if len(name) <= _LONGEST_KEY else []
    return f"did you mean {by_lower[near[0]]}?" if near else f"known are {', '.join(map(_readable, known))}"


def shown_value(value: object) -> str:
    """Return a value as a study file spells it, on one short line."""
    return str(value).lower() if isinstance(value, bool) else quoted(value)


def _dotted(key: tuple[object, ...]) -> str:
    return ".".join(_readable(str(part)) for part in key[:8])


def _readable(key: str) -> str:
    """Return a key, in quotes where it is unusual."""
    return key if name_problem(key, _LONGEST_KEY) is None else quoted(key)


def _demand(item: ErrorDetails) -> str:
    """Return what a value must do: be a list, be greater than 0, have at most 3 items."""
    kind, said = item["type"], item["msg"]
    if item["loc"][-1:] == ("[key]",):
        return f"be called {item['ctx']['expected']}"
    words = _WORDS.get(kind) or _WORDS.get(kind.partition("_")[0])
    return words or re.sub(r"^\w+ should | after validation.*$", "", said)


def _key_in(values: object, item: ErrorDetails) -> _Key:
    """Return the location of an error without the parts that name the alternatives of a type."""
    location = item["loc"]
    if location[:1] == ("family",) and location[2:3] == ("source",):
        # Its keys are those of the family.
        location = (*location[:2], *location[3:])
    key: list[int | str] = []
    for number, part in enumerate(location, 1):
        is_list = isinstance(values, list | tuple) and isinstance(part, int) and part < len(values)
        if is_list or (isinstance(values, Mapping) and part in values):
            values = values[part]  # type: ignore[index]
        elif item["type"] != "missing" or number < len(location):
            continue
        key.append(part)
    return tuple(key)


def _value_at(values: Any, key: _Key) -> Any:
    return reduce(getitem, key, values)


def _known_keys(values: Mapping[str, Any], key: _Key) -> Iterable[str]:
    """Return the keys that the table at a key may have."""
    if not key:
        return StudyDocument.model_fields
    table = _value_at(values, key)
    with suppress(ValueError):  # as where a key is that of another section
        table = with_named_meshes(table, values.get("mesh", {}))
    if "source" not in table:
        return next(models_in(StudyDocument.model_fields[str(key[0])].annotation)).model_fields
    if key == ("reference",) and table["source"] == "family":
        return (*FamilyReference.model_fields, "source")
    own = (*KEYS_OF_FAMILY, *KEYS_OF_SEARCH) if key[0] == "family" and len(key) == len(("family", 0)) else ()
    return (*source_type_of(table["source"]).model_fields, "source", *own)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that a type is made of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def _named(key: _Key, values: Mapping[str, Any]) -> str:
    """Return a key with its place: ``[norm]: entry 2 of orders``. Entries count from one."""
    if not key:
        return ""
    section, rest = str(key[0]), key[1:]
    value = values.get(section)
    if not rest and section in values and not isinstance(value, dict | list):
        return _readable(section)
    place = f"[[{section}]]" if section in _REPEATED else f"[{_readable(section)}]"
    if section in _REPEATED and rest:
        entry, rest = _value_at(value, rest[:1]), rest[1:]
        place += f" {int(key[1]) + 1}"
        if isinstance(entry, Mapping) and isinstance(entry.get("name"), str):
            place += f" (named {quoted(entry['name'])})"
    if section == "mesh" and rest:
        place, rest = f"[mesh.{_readable(str(rest[0]))}]", rest[1:]
    name = ".".join(_readable(part) for part in rest if isinstance(part, str))
    numbers = ", ".join(str(part + 1) for part in rest if isinstance(part, int))
    if numbers:
        name = f"entry {numbers} of {name}" if name else f"entry {numbers}"
    return ": ".join(filter(None, (place, name)))
