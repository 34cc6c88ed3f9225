"""Writing mesh files."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from uuid import uuid4

import numpy as np
from plyfile import PlyData, PlyElement

from sobolev_batch.errors import InputError, MeshError
from sobolev_batch.surfaces.formats.objects import MeshLike, as_mesh
from sobolev_batch.surfaces.shapes.mesh import Mesh

# Seventeen digits give every double back.
_DIGITS = "%.17g"


def write_mesh(mesh: MeshLike, path: str | Path) -> None:
    """Write a mesh to a file in the format of its suffix: .ply, .obj, .off or .stl.

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
    ...     sb.write_mesh(sb.icosphere(1), Path(folder) / "ball.obj")
    ...     sb.read_mesh(Path(folder) / "ball.obj")
    Mesh(42 vertices, 80 triangles)
    """
    path = require_writable(path)
    data = _FORMATS[path.suffix.lower()](as_mesh(mesh))
    # The old file stays until the new one is whole: a disk may be full.
    with _new_file_beside(path) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        os.replace(file.name, os.path.realpath(path))


def require_writable(path: str | Path) -> Path:
    """Return a path whose suffix names a format that can be written, in a folder that files can be made in.

    Raises:
        InputError: It is none, or something else than a file is there.
        MeshError: No file can be made in its folder.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: meshes are written as {', '.join(_FORMATS)}; found the suffix {path.suffix!r}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    with _new_file_beside(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: something that is no file is there already; name another file")
    return path


@contextmanager
def _new_file_beside(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file that may take the place of another one; it is gone at the end unless it has.

    Raises:
        MeshError: It cannot be made or written.
    """
    place = path.parent / f".{uuid4().hex}{path.suffix}"
    try:
        with place.open("xb") as file:
            yield file
    except OSError as error:
        raise MeshError(f"{path}: the mesh cannot be written there: {error.strerror or error}") from error
    finally:
        place.unlink(missing_ok=True)


def _ply(mesh: Mesh) -> bytes:
    vertices = np.empty(len(mesh.vertices), dtype=[(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", mesh.vertices.T, strict=True):
        vertices[axis] = column
    faces = np.empty(len(mesh.triangles), dtype=[("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.triangles
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    file = io.BytesIO()
    PlyData(elements, text=False, byte_order="<").write(file)
    return file.getvalue()


def _obj(mesh: Mesh) -> bytes:
    file = io.BytesIO()
    np.savetxt(file, mesh.vertices, fmt=f"v {_DIGITS} {_DIGITS} {_DIGITS}")
    np.savetxt(file, mesh.triangles + 1, fmt="f %d %d %d")
    return file.getvalue()


def _off(mesh: Mesh) -> bytes:
    file = io.BytesIO()
    file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.triangles)} 0\n".encode())
    np.savetxt(file, mesh.vertices, fmt=_DIGITS)
    np.savetxt(file, mesh.triangles, fmt="3 %d %d %d")
    return file.getvalue()


def _stl(mesh: Mesh) -> bytes:
    import trimesh

    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), process=False)
    return bytes(trimesh.exchange.stl.export_stl(surface))


_FORMATS: Mapping[str, Callable[[Mesh], bytes]] = {".ply": _ply, ".obj": _obj, ".off": _off, ".stl": _stl}
