"""The source `files`: meshes from the file system, by path or glob."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from glob import has_magic
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Annotated

from pydantic import Field

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.formats.readers import companion_files, expected_size, mesh_format, mesh_stem, read_mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.fingerprints import file_digest
from sobolev_batch.surfaces.sources.globs import expand
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, label_problem, quoted
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Fingerprint, Member, Source, at_most

_MOST_PATHS = 100_000


class FileSource(Source):
    """Mesh files.

    Attributes:
        paths: Paths or globs (``**`` crosses folders), relative to the study file. A path may lie anywhere,
            and its file must exist when its mesh is computed. A glob must match a file at once, and matches
            none outside the folder that it names: see `globs.expand`.
        distribution: Installed Python distribution. Paths are then those of files that it recorded at its
            installation, without wildcards. It is not imported.
    """

    paths: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1, strict=False), at_most(_MOST_PATHS)
    ]
    distribution: Annotated[str, Field(min_length=1)] | None = None

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per file, sorted by path, and named by the file's stem where that is unique."""
        if self.distribution is not None:
            paths = sorted({_recorded_file(self.distribution, path) for path in self.paths})
        else:
            paths = sorted({match for path in self.paths for match in _matches(folder, path)})
        # Absolute, since a worker may have been started in another folder.
        return tuple(FileMember(name, -1, path.absolute()) for name, path in zip(_names(paths), paths, strict=True))


@dataclass(frozen=True)
class FileMember(Member):
    """A mesh file."""

    path: Path

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


def _matches(folder: Path, path: str) -> list[Path]:
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


def _names(paths: list[Path]) -> list[str]:
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
