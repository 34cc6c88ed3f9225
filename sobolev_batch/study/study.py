"""Studies: objects, each with its own reference, and how meshes by the same methods are compared with these."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, Literal, Self

from sobolev_batch.arrays import ComplexDtype
from sobolev_batch.errors import InputError, StudyError, naming
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import TAKEN_NAMES
from sobolev_batch.parameters import path_of
from sobolev_batch.reduction.searched import SearchedSource
from sobolev_batch.sources.command import function_name
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import caseless_key, duplicate_names, fits, known_names, node_problem, quoted
from sobolev_batch.sources.registry import Member, Source, single_member
from sobolev_batch.study.schema import REFERENCE_LABEL, Family, FamilyReference, ProximitySection, SurfaceSections
from sobolev_batch.study.templates import sections_of_objects
from sobolev_batch.study.toml import plain_tables, read_toml
from sobolev_batch.transform.backends import Backends
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, check_orders

# Halves of characters, which no file can hold.
_HALVES = re.compile("[\ud800-\udfff]")

# Family and member of each surface, by label.
Members = Mapping[str, tuple[str, Member]]


@dataclass(frozen=True)
class StudyObject:
    """An object of a study: a reference, and families of meshes to compare with it.

    Attributes:
        name: Its name among the objects of the study; empty for the only object of a study that names none.
        title: Free text.
        families: Families of its surfaces. A method is a family with the same name in several objects.
        reference: Surface that they are compared with.
        scaling: Similarity transform of all surfaces; None takes the reference's bounding sphere to the unit sphere.
        folder: Folder in which relative paths start.
        table: The object as a study of its own, as it was written.
        lacking: Methods of the study that have no files for it.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_toml("workflows/icosphere.toml")
    >>> list(study.object.members)[:2], len(study.object.members)
    (['icosphere/0', 'icosphere/1'], 9)
    """

    name: str
    title: str
    families: tuple[Family, ...]
    reference: Source | FamilyReference
    scaling: Similarity | None
    folder: Path
    table: Mapping[str, Any]
    lacking: tuple[str, ...] = ()

    @classmethod
    def from_sections(cls, name: str, sections: SurfaceSections, table: Mapping[str, Any], folder: Path) -> Self:
        """Check that the families of an object and its reference fit together; StudyError where they do not."""
        reference, names = sections.reference, [family.name for family in sections.family]
        if not names:
            raise StudyError("[[family]] must have at least 1 item, found []")
        if reference is None:
            raise StudyError("[reference] must be a table, found None")
        if same := duplicate_names(names):
            twice = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
            raise StudyError(f"family: names must differ by more than case and accents, found {twice}; rename one")
        if any(caseless_key(name) == REFERENCE_LABEL for name in names):
            raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")
        if isinstance(reference, FamilyReference) and reference.family not in names:
            hint = known_names(reference.family, names)
            raise StudyError(f"[reference]: no family is named {quoted(reference.family)}; {hint}")
        header, families = table["study"], []
        orders = table.get("norm", {}).get("orders") or [DEFAULT_ORDER]
        for family in sections.family:
            source = family.source.with_reference(reference) if isinstance(reference, Source) else family.source
            if isinstance(source, SearchedSource):
                with naming(f"family {family.name!r}"):
                    source = source.in_study(header.get("length_unit"), orders[0])
            families.append(family.model_copy(update={"source": source}))
        title, scaling = header.get("title") or header["name"], sections.scaling.settings()
        return cls(name, title, tuple(families), reference, scaling, folder, _as_written(table))

    @cached_property
    def members(self) -> Members:
        """Family and member of each surface, by label. They are listed once, and none is made.

        StudyError where a family or the reference cannot be listed, or labels or names of metadata collide.
        """
        members: dict[str, tuple[str, Member]] = {}
        for family in self.families:
            with naming(f"family {family.name!r}"):
                listed = [_with_other_names(one, family.name) for one in family.source.members(self.folder)]
            for member in listed:
                if (label := f"{family.name}/{member.name}") in members:
                    raise StudyError(f"two surfaces of the study have the label {label!r}")
                members[label] = family.name, member
        if not isinstance(self.reference, FamilyReference):
            with naming("reference"):
                members[REFERENCE_LABEL] = REFERENCE_LABEL, single_member(self.reference, self.folder)
        columns = dict.fromkeys(name for _, member in members.values() for name, _ in member.metadata)
        if same := duplicate_names(columns):
            raise StudyError(f"metadata: {' and '.join(map(quoted, same[0]))} differ in case alone; rename one")
        return members

    def chosen(self, only: Sequence[str]) -> set[str]:
        """Return the labels of the members that names of families or members, or patterns of these, choose.

        A name may begin with that of the object, or be no more than that.
        """
        chosen = set()
        for label, (family, _) in self.members.items():
            own = (self.name, f"{self.name}/{family}", f"{self.name}/{label}") if self.name else ()
            if any(fits(name, one) for name in (family, label, *own) for one in only):
                chosen.add(label)
        return chosen

    @property
    def sources(self) -> list[Source]:
        """Sources of its families, and that of its reference unless it is a member of one."""
        own = [self.reference] if isinstance(self.reference, Source) else []
        return [*(family.source for family in self.families), *own]

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the object, not listed yet, with the place where its meshes are kept that take long to make."""
        if not any(source.keeps_meshes for source in self.sources):
            return replace(self)
        families = tuple(f.model_copy(update={"source": f.source.with_cache(cache)}) for f in self.families)
        reference = self.reference.with_cache(cache) if isinstance(self.reference, Source) else self.reference
        return replace(self, families=families, reference=reference)


@dataclass(frozen=True)
class Study:
    """A validated study: objects, and how their surfaces are compared. Make it by `from_toml` or `from_table`.

    Attributes:
        name: Word or line that identifies the study; a store remembers it.
        title: Free text.
        lattice: Lattice of all fields; None if an accuracy is requested.
        accuracy: Accuracy of the distances to the references; None if the lattice is given.
        transform: Accuracy, dtype and quadrature of the transforms.
        dtype: Dtype that was requested, if any.
        backend: Backend of the transforms; "auto" leaves it to each worker.
        orders: Sobolev orders s < -1/2.
        pairs: "reference" for the distances to the reference alone, "all" for those of all pairs of an object's meshes.
        proximity: How the usual distances of each mesh from the reference are measured; None if they are not requested.
        objects: Its objects by name; the only object of a study that names none is under "".
        table: The study as it was written.
        largest_chunk_bytes: Size above which a stored field is split into blocks, one chunk each.
        octaves: Number of octaves that are sampled beyond a given lattice.
        cache: Where meshes are kept that take long to make; None if the study makes none, or has no store yet.
        only: Families and members FAMILY/MEMBER that a run computes, or patterns of these; empty for all.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "balls"},
    ...     "lattice": {"xi_max": 3.0, "M": 16},
    ...     "norm": {"orders": [-2.0]},
    ...     "object": [
    ...         {"name": "ball", "reference": {"source": "sphere"}},
    ...         {"name": "egg", "reference": {"source": "ellipsoid", "axes": [1.0, 0.8, 0.8]}},
    ...     ],
    ...     "family": [{"name": "icosphere", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> study.orders, study.lattice, study.pairs
    ((-2.0,), Lattice(xi_max=3.0, M=16), 'reference')
    >>> list(study.objects), list(study.objects["egg"].members)
    (['ball', 'egg'], ['icosphere/0', 'icosphere/1', 'reference'])
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
    proximity: ProximitySection | None
    objects: Mapping[str, StudyObject]
    table: Mapping[str, Any]
    largest_chunk_bytes: int = 256 << 20
    octaves: int = 0
    cache: MeshCache | None = None
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_orders(self.orders)

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file. Relative paths in it start from its folder.

        Args:
            path: Path of the file. docs/studies.md describes its sections, docs/leagues.md those for several objects.

        Raises:
            StudyError: The file cannot be read, is no TOML, or has keys that are unknown, of the wrong type, or out of
                range. The message lists every offender.
        """
        path = path_of(path)
        try:
            return cls.from_table(read_toml(path), folder=path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: Sections of the study file. A pandas.DataFrame may take the place of a list of tables, such as for
                ``meshes`` of the source ``files``, or of the objects.
            folder: Folder in which relative paths start.

        Raises:
            StudyError: See `from_toml`.
        """
        # Absolute, since a worker that plans an object may have been started in another folder.
        values, folder = plain_tables(table), path_of(folder).absolute()
        document, sections = sections_of_objects(values, folder)
        objects: dict[str, StudyObject] = {}
        for name, (of_object, as_written) in sections.items():
            with naming(f"object {quoted(name)}" if name else ""):
                objects[name] = StudyObject.from_sections(name, of_object, as_written, folder)
        methods = dict.fromkeys(family.name for one in objects.values() for family in one.families)
        for name, one in objects.items():
            own = {family.name for family in one.families}
            objects[name] = replace(one, lacking=tuple(method for method in methods if method not in own))
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
            proximity=document.proximity,
            objects=objects,
            table=_as_written(values),
            octaves=document.lattice.octaves if document.lattice else 0,
        )

    @property
    def object(self) -> StudyObject:
        """Its only object; ValueError where there are several."""
        (only,) = self.objects.values()
        return only

    def of_object(self, name: str) -> Self:
        """Return the study of one of its objects: what a task takes along, and a store is made for."""
        one = self.objects[name]
        return replace(self, objects={name: one}, table=one.table)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that its surfaces need besides those that this package requires."""
        return tuple(sorted({library for source in self._sources for library in source.libraries}))

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that it runs to make its meshes, as a shell would have them, each once."""
        found = ((str(one.folder), source.commands) for one in self.objects.values() for source in one.sources)
        return tuple(dict.fromkeys(text.replace("{folder}", folder) for folder, commands in found for text in commands))

    @property
    def _sources(self) -> Iterator[Source]:
        return (source for one in self.objects.values() for source in one.sources)

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the study, not listed yet, with the place where its meshes are kept that take long to make."""
        objects = {name: one.with_cache(cache) for name, one in self.objects.items()}
        makes_some = any(source.keeps_meshes for source in self._sources)
        return replace(self, objects=objects, cache=cache if makes_some else None)


StudyLike = Study | str | Path


def as_study(study: StudyLike) -> Study:
    """Return a study, which may be given by the path of its file."""
    if isinstance(study, Mapping):
        raise StudyError("a study is a Study or the path of its file, found a mapping; pass Study.from_table(...)")
    return study if isinstance(study, Study) else Study.from_toml(study)


def _with_other_names(member: Member, family: str) -> Member:
    """Return a member whose metadata tables can hold, beside what they have themselves; StudyError otherwise."""
    if member.names_wishes:
        named = ((f"target_{name}" if _is_taken(name) else name, value) for name, value in member.metadata)
        member = replace(member, metadata=tuple(named))
    for name, value in member.metadata:
        if (problem := node_problem(name)) is None and _is_taken(name):
            problem = f"tables use that themselves; rename it, for example to {family}_{name}"
        if problem is not None:
            raise StudyError(f"the metadata of {quoted(member.name)} have the name {quoted(name)}: {problem}")
        if not isinstance(value, Real) and (not isinstance(value, str) or _HALVES.search(value)):
            raise StudyError(f"{name} of {quoted(member.name)} must be a number or a text, found {quoted(value)}")
    return member


def _is_taken(name: str) -> bool:
    """Tell whether tables use a name themselves, or another one that some file systems take for the same."""
    return caseless_key(name) in TAKEN_NAMES


def _as_written(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a study as JSON holds them, functions by their names."""
    text = json.dumps(values, default=lambda value: function_name(value) if callable(value) else str(value))
    return dict(json.loads(text))
