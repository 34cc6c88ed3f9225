"""Guess what the mesh files in a folder are for: references of one object or several, and families of methods."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from sobolev_batch.batch.study.collection import METHOD, OBJECT
from sobolev_batch.batch.study.schema import RESERVED
from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.formats.readers import expected_size, is_mesh_name, mesh_stem, read_mesh
from sobolev_batch.surfaces.sources.files import MOST_MESHES
from sobolev_batch.surfaces.sources.names import caseless_key, label_problem, name_problem, natural_key, quoted

# Bytes of files that are read as a whole; the header or the length of others gives their size.
_MOST_BYTES = 32 << 20
# Words in the names of references, and of folders that hold references.
_REFERENCE = re.compile(r"(?<![^\W\d_])(original|reference|ref|target|ground[\W_]*truth|gt)(?![^\W\d_])", re.IGNORECASE)
# Only in the names of folders that hold the files themselves: objects/cow/ is the folder of one object.
_REFERENCES = re.compile(r"(originals|references|targets|objects)", re.IGNORECASE)
# The size of a mesh at the end of its name: cow_500, cow-1k7, cow 20.5.
_SIZE = re.compile(r"(?P<separator>[\W_]*)\d+(?:[.,]\d+)?(?:[kKmM]\d*)?$")
_LONGEST_NAME = 100


@dataclass(frozen=True)
class MeshFile:
    """A mesh file: its path below the folder, with slashes, and its number of triangles if a look shows it."""

    path: str
    triangles: int

    @property
    def stem(self) -> str:
        """Name without folder, format and compression."""
        return mesh_stem(Path(self.path))

    @property
    def folders(self) -> tuple[str, ...]:
        """Names of the folders that lead to the file."""
        return PurePosixPath(self.path).parent.parts

    @property
    def is_called_reference(self) -> bool:
        """Whether its name, or that of a folder on the way to it, is that of a reference."""
        return any(map(_REFERENCE.search, (self.stem, *self.folders))) or any(
            map(_REFERENCES.fullmatch, self.folders[-1:])
        )


@dataclass(frozen=True)
class Layout:
    """The references and families among the mesh files of a folder.

    Attributes:
        references: Reference of each object, by its name; if all files are of one object, its name is "".
        files: Other files of each object, by the names of object and family.
        left_out: Reason for each mesh file that a study cannot name, by path.
    """

    references: Mapping[str, MeshFile]
    files: Mapping[tuple[str, str], Sequence[MeshFile]]
    left_out: Mapping[str, str]


def guess_layout(folder: Path) -> Layout:
    """Guess the layout of a folder and those in it, except hidden ones, stores, and links to folders, as globs do.

    There are several objects if several files are called references, and each has files of its name. Otherwise the
    reference is the finest file that is called one, or else the finest of all.

    Raises:
        StudyError: There is no such folder, it has more mesh files than a family takes, or none can be the reference.
    """
    if not folder.is_dir():
        raise StudyError(f"{folder}: there is no such folder; name one with mesh files")
    files, left_out = _look_at(folder)
    several = _several_objects(files)
    if several is not None:
        references, own = several
        used = {file.path for group in (references.values(), *own.values()) for file in group}
        strangers = dict.fromkeys(
            (file.path for file in files if file.path not in used), "its name is that of no object"
        )
        return Layout(references, own, {**left_out, **strangers})
    # Of equals the one with the shortest path: original.ply before original_2.ply.
    ranked = sorted(files, key=lambda file: (not file.is_called_reference, -file.triangles, len(file.path)))
    reference = next((file for file in ranked if _is_readable(folder / file.path)), None)
    if reference is None:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
        raise StudyError(
            f"{folder} holds no mesh file that can be read{': ' * bool(reasons)}{reasons}; name a folder with meshes"
        )
    families = _families([file for file in files if file != reference])
    return Layout({"": reference}, {("", name): members for name, members in families.items()}, left_out)


def free_name(wanted: str, taken: Iterable[str] = (), fallback: str = "meshes") -> str:
    """Return a name for a family that no other has."""
    visible = "".join(c if c.isprintable() and c not in "/\\" else " " for c in wanted)
    name = " ".join(visible.split())[: _LONGEST_NAME - 10].strip() or fallback
    known = {caseless_key(other) for other in (*taken, REFERENCE_LABEL)}
    numbered = [name, *(f"{name} {number}" for number in range(2, len(known) + 3))]
    return next(candidate for candidate in numbered if caseless_key(candidate) not in known)


def with_any_size(stem: str) -> str:
    """Return the stem of a file with a wildcard for the number at its end."""
    return _SIZE.sub(lambda size: f"{size['separator']}*", stem)


def _without_size(stem: str) -> str:
    return _SIZE.sub("", stem).rstrip(" _-.")


def _look_at(folder: Path) -> tuple[list[MeshFile], dict[str, str]]:
    """Return the mesh files that a study can name, in the natural order of their paths, and why it cannot the others.

    Small files are read as a whole, up to some bytes together.
    """
    files: list[MeshFile] = []
    left_out: dict[str, str] = {}
    left = _MOST_BYTES
    names: dict[str, str] = {}
    for below in sorted(_mesh_names(folder), key=natural_key):
        other = names.setdefault(caseless_key(below), below)
        try:
            if other != below:
                raise MeshError(f"its name differs from that of {quoted(other)} only in case or accents; rename one")
            problem = label_problem(below)
            if problem is not None:
                raise MeshError(f"its name cannot be a label: {problem}; rename it")
            if OBJECT in below or METHOD in below:
                raise MeshError(f"its name holds {OBJECT} or {METHOD}, which study files replace; rename it")
            (triangles, _), size = expected_size(folder / below), (folder / below).stat().st_size
            # A file without an expected size is of another format, damaged or empty.
            if size <= left or not triangles:
                left -= size
                triangles = len(read_mesh(folder / below).triangles)
            files.append(MeshFile(below, triangles))
        except (MeshError, OSError) as error:
            left_out[below] = str(error).removeprefix(f"{folder / below}: ")
    return files, left_out


def _mesh_names(folder: Path) -> Iterator[str]:
    count = 0
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".") and not name.endswith(".zarr")]
        for name in names:
            if name.startswith(".") or not is_mesh_name(Path(name)):
                continue
            count += 1
            if count > MOST_MESHES:
                raise StudyError(f"{folder} has more than {MOST_MESHES} mesh files; name a folder with fewer")
            yield Path(parent, name).relative_to(folder).as_posix()


def _is_readable(path: Path) -> bool:
    try:
        read_mesh(path)
    except MeshError:
        return False
    return True


def _families(files: Sequence[MeshFile]) -> dict[str, list[MeshFile]]:
    """Return the files of one object by family: one for each folder, or by what names in one folder have in common."""
    has_folders = len({file.folders for file in files}) > 1
    groups: dict[str, list[MeshFile]] = {}
    for file in files:
        # With slashes, or those of a/b and "a b" would be one.
        groups.setdefault("/".join(file.folders) if has_folders else _without_size(file.stem), []).append(file)
    if not has_folders:
        alone = [file for members in groups.values() for file in members if len(members) == 1]
        groups = {name: members for name, members in groups.items() if len(members) > 1}
        groups.setdefault("", []).extend(alone)
    families: dict[str, list[MeshFile]] = {}
    for wanted, members in groups.items():
        if members:
            families[free_name(wanted, families)] = members
    return families


def _several_objects(
    files: Sequence[MeshFile],
) -> tuple[dict[str, MeshFile], dict[tuple[str, str], list[MeshFile]]] | None:
    """Return the references and the files of several objects; None where the files are of one."""
    called = [file for file in files if file.is_called_reference]
    references = {_object_of(file): file for file in called}
    are_names = all(
        name_problem(name, _LONGEST_NAME, RESERVED) is None and not name.startswith((".", "__")) for name in references
    )
    owned = [(file, owner) for file in files if file not in called and (owner := _owner(file, references)) is not None]
    are_all_owners = references.keys() == {owner for _, owner in owned}
    if not are_names or not are_all_owners or not 2 <= len({*map(caseless_key, references)}) == len(called):
        return None
    # Folders that are neither the object's nor those of its reference.
    folders = [[part for part in file.folders if part not in (name, *references[name].folders)] for file, name in owned]
    shared = sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False)))
    families: dict[str, str] = {}
    own: dict[tuple[str, str], list[MeshFile]] = {}
    for (file, name), parts in zip(owned, folders, strict=True):
        # What the name of the file says beside object and size; cowboy in the folder of cow is a method.
        rest = file.stem.removeprefix(name)
        rest = _without_size(file.stem if rest[:1].isalnum() else rest).strip(" _-.")
        # With slashes, or the methods of a/b and "a b" would be one.
        method = "/".join(parts[shared:]) or rest or "".join(parts[-1:])
        family = families.setdefault(method, free_name(method, families.values()))
        own.setdefault((name, family), []).append(file)
    return references, own


def _object_of(reference: MeshFile) -> str:
    """Return the name of the object of a reference: cow of objects/cow.ply, cow/original.ply, cow_original.ply."""
    rest = _REFERENCE.sub("", reference.stem).strip(" _-.")
    own = [part for part in reference.folders if not _REFERENCE.search(part) and not _REFERENCES.fullmatch(part)]
    return rest or "".join(own[-1:])


def _owner(file: MeshFile, references: Mapping[str, MeshFile]) -> str | None:
    """Return the object that a file belongs to: the longest that its name begins with, or that of its folder."""
    stem = file.stem
    # cow_big_500 is of cow_big, not of cow.
    beginnings = (stem[:end] for end in range(len(stem), 0, -1) if not stem[end : end + 1].isalnum())
    return next((name for name in (*beginnings, *file.folders) if name in references), None)
