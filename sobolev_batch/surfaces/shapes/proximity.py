"""Hausdorff and Chamfer distances of two meshes, for orientation beside Sobolev distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.mesh import Mesh

DEFAULT_POINTS = 10_000
MOST_POINTS = 10_000_000

# What its libraries need is measured: for each triangle of either mesh, and each point.
TRIANGLE_BYTES, POINT_BYTES = 350.0, 250.0


@dataclass(frozen=True)
class Proximity:
    """How near two meshes are to each other, point by point, in their unit of length.

    Attributes:
        hausdorff: the largest distance found from a point of either mesh to the other. Points are drawn and
            all vertices are looked at, so the true Hausdorff distance may be larger, and not smaller.
        chamfer: the mean distance from a point of the first mesh to the second, by area, plus that from the
            second to the first.
        chamfer_error: standard error of `chamfer`, from the points being drawn.
    """

    hausdorff: float
    chamfer: float
    chamfer_error: float


def proximity(a: Mesh, b: Mesh, *, points: int = DEFAULT_POINTS, seed: int = 0) -> Proximity:
    """Measure Hausdorff and Chamfer distances with VTK, from points to the closest points of triangles.

    Args:
        a: one mesh.
        b: the other one.
        points: how many are drawn on each mesh, evenly by area.
        seed: of the drawing; the same seed gives the same numbers.

    Raises:
        InputError: VTK is not installed (the extra ``vtk``); points out of range.

    Source: P. Cignoni, C. Rocchini, R. Scopigno, "Metro: measuring error on simplified surfaces" (1998),
    doi:10.1111/1467-8659.00236, for distances of drawn points; Chamfer distance as H. Barrow et al., "Parametric
    correspondence and chamfer matching" (1977), in both directions.
    """
    if isinstance(points, bool) or not isinstance(points, int) or not 1 < points <= MOST_POINTS:
        raise InputError(f"points must be an integer from 2 to {MOST_POINTS}, found {points!r}")
    try:
        import pyvista
        from vtkmodules.vtkFiltersModeling import vtkHausdorffDistancePointSetFilter
    except ImportError as error:
        raise InputError(
            f"Hausdorff and Chamfer distances need a library that is missing ({error}); install the extra: "
            "pip install 'sobolev-batch[vtk]'"
        ) from error
    # Powers of two lose no digit, and keep squares of lengths within what doubles hold.
    scale = 2.0 ** np.frexp(max(float(np.abs(mesh.vertices).max()) for mesh in (a, b)))[1]
    generators = np.random.SeedSequence(seed).spawn(2)
    search = vtkHausdorffDistancePointSetFilter()
    for port, (mesh, generator) in enumerate(zip((a, b), generators, strict=True)):
        search.SetInputData(port, _with_points(pyvista, mesh, scale, points, np.random.default_rng(generator)))
    search.SetTargetDistanceMethodToPointToCell()
    search.Update()
    drawn, farthest = [], 0.0
    for port, mesh in enumerate((a, b)):
        distances = scale * np.asarray(pyvista.wrap(search.GetOutput(port)).point_data["Distance"])
        drawn.append(distances[:points])
        # A vertex that no triangle has is not on the surface.
        on_surface = distances[points:][mesh.used_vertices]
        farthest = max(farthest, float(drawn[port].max()), float(on_surface.max()))
    return Proximity(
        hausdorff=farthest,
        chamfer=sum(float(distances.mean()) for distances in drawn),
        chamfer_error=float(np.sqrt(sum(distances.var(ddof=1) for distances in drawn) / points)),
    )


def _with_points(pyvista: Any, mesh: Mesh, scale: float, points: int, rng: np.random.Generator) -> Any:
    """A mesh as VTK takes it, with points drawn on it before its vertices, in units of the scale."""
    vertices, triangles = np.asarray(mesh.vertices) / scale, np.asarray(mesh.triangles, dtype=np.int64)
    surface = trimesh.Trimesh(vertices, triangles, process=False)
    drawn, _ = trimesh.sample.sample_surface(surface, points, seed=rng)
    return pyvista.PolyData.from_regular_faces(np.vstack([drawn, vertices]), triangles + points)
