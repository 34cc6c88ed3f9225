"""Meshes of other libraries, paths and pairs of arrays are meshes to every function, and meshes become theirs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
import xarray as xr
from numpy.typing import NDArray

import sobolev_batch as sb
from tests.support.shapes import AWKWARD_VERTICES, BOX_QUADS, BOX_TRIANGLES, BOX_VERTICES, box

try:
    import open3d
except ImportError:
    open3d = None  # not for every version of Python
with_open3d = pytest.mark.skipif(open3d is None, reason="Open3D is not installed")

# Vertices in an order of their own, two of them in one place, and one that no triangle uses.
VERTICES: NDArray[np.float64] = np.vstack([AWKWARD_VERTICES[::-1], AWKWARD_VERTICES[:1], [(9, 9, 9)]])
TRIANGLES = np.array([*BOX_TRIANGLES, BOX_TRIANGLES[0], [7, 8, 1]])


def original() -> sb.Mesh:
    return sb.Mesh(VERTICES, TRIANGLES)


def scene() -> Any:
    """The mesh in a scene that moves it by a power of two, which loses no digit."""
    made = trimesh.Scene()
    moved = trimesh.transformations.scale_matrix(0.5)
    made.add_geometry(trimesh.Trimesh(2 * VERTICES, TRIANGLES, process=False), transform=moved)
    return made


MAKERS: dict[str, Callable[[], Any]] = {
    "mesh": original,
    "pair": lambda: (VERTICES, TRIANGLES),
    "trimesh scene": scene,
    # A class of somebody's own.
    "sub class": lambda: type("Sub", (trimesh.Trimesh,), {})(VERTICES, TRIANGLES, process=False),
    "meshio": lambda: meshio.Mesh(
        VERTICES, [("line", [[0, 1]]), ("triangle", TRIANGLES[:5]), ("triangle", TRIANGLES[5:])]
    ),
    "to_trimesh": lambda: original().to_trimesh(),
    "to_pyvista": lambda: original().to_pyvista(),
    "open3d": lambda: open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(VERTICES), open3d.utility.Vector3iVector(TRIANGLES.astype(np.int32))
    ),
    "open3d tensors": lambda: open3d.t.geometry.TriangleMesh(
        open3d.core.Tensor(VERTICES), open3d.core.Tensor(TRIANGLES)
    ),
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=with_open3d if "open3d" in name else ()) for name in MAKERS])
def test_meshes_of_other_libraries_stay_as_they_are(name: str) -> None:
    assert sb.as_mesh(MAKERS[name]()).digest == original().digest


# A square, a triangle, an arrow and an L with their areas; a cut from the first corner would make the last two larger.
CORNERS = np.array([(0, 0, 0), (0, 2, 0), (2, 2, 0), (2, 0, 0), (0.5, 1.5, 0), (2, 1, 0), (1, 1, 0), (1, 0, 0)])
FACES = {(0, 1, 2, 3): 4.0, (0, 1, 3): 2.0, (0, 1, 2, 4): 1.0, (2, 5, 6, 7, 0, 1): 3.0}
POLYGONS: dict[str, Callable[[], Any]] = {
    "pyvista": lambda: pyvista.PolyData(CORNERS, np.concatenate([[len(face), *face] for face in FACES])),
    "meshio": lambda: meshio.Mesh(
        CORNERS,
        [({3: "triangle", 4: "quad"}.get(len(face), "polygon"), [face]) for face in FACES] + [("quad", [])],
    ),
}


@pytest.mark.parametrize("library", POLYGONS)
def test_polygons_of_other_libraries_are_cut_as_in_files(library: str) -> None:
    mesh = sb.as_mesh(POLYGONS[library]())
    assert mesh.areas.sum() == pytest.approx(sum(FACES.values()))
    assert mesh.notes == ()
    assert sb.as_mesh(pyvista.Box(quads=True)).area == pytest.approx(24.0)


@pytest.mark.parametrize("name", ["trimesh", "pyvista"])
def test_nothing_is_shared_with_other_libraries(name: str) -> None:
    mesh = original()
    made = getattr(mesh, f"to_{name}")()
    array = made.vertices if name == "trimesh" else made.points
    again = sb.as_mesh(made)
    array[0] = 0.0
    assert mesh.digest == again.digest == original().digest
    assert sb.as_mesh(mesh) is mesh
    assert type(made).__module__.startswith(name)


def two_parts() -> Any:
    made = scene()
    made.add_geometry(trimesh.creation.box())
    return made


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "number": (lambda: 7, "expected a Mesh, the path of a mesh file, a pair .* or Open3D; found int"),
    "three": (lambda: (1, 2, 3), "found tuple"),
    "strips": (lambda: pyvista.Sphere().strip(), r"PolyData is no mesh .* strips of triangles; .*mesh\.triangulate"),
    "no faces": (lambda: pyvista.PolyData(BOX_VERTICES), r"the pyvista\.PolyData is no mesh .*no triangles"),
    "grid": (lambda: box().to_pyvista().cast_to_unstructured_grid(), "found pyvista.UnstructuredGrid"),
    "tetrahedra": (lambda: meshio.Mesh(BOX_VERTICES, [("tetra", [[0, 1, 2, 4]])]), "cells of the type tetra"),
    "flat": (lambda: meshio.Mesh(BOX_VERTICES[:, :2], [("quad", BOX_QUADS)]), r"shape \(8, 2\), expected \(n, 3\)"),
    "outside": (lambda: meshio.Mesh(BOX_VERTICES, [("quad", [[0, 1, 2, 8]])]), r"face 1 has an index outside 0\.\.7"),
    "infinite": (lambda: meshio.Mesh(BOX_VERTICES + np.inf, [("quad", BOX_QUADS)]), "NaN or infinite coordinates"),
    "no cells": (lambda: meshio.Mesh(BOX_VERTICES, [("line", [[0, 1]])]), "the mesh has no triangles"),
    "two parts": (two_parts, r"it holds 2 parts, .* as scene\.to_mesh\(\)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_mesh_is_refused_by_its_type(name: str) -> None:
    make, reason = WRONG[name]
    with pytest.raises(sb.errors.InputError, match=reason):
        sb.as_mesh(make())


LATTICE = sb.Lattice(2.0, 12)
BALL = sb.shapes.icosphere(0)
# Every function that takes a mesh; the target is a field, since closeness to a surface takes longer.
USES: dict[str, Callable[[Any, xr.DataArray], Any]] = {
    "distance": lambda mesh, target: sb.distance(mesh, target, -2.0)["distance"].item(),
    "norm": lambda mesh, _: sb.norm(mesh, -4.0, rtol=0.5)["norm"].item(),
    "spectrum": lambda mesh, _: sb.spectrum(mesh, None, -2.0, lattice=LATTICE)["total"].item(),
    "witness": lambda mesh, target: sb.witness(mesh, target, -2.0, [[0, 0, 0]]).item(),
    "fourier_transform": lambda mesh, _: abs(sb.fourier_transform(mesh, LATTICE)).sum().item(),
    "proximity": lambda mesh, _: sb.proximity(mesh, BALL, points=10)["hausdorff"],
    "gradient": lambda mesh, target: sb.fitting.gradient(mesh, target, -2.0, threads=1)["squared_distance"].item(),
    "target": lambda mesh, _: sb.fitting.SquaredDistance.for_mesh(BALL, mesh, -2.0, lattice=LATTICE).value(
        BALL.vertices
    ),
    "fit": lambda mesh, target: sb.fit(mesh, target, -4.0, steps=1, threads=1).mesh.area,
    "refine": lambda mesh, target: sb.fitting.refine(mesh, target, -4.0, triangles=21, steps=1, threads=1).mesh.area,
}


@pytest.fixture(scope="module")
def target() -> xr.DataArray:
    return sb.fourier_transform(sb.shapes.Sphere(1.2), LATTICE)


@pytest.mark.slow
@pytest.mark.parametrize("name", USES)
def test_every_function_takes_paths_and_meshes_of_other_libraries(
    tmp_path: Path, name: str, target: xr.DataArray
) -> None:
    larger = BALL.moved(1.25, (0.0, 0.0, 0.0))
    path = tmp_path / "ball.off"
    sb.write_mesh(larger.to_trimesh(), path)
    expected = USES[name](larger, target)
    for given in (path, meshio.Mesh(larger.vertices, [("triangle", larger.triangles)])):
        assert USES[name](given, target) == pytest.approx(expected, rel=1e-9)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    # Python's own way to say that a module cannot be imported.
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(sb.errors.InputError, match=r"PyVista .* pip install 'sobolev-batch\[vtk\]'"):
        box().to_pyvista()
