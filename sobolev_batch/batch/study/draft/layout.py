"""Guesses what the mesh files in a folder are for: the reference, and families."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sobolev_batch.batch.study.draft.mesh_files import MeshFile, MeshFolder
from sobolev_batch.batch.study.study import REFERENCE_LABEL
from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.sources.names import caseless_key

# Words in the names of references, and of folders that hold references.
REFERENCE_WORD = re.compile(
    r"(?<![^\W\d_])(original|reference|ref|target|ground[\W_]*truth|gt)(?![^\W\d_])", re.IGNORECASE
)
# Only in the names of folders that hold the files themselves: objects/cow/ is the folder of one object.
_REFERENCES = re.compile(r"(originals|references|targets|objects)", re.IGNORECASE)
# The size of a mesh at the end of its name: cow_500, cow-1k7, cow 20.5.
_SIZE = re.compile(r"(?P<separator>[\W_]*)\d+(?:[.,]\d+)?(?:[kKmM]\d*)?$")
_OTHERS = "meshes"
_LONGEST_NAME = 100


@dataclass(frozen=True)
class Layout:
    """The reference and the families in a folder whose files are of one object.

    Attributes:
        reference: File of the reference.
        is_named: True if its name tells that it is the reference.
        families: Files of each family, by name.
    """

    reference: MeshFile
    is_named: bool
    families: Mapping[str, Sequence[MeshFile]]

    @classmethod
    def of(cls, folder: MeshFolder) -> Layout:
        """Guess the layout of a folder.

        The reference is the finest file that is called one, or else the finest of all. Each folder is a family. Files
        of a single folder are families by what their names have in common.

        Raises:
            StudyError: No file can be the reference.
        """
        named = [file for file in folder.files if is_called_reference(file)]
        reference = _finest_readable(folder, named) or _finest_readable(folder, folder.files)
        if reference is None:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in list(folder.left_out.items())[:3])
            raise StudyError(
                f"{folder.path} holds no mesh file that can be read{': ' * bool(reasons)}{reasons}; "
                "name a folder with meshes"
            )
        others = [file for file in folder.files if file != reference]
        return cls(reference, reference in named, _families(others))


def is_called_reference(file: MeshFile) -> bool:
    """Return whether the name of a file, or that of a folder on the way to it, is that of a reference."""
    return any(map(REFERENCE_WORD.search, (file.stem, *file.folders))) or any(map(_is_plural, file.folders[-1:]))


def is_folder_of_references(name: str) -> bool:
    """Return whether the name of a folder says that it holds references, not which object they are of."""
    return bool(REFERENCE_WORD.search(name)) or _is_plural(name)


def without_size(stem: str) -> str:
    """Return the stem of a file without the number at its end."""
    return _SIZE.sub("", stem).rstrip(" _-.")


def with_any_size(stem: str) -> str:
    """Return the stem of a file with a wildcard for the number at its end."""
    return _SIZE.sub(lambda size: f"{size['separator']}*", stem)


def free_name(wanted: str, taken: Iterable[str], fallback: str = _OTHERS) -> str:
    """Return a name for a family that no other has."""
    visible = "".join(c if c.isprintable() and c not in "/\\" else " " for c in wanted)
    name = " ".join(visible.split())[: _LONGEST_NAME - 10].strip() or fallback
    known = {caseless_key(one) for one in (*taken, REFERENCE_LABEL)}
    numbered = [name, *(f"{name} {number}" for number in range(2, len(known) + 3))]
    return next(one for one in numbered if caseless_key(one) not in known)


def _is_plural(name: str) -> bool:
    return bool(_REFERENCES.fullmatch(name))


def _finest_readable(folder: MeshFolder, files: Iterable[MeshFile]) -> MeshFile | None:
    # Of equals the one with the shortest path: original.ply before original_2.ply.
    ranked = sorted(files, key=lambda file: (-file.triangles, len(file.path)))
    return next((file for file in ranked if folder.is_readable(file)), None)


def _families(files: Sequence[MeshFile]) -> dict[str, tuple[MeshFile, ...]]:
    has_folders = len({file.folders for file in files}) > 1
    groups: dict[str, list[MeshFile]] = {}
    for file in files:
        # With slashes, or those of a/b and "a b" would be one.
        groups.setdefault("/".join(file.folders) if has_folders else without_size(file.stem), []).append(file)
    if not has_folders:
        alone = [file for members in groups.values() for file in members if len(members) == 1]
        groups = {name: members for name, members in groups.items() if len(members) > 1}
        groups.setdefault("", []).extend(alone)
    families: dict[str, tuple[MeshFile, ...]] = {}
    for wanted, members in groups.items():
        if members:
            families[free_name(wanted, families)] = tuple(members)
    return families
