"""Meshes from files, arrays and objects of other libraries, and back into files.

Libraries are known by the names of their classes, and none is imported.
"""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import numpy as np
from numpy.typing import ArrayLike

from sobolev_batch.errors import InputError, MeshError, written
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.formats.by_name import BY_SUFFIX, WRITERS, mesh_format
from sobolev_batch.geometry.formats.parsing import (
    Read,
    checked_length,
    is_gzipped,
    open_regular,
    read_unpacked,
    require_memory_to_read,
    unpacked_limit,
)
from sobolev_batch.geometry.formats.ply import HEADER_BYTES
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.geometry.surface import Surface

# What `as_mesh` makes a mesh of: "Any" stands for the meshes of other libraries, whose types may not be installed.
MeshLike = Mesh | str | os.PathLike[str] | tuple[ArrayLike, ArrayLike] | Any
SurfaceLike = Surface | MeshLike
# A further kind has a class in `transform/kinds` too.
SURFACE_KINDS = (Mesh, Sphere, Smooth)

_EXPECTED = (
    "a Mesh, the path of a mesh file, a pair (vertices, triangles) of arrays, or a mesh of trimesh, PyVista, meshio or "
    "Open3D"
)
_SURFACES = "a Sphere, a parametrised surface (Ellipsoid, Torus, ParametrisedSurface)"
# Cells of meshio without area.
_WITHOUT_AREA = ("vertex", "line", "line3")


_LONGEST_REASON = 250
# Factor by which gzip usually shrinks mesh files.
_PACKING = 4


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh from a PLY, OBJ, STL, OFF, glTF, GLB, GIFTI, VTK or FreeSurfer file, gzipped or not.

    The format follows from the name: FreeSurfer's are such as lh.pial, VTK's end in .vtk, .vtp or .vtu. Coordinates
    keep the precision of the file. Polygons are cut into fans of triangles, which is exact for convex ones. STL and
    glTF repeat vertices, so those that coincide exactly are merged; vertices of other formats stay as they are.

    Args:
        path: Path of the file.

    Raises:
        MeshError: The file is missing, of no known format, damaged, or holds no valid mesh. The message
            starts with the path.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sobolev_batch as sb
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "triangle.off")
    ...     with path.open("w") as file:
    ...         print("OFF", "3 1 0", "0 0 0", "1 0 0", "0 1 0", "3 0 1 2", sep=chr(10), file=file)
    ...     sb.read_mesh(path)
    Mesh(3 vertices, 1 triangles)
    """
    return read_mesh_by(Path(path), BufferedReader.read)


def read_mesh_by(path: Path, read: Read) -> Mesh:
    """Read a mesh as `read_mesh` does, by a function that reads the bytes of its file."""
    suffix = mesh_format(path)
    if suffix not in BY_SUFFIX:
        known = ", ".join(name for name, form in BY_SUFFIX.items() if form.is_name is None)
        raise MeshError(
            f"{path}: no mesh format that is read has this name; known are {known} and FreeSurfer's names such as "
            "lh.pial, each also with .gz. docs/formats.md shows how to convert others"
        )
    form = BY_SUFFIX[suffix]
    try:
        # The header of a PLY file tells more than its length.
        require_memory_to_read(expected_size(path)[1])
        data = [read_unpacked(path, form.memory_bytes / form.file_bytes, read)]
        # Numbers that overflow become infinite, which the mesh refuses.
        with np.errstate(all="ignore"):
            # Only the parser holds the bytes, so that it can free them early.
            vertices, triangles = form.parse(data.pop())
            for array in (vertices, triangles):
                array.setflags(write=False)
            return Mesh(vertices, triangles)
    except MeshError as error:
        raise MeshError(f"{path}: {_shortened(error)}") from error
    except MemoryError as error:
        raise MeshError(f"{path}: reading it takes more memory than there is: {_shortened(error)}") from error
    except Exception as error:
        # On damaged input parsers raise anything from struct.error to RecursionError.
        raise MeshError(
            f"{path}: not a readable {suffix.removeprefix('.')} file: {type(error).__name__}: {_shortened(error)}"
        ) from error


def expected_size(path: Path) -> tuple[int, float]:
    """Estimate the number of triangles in a file, and the peak of the memory in bytes that reading it takes.

    The estimate rests on the header of a PLY file, and on the length of others. It never exceeds what a file
    of this length can hold. Both are zero where the file cannot be read.
    """
    form = BY_SUFFIX.get(mesh_format(path))
    if form is None:
        return 0, 0.0
    try:
        with open_regular(path) as file:
            length = checked_length(file)
            if is_gzipped(path):
                length = min(_PACKING * length, unpacked_limit(length))
            if form.announced_size is not None:
                unpacked = gzip.GzipFile(fileobj=file) if is_gzipped(path) else file
                return form.announced_size(unpacked.read(HEADER_BYTES), length)
    except (OSError, EOFError, ValueError, zlib.error, MeshError):
        return 0, 0.0
    triangles = int(length / form.file_bytes)
    return triangles, float(triangles * form.memory_bytes)


def _shortened(error: Exception) -> str:
    """Return the message of an error on one line; it may quote any length of a file."""
    reason = " ".join(str(error).split()) or "no details"
    return reason if len(reason) <= _LONGEST_REASON else reason[: _LONGEST_REASON - 3] + "..."


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
    way back there are `Mesh.to_trimesh` and `Mesh.to_pyvista`, and the arrays of the mesh.

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
    """Return a surface in closed form as it is, and anything else as a mesh, or InputError; see `as_mesh`."""
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
    ...     sb.write_mesh(sb.shapes.icosphere(1), Path(folder) / "ball.obj")
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
    """Return a path that a mesh can be written to; InputError where its suffix or folder does not permit that."""
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
    """Open a file that may replace another one, and is gone at the end unless it has; MeshError where that fails."""
    place = path.parent / f".{uuid4().hex}{path.suffix}"
    try:
        with written(path, "the mesh", MeshError), place.open("xb") as file:
            yield file
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
    ("trimesh", "Trimesh"): lambda found: Mesh(np.array(found.vertices), np.array(found.faces)),
    ("trimesh", "Scene"): _of_scene,
    ("pyvista", "PolyData"): _of_pyvista,
    ("meshio", "Mesh"): _of_meshio,
    ("open3d", "TriangleMesh"): _of_open3d,
}
