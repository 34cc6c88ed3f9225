"""Writing mesh files."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import trimesh
from plyfile import PlyData, PlyElement

from sobolev_batch.errors import InputError, MeshError
from sobolev_batch.surfaces.shapes.mesh import Mesh

# Seventeen digits give every double back.
_DIGITS = "%.17g"


def write_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh to a file in the format of its suffix: .ply, .obj, .off or .stl.

    Coordinates keep all digits, except in STL, which has single precision and no shared vertices.

    Args:
        mesh: Mesh to write.
        path: File to write; it replaces one of the same name.

    Raises:
        InputError: The suffix is none of these.
        MeshError: The file cannot be written.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sb.write_mesh(sb.icosphere(1), Path(folder) / "ball.obj")
    ...     sb.read_mesh(Path(folder) / "ball.obj")
    Mesh(42 vertices, 80 triangles)
    """
    path = require_writable_format(path)
    data = _FORMATS[path.suffix.lower()](mesh)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise MeshError(f"{path}: the mesh cannot be written there: {error.strerror or error}") from error


def require_writable_format(path: str | Path) -> Path:
    """Return a path whose suffix names a format that can be written, in a folder that exists.

    Raises:
        InputError: It is none.
    """
    path = Path(path)
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: meshes are written as {', '.join(_FORMATS)}; found the suffix {path.suffix!r}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    return path


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
    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), process=False)
    return bytes(trimesh.exchange.stl.export_stl(surface))


_FORMATS: Mapping[str, Callable[[Mesh], bytes]] = {".ply": _ply, ".obj": _obj, ".off": _off, ".stl": _stl}
