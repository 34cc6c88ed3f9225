"""The mesh files in a folder, looked at cheaply."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Self

from sobolev_batch.batch.study.templates import METHOD, OBJECT
from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.formats.readers import expected_size, is_mesh_name, mesh_stem, read_mesh
from sobolev_batch.surfaces.sources.mesh_lists import MOST_MESHES
from sobolev_batch.surfaces.sources.names import caseless_key, label_problem, natural_key, quoted

# Bytes of files that are read as a whole; of others the header tells the size, or the length.
_MOST_BYTES = 32 << 20


@dataclass(frozen=True)
class MeshFile:
    """A mesh file.

    Attributes:
        path: Path below the folder, with slashes.
        triangles: Number of triangles, as far as a look at the file tells.
    """

    path: str
    triangles: int

    @property
    def stem(self) -> str:
        """Name without folder, format and compression."""
        return mesh_stem(Path(self.path))

    @property
    def ending(self) -> str:
        """Suffixes of format and compression, behind the stem."""
        return PurePosixPath(self.path).name.removeprefix(self.stem)

    @property
    def folders(self) -> tuple[str, ...]:
        """Names of the folders that lead to the file."""
        return PurePosixPath(self.path).parent.parts


@dataclass(frozen=True)
class MeshFolder:
    """A folder with mesh files.

    Attributes:
        path: Path of the folder.
        files: Files that a study can name, in the natural order of their paths.
        left_out: Reason for each mesh file that it cannot, by path.
    """

    path: Path
    files: tuple[MeshFile, ...]
    left_out: Mapping[str, str]

    @classmethod
    def of(cls, path: Path) -> Self:
        """Look at a folder and those in it, except hidden ones, stores, and links to folders, as globs do.

        Links to files are looked at like files. Small files are read as a whole, up to some bytes together.

        Raises:
            StudyError: There is no such folder, or it has more mesh files than a family takes.
        """
        if not path.is_dir():
            raise StudyError(f"{path}: there is no such folder; name one with mesh files")
        files: list[MeshFile] = []
        left_out: dict[str, str] = {}
        left = _MOST_BYTES
        names: dict[str, str] = {}
        for below in sorted(_mesh_names(path), key=natural_key):
            other = names.setdefault(caseless_key(below), below)
            if other != below:
                left_out[below] = f"its name differs from that of {quoted(other)} only in case or accents; rename one"
                continue
            try:
                triangles, size = _expected_triangles(path, below), os.stat(path / below).st_size
                # A file of which nothing can be expected is of another format, damaged or empty.
                if size <= left or not triangles:
                    left -= size
                    triangles = len(read_mesh(path / below).triangles)
                files.append(MeshFile(below, triangles))
            except (MeshError, OSError) as error:
                left_out[below] = str(error).removeprefix(f"{path / below}: ")
        return cls(path, tuple(files), left_out)

    def is_readable(self, file: MeshFile) -> bool:
        """Return whether a file can be read as a whole."""
        try:
            read_mesh(self.path / file.path)
        except MeshError:
            return False
        return True


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


def _expected_triangles(folder: Path, below: str) -> int:
    """Return how many triangles a file has, as far as a look at it tells; refuse names that no study can have."""
    problem = label_problem(below)
    if problem is not None:
        raise MeshError(f"its name cannot be a label: {problem}; rename it")
    if OBJECT in below or METHOD in below:
        raise MeshError(f"its name holds {OBJECT} or {METHOD}, which study files replace; rename it")
    triangles, _ = expected_size(folder / below)
    return triangles
