"""A collection: several objects, each with its own reference, and the same methods for all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from glob import has_magic
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, ValidationError

from sobolev_batch.batch.study.refusals import joined, refusals
from sobolev_batch.batch.study.schema import Name, Section, plain_tables, read_toml, require_modest
from sobolev_batch.batch.study.study import REFERENCE_LABEL, Study
from sobolev_batch.batch.study.templates import METHOD, OBJECT, RESERVED, as_written, filled, holds, names_of
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.surfaces.sources.files import checked_list, matching_files, number_as_text, read_mesh_list
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, natural_key, quoted

_MOST_OBJECTS = 1000


def _plain_name(name: str) -> str:
    if any(character in RESERVED for character in name) or name.startswith((".", "__")) or name.endswith(".json"):
        raise ValueError(
            f"the name of an object is that of a folder in the store: it holds none of {' '.join(RESERVED)}, does not "
            "begin with . or __, and does not end with .json"
        )
    return name


class _ObjectSection(Section):
    name: Annotated[Name, AfterValidator(_plain_name)]
    reference: dict[str, Any] | None = None
    scaling: dict[str, Any] | None = None


class _ObjectsSection(Section):
    meshes: Any


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
        """Read a study file with several objects. Relative paths in it start from its folder.

        Args:
            path: Path of the file. docs/leagues.md describes its sections.

        Raises:
            StudyError: The file cannot be read, or is no collection. The message lists every offender.
        """
        path = Path(path)
        try:
            return cls._of(read_toml(path), path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a collection given as nested tables, with the keys of the study file.

        Args:
            table: Sections of a study, besides object (a list), or objects. A pandas.DataFrame may stand for the list
                of meshes of objects.
            folder: Folder in which relative paths start.

        Raises:
            StudyError: See `from_toml`.
        """
        return cls._of(table, Path(folder))

    def with_best_effort(self) -> Self:
        """Return the collection with the key ``best_effort`` of its accuracy set.

        Raises:
            StudyError: It has a lattice instead of an accuracy.
        """
        studies = {name: study.with_best_effort() for name, study in self.studies.items()}
        accuracy = {**self.table["accuracy"], "best_effort": True}
        return replace(self, studies=studies, table={**self.table, "accuracy": accuracy})

    @classmethod
    def _of(cls, table: Mapping[str, Any], folder: Path) -> Self:
        require_modest(table)
        table = plain_tables(table)
        _require_sections(table)
        common = {key: value for key, value in table.items() if key not in ("object", "objects")}
        listed = _listed_meshes(table.get("objects"), folder)
        named = list(dict.fromkeys(name for name, _ in listed))
        objects = _named_objects(table["object"]) if "object" in table else []
        unnamed = [name for name in named if objects and name not in {section.name for section in objects}]
        if unnamed:
            raise StudyError(
                f"[objects] lists {quoted(unnamed[0])}, and no [[object]] section has this name; list all objects, or "
                "give all of them sections"
            )
        if not objects:
            plain = {f"object {quoted(name)}": {"name": name} for name in named or _names_in_reference(common, folder)}
            objects = _object_sections(plain)
        same = duplicate_names(section.name for section in objects)
        if same:
            raise StudyError(f"object: names must differ by more than case, found {quoted(same[0][:3])}; rename one")
        studies: dict[str, Study] = {}
        for section in objects:
            own = {method: meshes for (name, method), meshes in listed.items() if name == section.name}
            # Files of objects with longer names also match the templates of this object.
            longer = [other.name for other in objects if section.name in other.name and other.name != section.name]
            try:
                table_of_object = _Part(section, common, own, longer, folder).table()
                studies[section.name] = Study.from_table(table_of_object, folder=folder)
            except StudyError as error:
                raise StudyError(f"object {quoted(section.name)}: {error}") from error
        methods = dict.fromkeys(family.name for study in studies.values() for family in study.families)
        lacking: dict[str, tuple[str, ...]] = {}
        for name, study in studies.items():
            missing = methods.keys() - {family.name for family in study.families}
            if missing:
                lacking[name] = tuple(method for method in methods if method in missing)
        header = common["study"]
        return cls(
            header["name"],
            header.get("title") or header["name"],
            studies,
            lacking,
            json.loads(json.dumps(table, default=str)),
        )


def is_collection(table: Mapping[str, Any]) -> bool:
    """Return True where the table of a study file has several objects."""
    templates = table.get("reference"), table.get("family")
    return "object" in table or "objects" in table or any(holds(templates, name) for name in (OBJECT, METHOD))


def read_study(path: str | Path) -> Study | StudyCollection:
    """Read a study file, of one object or of several.

    Raises:
        StudyError: See `Study.from_toml`.
    """
    path = Path(path)
    try:
        kind = StudyCollection if is_collection(read_toml(path)) else Study
    except InputError as error:
        raise StudyError(f"{path}: {error}") from error
    return kind.from_toml(path)


def _listed_meshes(section: Any, folder: Path) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Return the meshes of the section [objects], as entries of a family, by object and method."""
    if section is None:
        return {}
    try:
        given = checked_list(_ObjectsSection.model_validate(section).meshes)
    except ValidationError as error:
        values = section if isinstance(section, dict) else {}
        raise StudyError(joined(refusals(error, values, _ObjectsSection, "[objects]"))) from error
    except ValueError as error:
        raise StudyError(f"[objects]: meshes {error}") from error
    base = Path()
    if isinstance(given, str):
        base, given = Path(given).parent, read_mesh_list(folder / given)
    meshes: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for mesh in given or ():
        known: dict[str, Any] = dict(mesh.metadata)
        names: list[str] = []
        for column in ("object", "method"):
            if column not in known:
                raise StudyError(f"[objects]: meshes: {quoted(mesh.path)} has no {column}; each mesh needs both")
            name = known.pop(column)
            names.append(number_as_text(name) if isinstance(name, float) else str(name))
        own = {"path": (base / mesh.path).as_posix(), "name": mesh.name, "time": mesh.time, **known}
        entry = {key: value for key, value in own.items() if value is not None}
        meshes.setdefault((names[0], names[1]), []).append(entry)
    return meshes


@dataclass(frozen=True)
class _Part:
    """The study of one object of a collection.

    Attributes:
        section: Section of the object.
        common: Sections that all objects share.
        listed: Its meshes in a list, by method.
        longer: Names of other objects that hold its name. A file is of the object with the longest name that fits.
        folder: Folder where relative paths start.
    """

    section: _ObjectSection
    common: Mapping[str, Any]
    listed: Mapping[str, Sequence[Mapping[str, Any]]]
    longer: Sequence[str]
    folder: Path

    def table(self) -> dict[str, Any]:
        """Return the study as nested tables."""
        name = self.section.name
        common = filled({key: value for key, value in self.common.items() if key != "family"}, OBJECT, name)
        reference = self.section.reference or self._listed_reference() or common.get("reference")
        families = [table for family in self.common.get("family", []) for table in self._families(family)]
        families += (
            {"name": method, "source": "files", "meshes": meshes}
            for method, meshes in self.listed.items()
            if caseless_key(method) != REFERENCE_LABEL
        )
        header = common["study"]
        return {
            **common,
            "study": {**header, "name": f"{header['name']} {name}"},
            **({} if reference is None else {"reference": filled(reference, OBJECT, name)}),
            **({} if self.section.scaling is None else {"scaling": self.section.scaling}),
            "family": families,
        }

    def _listed_reference(self) -> dict[str, Any] | None:
        listed = self.listed.items()
        meshes = [mesh for method, meshes in listed if caseless_key(method) == REFERENCE_LABEL for mesh in meshes]
        return {"source": "files", "paths": [mesh["path"] for mesh in meshes]} if meshes else None

    def _families(self, family: Any) -> list[Any]:
        """Return a family for each method among its files, or none where no file matches."""
        others = filled({key: value for key, value in family.items() if key != "paths"}, OBJECT, self.section.name)
        paths = family.get("paths")
        if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
            return [filled(family, OBJECT, self.section.name)]
        if not holds(family.get("name"), METHOD):
            own = [file for path in paths for file in self._paths(path, self._files_of_others(path))]
            return [{**others, "paths": own}]
        methods: dict[str, list[str]] = {}
        for path in paths:
            foreign = self._files_of_others(path)
            for method in self._methods(path, foreign) if METHOD in path else []:
                methods.setdefault(method, []).extend(self._paths(path, foreign, method))
        return [
            {**filled(others, METHOD, method), "paths": methods[method]} for method in sorted(methods, key=natural_key)
        ]

    def _methods(self, template: str, foreign: set[Path]) -> list[str]:
        """Return the methods that have files of the object; none where no file matches."""
        own = template.replace(OBJECT, self.section.name)
        try:
            return names_of(own, METHOD, self.folder, foreign)
        except StudyError:
            return []

    def _paths(self, template: str, foreign: set[Path], method: str = "") -> list[str]:
        """Return the path or glob of a method, or the files that match it where others are of another object."""
        text = template.replace(OBJECT, self.section.name).replace(METHOD, method)
        files = _files(self.folder, text) if foreign and has_magic(text) else []
        if foreign.isdisjoint(files):
            return [text]
        own = [as_written(path, self.folder) for path in files if path not in foreign]
        if not own:
            raise StudyError(
                f"{quoted(text)} matches files of other objects alone, such as {quoted(str(files[0]))}; "
                f"put files of {quoted(self.section.name)} there, or correct it"
            )
        return own

    def _files_of_others(self, template: str) -> set[Path]:
        """Return the files of the objects with longer names."""
        globs = [template.replace(OBJECT, name).replace(METHOD, "*") for name in self.longer if OBJECT in template]
        return {path for glob in globs for path in _files(self.folder, glob)}


def _files(folder: Path, text: str) -> list[Path]:
    """Return the files that match a path or glob; none where no file does."""
    try:
        return matching_files(folder, text)
    except StudyError:
        return []


def _require_sections(table: Mapping[str, Any]) -> None:
    """Check the kinds of the sections that objects share, since their studies are made from them."""
    kinds: dict[str, tuple[type, str]] = {
        "study": (Mapping, "a section, [study], with the name of the study"),
        "reference": (Mapping, "a section, [reference]"),
        "objects": (Mapping, '[objects] with the key meshes, such as meshes = "meshes.csv"'),
        "family": (list, "written as sections, [[family]] before each"),
    }
    for key, (kind, words) in kinds.items():
        value = table.get(key)
        entries = value if isinstance(value, list) else []
        is_one = isinstance(value, kind) and all(isinstance(entry, Mapping) for entry in entries)
        if not is_one and (key in table or key == "study"):
            found = f", found {quoted(value)}" if key in table else ", and is missing"
            raise StudyError(f"{key} must be {words}{found}")
    if not isinstance(table["study"].get("name"), str):
        raise StudyError(f"[study]: name must be a text, found {quoted(table['study'].get('name'))}")


def _named_objects(entries: Any) -> list[_ObjectSection]:
    """Return the sections [[object]]."""
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise StudyError(f"object must be written as sections, [[object]] before each, found {quoted(entries)}")
    return _object_sections({f"[[object]] {number}": entry for number, entry in enumerate(entries, 1)})


def _object_sections(entries: Mapping[str, dict[str, Any]]) -> list[_ObjectSection]:
    """Return the sections of objects, by where they are given."""
    if len(entries) > _MOST_OBJECTS:
        raise StudyError(f"object: at most {_MOST_OBJECTS} objects are allowed, found {len(entries)}")
    sections: list[_ObjectSection] = []
    refused: list[str] = []
    for place, entry in entries.items():
        try:
            sections.append(_ObjectSection.model_validate(entry))
        except ValidationError as error:
            refused += refusals(error, entry, _ObjectSection, place)
    if refused:
        raise StudyError(joined(refused))
    return sections


def _names_in_reference(common: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the objects that the files of the reference name."""
    reference = common.get("reference")
    paths = reference.get("paths") if isinstance(reference, Mapping) else None
    templates = [path for path in paths if isinstance(path, str) and OBJECT in path] if isinstance(paths, list) else []
    if not templates:
        raise StudyError(
            "a collection needs its objects: [[object]] sections, a list in [objects], or a [reference] with paths "
            'such as ["objects/{object}.obj"]'
        )
    names = dict.fromkeys(name for template in templates for name in names_of(template, OBJECT, folder))
    return sorted(names, key=natural_key)
