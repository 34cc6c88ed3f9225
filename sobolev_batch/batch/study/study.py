"""A study: families of surfaces, a reference, a lattice, orders; read from TOML and validated once."""

from __future__ import annotations

import codecs
import json
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.quadrature.meshes import Quadrature
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.formats.raw_files import open_regular
from sobolev_batch.surfaces.proximity import DEFAULT_POINTS, MOST_POINTS
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, name_problem, quoted
from sobolev_batch.surfaces.sources.registry import Source, at_most, parse_source

REFERENCE_LABEL = "reference"

# "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]

# Larger study files and deeper tables are typing errors, or made to keep the parser busy.
_LARGEST_FILE_BYTES = 4 << 20
_DEEPEST = 20
_MOST_VALUES = 1_000_000
_LONGEST_TEXT = 10_000
_MOST_ORDERS = 100
_MOST_OFFENDERS = 10
_LONGEST_NAME, _LONGEST_TITLE = 100, 1000
# TOML's integers.
_LARGEST_INTEGER = (1 << 63) - 1
# A key of so many dotted parts would take the parser the square of their number.
_LONG_KEY = re.compile(rb"""(?<![\w-])(?:(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){100}""")


def _name(text: str) -> str:
    """Names become labels in the store and never paths or keys."""
    wrong = name_problem(text, _LONGEST_NAME, "/\\")
    if wrong is not None:
        raise ValueError(
            f"a name is 1 to {_LONGEST_NAME} visible characters, blanks only between them, without / and \\; {wrong}"
        )
    return text


def _title(text: str) -> str:
    wrong = name_problem(text, _LONGEST_TITLE) if text else None
    if wrong is not None:
        raise ValueError(f"a title is one line of up to {_LONGEST_TITLE} visible characters and blanks; {wrong}")
    return text


Name = Annotated[str, AfterValidator(_name)]
Number = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class Family:
    """A named source of surfaces."""

    name: str
    source: Source


@dataclass(frozen=True)
class FamilyReference:
    """A reference that is a member of one of the study's families: its finest unless named."""

    family: str
    member: str | None


@dataclass(frozen=True)
class Scaling:
    """How the study's one similarity transform is chosen.

    "reference": the one that takes the reference's bounding sphere to the unit sphere at the origin;
    "none": the identity; "fixed": the given one.
    """

    mode: Literal["reference", "none", "fixed"]
    fixed: Similarity


@dataclass(frozen=True)
class Study:
    """What is to be computed, with every value validated. Made by `from_toml` or `from_table`.

    Attributes:
        name: one word or line that identifies the study; a store remembers it.
        title: free text.
        lattice: the one lattice of all fields; None where an accuracy asks for one.
        accuracy: of the distances to the reference; None where the lattice is given.
        transform: accuracy, precision and quadrature.
        dtype: the precision that was asked for, if any.
        backend: what computes the transforms; "auto" leaves it to each worker.
        orders: the Sobolev orders s < -1/2.
        pairs: "all" for the distance of every mesh to every other, "reference" for those to the
            reference alone.
        families: the surfaces to compare.
        reference: what they are compared with.
        scaling: how all of them are brought to one unit of length.
        witness: the orders of which every mesh's witness function against the reference is stored, at its
            vertices; empty where none is asked for.
        proximity: how many points are drawn on each mesh for its Hausdorff and Chamfer distances from the
            reference; None where these are not asked for.
        folder: where relative paths start.
        table: the study as it was written, for the record.
    """

    name: str
    title: str
    lattice: Lattice | None
    accuracy: Accuracy | None
    transform: TransformSettings
    dtype: ComplexDtype | None
    backend: Backends
    orders: tuple[float, ...]
    pairs: Literal["all", "reference"]
    families: tuple[Family, ...]
    reference: Source | FamilyReference
    scaling: Scaling
    witness: tuple[float, ...]
    proximity: int | None
    folder: Path
    table: Mapping[str, Any]

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that its surfaces take, besides those that this package requires."""
        sources = [family.source for family in self.families]
        if isinstance(self.reference, Source):
            sources.append(self.reference)
        own = () if self.proximity is None else ("vtk",)
        return tuple(sorted({*own, *(library for source in sources for library in source.libraries)}))

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file; relative paths in it start from its folder.

        Raises:
            StudyError: the file cannot be read, is not TOML, or asks for something that is unknown,
                of the wrong type or out of range; the message lists every offender.
        """
        path = Path(path)
        try:
            return cls.from_table(_parsed(path), folder=path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: sections [study], [lattice] or [accuracy], [norm], [transform], [reference],
                [[family]], [scaling], [witness], [proximity].
            folder: where relative paths start.

        Raises:
            StudyError: as for `from_toml`.
        """
        _require_modest(table)
        try:
            document = _Document.model_validate(dict(table))
        except ValidationError as error:
            raise StudyError(_explain(error)) from error
        families = tuple(_family(i, entry) for i, entry in enumerate(document.family))
        same = duplicate_names(family.name for family in families)
        if same:
            found = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
            raise StudyError(
                "family: names must differ by more than case and the spelling of accents, "
                f"found {found} twice; rename one"
            )
        if any(caseless_key(family.name) == REFERENCE_LABEL for family in families):
            raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")
        try:
            orders = _distinct(check_orders(document.norm.orders))
            return cls(
                name=document.study.name,
                title=document.study.title or document.study.name,
                lattice=None if document.lattice is None else document.lattice.settings(),
                accuracy=None if document.accuracy is None else document.accuracy.settings(),
                transform=document.transform.settings(),
                dtype=document.transform.dtype,
                backend=document.transform.backend,
                orders=orders,
                pairs=document.norm.pairs,
                families=families,
                reference=_reference(document.reference, families),
                scaling=document.scaling.settings(),
                witness=() if document.witness is None else document.witness.settings(orders),
                proximity=None if document.proximity is None else document.proximity.points,
                folder=Path(folder),
                table=json.loads(json.dumps(table, default=str)),
            )
        except StudyError:
            raise
        except InputError as error:
            raise StudyError(str(error)) from error


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Header(_Section):
    name: Name
    title: Annotated[str, AfterValidator(_title)] = ""


class _LatticeSection(_Section):
    xi_max: Number
    M: int

    def settings(self) -> Lattice:
        return Lattice(self.xi_max, self.M)


class _AccuracySection(_Section):
    rtol: Number
    memory_gb: Number | None = None

    def settings(self) -> Accuracy:
        return Accuracy(self.rtol) if self.memory_gb is None else Accuracy(self.rtol, 1e9 * self.memory_gb)


class _NormSection(_Section):
    orders: Annotated[tuple[Number, ...], Field(min_length=1, strict=False), at_most(_MOST_ORDERS)]
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

    def settings(self) -> Scaling:
        scale = 1.0 if self.scale is None else self.scale
        return Scaling(self.mode, Similarity(scale, self.origin or (0.0, 0.0, 0.0)))


class _WitnessSection(_Section):
    orders: Annotated[tuple[Number, ...] | None, Field(strict=False), at_most(_MOST_ORDERS)] = None

    def settings(self, of_norm: tuple[float, ...]) -> tuple[float, ...]:
        return of_norm if self.orders is None else _distinct(check_orders(self.orders))


class _ProximitySection(_Section):
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = DEFAULT_POINTS


class _FamilyReferenceSection(_Section):
    family: str
    member: str | None = None


class _Document(_Section):
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


class _FamilyName(_Section):
    name: Name


def _family(index: int, entry: dict[str, Any]) -> Family:
    where = f"family {quoted(entry.get('name', index + 1))}"
    parameters = {key: value for key, value in entry.items() if key != "name"}
    try:
        name = _FamilyName.model_validate({key: entry[key] for key in ("name",) if key in entry}).name
        return Family(name, parse_source(parameters))
    except ValidationError as error:
        raise StudyError(f"{where}: {_explain(error)}") from error
    except InputError as error:
        raise StudyError(f"{where}: {error}") from error


def _reference(entry: dict[str, Any], families: tuple[Family, ...]) -> Source | FamilyReference:
    try:
        if entry.get("source") == "family":
            section = _FamilyReferenceSection.model_validate({k: v for k, v in entry.items() if k != "source"})
            if section.family not in {family.name for family in families}:
                raise StudyError(f"no family is named {quoted(section.family)}")
            return FamilyReference(section.family, section.member)
        return parse_source(entry)
    except ValidationError as error:
        raise StudyError(f"reference: {_explain(error)}") from error
    except InputError as error:
        raise StudyError(f"reference: {error}") from error


def _parsed(path: Path) -> dict[str, Any]:
    """The tables of a study file, if it is one.

    Raises:
        StudyError: it cannot be read, is too large, or is not TOML; the message does not name it.
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
        raise StudyError("a key has 100 dotted parts or more; a study's have two")
    try:
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise StudyError(f"not a TOML file: {error}; save it as UTF-8") from error
    except RecursionError as error:
        raise StudyError("its tables and lists are nested too deeply") from error
    # Beyond TOML's own errors, numbers and dates that Python cannot hold.
    except ValueError as error:
        raise StudyError(f"not a TOML file: {error}") from error


def _require_modest(table: object) -> None:
    """Refuse what would keep validation, or the messages about it, busy: too deep, too long, too many."""
    waiting: list[tuple[object, tuple[object, ...]]] = [(table, ())]
    count = 0
    while waiting:
        value, place = waiting.pop()
        count += 1
        if len(place) > _DEEPEST:
            raise StudyError(f"{_place(place)}: nested more than {_DEEPEST} deep")
        if count > _MOST_VALUES:
            raise StudyError(f"{_place(place)}: the study has more than {_MOST_VALUES} values")
        if isinstance(value, Mapping):
            if not all(isinstance(key, str) for key in value):
                raise StudyError(f"{_place(place)}: keys must be strings")
            waiting += ((entry, (*place, key)) for key, entry in value.items())
        elif isinstance(value, list | tuple):
            waiting += ((entry, (*place, index)) for index, entry in enumerate(value))
        elif isinstance(value, str) and len(value) > _LONGEST_TEXT:
            raise StudyError(f"{_place(place)}: at most {_LONGEST_TEXT} characters are allowed, found {len(value)}")
        elif isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
            raise StudyError(f"{_place(place)}: integers go up to {_LARGEST_INTEGER}, found {quoted(value)}")


def _place(location: Sequence[object]) -> str:
    """Where a value stands, with dots between keys; keys that are no words are quoted."""
    return ".".join(str(key) if name_problem(str(key), 40) is None else quoted(key) for key in location[:8]) or "study"


def _explain(error: ValidationError) -> str:
    """Every offender on one line: where it stands, what was found, what was expected."""
    lines = []
    for item in error.errors(include_url=False)[:_MOST_OFFENDERS]:
        where = _place(item["loc"])
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown key {where}")
        elif item["type"] == "missing":
            lines.append(f"{where} is missing")
        else:
            message = item["msg"].removeprefix("Value error, ")
            lines.append(f"{where}: {message[0].lower() + message[1:]}, found {quoted(item['input'])}")
    more = error.error_count() - len(lines)
    return "; ".join(lines) + (f"; and {more} more" if more else "")


def _distinct(orders: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(dict.fromkeys(orders))
