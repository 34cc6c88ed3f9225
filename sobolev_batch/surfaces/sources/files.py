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
from sobolev_batch.surfaces.sources.globs import expand
from sobolev_batch.surfaces.sources.names import flaw, folded, shown, twins
from sobolev_batch.surfaces.sources.registry import Fingerprint, Member, Size, Source, at_most, file_digest

# A stem has up to 255 bytes; a path that stands in for it may be longer.
_LONGEST_NAME = 1000
_MOST_PATHS = 100_000


class FileSource(Source):
    """Mesh files.

    Attributes:
        paths: paths or globs (``**`` crosses folders), relative to the study file. A path that is
            named must exist when its mesh is computed, and may lie anywhere; a glob must match something
            at once, and finds nothing outside the folder that it names, see `globs.expand`.
        distribution: an installed Python distribution. Paths are then those of files that it
            recorded at its installation, without wildcards; nothing of it is imported.
    """

    paths: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1, strict=False), at_most(_MOST_PATHS)
    ]
    distribution: Annotated[str, Field(min_length=1)] | None = None

    def members(self, folder: Path) -> tuple[Member, ...]:
        """One member per file, sorted by path; named by the file's stem where that tells them apart."""
        if self.distribution is not None:
            found = {self._recorded(self.distribution, path) for path in self.paths}
        else:
            found = {match for path in self.paths for match in _matches(folder, path)}
        paths = sorted(found)
        # Absolute, since a worker may have been started in another folder.
        return tuple(FileMember(name, -1, path.absolute()) for name, path in zip(_names(paths), paths, strict=True))

    @staticmethod
    def _recorded(name: str, path: str) -> Path:
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


@dataclass(frozen=True)
class FileMember(Member):
    """A mesh file."""

    path: Path

    def load(self) -> Surface:
        """Read the file."""
        return read_mesh(self.path)

    def fingerprint(self) -> Fingerprint:
        """The digests of the file's bytes and of those it refers to, and its format."""
        beside = [file_digest(path) for path in companion_files(self.path)]
        return {"file": file_digest(self.path), "beside": beside, "format": mesh_format(self.path)}

    def expected_size(self) -> Size:
        """What the header announces, or the length of the file suggests."""
        return Size(*expected_size(self.path))


def _matches(folder: Path, path: str) -> list[Path]:
    if "\0" in path:
        raise StudyError(f"paths: no file can have the name {shown(path)}, which holds the character NUL")
    # A file may have wildcard characters in its name: one that is there is meant.
    if not has_magic(path) or os.path.isfile(folder / path):
        return [folder / path]
    try:
        return expand(folder, path)
    except StudyError as error:
        raise StudyError(f"paths: {error}") from error


def _names(paths: list[Path]) -> list[str]:
    """Stems; file names where stems collide, and whole paths where these collide with any other name."""
    stems = [mesh_stem(path) for path in paths]
    names = [stem if alone else path.name for stem, path, alone in zip(stems, paths, _alone(stems), strict=True)]
    names = [name if alone else path.as_posix() for name, path, alone in zip(names, paths, _alone(names), strict=True)]
    for path, name in zip(paths, names, strict=True):
        wrong = flaw(name, _LONGEST_NAME, "\\")
        if wrong is not None:
            raise StudyError(f"paths: the name of the file {shown(path.name)} is no label: {wrong}; rename the file")
    same = twins(names)
    if same:
        raise StudyError(
            f"paths: the files {' and '.join(map(shown, same[0][:3]))} have names that differ in nothing but case or "
            "the spelling of accents; rename one"
        )
    return names


def _alone(names: list[str]) -> list[bool]:
    """Which names cannot be taken for any other."""
    keys = list(map(folded, names))
    counts = Counter(keys)
    return [counts[key] == 1 for key in keys]
