"""Meshes into files, each replaced only once the new one is whole."""

from __future__ import annotations

from pathlib import Path

from sobolev_batch.errors import InputError, MeshError, new_file_beside, write_file
from sobolev_batch.geometry.formats.by_name import WRITERS
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh
from sobolev_batch.parameters import path_of

_WHAT = "the mesh"


def write_mesh(mesh: MeshLike, path: str | Path) -> None:
    """Write a mesh to a file in the format of its suffix: .ply, .obj, .stl, .off or .mesh.

    Coordinates keep all digits, except in STL, which has single precision and no shared vertices.

    Args:
        mesh: Mesh to write, or what `as_mesh` makes one of.
        path: File to write; it replaces one of the same name once it is whole.

    Raises:
        InputError: The suffix is none of these, or the path is a folder or a device.
        MeshError: The file cannot be written; or see `as_mesh`.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sb.write_mesh(sb.shapes.icosphere(1), Path(folder) / "ball.obj")
    ...     sb.read_mesh(Path(folder) / "ball.obj")
    Mesh(42 vertices, 80 triangles)
    """
    path = require_writable(path)
    write_file(path, WRITERS[path.suffix.lower()](as_mesh(mesh)), _WHAT, MeshError)


def require_writable(path: str | Path) -> Path:
    """Return a path that a mesh can be written to; InputError where its suffix or folder does not permit that."""
    path = path_of(path)
    if path.suffix.lower() not in WRITERS:
        raise InputError(f"{path}: meshes are written as {', '.join(WRITERS)}; found the suffix {path.suffix!r}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    with new_file_beside(path, _WHAT, MeshError):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: it exists already and is no file; name another file")
    return path
