"""Schema of study files: their sections, keys and limits."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, SerializeAsAny, ValidationInfo, model_validator
from pydantic_core import PydanticKnownError

from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import StudyError, refused_by_pydantic
from sobolev_batch.geometry.formats.by_name import is_mesh_name
from sobolev_batch.geometry.proximity import DEFAULT_POINTS, METRICS, MOST_POINTS
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.parameters import byte_count
from sobolev_batch.reduction.searched import SearchedSource
from sobolev_batch.sources.files import MeshTable, checked_list
from sobolev_batch.sources.names import known_names, name_problem, node_problem, quoted
from sobolev_batch.sources.registry import Source, at_most, parse_source, source_type_of
from sobolev_batch.study.toml import DEEPEST
from sobolev_batch.transform.backends import Backends
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, check_orders

Metric = Literal[
    "hausdorff", "mean", "rms", "bias", "percentiles", "chamfer", "fscore", "normals", "volume", "triangles"
]

_MOST_ORDERS, _MOST_OBJECTS = 100, 100_000
MOST_OCTAVES = 24
# Keys of a family that are none of its source, and those with which its meshes are searched.
KEYS_OF_FAMILY, KEYS_OF_SEARCH = ("name", "order_by"), ("within", "order", "measure", "search")
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
        if (problem := name_problem(text, longest, forbidden)) is not None:
            raise ValueError(f"1 to {longest} visible characters are needed, blanks only between{without}; {problem}")
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


class Section(BaseModel, frozen=True, extra="forbid", strict=True):
    """A section of a study file: frozen, of strict types, without unknown keys."""

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


Metrics = Annotated[tuple[Metric, ...], Field(strict=False, min_length=1), at_most(len(METRICS))]


class ProximitySection(Section):
    """The usual distances of meshes from the reference; docs/studies.md has the keys."""

    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] = DEFAULT_POINTS
    threshold: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    metrics: Metrics = ("hausdorff", "chamfer")


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
        if table in above or len(above) > DEEPEST:
            raise ValueError(f"the mesh {quoted(table)} is made from itself, or from too many others")
        if table not in meshes:
            known = known_names(table, meshes) if meshes else "the study has no section [mesh.NAME]"
            if is_mesh_name(Path(table)):
                known += f'; for a file, write {{ source = "files", paths = [{json.dumps(table)}] }}'
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


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that a type is made of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)
