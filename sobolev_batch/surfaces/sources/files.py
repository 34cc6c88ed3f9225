"""The source `files`: meshes from the file system, by path, by glob or in a list."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import translate
from glob import has_magic
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.formats.raw_files import checked_length, open_regular
from sobolev_batch.surfaces.formats.readers import companion_files, expected_size, mesh_format, mesh_stem, read_mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.mesh_lists import MOST_MESHES, ListedMesh, checked_list, read_mesh_list
from sobolev_batch.surfaces.sources.names import (
    caseless_key,
    duplicate_names,
    label_problem,
    natural_key,
    numbers_in,
    quoted,
)
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Fingerprint, Member, Source, at_most, checked_times


def _checked_times(value: object) -> tuple[float, ...] | Literal["names"] | None:
    if value is None:
        return None
    if isinstance(value, str):
        if value == "names":
            return "names"
        raise ValueError('must be a list of numbers, or "names" for the numbers in the names of the files')
    return checked_times(value, MOST_MESHES)


class FileSource(Source):
    """Mesh files.

    Attributes:
        paths: Paths or globs (``**`` crosses folders), relative to the study file. A path may lie anywhere,
            and its file must exist when its mesh is computed. A glob must match a file at once, and matches
            none outside the folder that it names: see `expand`.
        meshes: Instead of paths, a list of meshes with what is known of them: a CSV file, or tables of the study. See
            `mesh_lists`.
        distribution: Installed Python distribution. Paths are then those of files that it recorded at its
            installation, without wildcards. It is not imported.
        times: Times of the meshes if they are states of one that moves: a list with one for each file, in the order of
            the numbers in their names, or "names" for the last number in the name of each file.
    """

    paths: (
        Annotated[
            tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1, strict=False), at_most(MOST_MESHES)
        ]
        | None
    ) = None
    meshes: Annotated[str | tuple[ListedMesh, ...] | None, BeforeValidator(checked_list)] = None
    distribution: Annotated[str, Field(min_length=1)] | None = None
    times: Annotated[tuple[float, ...] | Literal["names"] | None, BeforeValidator(_checked_times)] = None

    @model_validator(mode="after")
    def _paths_or_meshes(self) -> Self:
        if (self.paths is None) == (self.meshes is None):
            raise ValueError(
                'either paths, such as ["a.ply", "scans/*.obj"], or a list of meshes is needed, and not both'
            )
        if self.meshes is not None and (self.distribution is not None or self.times is not None):
            raise ValueError("distribution and times belong to paths; a list of meshes gives each its time")
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per file, sorted by path or time, and named by the file's stem where that is unique.

        The meshes of a list keep its order.
        """
        if self.meshes is not None:
            return _listed_members(self.meshes, folder)
        given = self.paths or ()
        if self.distribution is not None:
            paths = sorted({_recorded_file(self.distribution, path) for path in given})
        else:
            paths = sorted({match for path in given for match in matching_files(folder, path)})
        times = dict.fromkeys(paths) if self.times is None else _times(paths, self.times)
        names = dict(zip(paths, names_of_files(paths), strict=True))
        # Absolute, since a worker may have been started in another folder.
        return tuple(FileMember(names[path], -1, path.absolute(), time=time) for path, time in times.items())


@dataclass(frozen=True)
class FileMember(Member):
    """A mesh file."""

    path: Path
    is_quickly_loaded: ClassVar[bool] = True

    def load(self) -> Surface:
        """Read the file."""
        return read_mesh(self.path)

    def fingerprint(self) -> Fingerprint:
        """Return the format, and the digests of the file and of those that it refers to."""
        beside = [file_digest(path) for path in companion_files(self.path)]
        return {"file": file_digest(self.path), "beside": beside, "format": mesh_format(self.path)}

    def expected_size(self) -> ExpectedSize:
        """Return the size that the header announces, or that the length of the file suggests."""
        return ExpectedSize(*expected_size(self.path))


def _listed_members(meshes: str | tuple[ListedMesh, ...], folder: Path) -> tuple[Member, ...]:
    """Return one member for each mesh of a list, by the name that it gives or the stem of its file."""
    if isinstance(meshes, str):
        folder, meshes = (folder / meshes).parent, read_mesh_list(folder / meshes)
    paths = [folder / mesh.path for mesh in meshes]
    unnamed = list(dict.fromkeys(path for path, mesh in zip(paths, meshes, strict=True) if mesh.name is None))
    stems = dict(zip(unnamed, names_of_files(unnamed), strict=True))
    names = [stems[path] if mesh.name is None else mesh.name for path, mesh in zip(paths, meshes, strict=True)]
    repeated = duplicate_names(names)
    if repeated:
        raise StudyError(f"meshes: several are named {quoted(repeated[0][0])}; give each a name of its own")
    return tuple(
        FileMember(name, -1, path.absolute(), time=mesh.time, metadata=mesh.metadata)
        for name, path, mesh in zip(names, paths, meshes, strict=True)
    )


def _recorded_file(name: str, path: str) -> Path:
    """Return the path of a file that an installed distribution recorded."""
    try:
        recorded = distribution(name).files or []
    except PackageNotFoundError as error:
        raise StudyError(
            f"the distribution {name!r} is not installed; install it, for example by pip install {name}"
        ) from error
    for file in recorded:
        if file.as_posix() == path:
            return Path(str(file.locate()))
    raise StudyError(f"the distribution {name!r} {distribution(name).version} contains no file {path!r}")


def matching_files(folder: Path, path: str) -> list[Path]:
    """Return the files that a path or glob names."""
    if "\0" in path:
        raise StudyError(f"paths: no file can have the name {quoted(path)}, which holds the character NUL")
    # A file may have wildcard characters in its name; an existing one is meant.
    if not has_magic(path) or os.path.isfile(folder / path):
        return [folder / path]
    try:
        return expand(folder, path)
    except StudyError as error:
        raise StudyError(f"paths: {error}") from error


def _times(paths: list[Path], given: tuple[float, ...] | Literal["names"]) -> dict[Path, float]:
    """Return the time of each file, in the order of times."""
    if given == "names":
        times = {path: _last_number(path) for path in paths}
    elif len(given) == len(paths):
        times = dict(zip(sorted(paths, key=lambda path: natural_key(path.as_posix())), given, strict=True))
    else:
        raise StudyError(f"times: {len(given)} times are given for {len(paths)} files; give one for each")
    repeated = [time for time, count in Counter(times.values()).items() if count > 1]
    if repeated:
        raise StudyError(f"times: several files have the time {repeated[0]:g}; each state needs a time of its own")
    return dict(sorted(times.items(), key=lambda item: item[1]))


def _last_number(path: Path) -> float:
    numbers = numbers_in(mesh_stem(path))
    if not numbers:
        raise StudyError(f"times: the name of the file {quoted(path.name)} has no number; list the times instead")
    return numbers[-1]


def names_of_files(paths: list[Path]) -> list[str]:
    """Return stems; file names where stems collide, and whole paths where these collide with any other name."""
    stems = [mesh_stem(path) for path in paths]
    names = [stem if alone else path.name for stem, path, alone in zip(stems, paths, _unique(stems), strict=True)]
    names = [name if alone else path.as_posix() for name, path, alone in zip(names, paths, _unique(names), strict=True)]
    for path, name in zip(paths, names, strict=True):
        problem = label_problem(name)
        if problem is not None:
            raise StudyError(f"paths: the name of the file {quoted(path.name)} is no label: {problem}; rename the file")
    duplicates = duplicate_names(names)
    if duplicates:
        raise StudyError(
            f"paths: the files {' and '.join(map(quoted, duplicates[0][:3]))} have names that differ only in case or "
            "in the encoding of accents; rename one"
        )
    return names


def _unique(names: list[str]) -> list[bool]:
    """Return, for each name, whether no other one has the same `caseless_key`."""
    keys = list(map(caseless_key, names))
    counts = Counter(keys)
    return [counts[key] == 1 for key in keys]


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        MeshError: The file cannot be read.
    """
    try:
        with open_regular(path) as file:
            checked_length(file)
            return hashlib.file_digest(file, "sha256").hexdigest()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def expand(folder: Path, pattern: str) -> list[Path]:
    """Return the files that match a pattern of ``**``, ``*``, ``?`` and ``[...]``.

    The part of the pattern before its first wildcard names a folder. Files outside of that folder are
    refused, since nobody would notice them: ``..`` after a wildcard, and links that lead out. Hidden files
    match only a part that begins with a dot; ``**`` follows no links to folders.

    Args:
        folder: Folder where relative patterns start.
        pattern: Pattern with at least one wildcard.

    Raises:
        StudyError: The pattern matches no file, or one outside its folder.
    """
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if has_magic(part))
    base, rest = folder.joinpath(*parts[:first]), parts[first:]
    glob = f"the glob {quoted(pattern, 300)}"
    if ".." in rest:
        raise StudyError(f"{glob} goes back up behind a wildcard; name the folder to search")
    paths = [base]
    for part in rest:
        # Without duplicates, or some patterns would take for ever.
        paths = list(dict.fromkeys(match for path in paths for match in _matches(path, part)))
    inside = Path(os.path.realpath(base))
    files = [path for path in paths if os.path.isfile(path)]
    if not files:
        raise StudyError(f"{glob} matches no file below {inside}; correct it, or put files there")
    for path in files:
        target = Path(os.path.realpath(path))
        if not target.is_relative_to(inside):
            raise StudyError(
                f"{glob} matches {str(path)!r}, a link out of {inside} to {target}; name such files by their paths"
            )
    return files


def _matches(folder: Path, part: str) -> Iterator[Path]:
    """Yield the paths in a folder that match one part of a pattern."""
    if part == "**":
        # Any number of folders; as the last part it stands for their files.
        yield folder
        for parent, folders, files in os.walk(folder):
            folders[:] = [
                name for name in folders if not name.startswith(".") and not os.path.islink(os.path.join(parent, name))
            ]
            for name in (*folders, *files):
                if not name.startswith("."):
                    yield Path(parent, name)
    elif not has_magic(part):
        if os.path.lexists(folder / part):
            yield folder / part
    else:
        matches = re.compile(translate(part)).match
        try:
            names = os.listdir(folder)
        except OSError:
            # A file, or a folder that may not be listed, matches nothing, as in a shell.
            return
        for name in names:
            if matches(name) and (part.startswith(".") or not name.startswith(".")):
                yield folder / name
