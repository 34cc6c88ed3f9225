"""Studies: of one object, and collections of several, each with its own reference, by the same methods.

The file of a collection has templates: texts with {object} and {method}, which are filled in, or matched with files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from glob import has_magic
from itertools import islice
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.geometry.surface import Similarity
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.sources.command import function_name
from sobolev_batch.sources.files import MeshTable, matching_files, number_as_text, read_mesh_list
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import caseless_key, duplicate_names, natural_key, quoted
from sobolev_batch.sources.registry import Source
from sobolev_batch.study.schema import (
    Backends,
    Family,
    FamilyReference,
    ObjectSection,
    ProximitySection,
    StudyDocument,
    known_names,
    plain_tables,
    read_toml,
    with_named_meshes,
)
from sobolev_batch.transform.backends import ComplexDtype
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, check_orders

Parsed = TypeVar("Parsed")

REFERENCE_LABEL = "reference"
OBJECT, METHOD = "{object}", "{method}"

_PART = re.compile(r"(\*\*/|\*\*|\*|\?|\[[^\]]*\]|\{object\}|\{method\})")
_PATTERNS = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}

# Meshes of a list as entries of a family, by object and method.
_Listed = Mapping[tuple[str, str], Sequence[Mapping[str, Any]]]


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

    def chooses(self, family: str, label: str) -> bool:
        """Return whether a run computes a member, where only a part is chosen."""
        names = (family, label)
        return not self.only or any(name == one or fnmatchcase(name, one) for one in self.only for name in names)

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
        """Return the study with the place where its meshes are kept that take long to make."""
        if not any(source.keeps_meshes for source in self._sources):
            return self
        families = tuple(f.model_copy(update={"source": f.source.with_cache(cache)}) for f in self.families)
        reference = self.reference.with_cache(cache) if isinstance(self.reference, Source) else self.reference
        return replace(self, families=families, reference=reference, cache=cache)

    def with_only(self, only: tuple[str, ...]) -> Self:
        """Return the study for a run of a part; see `only`."""
        return replace(self, only=only)


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
        folder = Path(folder)
        # Objects and lists may bring references and families.
        written = plain_tables(table)
        values = {"reference": None, "family": [], **written}
        # A family may be of the mesh that has the name of the object: any will do to check it.
        names = [section.get("name") for section in values.get("object") or [] if isinstance(section, dict)]
        checked = _filled(values["family"], OBJECT, names[0]) if names and names[0] else values["family"]
        document = StudyDocument.from_tables({**values, "family": checked})
        listed = _listed_meshes(document.objects.get("meshes", ()), folder)
        objects = _objects(document, values, list(dict.fromkeys(name for name, _ in listed)), folder)
        families = [_families(family, [section.name for section in objects], folder) for family in values["family"]]
        studies: dict[str, Study] = {}
        for section in objects:
            made = [entry for entries in families for entry in entries[section.name]]
            try:
                table_of_object = _table_of_object(values, section, listed, made)
                one = Study.from_table(table_of_object, folder=folder)
                studies[section.name] = replace(one, part=section.name)
            except StudyError as error:
                raise StudyError(f"object {quoted(section.name)}: {error}") from error
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


def is_collection(table: Mapping[str, Any]) -> bool:
    """Return True where the table of a study file has several objects."""
    templates = str([table.get(key) for key in ("mesh", "reference", "family")])
    return "object" in table or "objects" in table or OBJECT in templates or METHOD in templates


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


def _listed_meshes(given: str | Sequence[MeshTable], folder: Path) -> _Listed:
    """Return the meshes of the section [objects]."""
    base = Path()
    if isinstance(given, str):
        base, given = Path(given).parent, read_mesh_list(folder / given)
    meshes: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for mesh in given:
        known = dict(mesh)
        names: list[str] = []
        for column in ("object", "method"):
            if column not in known:
                raise StudyError(f"[objects]: meshes: {quoted(mesh['path'])} has no {column}; each mesh needs both")
            name = known.pop(column)
            names.append(number_as_text(name) if isinstance(name, float) else str(name))
        meshes.setdefault((names[0], names[1]), []).append({**known, "path": (base / known["path"]).as_posix()})
    return meshes


def _objects(
    document: StudyDocument, values: Mapping[str, Any], listed: Sequence[str], folder: Path
) -> Sequence[ObjectSection]:
    """Return the objects that have sections, or those that a list or the files of the reference name."""
    if document.object is None:
        found = [{"name": name} for name in listed or _names_in_reference(values, folder)]
        document = StudyDocument.from_tables({**values, "object": found})
    objects = document.object or []
    names = [section.name for section in objects]
    unnamed = [name for name in listed if name not in names]
    if unnamed:
        raise StudyError(
            f"[objects] lists {quoted(unnamed[0])}, and no [[object]] section has this name; list all objects, or give "
            "all of them sections"
        )
    same = duplicate_names(names)
    if same:
        raise StudyError(f"object: names must differ by more than case, found {quoted(same[0][:3])}; rename one")
    return objects


def _names_in_reference(values: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the objects that the files of the reference name, in their natural order."""
    paths = (with_named_meshes(values["reference"], values.get("mesh", {})) or {}).get("paths")
    templates = [path for path in paths if isinstance(path, str) and OBJECT in path] if isinstance(paths, list) else []
    if not templates:
        raise StudyError(
            "a collection needs its objects: [[object]] sections, a list in [objects], or a [reference] with paths "
            'such as ["objects/{object}.obj"]'
        )
    names: set[str] = set()
    for template in templates:
        match = re.compile(_pattern(template)).fullmatch
        texts = map(partial(_text, folder), matching_files(folder, _glob(template)))
        found = {matched["object"] for matched in map(match, texts) if matched}
        if not found:
            raise StudyError(
                f"no file gives {OBJECT} of {template!r} one name; it stands for a part of a path, without /"
            )
        names |= found
    return sorted(names, key=natural_key)


def _table_of_object(
    values: Mapping[str, Any], section: ObjectSection, listed: _Listed, families: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the study of an object as nested tables."""
    name = section.name
    common = {key: value for key, value in values.items() if key not in ("family", "object", "objects")}
    common = _filled(common, OBJECT, name)
    own = {method: meshes for (owner, method), meshes in listed.items() if owner == name}
    is_reference = {method: caseless_key(method) == REFERENCE_LABEL for method in own}
    references = [mesh["path"] for method, meshes in own.items() if is_reference[method] for mesh in meshes]
    if section.reference is not None:
        common["reference"] = _filled(section.reference, OBJECT, name)
    elif references:
        common["reference"] = {"source": "files", "paths": references}
    if section.scaling is not None:
        common["scaling"] = section.scaling
    methods = [method for method in own if not is_reference[method]]
    all_families = [*families, *({"name": method, "source": "files", "meshes": own[method]} for method in methods)]
    if not all_families:
        raise StudyError("no family has a file of it; add files, or leave it out")
    return {**common, "study": {**common["study"], "name": f"{common['study']['name']} {name}"}, "family": all_families}


def _families(family: Mapping[str, Any], names: Sequence[str], folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the families that a section gives for each object: one, or one for each method among its files."""
    paths = family.get("paths")
    templates = paths if isinstance(paths, list) and all(isinstance(path, str) for path in paths) else []
    if not any(OBJECT in template or METHOD in template for template in templates):
        return {name: [_filled(family, OBJECT, name)] for name in names}
    methods: dict[str, dict[str, list[str]]] = {name: {} for name in names}
    for template in templates:
        for name, method, path in _files(template, names, folder):
            methods[name].setdefault(method if METHOD in family["name"] else "", []).append(path)
    if not any(methods.values()):
        raise StudyError(f"family {quoted(family['name'])}: no file that it names is of an object; correct its paths")
    return {
        name: [
            {**_filled(_filled(family, OBJECT, name), METHOD, method), "paths": own[method]}
            for method in sorted(own, key=natural_key)
        ]
        for name, own in methods.items()
    }


def _files(template: str, names: Sequence[str], folder: Path) -> Iterator[tuple[str, str, str]]:
    """Yield object, method and path of the files that match a template; the longest names that fit count."""
    texts = {name: template.replace(OBJECT, name) for name in sorted(names, key=len, reverse=True)}
    if not has_magic(_glob(template.replace(OBJECT, ""))):
        # The files need not exist yet.
        yield from ((name, "", text) for name, text in texts.items())
        return
    patterns = {name: re.compile(_pattern(text)).fullmatch for name, text in texts.items()}
    for path in map(partial(_text, folder), matching_files(folder, _glob(template))):
        candidates = (name for name in patterns if name in path or OBJECT not in template)
        found = ((name, match) for name in candidates if (match := patterns[name](path)) is not None)
        for name, match in found if OBJECT not in template else islice(found, 1):
            yield name, match.groupdict().get("method", ""), path


def _filled(value: Any, placeholder: str, name: str) -> Any:
    """Return nested tables with a name in place of a placeholder."""
    if isinstance(value, str):
        return value.replace(placeholder, name)
    if isinstance(value, Mapping):
        return {key: _filled(entry, placeholder, name) for key, entry in value.items()}
    return [_filled(entry, placeholder, name) for entry in value] if isinstance(value, list) else value


def _glob(template: str) -> str:
    return template.replace(OBJECT, "*").replace(METHOD, "*")


def _text(folder: Path, path: Path) -> str:
    """Return a path as a template of the study would have it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.as_posix()


def _pattern(template: str) -> str:
    """Return the regular expression of a template, with the groups object and method.

    A placeholder stands for as many characters as it can, of one part of the path; where it is repeated, for the same.
    """
    seen: set[str] = set()
    pattern = ""
    for part in _PART.split(Path(template).as_posix()):
        if part in (OBJECT, METHOD):
            group = part.strip("{}")
            pattern += f"(?P={group})" if part in seen else f"(?P<{group}>[^/]+)"
            seen.add(part)
        elif part.startswith("[") and part.endswith("]"):
            pattern += "[^" + re.escape(part[2:-1]) + "]" if part[1:2] == "!" else part
        else:
            pattern += _PATTERNS.get(part) or re.escape(part)
    return pattern
