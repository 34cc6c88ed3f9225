"""A study: families of surfaces, a reference, a lattice, orders; read from TOML and validated once."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.spectral.accuracy import Accuracy
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.precision import Precision
from sobolev_batch.spectral.quadrature import Quadrature
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform import Transform
from sobolev_batch.surfaces.similarity import Similarity
from sobolev_batch.surfaces.sources import Source, parse_source

REFERENCE_LABEL = "reference"

# "auto" leaves it to each worker.
Backends = Literal["auto", "cpu", "gpu"]

# One line of printable text. Names become labels in the store and never paths or keys.
Name = Annotated[
    str,
    Field(min_length=1, max_length=100, pattern=r"^[^\s/\\\x00-\x1f\x7f]([^/\\\x00-\x1f\x7f]*[^\s/\\\x00-\x1f\x7f])?$"),
]
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
        folder: where relative paths start.
        table: the study as it was written, for the record.
    """

    name: str
    title: str
    lattice: Lattice | None
    accuracy: Accuracy | None
    transform: Transform
    dtype: Precision | None
    backend: Backends
    orders: tuple[float, ...]
    pairs: Literal["all", "reference"]
    families: tuple[Family, ...]
    reference: Source | FamilyReference
    scaling: Scaling
    folder: Path
    table: Mapping[str, Any]

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that its surfaces take, besides those that this package requires."""
        sources = [family.source for family in self.families]
        if isinstance(self.reference, Source):
            sources.append(self.reference)
        return tuple(sorted({library for source in sources for library in source.libraries}))

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file; relative paths in it start from its folder.

        Raises:
            StudyError: the file cannot be read, is not TOML, or asks for something that is unknown,
                of the wrong type or out of range; the message lists every offender.
        """
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise StudyError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise StudyError(f"{path}: not a TOML file: {error}") from error
        try:
            return cls.from_table(table, folder=path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: sections [study], [lattice] or [accuracy], [norm], [transform], [reference],
                [[family]], [scaling].
            folder: where relative paths start.

        Raises:
            StudyError: as for `from_toml`.
        """
        try:
            document = _Document.model_validate(dict(table))
        except ValidationError as error:
            raise StudyError(_explain(error)) from error
        families = tuple(_family(i, entry) for i, entry in enumerate(document.family))
        folded = [family.name.casefold() for family in families]
        twins = sorted({family.name for family in families if folded.count(family.name.casefold()) > 1})
        if twins:
            raise StudyError(f"family names must differ by more than case, found {', '.join(map(repr, twins))} twice")
        if REFERENCE_LABEL in folded:
            raise StudyError(f"no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")
        try:
            return cls(
                name=document.study.name,
                title=document.study.title or document.study.name,
                lattice=None if document.lattice is None else document.lattice.settings(),
                accuracy=None if document.accuracy is None else document.accuracy.settings(),
                transform=document.transform.settings(),
                dtype=document.transform.dtype,
                backend=document.transform.backend,
                orders=_distinct(check_orders(document.norm.orders)),
                pairs=document.norm.pairs,
                families=families,
                reference=_reference(document.reference, families),
                scaling=document.scaling.settings(),
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
    title: Annotated[str, Field(max_length=1000)] = ""


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
    orders: Annotated[tuple[Number, ...], Field(min_length=1, max_length=100, strict=False)]
    pairs: Literal["all", "reference"] = "all"


class _TransformSection(_Section):
    eps: Number | None = None
    dtype: Precision | None = None
    quadrature: str | int = "auto"
    backend: Backends = "auto"

    def settings(self) -> Transform:
        return Transform(self.eps, self.dtype or "complex128", Quadrature(self.quadrature))


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
    where = f"family {entry.get('name', index + 1)!r}"
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
                raise StudyError(f"no family is named {section.family!r}")
            return FamilyReference(section.family, section.member)
        return parse_source(entry)
    except ValidationError as error:
        raise StudyError(f"reference: {_explain(error)}") from error
    except InputError as error:
        raise StudyError(f"reference: {error}") from error


def _explain(error: ValidationError) -> str:
    """Every offender on one line: where it stands, what was found, what was expected."""
    lines = []
    for item in error.errors(include_url=False):
        where = ".".join(map(str, item["loc"])) or "study"
        if item["type"] == "extra_forbidden":
            lines.append(f"unknown key {where}")
        elif item["type"] == "missing":
            lines.append(f"{where} is missing")
        else:
            message = item["msg"].removeprefix("Value error, ")
            found = repr(item["input"])
            shown = found if len(found) <= 60 else found[:57] + "..."
            lines.append(f"{where}: {message[0].lower() + message[1:]}, found {shown}")
    return "; ".join(lines)


def _distinct(orders: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(dict.fromkeys(orders))
