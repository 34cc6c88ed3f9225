"""Run four remeshers on eight objects at several sizes, and write the meshes with a list of them.

    python workflows/remeshers/make_meshes.py FOLDER

FOLDER then has the objects, what the remeshers made of them, and meshes.csv: object, method, path and method_seconds of
each mesh. It needs nilearn, pyacvd and pymeshlab; the last is under the GPL, and nothing else here uses it.
"""

from __future__ import annotations

import csv
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import fast_simplification
import numpy as np
import pyacvd
import pymeshlab
import pyvista
from nilearn.datasets import load_fsaverage

import sobolev_batch as sb

TRIANGLES = (500, 1000, 2000, 4000)
# Of ACVD: it moves vertices only within clusters of many.
_VERTICES_PER_CLUSTER = 20


def objects() -> Iterator[tuple[str, sb.Mesh]]:
    """Yield the objects: three surfaces of a brain, and five of formulas."""
    brain = load_fsaverage("fsaverage5")
    parts = {"pial": ("pial", "left"), "white": ("white_matter", "right"), "inflated": ("inflated", "left")}
    for name, (part, side) in parts.items():
        surface = brain[part].parts[side]
        yield name, sb.Mesh(surface.coordinates, surface.faces)
    yield "egg", sb.Ellipsoid((1.0, 0.7, 0.6)).mesh(5)
    yield "torus", sb.Torus().mesh(144, 72)
    yield "bumps", bumps(sb.icosphere(5))
    yield "cushion", cushion(sb.icosphere(5))
    yield "trefoil", tube_around_trefoil(400, 25)


def bumps(sphere: sb.Mesh) -> sb.Mesh:
    """Return a sphere whose radius goes up and down."""
    x, y, z = np.asarray(sphere.vertices).T
    radii = 1 + 0.15 * np.sin(5 * x) * np.sin(5 * y) + 0.1 * np.cos(7 * z)
    return sb.Mesh(radii[:, None] * np.asarray(sphere.vertices), sphere.triangles)


def cushion(sphere: sb.Mesh) -> sb.Mesh:
    """Return a cube with round edges and corners, the unit sphere of the 6-norm, pressed flat."""
    vertices = np.asarray(sphere.vertices)
    radii = np.linalg.norm(vertices, ord=6, axis=1, keepdims=True)
    return sb.Mesh(vertices / radii * [1.0, 0.7, 0.4], sphere.triangles)


def tube_around_trefoil(around: int, across: int) -> sb.Mesh:
    """Return a tube around a trefoil knot, of a grid with this many cells along it and across."""
    t = np.linspace(0, 2 * np.pi, around, endpoint=False)
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    tangents = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    # The knot never runs along z.
    sides = np.cross(tangents, [0.0, 0.0, 1.0])
    ups = np.cross(sides, tangents)
    sides, ups = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (sides, ups))
    u = np.linspace(0, 2 * np.pi, across, endpoint=False)[:, None]
    points = curve[:, None] + 0.45 * (np.cos(u) * sides[:, None] + np.sin(u) * ups[:, None])
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b = i * across + j, (i + 1) % around * across + j
    c, d = (i + 1) % around * across + (j + 1) % across, i * across + (j + 1) % across
    return sb.Mesh(points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


def quadric(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Collapse edges by quadric errors, with fast-simplification."""
    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32), target_count=triangles
    )
    return sb.Mesh(vertices, faces)


def clustering(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Triangulate clusters of vertices, with pyacvd."""
    clusters = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.triangles)))
    while len(clusters.mesh.points) < _VERTICES_PER_CLUSTER * triangles // 2:
        clusters.subdivide(2)
    clusters.cluster(triangles // 2 + 2)
    made = clusters.create_mesh()
    return sb.Mesh(np.asarray(made.points), np.asarray(made.regular_faces))


def meshlab_quadric(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Collapse edges by quadric errors, with MeshLab."""
    filters = meshlab(mesh)
    filters.meshing_decimation_quadric_edge_collapse(targetfacenum=triangles)
    return from_meshlab(filters)


def meshlab_isotropic(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Split, collapse, flip and smooth towards even edges, with MeshLab."""
    filters = meshlab(mesh)
    # The edge of equilateral triangles that cover the area.
    edge = np.sqrt(4 / np.sqrt(3) * mesh.area / triangles)
    # Otherwise it keeps folds of more than 30 degrees as creases, and a cortex has thousands.
    filters.meshing_isotropic_explicit_remeshing(targetlen=pymeshlab.PureValue(edge), iterations=10, featuredeg=180)
    return from_meshlab(filters)


def meshlab(mesh: sb.Mesh) -> pymeshlab.MeshSet:
    """Return a mesh as MeshLab takes it."""
    filters = pymeshlab.MeshSet()
    filters.add_mesh(pymeshlab.Mesh(np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)))
    return filters


def from_meshlab(filters: pymeshlab.MeshSet) -> sb.Mesh:
    """Return MeshLab's current mesh."""
    made = filters.current_mesh()
    return sb.Mesh(made.vertex_matrix(), made.face_matrix())


METHODS: dict[str, Callable[[sb.Mesh, int], sb.Mesh]] = {
    "fast-simplification": quadric,
    "pyacvd": clustering,
    "meshlab-quadric": meshlab_quadric,
    "meshlab-isotropic": meshlab_isotropic,
}


def main(folder: Path) -> None:
    """Write the objects, the meshes and their list."""
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for name, original in objects():
        sb.write_mesh(original, folder / f"{name}.ply")
        rows.append({"object": name, "method": "reference", "path": f"{name}.ply"})
        for method, make in METHODS.items():
            for triangles in TRIANGLES:
                start = time.perf_counter()
                made = make(original, triangles)
                seconds = time.perf_counter() - start
                path = Path(method) / f"{name}-{triangles}.ply"
                (folder / method).mkdir(exist_ok=True)
                sb.write_mesh(made, folder / path)
                about = {"object": name, "method": method, "path": path.as_posix(), "name": triangles}
                rows.append({**about, "method_seconds": f"{seconds:.4f}"})
                print(f"{path}: {len(made.triangles)} triangles in {seconds:.2f} s")
    with (folder / "meshes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["object", "method", "path", "name", "method_seconds"])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    with warnings.catch_warnings():
        # pyacvd still reads an attribute that pyvista has renamed.
        warnings.filterwarnings("ignore", message=".*_connectivity_array")
        main(Path(sys.argv[1]))
