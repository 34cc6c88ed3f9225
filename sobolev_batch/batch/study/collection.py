"""A collection: several objects, each with its own reference, and the same methods for all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, ValidationError

from sobolev_batch.batch.study.refusals import joined, refusals
from sobolev_batch.batch.study.schema import Name, Section, read_toml, require_modest, without_frames
from sobolev_batch.batch.study.study import REFERENCE_LABEL, Study
from sobolev_batch.batch.study.templates import METHOD, OBJECT, RESERVED, ObjectTemplate, filled, holds, names_of
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.surfaces.sources.files import ListedMesh, checked_list, number_as_text, read_mesh_list
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, natural_key, quoted

_MOST_OBJECTS = 1000


def _plain_name(name: str) -> str:
    found = next((character for character in name if character in RESERVED), None)
    if found is not None or name.startswith((".", "__")) or name.endswith(".json"):
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
        table = without_frames(table)
        require_modest(table)
        _require_sections(table)
        common = {key: value for key, value in table.items() if key not in ("object", "objects")}
        listed = _Listed.from_section(table.get("objects"), folder)
        objects = _named_objects(table["object"]) if "object" in table else []
        unnamed = [name for name in listed.objects if objects and name not in {one.name for one in objects}]
        if unnamed:
            raise StudyError(
                f"[objects] lists {quoted(unnamed[0])}, and no [[object]] section has this name; list all objects, or "
                "give all of them sections"
            )
        objects = objects or _plain_objects(listed.objects or _found(common, folder))
        same = duplicate_names(one.name for one in objects)
        if same:
            raise StudyError(f"object: names must differ by more than case, found {quoted(same[0][:3])}; rename one")
        studies, lacking = {}, {}
        for one in objects:
            # Their files match the templates of this object, too.
            longer = [other.name for other in objects if one.name in other.name and other.name != one.name]
            part = _Part(common, one, longer, listed, folder)
            try:
                studies[one.name] = Study.from_table(part.table(), folder=folder)
            except StudyError as error:
                raise StudyError(f"object {quoted(one.name)}: {error}") from error
        methods = dict.fromkeys(family.name for study in studies.values() for family in study.families)
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


@dataclass(frozen=True)
class _Listed:
    """Meshes of a list with the columns object and method.

    Attributes:
        meshes: Meshes by object and method.
    """

    meshes: Mapping[tuple[str, str], Sequence[ListedMesh]]

    @classmethod
    def from_section(cls, section: Any, folder: Path) -> Self:
        """Return the meshes of the section [objects]."""
        if section is None:
            return cls({})
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
        meshes: dict[tuple[str, str], list[ListedMesh]] = {}
        for mesh in given or ():
            known = dict(mesh.metadata)
            names = [known.pop(key, None) for key in ("object", "method")]
            if None in names:
                column = ("object", "method")[names.index(None)]
                raise StudyError(f"[objects]: meshes: {quoted(mesh.path)} has no {column}; each mesh needs both")
            path = (base / mesh.path).as_posix()
            rest = ListedMesh(path, mesh.name, mesh.time, tuple(known.items()))
            of_object, method = (number_as_text(name) if isinstance(name, float) else str(name) for name in names)
            meshes.setdefault((of_object, method), []).append(rest)
        return cls(meshes)

    @property
    def objects(self) -> list[str]:
        """Names of the objects, as the list has them."""
        return list(dict.fromkeys(name for name, _ in self.meshes))

    def reference(self, name: str) -> dict[str, Any] | None:
        """Return the reference of an object, if the list has one."""
        found = [
            mesh
            for (one, method), meshes in self.meshes.items()
            for mesh in meshes
            if one == name and caseless_key(method) == REFERENCE_LABEL
        ]
        return {"source": "files", "paths": [mesh.path for mesh in found]} if found else None

    def families(self, name: str) -> list[dict[str, Any]]:
        """Return the families of an object."""
        return [
            {"name": method, "source": "files", "meshes": [_as_table(mesh) for mesh in meshes]}
            for (one, method), meshes in self.meshes.items()
            if one == name and caseless_key(method) != REFERENCE_LABEL
        ]


@dataclass(frozen=True)
class _Part:
    """The study of one object of a collection.

    Attributes:
        common: Sections that all objects share.
        object: Section of the object.
        longer: Names of other objects that hold the name of this one.
        listed: Meshes that a list gives.
        folder: Folder in which relative paths start.
    """

    common: Mapping[str, Any]
    object: _ObjectSection
    longer: Sequence[str]
    listed: _Listed
    folder: Path

    def table(self) -> dict[str, Any]:
        """Return the study as nested tables."""
        name = self.object.name
        common = filled({key: value for key, value in self.common.items() if key != "family"}, OBJECT, name)
        reference = self.object.reference or self.listed.reference(name) or common.get("reference")
        header = dict(common.get("study", {}))
        families = [table for family in self.common.get("family", []) for table in self._families(family)]
        return {
            **common,
            "study": {**header, "name": f"{header.get('name', '')} {name}"},
            **({} if reference is None else {"reference": filled(reference, OBJECT, name)}),
            **({} if self.object.scaling is None else {"scaling": self.object.scaling}),
            "family": [*families, *self.listed.families(name)],
        }

    def _families(self, family: Any) -> list[Any]:
        """Return a family for each method among its files, or none where no file matches."""
        others = filled({key: value for key, value in family.items() if key != "paths"}, OBJECT, self.object.name)
        paths = family.get("paths")
        if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
            return [filled(family, OBJECT, self.object.name)]
        if not holds(family.get("name"), METHOD):
            return [{**others, "paths": [own for path in paths for own in self._template(path).paths()]}]
        methods: dict[str, list[str]] = {}
        for path in paths:
            template = self._template(path)
            for method in template.methods() if METHOD in path else []:
                methods.setdefault(method, []).extend(template.paths(method))
        return [
            {**filled(others, METHOD, method), "paths": methods[method]} for method in sorted(methods, key=natural_key)
        ]

    def _template(self, path: str) -> ObjectTemplate:
        return ObjectTemplate(path, self.object.name, self.longer, self.folder)


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


def _plain_objects(names: Sequence[str]) -> list[_ObjectSection]:
    """Return the sections of objects of which the names alone are known."""
    return _object_sections({f"object {quoted(name)}": {"name": name} for name in names})


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


def _found(common: Mapping[str, Any], folder: Path) -> list[str]:
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


def _as_table(mesh: ListedMesh) -> dict[str, Any]:
    known = {"path": mesh.path, "name": mesh.name, "time": mesh.time, **dict(mesh.metadata)}
    return {key: value for key, value in known.items() if value is not None}
