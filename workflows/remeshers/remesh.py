"""Bring a mesh to about a number of triangles: python remesh.py METHOD INPUT OUTPUT TRIANGLES.

Each method imports its own library. PyMeshLab and gmsh are under the GPL, and nothing else here uses them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

import sobolev_batch as sb

# Of ACVD: it moves vertices only within clusters of many.
_VERTICES_PER_CLUSTER = 20


def edge_length(mesh: sb.Mesh, triangles: int) -> float:
    """Return the edge of equilateral triangles that cover the area of a mesh."""
    return float(np.sqrt(4 / np.sqrt(3) * mesh.area / triangles))


def quadric(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Collapse edges by quadric errors, with fast-simplification."""
    import fast_simplification

    return sb.as_mesh(
        fast_simplification.simplify(
            np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32), target_count=triangles
        )
    )


def acvd(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Triangulate clusters of vertices, with pyacvd."""
    import pyacvd
    import pyvista

    # It still reads an attribute that pyvista has renamed.
    warnings.filterwarnings("ignore", message=".*_connectivity_array")
    clusters = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.triangles)))
    while len(clusters.mesh.points) < _VERTICES_PER_CLUSTER * triangles // 2:
        clusters.subdivide(2)
    clusters.cluster(triangles // 2 + 2)
    return sb.as_mesh(clusters.create_mesh())


def meshlab_quadric(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Collapse edges by quadric errors, with MeshLab."""
    return _by_meshlab(mesh, "meshing_decimation_quadric_edge_collapse", targetfacenum=triangles)


def meshlab_isotropic(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Split, collapse, flip and smooth towards even edges, with MeshLab."""
    import pymeshlab

    edge = pymeshlab.PureValue(edge_length(mesh, triangles))
    # Otherwise it keeps folds of more than 30 degrees as creases, and a cortex has thousands.
    return _by_meshlab(mesh, "meshing_isotropic_explicit_remeshing", targetlen=edge, iterations=10, featuredeg=180)


def _by_meshlab(mesh: sb.Mesh, name: str, **options: object) -> sb.Mesh:
    import pymeshlab

    filters = pymeshlab.MeshSet()
    filters.add_mesh(pymeshlab.Mesh(np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)))
    filters.apply_filter(name, **options)
    made = filters.current_mesh()
    return sb.Mesh(made.vertex_matrix(), made.face_matrix())


def mmg(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Adapt edges to one length and to the surface, with Mmg."""
    import meshio

    size = float(np.ptp(mesh.vertices, axis=0).max())
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder, "given.mesh"), Path(folder, "made.mesh")
        meshio.write(given, meshio.Mesh(np.array(mesh.vertices), [("triangle", np.array(mesh.triangles))]))
        # It tells folds from creases by their angle, as above.
        options = ["-hsiz", str(edge_length(mesh, triangles)), "-hausd", str(0.05 * size), "-nr", "-v", "0"]
        subprocess.run(["mmgs_O3", "-in", given, "-out", made, *options], check=True)
        return sb.as_mesh(meshio.read(made))


def gmsh_frontal(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Mesh a parametrisation of the surface by advancing fronts, with gmsh."""
    import gmsh

    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder, "given.stl"), Path(folder, "made.stl")
        sb.write_mesh(mesh, given)
        gmsh.initialize()
        gmsh.option.setNumber("General.Verbosity", 1)
        gmsh.merge(str(given))
        gmsh.model.mesh.classifySurfaces(np.pi, True, True, np.pi)
        gmsh.model.mesh.createGeometry()
        edge = edge_length(mesh, triangles)
        for option, value in (("MeshSizeMin", edge), ("MeshSizeMax", edge), ("Algorithm", 6)):
            gmsh.option.setNumber(f"Mesh.{option}", value)
        gmsh.model.mesh.generate(2)
        gmsh.write(str(made))
        gmsh.finalize()
        return sb.read_mesh(made)


def instant(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
    """Follow a field of directions, with Instant Meshes."""
    import pyinstantmeshes

    vertices, faces = pyinstantmeshes.remesh(
        np.array(mesh.vertices, dtype=np.float32),
        np.array(mesh.triangles, dtype=np.int32),
        target_face_count=triangles,
        rosy=6,
        posy=3,
        deterministic=True,
    )
    return sb.as_mesh((vertices, faces[:, :3]))


METHODS = {
    "quadric": quadric,
    "acvd": acvd,
    "meshlab-quadric": meshlab_quadric,
    "meshlab-isotropic": meshlab_isotropic,
    "mmg": mmg,
    "gmsh": gmsh_frontal,
    "instant": instant,
}

if __name__ == "__main__":
    method, source, output, count = sys.argv[1:]
    sb.write_mesh(METHODS[method](sb.read_mesh(source), int(count)), output)
