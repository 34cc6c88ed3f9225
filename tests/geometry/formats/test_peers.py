"""Readers beside those of other programs: the same area, or a reason why the other one differs."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import meshio
import nibabel
import numpy as np
import pytest
import pyvista
import trimesh

from sobolev_batch import read_mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.errors import MeshError
from tests.support.mesh_files import BIG, LITTLE, obj, off, ply, vtk_legacy
from tests.support.shapes import BOX_AREA, BOX_TRIANGLES, BOX_VERTICES

pytestmark = pytest.mark.all
Faces = list[list[int]]
# Vertices and faces as another program reads them.
Read = Callable[[Path], tuple[Any, Sequence[Any]]]


def newell(vertices: Any, faces: Any) -> float:
    """Return the area of faces, each of which is flat: half the length of the sum of what its sides span."""
    total = 0.0
    for face in faces:
        corners = np.asarray(vertices, np.float64)[np.asarray(face)]
        corners = corners - corners[0]
        total += float(np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0))) / 2
    return total


def fans(faces: Sequence[Any]) -> Faces:
    """Return the triangles of faces that are cut from their first corner, as of convex ones."""
    return [[face[0], *pair] for face in faces for pair in pairwise(face[1:])]


def by_vtk(path: Path) -> tuple[Any, Sequence[Any]]:
    found: Any = pyvista.read(path)
    found = found if isinstance(found, pyvista.PolyData) else found.extract_surface(algorithm="dataset_surface")
    return found.points, found.irregular_faces


def by_trimesh(path: Path) -> tuple[Any, Sequence[Any]]:
    found: Any = trimesh.load(path, process=False, force="mesh")
    return found.vertices, found.faces


def by_meshlab(path: Path) -> tuple[Any, Sequence[Any]]:
    import pymeshlab

    found = pymeshlab.MeshSet(verbose=False)
    found.load_new_mesh(str(path))
    found.generate_by_merging_visible_meshes()
    return found.current_mesh().vertex_matrix(), found.current_mesh().face_matrix()


def by_nibabel(path: Path) -> tuple[Any, Sequence[Any]]:
    vertices, faces = nibabel.load(path).agg_data(("pointset", "triangle"))
    return vertices, faces


PEERS: dict[str, Read] = {"VTK": by_vtk, "trimesh": by_trimesh, "MeshLab": by_meshlab, "nibabel": by_nibabel}
# Which of them read files of which formats.
READ_BY = {
    ".gz": ["nibabel"],
    ".vtk": ["VTK"],
    ".vtp": ["VTK"],
    ".vtu": ["VTK"],
    **{suffix: ["VTK", "trimesh", "MeshLab"] for suffix in (".ply", ".obj", ".stl")},
    ".off": ["trimesh", "MeshLab"],
}


MISSING = {name for name, package in (("MeshLab", "pymeshlab"),) if importlib.util.find_spec(package) is None}


def shipped() -> list[Path]:
    """Return the mesh files that installed packages have among their examples."""
    found: list[Path] = []
    for package, folder, pattern in (
        ("nilearn", "datasets/data", "**/*.gii.gz"),
        ("pyvista", "examples", "*.*"),
        ("pymeshlab", "tests/sample_meshes", "**/*.*"),
        ("trimesh", "", "**/*.*"),
    ):
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            found += [path for path in Path(root, folder).glob(pattern) if path.suffix in READ_BY]
    return sorted(found)


# Files of these names hold values at vertices, or other data sets than surfaces.
WITHOUT_SURFACE = ("sulc", "thick", "curv", "area", "uniform", "rectilinear", "hexbeam")


@pytest.mark.parametrize("path", shipped(), ids=lambda path: "/".join(path.parts[-3:]))
def test_files_that_packages_ship_have_the_area_that_others_find(path: Path) -> None:
    if any(name in path.name for name in WITHOUT_SURFACE):
        with pytest.raises(MeshError):
            read_mesh(path)
        return
    mesh = read_mesh(path)
    # VTK keeps the coordinates of PLY and OBJ files in single precision.
    same = mesh.area, newell(mesh.vertices.astype(np.float32), mesh.triangles)
    for name in READ_BY[path.suffix]:
        # VTK ends the process on strips in PLY files.
        if name not in MISSING and (name, path.parent.name) != ("VTK", "rangemaps"):
            found = newell(*PEERS[name](path))
            assert any(math.isclose(found, area, rel_tol=1e-9) for area in same), (name, found, same)


# Trimesh fails on OFF files with faces of more than four corners, and on binary PLY files of faces of several sizes.
# MeshLab takes big-endian doubles for others.
FAILING = [("trimesh", "OFF"), *((peer, "PLY of the other order") for peer in ("trimesh", "MeshLab"))]
FAILING += [("trimesh", "PLY in binary")]


def outline(random: np.random.Generator, is_concave: bool) -> Reals:
    """Return the corners (n, 2) of an outline around the origin, between radii of one and two, or on a circle."""
    count = int(random.integers(5, 12))
    angles = 2 * np.pi * (np.arange(count) + random.uniform(-0.3, 0.3, count)) / count
    radii = random.uniform(1, 2, count) if is_concave else np.full(count, 1.5)
    return np.asarray(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1))


def polyhedron(seed: int) -> tuple[Reals, Faces, bool, bool]:
    """Return a prism at a random place, and whether it has faces that are not convex, and that are bent.

    It may have a hole all through it, which bridges join to the outlines of both ends.
    """
    random = np.random.default_rng(seed)
    is_concave, has_hole, is_bent = random.random(3) < [0.6, 0.5, 0.3]
    outer = outline(random, is_concave)
    rings = [outer]
    if has_hole:
        hole = 0.2 * outline(random, is_concave=True)[::-1]
        # The bridge joins the corners that are next to each other.
        lengths = np.linalg.norm(outer[:, None] - hole, axis=2)
        near, first_of_hole = np.unravel_index(lengths.argmin(), lengths.shape)
        rings.append(np.roll(hole, -first_of_hole, axis=0))
    flat = np.concatenate(rings)
    count = len(flat)
    vertices = np.concatenate([np.column_stack([flat, np.full(count, height)]) for height in (0.0, 1.5)])
    if is_bent:
        vertices[:, 2] += random.uniform(-1e-3, 1e-3, 2 * count)
    faces, cap, first = [], list[int](), 0
    for ring in rings:
        around = [first + i for i in range(len(ring))]
        faces += [[a, b, b + count, a + count] for a, b in zip(around, np.roll(around, -1).tolist(), strict=True)]
        # To the hole and back.
        cap = [*cap[near:], *cap[: near + 1], *around, around[0]] if cap else around
        first += len(ring)
    faces += [cap[::-1], [corner + count for corner in cap]]
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    vertices = np.asarray(vertices @ turn * 10 ** random.uniform(-2, 2) + random.normal(size=3))
    faces = [np.roll(face, random.integers(len(face))).tolist() for face in faces]
    return vertices, faces, bool(is_concave or has_hole), bool(is_bent)


WRITERS: dict[str, tuple[str, Callable[..., bytes]]] = {
    "OBJ": (".obj", obj),
    "OFF": (".off", off),
    "PLY": (".ply", partial(ply, real="double")),
    "PLY in binary": (".ply", partial(ply, encoding=LITTLE, real="double")),
    "PLY of the other order": (".ply", partial(ply, encoding=BIG, real="double")),
    "VTK": (".vtk", vtk_legacy),
}


@pytest.mark.parametrize("seed", range(200))
def test_random_polyhedra_have_the_right_area_and_peers_the_same_or_that_of_fans(tmp_path: Path, seed: int) -> None:
    vertices, faces, is_concave, is_bent = polyhedron(seed)
    right, of_fans = newell(vertices, faces), newell(vertices, fans(faces))
    for name, (suffix, write) in WRITERS.items():
        path = tmp_path / f"scan{suffix}"
        path.write_bytes(write(vertices, faces))
        mesh = read_mesh(path)
        # Faces that are bent by a thousandth have larger areas than their outlines enclose; a note tells by how much.
        assert right * (1 - 1e-9) <= mesh.area <= right * (1 + (1e-3 if is_bent else 1e-9)), name
        assert [("are not flat" in note) for note in mesh.notes] == [True] * is_bent, (name, mesh.notes)
        for peer in READ_BY[suffix]:
            if peer in MISSING or (peer, name) in FAILING:
                continue
            found = newell(*PEERS[peer](path))
            if (peer, suffix, is_concave) == ("MeshLab", ".off", True):
                # It cuts faces of OFF files that are not convex into triangles which overlap.
                assert found > right * (1 - 1e-9)
                continue
            single = vertices.astype(np.float32)
            same = [mesh.area, right, newell(single, faces)]
            same += [of_fans, newell(single, fans(faces))] if is_concave else []
            tolerance = 1e-3 if is_bent else 1e-9
            assert any(math.isclose(found, area, rel_tol=tolerance) for area in same), (name, peer, found, same)


def by_meshio(path: Path) -> None:
    meshio.Mesh(BOX_VERTICES, [("triangle", np.array(BOX_TRIANGLES))]).write(path)


# What writes a file of a format that is not read, where its library is installed.
OTHERS: dict[str, Callable[[Path], object]] = {
    ".inp": by_meshio,
    ".bdf": by_meshio,
    ".vtm": lambda path: pyvista.MultiBlock([pyvista.wrap(trimesh.Trimesh(BOX_VERTICES, BOX_TRIANGLES))]).save(path),
    ".dae": lambda path: trimesh.Trimesh(BOX_VERTICES, BOX_TRIANGLES).export(path),
}


NO_ASSIMP = pytest.mark.skipif(shutil.which("assimp") is None, reason="Assimp is not installed")


@pytest.mark.parametrize("suffix", [pytest.param(one, marks=[NO_ASSIMP] * (one == ".dae")) for one in OTHERS])
def test_the_command_of_a_refusal_converts_the_file(tmp_path: Path, suffix: str) -> None:
    OTHERS[suffix](tmp_path / f"scan{suffix}")
    with pytest.raises(MeshError, match="convert it: ") as refusal:
        read_mesh(tmp_path / f"scan{suffix}")
    command = re.sub("^pip install .*?; ", "", str(refusal.value).partition("convert it: ")[2])
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(command, shell=True, check=True, cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True)
    (made,) = [one for one in tmp_path.glob("scan.*") if one.suffix in (".ply", ".stl", ".vtu", ".vtp")]
    assert read_mesh(made).area == pytest.approx(BOX_AREA, rel=1e-6)
