"""The templates of a study file with several objects, filled in: the tables of a study of each.

Texts with {object} and {method} are filled in, or matched with the names of files.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from glob import has_magic
from itertools import islice
from pathlib import Path
from typing import Any

from sobolev_batch.errors import StudyError, naming
from sobolev_batch.sources.files import MeshTable, matching_files, number_as_text, read_mesh_list
from sobolev_batch.sources.names import caseless_key, duplicate_names, natural_key, quoted
from sobolev_batch.study.refusals import validated
from sobolev_batch.study.schema import REFERENCE_LABEL, ObjectSection, StudyDocument, SurfaceSections, with_named_meshes

OBJECT, METHOD = "{object}", "{method}"

_PART = re.compile(r"(\*\*/|\*\*|\*|\?|\[[^\]]*\]|\{object\}|\{method\})")
# They take the stars beside them along, since two stars in a row stand for whole folders.
_PLACEHOLDERS = re.compile(r"(?:\*?\{(?:object|method)\}\*?)+")
_PATTERNS = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}

# Meshes of a list as entries of a family, by method.
_Listed = Mapping[str, Sequence[Mapping[str, Any]]]


def sections_of_objects(
    written: Mapping[str, Any], folder: Path
) -> tuple[StudyDocument, dict[str, tuple[SurfaceSections, dict[str, Any]]]]:
    """Return the sections of a study, and for each object its own ones and its study as nested tables, by its name.

    The only object of a study without templates and sections of objects is under "". Tables are given as `plain_tables`
    returns them. StudyError where they are malformed, or name no object.
    """
    templates = str([written.get(key) for key in ("mesh", "reference", "family")])
    if not ("object" in written or "objects" in written or OBJECT in templates or METHOD in templates):
        document = validated(StudyDocument, written)
        return document, {"": (document, dict(written))}
    # Objects and lists may bring references and families.
    values = {"reference": None, "family": [], **written}
    # A family may be of the mesh that has the name of the object: any will do to check it.
    given = values.get("object")
    names = [section.get("name") for section in given if isinstance(section, dict)] if isinstance(given, list) else []
    checked = _filled(values["family"], OBJECT, str(names[0])) if names and names[0] else values["family"]
    document = validated(StudyDocument, {**values, "family": checked})
    listed = _listed_meshes(document.objects.get("meshes", ()), folder)
    objects = _objects(document, values, [*listed], folder)
    families = [_families(family, [section.name for section in objects], folder) for family in values["family"]]
    sections = {}
    for section in objects:
        own = [entry for entries in families for entry in entries[section.name]]
        table = _table_of_object(values, section, listed.get(section.name, {}), own)
        with naming(f"object {quoted(section.name)}"):
            own_sections = {name: table[name] for name in SurfaceSections.model_fields if name in table}
            sections[section.name] = validated(SurfaceSections, own_sections), table
    return document, sections


def _listed_meshes(given: str | Sequence[MeshTable], folder: Path) -> dict[str, _Listed]:
    base = Path()
    if isinstance(given, str):
        base, given = Path(given).parent, read_mesh_list(folder / given)
    meshes: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for mesh in given:
        known = dict(mesh)
        names: list[str] = []
        for column in ("object", "method"):
            if column not in known:
                raise StudyError(f"[objects]: meshes: {quoted(mesh['path'])} has no {column}; each mesh needs both")
            name = known.pop(column)
            names.append(number_as_text(name) if isinstance(name, float) else str(name))
        of_method = meshes.setdefault(names[0], {}).setdefault(names[1], [])
        of_method.append({**known, "path": (base / known["path"]).as_posix()})
    return {**meshes}


def _objects(
    document: StudyDocument, values: Mapping[str, Any], listed: Sequence[str], folder: Path
) -> Sequence[ObjectSection]:
    """Return the objects that have sections, or those that a list or the files of the reference name."""
    if document.object is None:
        found = [{"name": name} for name in listed or _names_in_reference(values, folder)]
        document = validated(StudyDocument, {**values, "object": found})
    objects = document.object or []
    names = [section.name for section in objects]
    known = {*names}
    if unnamed := [name for name in listed if name not in known]:
        raise StudyError(
            f"[objects] lists {quoted(unnamed[0])}, and no [[object]] section has this name; list all objects, or give "
            "all of them sections"
        )
    if same := duplicate_names(names):
        raise StudyError(f"object: names must differ by more than case, found {quoted(same[0][:3])}; rename one")
    return objects


def _names_in_reference(values: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the objects that the files of the reference name, in their natural order."""
    paths = (with_named_meshes(values["reference"], values.get("mesh", {})) or {}).get("paths")
    templates = [path for path in paths if isinstance(path, str) and OBJECT in path] if isinstance(paths, list) else []
    if not templates:
        raise StudyError(
            "a study of several objects has to name them: by [[object]] sections, a list in [objects], or a "
            '[reference] with paths such as ["objects/{object}.obj"]'
        )
    names: set[str] = set()
    for template in templates:
        match = re.compile(_pattern(template)).fullmatch
        if not (found := {matched["object"] for matched in map(match, _matching(template, folder)) if matched}):
            raise StudyError(f"no file gives {OBJECT} of {template!r} one name; it stands for a part without /")
        names |= found
    return sorted(names, key=natural_key)


def _table_of_object(
    values: Mapping[str, Any], section: ObjectSection, own: _Listed, families: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the study of an object as nested tables, with its own meshes of the list."""
    name = section.name
    common = {key: value for key, value in values.items() if key not in ("family", "object", "objects")}
    common = _filled(common, OBJECT, name)
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
        raise StudyError(f"object {quoted(name)}: no family has a file of it; add files, or leave it out")
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
    if METHOD not in template and not has_magic(template.replace(OBJECT, "")):
        # The files need not exist yet.
        yield from ((name, "", template.replace(OBJECT, name)) for name in names)
        return
    known, lengths = set(names), sorted({len(name) for name in names}, reverse=True)
    pattern_of = cache(lambda name: re.compile(_pattern(template.replace(OBJECT, name))).fullmatch)
    for path in _matching(template, folder):
        # Thousands of names are not tried one by one.
        parts = (path[i : i + length] for length in lengths for i in range(len(path) - length + 1))
        candidates = names if OBJECT not in template else (part for part in parts if part in known)
        found = ((name, match) for name in candidates if (match := pattern_of(name)(path)) is not None)
        for name, match in found if OBJECT not in template else islice(found, 1):
            yield name, match.groupdict().get("method", ""), path


def _filled(value: Any, placeholder: str, name: str) -> Any:
    if isinstance(value, str):
        return value.replace(placeholder, name)
    if isinstance(value, Mapping):
        return {key: _filled(entry, placeholder, name) for key, entry in value.items()}
    return [_filled(entry, placeholder, name) for entry in value] if isinstance(value, list) else value


def _matching(template: str, folder: Path) -> list[str]:
    """Return the files that a template may name, as it would have them."""
    found = matching_files(folder, _PLACEHOLDERS.sub("*", template))
    return [(path if Path(template).is_absolute() else path.relative_to(folder)).as_posix() for path in found]


def _pattern(template: str) -> str:
    """Return the regular expression of a template, with the groups object and method.

    A placeholder stands for as many characters as it can, of one part of the path; where it is repeated, for the same.
    """
    seen, pattern = set[str](), ""
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
