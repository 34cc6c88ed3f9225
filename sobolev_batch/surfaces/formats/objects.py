"""Meshes of other libraries, paths and pairs of arrays, wherever a mesh is expected; and meshes written to files.

Libraries are known by the names of their classes, and none is imported.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Protocol
from uuid import uuid4

import numpy as np
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, MeshError
from sobolev_batch.surfaces.formats.readers import WRITERS, read_mesh
from sobolev_batch.surfaces.shapes.closed_forms import Sphere
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.smooth import Smooth
from sobolev_batch.surfaces.shapes.surface import Surface


class WithVertices(Protocol):
    """A ``trimesh.Trimesh`` or an ``open3d.geometry.TriangleMesh``."""

    vertices: Any


class WithPoints(Protocol):
    """A ``pyvista.PolyData`` or a ``meshio.Mesh``."""

    points: Any


class WithParts(Protocol):
    """A ``trimesh.Scene``."""

    geometry: Any
    dump: Any


class WithTensors(Protocol):
    """An ``open3d.t.geometry.TriangleMesh``."""

    vertex: Any
    triangle: Any


# What `as_mesh` makes a mesh of.
MeshLike = (
    Mesh | str | os.PathLike[str] | tuple[ArrayLike, ArrayLike] | WithVertices | WithPoints | WithParts | WithTensors
)
SurfaceLike = Surface | MeshLike
# A further kind has a class in `spectral/quadrature/kinds` too.
SURFACE_KINDS = (Mesh, Sphere, Smooth)

_EXPECTED = (
    "a Mesh, the path of a mesh file, a pair (vertices, triangles) of arrays, or a mesh of trimesh, PyVista, meshio or "
    "Open3D"
)
_SURFACES = "a Sphere, a parametrised surface (Ellipsoid, Torus, ParametrisedSurface)"
# Cells of meshio without area.
_WITHOUT_AREA = ("vertex", "line", "line3")


def as_mesh(mesh: MeshLike) -> Mesh:
    """Return a mesh from whatever holds one.

    Every function that takes a mesh takes these too, and calls this function itself:

    - a `Mesh`, which is returned as it is;
    - the path of a mesh file, as text or `pathlib.Path`: see `read_mesh`;
    - a pair (vertices, triangles) of arrays, (n, 3) and (m, 3);
    - a ``trimesh.Trimesh``, or a ``trimesh.Scene`` of one mesh, which is placed as in the scene;
    - a ``pyvista.PolyData`` of triangles;
    - a ``meshio.Mesh`` with cells of the type "triangle"; its vertices and lines have no area and are left out;
    - an ``open3d.geometry.TriangleMesh`` or ``open3d.t.geometry.TriangleMesh``.

    Coordinates become float64, and are copied. Vertices stay as they are: none are merged, moved or left out. For the
    way back there are `Mesh.to_trimesh`, `Mesh.to_pyvista`, `Mesh.to_meshio` and `Mesh.to_open3d`.

    Args:
        mesh: Any of these.

    Raises:
        InputError: It is none of these, or not of triangles alone; the message gives the type that was found.
        MeshError: The file cannot be read, or the arrays make no mesh: see `Mesh`.

    >>> import sobolev_batch as sb
    >>> import trimesh
    >>> sb.as_mesh(trimesh.creation.box())
    Mesh(8 vertices, 12 triangles)
    >>> sb.as_mesh(([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])).area
    6.0
    """
    return _converted(mesh, _EXPECTED)


def as_surface(surface: SurfaceLike) -> Surface:
    """Return a surface in closed form as it is, and anything else as a mesh; see `as_mesh`.

    Raises:
        InputError: It is no surface of a known kind.
        MeshError: See `as_mesh`.
    """
    if isinstance(surface, SURFACE_KINDS):
        return surface
    return _converted(surface, f"{_EXPECTED}, {_SURFACES} or a Fourier field")


def write_mesh(mesh: MeshLike, path: str | Path) -> None:
    """Write a mesh to a file in the format of its suffix: .ply, .obj, .stl or .off.

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
    data = WRITERS[path.suffix.lower()](as_mesh(mesh))
    # The old file stays until the new one is whole: a disk may be full.
    with _new_file_beside(path) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        os.replace(file.name, os.path.realpath(path))


def require_writable(path: str | Path) -> Path:
    """Return a path whose suffix names a format that can be written, in a folder that files can be made in.

    Raises:
        InputError: It is none, or the path is no file.
        MeshError: No file can be made in its folder.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise InputError(f"{path}: meshes are written as {', '.join(WRITERS)}; found the suffix {path.suffix!r}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    with _new_file_beside(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: it exists already and is no file; name another file")
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


def _converted(found: Any, expected: str) -> Mesh:
    match found:
        case Mesh():
            return found
        case str() | os.PathLike():
            return read_mesh(Path(found))
        case (vertices, triangles):
            return Mesh(vertices, triangles)
    for kind in type(found).__mro__:
        library = kind.__module__.partition(".")[0]
        convert = _LIBRARIES.get((library, kind.__name__))
        if convert is not None:
            name = f"{library}.{kind.__name__}"
            try:
                return convert(found)
            except InputError as error:
                raise type(error)(f"the {name} is no mesh to compare: {error}") from error
    library, name = type(found).__module__.partition(".")[0], type(found).__name__
    known = library in ("builtins", "sobolev_batch")
    raise InputError(f"expected {expected}; found {name if known else f'{library}.{name}'}")


def _of_trimesh(found: Any) -> Mesh:
    return Mesh(np.array(found.vertices), np.array(found.faces))


def _of_scene(found: Any) -> Mesh:
    # Each part is placed as in the scene.
    parts = found.dump()
    if len(parts) != 1:
        raise InputError(f"it holds {len(parts)} parts, expected one mesh; pass one of them, or all as scene.to_mesh()")
    return as_mesh(parts[0])


def _of_pyvista(found: Any) -> Mesh:
    faces = np.asarray(found.faces)
    if found.n_strips or len(faces) % 4 or (faces[::4] != 3).any():
        raise InputError("it has polygons or strips; pass mesh.triangulate()")
    return Mesh(found.points, faces.reshape(-1, 4)[:, 1:])


def _of_meshio(found: Any) -> Mesh:
    others = {cells.type for cells in found.cells} - {"triangle", *_WITHOUT_AREA}
    if others:
        raise InputError(f"it has cells of the type {', '.join(sorted(others))}, expected triangles alone")
    triangles = [cells.data for cells in found.cells if cells.type == "triangle"]
    if not triangles:
        raise MeshError("the mesh has no triangles")
    return Mesh(found.points, np.concatenate(triangles))


def _of_open3d(found: Any) -> Mesh:
    if not hasattr(found, "vertex"):
        return Mesh(np.asarray(found.vertices), np.asarray(found.triangles))
    if "indices" not in found.triangle:
        raise MeshError("the mesh has no triangles")
    return Mesh(found.vertex["positions"].cpu().numpy(), found.triangle["indices"].cpu().numpy())


_LIBRARIES: dict[tuple[str, str], Callable[[Any], Mesh]] = {
    ("trimesh", "Trimesh"): _of_trimesh,
    ("trimesh", "Scene"): _of_scene,
    ("pyvista", "PolyData"): _of_pyvista,
    ("meshio", "Mesh"): _of_meshio,
    ("open3d", "TriangleMesh"): _of_open3d,
}
