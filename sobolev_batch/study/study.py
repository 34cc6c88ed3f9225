"""Studies: of one object, and collections of several, each with its own reference, by the same methods."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import TAKEN_NAMES
from sobolev_batch.sources.command import function_name
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import caseless_key, duplicate_names, quoted
from sobolev_batch.sources.registry import Member, Source, single_member
from sobolev_batch.study.schema import (
    REFERENCE_LABEL,
    Backends,
    Family,
    FamilyReference,
    ProximitySection,
    StudyDocument,
    known_names,
    plain_tables,
    read_toml,
)
from sobolev_batch.study.templates import is_collection, tables_of_objects
from sobolev_batch.transform.backends import ComplexDtype
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, check_orders

Parsed = TypeVar("Parsed")

# Family and member of each surface, by label.
Members = Mapping[str, tuple[str, Member]]


@dataclass(frozen=True)
class Study:
    """A validated study. Make it by `from_toml` or `from_table`.

    Attributes:
        name: Word or line that identifies the study; a store remembers it.
        title: Free text.
        lattice: Lattice of all fields; None if an accuracy is requested.
        octaves: Number of octaves that are sampled beyond a given lattice.
        accuracy: Accuracy of the distances to the reference; None if the lattice is given.
        transform: Accuracy, dtype and quadrature of the transforms.
        dtype: Dtype that was requested, if any.
        backend: Backend of the transforms; "auto" leaves it to each worker.
        orders: Sobolev orders s < -1/2.
        pairs: "reference" for the distances to the reference alone, "all" for those of all pairs of meshes.
        families: Families of surfaces to compare.
        reference: Surface that they are compared with.
        scaling: Similarity transform of all surfaces; None takes the reference's bounding sphere to the unit sphere.
        proximity: How the usual distances of each mesh from the reference are measured; None if they are not requested.
        folder: Folder in which relative paths start.
        table: The study as it was written.
        largest_chunk_bytes: Size above which a stored field is split into blocks, one chunk each.
        cache: Where meshes are kept that take long to make; None if the study makes none, or has no store yet.
        part: Name of the object, in the study of an object of a collection; else empty.
        only: Families and members FAMILY/MEMBER that a run computes, or patterns of these; empty for all.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "spheres"},
    ...     "lattice": {"xi_max": 2.0, "M": 8},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> study.orders, study.lattice, study.pairs
    ((-2.0,), Lattice(xi_max=2.0, M=8), 'reference')
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
    scaling: Similarity | None
    proximity: ProximitySection | None
    folder: Path
    table: Mapping[str, Any]
    largest_chunk_bytes: int = 256 << 20
    octaves: int = 0
    cache: MeshCache | None = None
    part: str = ""
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_orders(self.orders)

    @cached_property
    def members(self) -> Members:
        """Family and member of each surface, by label. They are listed once, and none is made.

        StudyError where a family or the reference cannot be listed, or labels or names of metadata collide.
        """
        members: dict[str, tuple[str, Member]] = {}
        for family in self.families:
            with _within(f"family {family.name!r}"):
                listed = family.source.members(self.folder)
            for member in listed:
                label = f"{family.name}/{member.name}"
                if label in members:
                    raise StudyError(f"two surfaces of the study have the label {label!r}")
                members[label] = family.name, _with_other_names(member, family.name)
        if not isinstance(self.reference, FamilyReference):
            with _within("reference"):
                members[REFERENCE_LABEL] = REFERENCE_LABEL, single_member(self.reference, self.folder)
        return members

    @property
    def studies(self) -> dict[str, Self]:
        """This study, as the only one of its kind; see `StudyCollection`."""
        return {"": self}

    def chosen(self, only: Sequence[str]) -> set[str]:
        """Return the labels of the members that names of families or members, or patterns of these, choose."""
        return {
            label
            for label, (family, _) in self.members.items()
            if any(name == one or fnmatchcase(name, one) for one in only for name in (family, label))
        }

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that its surfaces need besides those that this package requires."""
        return tuple(sorted({library for source in self._sources for library in source.libraries}))

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that it runs to make its meshes, as a shell would have them, each once."""
        return tuple(dict.fromkeys(command for source in self._sources for command in source.commands))

    @property
    def _sources(self) -> list[Source]:
        own = [self.reference] if isinstance(self.reference, Source) else []
        return [*(family.source for family in self.families), *own]

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file. Relative paths in it start from its folder.

        Args:
            path: Path of the file. docs/studies.md describes its sections.

        Raises:
            StudyError: The file cannot be read, is no TOML, or has keys that are unknown, of the wrong type, or out of
                range. The message lists every offender.
        """
        return _parsed_file(path, cls.from_table)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: Sections of the study file. A pandas.DataFrame may take the place of a list of tables, such as for
                ``meshes`` of the source ``files``.
            folder: Folder in which relative paths start.

        Raises:
            StudyError: See `from_toml`.
        """
        values = plain_tables(table)
        document = StudyDocument.from_tables(values)
        if document.object is not None or document.objects:
            raise StudyError("[[object]] and [objects] make several studies; read them as a StudyCollection")
        families, reference = document.family, document.reference
        if not families:
            raise StudyError("[[family]] must have at least 1 item, found []")
        if reference is None:
            raise StudyError("[reference] must be a table, found None")
        names = [family.name for family in families]
        _require_distinct(names)
        if isinstance(reference, FamilyReference):
            if reference.family not in names:
                hint = known_names(reference.family, names)
                raise StudyError(f"[reference]: no family is named {quoted(reference.family)}; {hint}")
        else:
            sources = [family.source.with_reference(reference) for family in families]
            families = [one.model_copy(update={"source": s}) for one, s in zip(families, sources, strict=True)]
        return cls(
            name=document.study.name,
            title=document.study.title or document.study.name,
            lattice=None if document.lattice is None else document.lattice.settings(),
            accuracy=None if document.accuracy is None else document.accuracy.settings(),
            transform=document.transform.settings(),
            dtype=document.transform.dtype,
            backend=document.transform.backend,
            orders=document.norm.settings(),
            pairs=document.compare.pairs,
            families=tuple(families),
            reference=reference,
            scaling=document.scaling.settings(),
            proximity=document.proximity,
            folder=Path(folder),
            octaves=document.lattice.octaves if document.lattice else 0,
            table=_as_written(values),
        )

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the study, not listed yet, with the place where its meshes are kept that take long to make."""
        if not any(source.keeps_meshes for source in self._sources):
            return replace(self)
        families = tuple(f.model_copy(update={"source": f.source.with_cache(cache)}) for f in self.families)
        reference = self.reference.with_cache(cache) if isinstance(self.reference, Source) else self.reference
        return replace(self, families=families, reference=reference, cache=cache)

    def with_only(self, only: tuple[str, ...]) -> Self:
        """Return the study for a run of a part; see `only`."""
        return replace(self, only=only)


@contextmanager
def _within(what: str) -> Iterator[None]:
    """Name in a StudyError what it is about."""
    try:
        yield
    except StudyError as error:
        raise StudyError(f"{what}: {error}") from error


def _with_other_names(member: Member, family: str) -> Member:
    """Return a member whose metadata have no name that tables use themselves; StudyError where they have one."""
    if member.names_wishes:
        named = ((f"target_{name}" if name in TAKEN_NAMES else name, value) for name, value in member.metadata)
        return replace(member, metadata=tuple(named))
    taken = next((name for name, _ in member.metadata if name in TAKEN_NAMES), None)
    if taken is not None:
        raise StudyError(
            f"family {family!r}: the metadata of {quoted(member.name)} have the name {taken!r}, which tables use "
            f"themselves; rename it, for example to {family}_{taken}"
        )
    return member


def _as_written(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a study as JSON holds them, functions by their names."""
    written: dict[str, Any] = json.loads(
        json.dumps(values, default=lambda value: function_name(value) if callable(value) else str(value))
    )
    return written


def _require_distinct(families: Sequence[str]) -> None:
    same = duplicate_names(families)
    if same:
        names = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
        raise StudyError(
            f"family: names must differ by more than case and the spelling of accents, found {names} twice; rename one"
        )
    if any(caseless_key(name) == REFERENCE_LABEL for name in families):
        raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")


@dataclass(frozen=True)
class StudyCollection:
    """Studies of several objects by the same methods. Make it by `from_toml` or `from_table`.

    Attributes:
        name: Name of the collection; a store remembers it.
        title: Free text.
        studies: Study of each object, by its name. A method is a family with the same name in all of them.
        lacking: Methods that have no files for an object, by its name.
        table: The collection as it was written.

    >>> import sobolev_batch as sb
    >>> collection = sb.StudyCollection.from_table({
    ...     "study": {"name": "balls"},
    ...     "lattice": {"xi_max": 3.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "object": [
    ...         {"name": "ball", "reference": {"source": "sphere"}},
    ...         {"name": "egg", "reference": {"source": "ellipsoid", "axes": [1.0, 0.8, 0.8]}},
    ...     ],
    ...     "family": [{"name": "icosphere", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> list(collection.studies)
    ['ball', 'egg']
    """

    name: str
    title: str
    studies: Mapping[str, Study]
    lacking: Mapping[str, tuple[str, ...]]
    table: Mapping[str, Any]

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file with several objects, as `Study.from_toml` does; docs/leagues.md describes its sections."""
        return _parsed_file(path, cls.from_table)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a collection given as nested tables, as `Study.from_table` does.

        A pandas.DataFrame may take the place of ``meshes`` of objects.
        """
        folder, written = Path(folder), plain_tables(table)
        document, tables = tables_of_objects(written, folder)
        studies: dict[str, Study] = {}
        for name, of_object in tables.items():
            with _within(f"object {quoted(name)}"):
                studies[name] = replace(Study.from_table(of_object, folder=folder), part=name)
        own = {name: [family.name for family in study.families] for name, study in studies.items()}
        methods = dict.fromkeys(method for names in own.values() for method in names)
        lacking = {name: tuple(method for method in methods if method not in own[name]) for name in own}
        lacking = {name: missing for name, missing in lacking.items() if missing}
        title = document.study.title or document.study.name
        return cls(document.study.name, title, studies, lacking, _as_written(written))

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that its studies run, as a shell would have them, each once."""
        return tuple(dict.fromkeys(command for study in self.studies.values() for command in study.commands))

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the collection with the place where its meshes are kept that take long to make."""
        return replace(self, studies={name: study.with_cache(cache) for name, study in self.studies.items()})

    def with_only(self, only: tuple[str, ...]) -> Self:
        """Return the collection for a run of a part of each study."""
        return replace(self, studies={name: study.with_only(only) for name, study in self.studies.items()})


AnyStudy = Study | StudyCollection
# As functions take it.
StudyLike = AnyStudy | str | Path


def as_study(study: StudyLike) -> AnyStudy:
    """Return a study of one object or of several, which may be given by the path of its file."""

    def parse(table: Mapping[str, Any], folder: Path) -> AnyStudy:
        return (StudyCollection if is_collection(table) else Study).from_table(table, folder=folder)

    return study if isinstance(study, AnyStudy) else _parsed_file(study, parse)


def _parsed_file(path: str | Path, parse: Callable[..., Parsed]) -> Parsed:
    path = Path(path)
    try:
        return parse(read_toml(path), folder=path.parent)
    except InputError as error:
        raise StudyError(f"{path}: {error}") from error
