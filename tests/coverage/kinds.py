"""Random pairs of spheres and meshes, by kind."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.shapes import Similarity, Sphere, icosphere
from sobolev_batch.sources.derived import decimated
from sobolev_batch.sources.files import FileSource
from sobolev_batch.sources.registry import load_mesh
from tests.coverage.truth import Pair
from tests.support.shapes import CENTRED_BOX as BOX

Surfaces = tuple[Surface, Surface]

# The cortical surface that the extra `studies` brings.
_CORTEX = "nilearn/datasets/data/fsaverage5/pial_left.gii.gz"
# Vertices on multiples of this have exact midpoints.
_GRID = 2.0**-20


def small_amount(rng: np.random.Generator) -> float:
    """Return a random distance of near surfaces, in units of length."""
    return float(10.0 ** rng.uniform(-4, -1))


def direction(rng: np.random.Generator) -> Reals:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def rotation(rng: np.random.Generator) -> Reals:
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def random_sphere(rng: np.random.Generator) -> Sphere:
    radius = rng.uniform(0.2, 0.9)
    return sphere_at(radius, rng.uniform(0, 1 - radius) * direction(rng))


def sphere_at(radius: float, center: Reals) -> Sphere:
    return Sphere(float(radius), (float(center[0]), float(center[1]), float(center[2])))


def random_box(rng: np.random.Generator) -> Mesh:
    sides = rng.uniform(0.1, 1.0, size=3)
    vertices = 2 * (BOX.vertices > 0) - 1
    vertices = (sides / np.linalg.norm(sides) * vertices) @ rotation(rng).T
    size = rng.uniform(0.4, 0.95)
    return Mesh(size * vertices + rng.uniform(0, 1 - size) * direction(rng), BOX.triangles)


def changed(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """Return the mesh a little scaled and moved, or sheared."""
    amount = small_amount(rng)
    if rng.random() < 0.5:
        return Mesh((1 - amount * rng.random()) * mesh.vertices + amount * direction(rng), mesh.triangles)
    return Mesh(mesh.vertices @ (np.eye(3) + amount * rng.normal(size=(3, 3)) / 2), mesh.triangles)


def placed(mesh: Mesh, sphere: Sphere, turn: Reals | None = None) -> Mesh:
    """Return a mesh of a unit sphere as one of a sphere, perhaps turned before."""
    vertices = mesh.vertices if turn is None else mesh.vertices @ turn.T
    return Mesh(sphere.radius * vertices + np.asarray(sphere.center), mesh.triangles)


@lru_cache
def cortex(triangles: int) -> Mesh:
    (original,) = FileSource(paths=(_CORTEX,), distribution="nilearn").members(Path())
    loaded = decimated(load_mesh(original), triangles)
    mesh = Similarity.to_unit_ball(loaded).apply(loaded)
    assert isinstance(mesh, Mesh)
    return mesh


def _near_spheres(rng: np.random.Generator) -> Surfaces:
    sphere, amount = random_sphere(rng), small_amount(rng)
    moved = np.asarray(sphere.center) + amount * rng.uniform(0, 1) * direction(rng)
    return sphere, sphere_at(sphere.radius + amount * rng.uniform(-1, 1), moved)


def _near_boxes(rng: np.random.Generator) -> Surfaces:
    box = random_box(rng)
    return box, changed(rng, box)


def _icosphere_and_sphere(rng: np.random.Generator) -> Surfaces:
    level, sphere = int(rng.integers(0, 5)), random_sphere(rng)
    mesh = placed(icosphere(level), sphere, rotation(rng))
    return mesh, sphere if rng.random() < 0.6 else random_sphere(rng)


def _icospheres(rng: np.random.Generator) -> Surfaces:
    """Return two levels of one sphere, near-duplicates of one level, or icospheres of two spheres."""
    first, second = rng.choice(4, size=2, replace=False)
    sphere, choice = random_sphere(rng), rng.random()
    a = placed(icosphere(int(first)), sphere)
    if choice < 0.4:
        return a, placed(icosphere(int(second)), sphere)
    return a, changed(rng, a) if choice < 0.7 else placed(icosphere(int(second)), random_sphere(rng))


def _solids(rng: np.random.Generator) -> Surfaces:
    """Return a prism, a torus or a capsule, and the same changed a little or in fewer triangles."""
    thick, choice = rng.uniform(0.1, 0.3), rng.random()
    sections = int(rng.integers(5, 9) if choice < 0.6 else rng.integers(10, 20))
    counts = (sections, sections - 2)
    if choice < 0.3:
        solids = [trimesh.creation.cylinder(thick, 1.2, count) for count in counts]
    elif choice < 0.8:
        solids = [trimesh.creation.torus(0.6, thick, count, 3 if choice < 0.6 else 8) for count in counts]
    else:
        solids = [trimesh.creation.capsule(0.8, thick, count=[count, count]) for count in counts]
    turn = rotation(rng)
    first, second = (Mesh((solid.vertices - solid.centroid) @ turn.T, solid.faces) for solid in solids)
    return first, second if rng.random() < 0.5 else changed(rng, first)


def _cortices(rng: np.random.Generator) -> Surfaces:
    """Return the cortical surface with two numbers of triangles, or twice with a small change."""
    first, second = rng.choice([100, 150, 200, 400, 1600, 3200], size=2, replace=False)
    a = cortex(int(first))
    return a, cortex(int(second)) if rng.random() < 0.6 else changed(rng, a)


def _open_surfaces(rng: np.random.Generator) -> Surfaces:
    """Return a box without some faces, part of an icosphere, or a triangle, and the same changed."""
    choice = rng.random()
    if choice < 0.3:
        a = Mesh(rng.uniform(-0.7, 0.7, size=(4, 3)), [[0, 1, 2], [0, 2, 3]][: int(rng.integers(1, 3))])
    elif choice < 0.6:
        box = random_box(rng)
        a = Mesh(box.vertices, box.triangles[: int(rng.integers(2, 11))])
    else:
        ball = _placed_ball(rng, int(rng.integers(0, 3)))
        heights = ball.vertices[ball.triangles].mean(axis=1) @ direction(rng)
        a = Mesh(ball.vertices, ball.triangles[heights > np.quantile(heights, rng.uniform(0.2, 0.8))])
    return a, changed(rng, a)


def _placed_ball(rng: np.random.Generator, level: int) -> Mesh:
    turn = rotation(rng)
    return placed(icosphere(level), random_sphere(rng), turn)


def _one_vertex_moved(rng: np.random.Generator) -> Surfaces:
    choice = rng.random()
    mesh = random_box(rng) if choice < 0.3 else _placed_ball(rng, int(rng.integers(1, 4)))
    if choice > 0.7:
        mesh = cortex(int(rng.choice([100, 400, 1600])))
    vertices = mesh.vertices.copy()
    vertices[rng.choice(mesh.triangles.ravel())] += small_amount(rng) * direction(rng)
    return mesh, Mesh(vertices, mesh.triangles)


def _distant_spheres(rng: np.random.Generator) -> Surfaces:
    radii, middle = rng.uniform(0.02, 0.3, size=2), rng.uniform(0.5, 3) * direction(rng)
    return sphere_at(radii[0], -middle), sphere_at(radii[1], middle)


def _distant_tetrahedra(rng: np.random.Generator) -> Surfaces:
    triangles, middle = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], rng.uniform(0.5, 3) * direction(rng)
    a, b = (Mesh(sign * middle + rng.uniform(-0.2, 0.2, size=(4, 3)), triangles) for sign in (-1, 1))
    return a, b


def _remeshed(rng: np.random.Generator) -> Pair:
    """Return a surface in two different sets of triangles: cut in four, corners renamed, other diagonals."""
    choice = rng.random()
    mesh = _placed_ball(rng, int(rng.integers(0, 3))) if choice < 0.5 else cortex(int(rng.choice([100, 200, 400])))
    if choice > 0.7:
        sides = _GRID * np.round(rng.uniform(0.3, 1.2, size=3) / _GRID)
        mesh = Mesh(np.where(BOX.vertices > 0, sides, 0.0), BOX.triangles)
        quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        other = Mesh(mesh.vertices, [[q[i] for i in corners] for q in quads for corners in ((0, 1, 3), (1, 2, 3))])
    else:
        mesh = other = Mesh(_GRID * np.round(mesh.vertices / _GRID), mesh.triangles)
    for _ in range(int(rng.integers(choice <= 0.7, 3))):
        other = Mesh(*trimesh.remesh.subdivide(other.vertices, other.triangles))
    names = rng.permutation(len(other.vertices))
    vertices = np.empty_like(other.vertices)
    vertices[names] = other.vertices
    triangles = names[rng.permutation(other.triangles)]
    return Pair(mesh, Mesh(vertices, np.roll(triangles, int(rng.integers(3)), axis=1)), equal=True)


MAKERS: dict[str, Callable[[np.random.Generator], Surfaces | Pair]] = {
    "near spheres": _near_spheres,
    "far spheres": lambda rng: (random_sphere(rng), random_sphere(rng)),
    "near boxes": _near_boxes,
    "far boxes": lambda rng: (random_box(rng), random_box(rng)),
    "box, sphere": lambda rng: (random_box(rng), random_sphere(rng)),
    "icosphere, sphere": _icosphere_and_sphere,
    "icospheres": _icospheres,
    "solids": _solids,
    "cortices": _cortices,
    "cortex, sphere": lambda rng: (cortex(int(rng.choice([100, 400, 1600]))), random_sphere(rng)),
    "open surfaces": _open_surfaces,
    "one vertex moved": _one_vertex_moved,
    "distant spheres": _distant_spheres,
    "distant tetrahedra": _distant_tetrahedra,
    "remeshed": _remeshed,
}
