"""Hausdorff and Chamfer distances of two meshes, for orientation beside Sobolev distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sobolev_batch.errors import InputError, from_extra
from sobolev_batch.parameters import check_seed, is_whole_number
from sobolev_batch.surfaces.formats.readers import MeshLike, as_mesh
from sobolev_batch.surfaces.shapes.mesh import Mesh

DEFAULT_POINTS = 10_000
MOST_POINTS = 10_000_000

# Measured memory of the libraries, for each triangle of either mesh and each point.
TRIANGLE_BYTES, POINT_BYTES = 350.0, 250.0


@dataclass(frozen=True)
class Proximity:
    """Hausdorff and Chamfer distances of two meshes, in their unit of length.

    Attributes:
        hausdorff: Largest distance found from a point of either mesh to the other. Random points and all
            vertices are looked at, so the true Hausdorff distance may be larger, but not smaller.
        chamfer: Mean distance, by area, from a point of the first mesh to the second, plus that from the
            second to the first.
        chamfer_error: Standard error of `chamfer`, since points are random.

    >>> import sobolev_batch as sb
    >>> sb.result_types.Proximity(hausdorff=0.25, chamfer=0.5, chamfer_error=0.01).chamfer
    0.5
    """

    hausdorff: float
    chamfer: float
    chamfer_error: float


def proximity(a: MeshLike, b: MeshLike, *, points: int = DEFAULT_POINTS, seed: int = 0) -> Proximity:
    """Measure Hausdorff and Chamfer distances with VTK, from points to the closest points of triangles.

    Args:
        a: First mesh, or what `as_mesh` makes one of.
        b: Second mesh, in the same unit of length, or what `as_mesh` makes one of.
        points: Number of random points on each mesh, spread evenly by area.
        seed: Seed of the random points; the same seed gives the same numbers.

    Raises:
        InputError: VTK is not installed (the extra ``vtk``); ``points`` or ``seed`` is out of range; or see `as_mesh`.

    Source: P. Cignoni, C. Rocchini, R. Scopigno, "Metro: measuring error on simplified surfaces" (1998),
    doi:10.1111/1467-8659.00236, for distances of random points; Chamfer distance as H. Barrow et al., "Parametric
    correspondence and chamfer matching" (1977), in both directions.

    >>> import sobolev_batch as sb
    >>> square = sb.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    >>> raised = sb.Mesh(square.vertices + [0, 0, 0.25], square.triangles)
    >>> distances = sb.proximity(square, raised, points=1000)
    >>> f"{distances.hausdorff:.6f} {distances.chamfer:.6f}"
    '0.250000 0.500000'
    """
    if not is_whole_number(points) or not 1 < points <= MOST_POINTS:
        raise InputError(f"points must be an integer from 2 to {MOST_POINTS}, found {points!r}")
    check_seed(seed)
    with from_extra("vtk", "Hausdorff and Chamfer distances need"):
        import pyvista
        from vtkmodules.vtkFiltersModeling import vtkHausdorffDistancePointSetFilter
    meshes = as_mesh(a), as_mesh(b)
    # Powers of two lose no digit, and keep squares of lengths within the range of doubles.
    scale = 2.0 ** np.frexp(max(float(np.abs(mesh.vertices).max()) for mesh in meshes))[1]
    seeds = np.random.SeedSequence(seed).spawn(2)
    search = vtkHausdorffDistancePointSetFilter()
    for port, (mesh, mesh_seed) in enumerate(zip(meshes, seeds, strict=True)):
        search.SetInputData(port, _with_points(pyvista, mesh, scale, points, np.random.default_rng(mesh_seed)))
    search.SetTargetDistanceMethodToPointToCell()
    search.Update()
    of_points, farthest = [], 0.0
    for port, mesh in enumerate(meshes):
        distances = scale * np.asarray(pyvista.wrap(search.GetOutput(port)).point_data["Distance"])
        of_points.append(distances[:points])
        # A vertex that no triangle uses is not on the surface.
        of_vertices = distances[points:][mesh.used_vertices]
        farthest = max(farthest, float(of_points[port].max()), float(of_vertices.max()))
    return Proximity(
        hausdorff=farthest,
        chamfer=sum(float(distances.mean()) for distances in of_points),
        chamfer_error=float(np.sqrt(sum(distances.var(ddof=1) for distances in of_points) / points)),
    )


def _with_points(pyvista: Any, mesh: Mesh, scale: float, points: int, rng: np.random.Generator) -> Any:
    """Return a mesh for VTK, in units of the scale, with random points on it before its vertices."""
    import trimesh

    vertices, triangles = np.asarray(mesh.vertices) / scale, np.asarray(mesh.triangles, dtype=np.int64)
    surface = trimesh.Trimesh(vertices, triangles, process=False)
    random_points, _ = trimesh.sample.sample_surface(surface, points, seed=rng)
    return pyvista.PolyData.from_regular_faces(np.vstack([random_points, vertices]), triangles + points)
