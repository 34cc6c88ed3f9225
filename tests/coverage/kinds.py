"""Random pairs of surfaces of each kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from sobolev_batch import Mesh, icosphere
from sobolev_batch.surfaces.shapes.surface import Surface
from tests.coverage.draws import (
    changed,
    cortex,
    direction,
    placed,
    random_box,
    random_sphere,
    rotation,
    small_amount,
    sphere_at,
)
from tests.coverage.pairs import Pair
from tests.coverage.parts import PARTS
from tests.support.shapes import CENTRED_BOX as BOX

Surfaces = tuple[Surface, Surface]

ORDERS = (-0.6, -0.75, -1.0, -1.5, -2.0, -3.0, -4.0, -5.0, -10.0)
# Those at which something is known of any pair, if often little.
_FROM_ONE = ORDERS[2:]
# Vertices on multiples of this have exact midpoints.
_GRID = 2.0**-20


@dataclass(frozen=True)
class Kind:
    """Pairs of one kind.

    Attributes:
        make: Makes a random pair.
        orders: Orders at which it is measured.
        on_lattices: True if some are measured on a given lattice. Its errors are documented to miss surfaces of short
            periods, and small ones far apart.
    """

    make: Callable[[np.random.Generator], Pair]
    orders: tuple[float, ...]
    on_lattices: bool = True


def _near_spheres(rng: np.random.Generator) -> Surfaces:
    sphere, amount = random_sphere(rng), small_amount(rng)
    moved = np.asarray(sphere.center) + amount * rng.uniform(0, 1) * direction(rng)
    return sphere, sphere_at(sphere.radius + amount * rng.uniform(-1, 1), moved)


def _far_spheres(rng: np.random.Generator) -> Surfaces:
    return random_sphere(rng), random_sphere(rng)


def _near_boxes(rng: np.random.Generator) -> Surfaces:
    box = random_box(rng)
    return box, changed(rng, box)


def _far_boxes(rng: np.random.Generator) -> Surfaces:
    return random_box(rng), random_box(rng)


def _box_and_sphere(rng: np.random.Generator) -> Surfaces:
    return random_box(rng), random_sphere(rng)


def _icosphere_and_sphere(rng: np.random.Generator) -> Surfaces:
    """Return an icosphere and the sphere that it approximates, or another one."""
    level, sphere = int(rng.integers(0, 5)), random_sphere(rng)
    mesh = icosphere(level)
    mesh = Mesh(sphere.radius * mesh.vertices @ rotation(rng).T + np.asarray(sphere.center), mesh.triangles)
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


def _cortex_and_sphere(rng: np.random.Generator) -> Surfaces:
    return cortex(int(rng.choice([100, 400, 1600]))), random_sphere(rng)


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
    ball = icosphere(level)
    return placed(Mesh(ball.vertices @ rotation(rng).T, ball.triangles), random_sphere(rng))


def _one_vertex_moved(rng: np.random.Generator) -> Surfaces:
    """Return a mesh twice, once with one of its vertices moved."""
    choice = rng.random()
    mesh = random_box(rng) if choice < 0.3 else _placed_ball(rng, int(rng.integers(1, 4)))
    if choice > 0.7:
        mesh = cortex(int(rng.choice([100, 400, 1600])))
    vertices = mesh.vertices.copy()
    vertices[rng.choice(mesh.triangles.ravel())] += small_amount(rng) * direction(rng)
    return mesh, Mesh(vertices, mesh.triangles)


def _distant_spheres(rng: np.random.Generator) -> Surfaces:
    """Return two small spheres some units apart."""
    radii, middle = rng.uniform(0.02, 0.3, size=2), rng.uniform(0.5, 3) * direction(rng)
    return sphere_at(radii[0], -middle), sphere_at(radii[1], middle)


def _distant_tetrahedra(rng: np.random.Generator) -> Surfaces:
    """Return two small tetrahedra some units apart."""
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
        other = _quartered(other)
    names = rng.permutation(len(other.vertices))
    vertices = np.empty_like(other.vertices)
    vertices[names] = other.vertices
    triangles = names[rng.permutation(other.triangles)]
    return Pair(mesh, Mesh(vertices, np.roll(triangles, int(rng.integers(3)), axis=1)), equal=True)


def _quartered(mesh: Mesh) -> Mesh:
    vertices, triangles = trimesh.remesh.subdivide(mesh.vertices, mesh.triangles)
    return Mesh(vertices, triangles)


def _plain(make: Callable[[np.random.Generator], Surfaces]) -> Callable[[np.random.Generator], Pair]:
    return lambda rng: Pair(*make(rng))


KINDS: dict[str, Kind] = {
    "near spheres": Kind(_plain(_near_spheres), ORDERS),
    "far spheres": Kind(_plain(_far_spheres), ORDERS),
    "near boxes": Kind(_plain(_near_boxes), _FROM_ONE),
    "far boxes": Kind(_plain(_far_boxes), _FROM_ONE),
    "box, sphere": Kind(_plain(_box_and_sphere), _FROM_ONE),
    "icosphere, sphere": Kind(_plain(_icosphere_and_sphere), _FROM_ONE),
    "icospheres": Kind(_plain(_icospheres), _FROM_ONE),
    "solids": Kind(_plain(_solids), _FROM_ONE),
    "cortices": Kind(_plain(_cortices), _FROM_ONE),
    "cortex, sphere": Kind(_plain(_cortex_and_sphere), _FROM_ONE),
    "open surfaces": Kind(_plain(_open_surfaces), _FROM_ONE),
    "one vertex moved": Kind(_plain(_one_vertex_moved), _FROM_ONE),
    "distant spheres": Kind(_plain(_distant_spheres), ORDERS, on_lattices=False),
    "distant tetrahedra": Kind(_plain(_distant_tetrahedra), ORDERS, on_lattices=False),
    "remeshed": Kind(_remeshed, ORDERS),
} | {name: Kind(make, ORDERS, on_lattices=False) for name, make in PARTS.items()}
