"""Meshes from whatever holds one: paths, arrays and objects of other libraries.

Libraries are known by the names of their classes, and none is imported.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sobolev_batch.errors import InputError, MeshError, naming
from sobolev_batch.geometry.closed_forms import Sphere
from sobolev_batch.geometry.formats.polygons import cut_polygons
from sobolev_batch.geometry.formats.readers import read_mesh
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.geometry.surface import Surface

# What `as_mesh` makes a mesh of: "Any" stands for the meshes of other libraries, whose types may not be installed.
MeshLike = Mesh | str | os.PathLike[str] | tuple[ArrayLike, ArrayLike] | Any
SurfaceLike = Surface | MeshLike
T = TypeVar("T")
# A further kind has a class in `transform/kinds` too.
SURFACE_KINDS = (Mesh, Sphere, Smooth)

_EXPECTED = "a Mesh, the path of a mesh file, a pair (vertices, triangles), one of trimesh, PyVista, meshio or Open3D"
_SMOOTH = "a parametrised surface (Ellipsoid, Torus, ParametrisedSurface)"
# Cells of meshio with flat faces, and those without area.
_FACES, _WITHOUT_AREA = ("triangle", "quad", "polygon"), ("vertex", "line", "line3")


def as_mesh(mesh: MeshLike) -> Mesh:
    """Return a mesh from whatever holds one.

    Every function that takes a mesh takes these too, and calls this function itself:

    - a `Mesh`, which is returned as it is;
    - the path of a mesh file, as text or `pathlib.Path`: see `read_mesh`;
    - a pair (vertices, triangles) of arrays, (n, 3) and (m, 3);
    - a ``trimesh.Trimesh``, or a ``trimesh.Scene`` of one mesh, which is placed as in the scene;
    - a ``pyvista.PolyData`` without strips;
    - a ``meshio.Mesh`` with cells of the types "triangle", "quad" and "polygon"; its vertices and lines have no area
      and are left out;
    - an ``open3d.geometry.TriangleMesh`` or ``open3d.t.geometry.TriangleMesh``.

    Coordinates become float64, and are copied. Polygons are cut into triangles as in files: see `read_mesh`. Vertices
    stay as they are: none are merged, moved or left out. For the way back there are `Mesh.to_trimesh` and
    `Mesh.to_pyvista`, and the arrays of the mesh.

    Args:
        mesh: Any of these.

    Raises:
        InputError: It is none of these, or has other faces than polygons; the message gives the type that was found.
        MeshError: The file cannot be read, or the arrays make no mesh: see `Mesh`.

    >>> import sobolev_batch as sb
    >>> import trimesh
    >>> sb.as_mesh(trimesh.creation.box())
    Mesh(8 vertices, 12 triangles)
    >>> sb.as_mesh(([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])).area
    6.0
    """
    return _converted(mesh, _EXPECTED)


def as_surface(surface: SurfaceLike, *, or_field: bool = False) -> Surface:
    """Return a surface in closed form as it is, and anything else as a mesh, or InputError; see `as_mesh`."""
    if isinstance(surface, SURFACE_KINDS):
        return surface
    others = f"a Sphere, {_SMOOTH} or a Fourier field" if or_field else f"a Sphere or {_SMOOTH}"
    return _converted(surface, f"{_EXPECTED}, {others}")


def each(convert: Callable[[Any], T], given: Mapping[str, Any]) -> list[T]:
    """Return what `as_mesh` or its like makes of parameters or meshes, whose names begin its errors."""
    found = []
    for name, one in given.items():
        with naming(name, InputError):
            found.append(convert(one))
    return found


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
    if found.n_strips:
        raise InputError("it has strips of triangles; pass mesh.triangulate()")
    return _of_faces(found.points, [found.regular_faces] if found.is_all_triangles else found.irregular_faces)


def _of_meshio(found: Any) -> Mesh:
    others = {cells.type for cells in found.cells} - {*_FACES, *_WITHOUT_AREA}
    if others:
        raise InputError(f"it has cells of the type {', '.join(sorted(others))}, expected triangles and polygons alone")
    return _of_faces(found.points, [cells.data for cells in found.cells if cells.type in _FACES and len(cells.data)])


def _of_faces(vertices: NDArray[Any], faces: Sequence[NDArray[Any]]) -> Mesh:
    """Return the mesh of polygons, each array of which has one (k,) or several of as many corners (n, k)."""
    if not faces:
        raise MeshError("the mesh has no triangles")
    if vertices.shape[1:] != (3,):
        raise MeshError(f"the vertices have the shape {vertices.shape}, expected (n, 3)")
    sizes = np.concatenate([np.full(one.size // one.shape[-1], one.shape[-1]) for one in faces])
    # Numbers that overflow become infinite, which the mesh refuses.
    with np.errstate(all="ignore"):
        return Mesh(*cut_polygons(vertices, np.concatenate([one.ravel() for one in faces]), sizes))


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
