"""Guesses which files of a folder belong to which of several objects."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile

from sobolev_batch.batch.study.draft.layout import (
    REFERENCE_WORD,
    free_name,
    is_called_reference,
    is_folder_of_references,
    with_any_size,
    without_size,
)
from sobolev_batch.batch.study.draft.mesh_files import MeshFile, MeshFolder
from sobolev_batch.batch.study.templates import METHOD, OBJECT, RESERVED
from sobolev_batch.surfaces.sources.names import caseless_key, name_problem

_LONGEST_NAME = 100
_FEWEST_OBJECTS = 2


@dataclass(frozen=True)
class ObjectFile:
    """A file of one of several objects.

    Attributes:
        file: File.
        object: Name of the object.
        method: Name of the method that made it, which is that of a family.
        template: Its path with placeholders for both, and a wildcard for its size.
    """

    file: MeshFile
    object: str
    method: str
    template: str


@dataclass(frozen=True)
class ObjectsLayout:
    """The references and the methods in a folder whose files are of several objects.

    Attributes:
        references: File of the reference of each object.
        reference_templates: Their paths with a placeholder for the object.
        files: Files of the methods.
        left_out: Reason for each file of no object, by path.
    """

    references: Mapping[str, MeshFile]
    reference_templates: Sequence[str]
    files: Sequence[ObjectFile]
    left_out: Mapping[str, str]

    @classmethod
    def of(cls, folder: MeshFolder) -> ObjectsLayout | None:
        """Guess the objects of a folder; None where its files are of one.

        There are several if several files are called references, and each has files of its name.
        """
        references = _references(folder.files)
        own_paths = {file.path for file in references.values()}
        others = [file for file in folder.files if file.path not in own_paths]
        owners = {file.path: owner for file in others if (owner := _owner(file, references)) is not None}
        if len(references) < _FEWEST_OBJECTS or set(owners.values()) != set(references):
            return None
        own = [file for file in others if file.path in owners]
        shared = _common_length([_folders_of_method(file, owners[file.path], references) for file in own])
        strangers = (file.path for file in others if file.path not in owners)
        files = []
        names: dict[str, str] = {}
        for file in own:
            name = owners[file.path]
            folders = _folders_of_method(file, name, references)
            # With slashes, or the methods of a/b and "a b" would be one.
            method = "/".join(folders[shared:]) or _rest(file, name) or "".join(folders[-1:])
            family = names.setdefault(method, free_name(method, names.values()))
            files.append(ObjectFile(file, name, family, _template(file, name, method)))
        templates = dict.fromkeys(_replaced(file.path, name, OBJECT) for name, file in references.items())
        return cls(
            references, tuple(templates), tuple(files), dict.fromkeys(strangers, "its name is that of no object")
        )


def _references(files: Sequence[MeshFile]) -> dict[str, MeshFile]:
    """Return the references of objects by their names, or none where names do not tell."""
    references = {_object_of(file): file for file in files if is_called_reference(file)}
    if len({caseless_key(name) for name in references}) < sum(map(is_called_reference, files)):
        return {}
    is_plain = (
        name_problem(name, _LONGEST_NAME, RESERVED) is None and not name.startswith((".", "__")) for name in references
    )
    return references if all(is_plain) else {}


def _object_of(reference: MeshFile) -> str:
    """Return the name of the object of a reference: cow of objects/cow.ply, cow/original.ply, cow_original.ply."""
    rest = REFERENCE_WORD.sub("", reference.stem).strip(" _-.")
    if rest:
        return rest
    own = [part for part in reference.folders if not is_folder_of_references(part)]
    return own[-1] if own else ""


def _owner(file: MeshFile, references: Mapping[str, MeshFile]) -> str | None:
    """Return the object that a file belongs to: the longest that its name begins with, or that of its folder."""
    stem = file.stem
    # cow_big_500 is of cow_big, not of cow.
    beginnings = (stem[:end] for end in range(len(stem), 0, -1) if not stem[end : end + 1].isalnum())
    return next((name for name in (*beginnings, *file.folders) if name in references), None)


def _folders_of_method(file: MeshFile, name: str, references: Mapping[str, MeshFile]) -> list[str]:
    """Return the folders of a file that are neither the object's nor those of its reference."""
    return [part for part in file.folders if part != name and part not in references[name].folders]


def _rest(file: MeshFile, name: str) -> str:
    """Return what the name of a file says beside its object and size."""
    rest = file.stem.removeprefix(name)
    # cowboy in the folder of cow is a method.
    return without_size(file.stem if rest[:1].isalnum() else rest).strip(" _-.")


def _common_length(paths: Sequence[Sequence[str]]) -> int:
    """Return the number of folders that paths begin with in common."""
    return sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*paths, strict=False)))


def _template(file: MeshFile, name: str, method: str) -> str:
    *folders, _ = _replaced(_replaced(file.path, name, OBJECT), method, METHOD).split("/")
    stem = with_any_size(_replaced(_replaced(file.stem, name, OBJECT), method, METHOD))
    return "/".join([*folders, f"{stem}{file.ending}"])


def _replaced(path: str, name: str, placeholder: str) -> str:
    """Return a path with a placeholder for a name, if any: a whole folder, or a whole word of the last part."""
    if not name:
        return path
    *folders, last = path.split("/")
    word = rf"(?<![^\W_]){re.escape(name)}(?![^\W_])"
    return "/".join(
        [
            *(placeholder if part == name else part for part in folders),
            re.sub(word, lambda _: placeholder, last, count=1),
        ]
    )
