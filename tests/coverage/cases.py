"""Random pairs of surfaces, and the settings under which their distances are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from sobolev_batch import Lattice, Mesh, Similarity, Sphere, icosphere
from sobolev_batch.surfaces.shapes.extent import Extent
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.decimation import DecimatedMember
from sobolev_batch.surfaces.sources.files import FileSource
from tests.support.shapes import CENTRED_BOX as BOX

Reals = NDArray[np.float64]
Pair = tuple[Surface, Surface]

ORDERS = (-2.0, -3.0, -5.0, -10.0)
# The cortical surface that the extra `studies` brings.
_CORTEX = "nilearn/datasets/data/fsaverage5/pial_left.gii.gz"


@dataclass(frozen=True)
class ChosenLattice:
    """A lattice and settings as a user might choose them, well or badly."""

    lattice: Lattice
    eps: float
    quadrature: str | int


@dataclass(frozen=True)
class ChosenAccuracy:
    """An accuracy relative to the distance; the package chooses everything else."""

    rtol: float


Setting = ChosenLattice | ChosenAccuracy


@dataclass(frozen=True)
class Case:
    """One distance.

    Attributes:
        kind: Kind of the pair.
        index: Index of the pair, which its cases share.
        pair: Two surfaces within about the unit ball.
        order: Order s.
        setting: Lattice or accuracy of the distance.
    """

    kind: str
    index: int
    pair: Pair
    order: float
    setting: Setting


def cases_of(seed: int, index: int) -> list[Case]:
    """Return the cases of one random pair, one per order; the same seed and index give the same ones."""
    rng = np.random.default_rng([seed, index])
    kind = tuple(KINDS)[index % len(KINDS)]
    a, b = KINDS[kind](rng)
    pair = (a, b) if rng.random() < 0.5 else (b, a)
    return [Case(kind, index, pair, order, _setting(rng, pair)) for order in ORDERS]


def all_cases(seed: int, count: int) -> Iterator[list[Case]]:
    """Yield at least ``count`` cases, pair by pair."""
    for index in range(-(-count // len(ORDERS))):
        yield cases_of(seed, index)


def _setting(rng: np.random.Generator, pair: Pair) -> Setting:
    """Return a random setting; two spheres always get a lattice, without which they have a closed form."""
    if rng.random() < 0.5 or all(isinstance(surface, Sphere) for surface in pair):
        return _chosen_lattice(rng, pair)
    return ChosenAccuracy(float(10.0 ** rng.uniform(-6, -2)))


def _chosen_lattice(rng: np.random.Generator, pair: Pair) -> ChosenLattice:
    """Return a lattice whose period leaves a third of a unit to three units around the surfaces."""
    extent = Extent.union([surface.extent for surface in pair])
    reach = float(np.abs([extent.lowest, extent.highest]).max())
    widest = float(extent.widths.max())
    xi_max = rng.uniform(2.0, 6.0)
    period = max(2.1 * reach, widest + rng.uniform(0.3, 3.0))
    lattice = Lattice(float(xi_max), 2 * int(np.ceil(xi_max * period)))
    quadrature: str | int = int(rng.integers(1, 5)) if rng.random() < 0.4 else "auto"
    return ChosenLattice(lattice, float(10.0 ** rng.uniform(-9, -4)), quadrature)


def _near(rng: np.random.Generator) -> float:
    """Return a random distance of near surfaces, in units of length."""
    return float(10.0 ** rng.uniform(-4, -1))


def _direction(rng: np.random.Generator) -> Reals:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _rotation(rng: np.random.Generator) -> Reals:
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def _sphere(rng: np.random.Generator) -> Sphere:
    radius = rng.uniform(0.2, 0.9)
    return _sphere_at(radius, rng.uniform(0, 1 - radius) * _direction(rng))


def _sphere_at(radius: float, center: Reals) -> Sphere:
    return Sphere(float(radius), (float(center[0]), float(center[1]), float(center[2])))


def _box(rng: np.random.Generator) -> Mesh:
    sides = rng.uniform(0.1, 1.0, size=3)
    vertices = 2 * (BOX.vertices > 0) - 1
    vertices = (sides / np.linalg.norm(sides) * vertices) @ _rotation(rng).T
    size = rng.uniform(0.4, 0.95)
    return Mesh(size * vertices + rng.uniform(0, 1 - size) * _direction(rng), BOX.triangles)


def _changed(rng: np.random.Generator, mesh: Mesh) -> Mesh:
    """Return the mesh a little scaled and moved, or sheared."""
    amount = _near(rng)
    if rng.random() < 0.5:
        return Mesh((1 - amount * rng.random()) * mesh.vertices + amount * _direction(rng), mesh.triangles)
    return Mesh(mesh.vertices @ (np.eye(3) + amount * rng.normal(size=(3, 3)) / 2), mesh.triangles)


def _near_spheres(rng: np.random.Generator) -> Pair:
    sphere, amount = _sphere(rng), _near(rng)
    moved = np.asarray(sphere.center) + amount * rng.uniform(0, 1) * _direction(rng)
    return sphere, _sphere_at(sphere.radius + amount * rng.uniform(-1, 1), moved)


def _far_spheres(rng: np.random.Generator) -> Pair:
    return _sphere(rng), _sphere(rng)


def _near_boxes(rng: np.random.Generator) -> Pair:
    box = _box(rng)
    return box, _changed(rng, box)


def _far_boxes(rng: np.random.Generator) -> Pair:
    return _box(rng), _box(rng)


def _box_and_sphere(rng: np.random.Generator) -> Pair:
    return _box(rng), _sphere(rng)


def _icosphere_and_sphere(rng: np.random.Generator) -> Pair:
    """Return an icosphere and the sphere that it approximates, or another one."""
    level, sphere = int(rng.integers(0, 5)), _sphere(rng)
    mesh = icosphere(level)
    mesh = Mesh(sphere.radius * mesh.vertices @ _rotation(rng).T + np.asarray(sphere.center), mesh.triangles)
    return mesh, sphere if rng.random() < 0.6 else _sphere(rng)


def _icospheres(rng: np.random.Generator) -> Pair:
    """Return two levels of one sphere, near-duplicates of one level, or icospheres of two spheres."""
    first, second = rng.choice(4, size=2, replace=False)
    sphere, choice = _sphere(rng), rng.random()
    a = _placed(icosphere(int(first)), sphere)
    if choice < 0.4:
        return a, _placed(icosphere(int(second)), sphere)
    return a, _changed(rng, a) if choice < 0.7 else _placed(icosphere(int(second)), _sphere(rng))


def _placed(mesh: Mesh, sphere: Sphere) -> Mesh:
    return Mesh(sphere.radius * mesh.vertices + np.asarray(sphere.center), mesh.triangles)


def _solids(rng: np.random.Generator) -> Pair:
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
    turn = _rotation(rng)
    first, second = (Mesh((solid.vertices - solid.centroid) @ turn.T, solid.faces) for solid in solids)
    return first, second if rng.random() < 0.5 else _changed(rng, first)


def _cortices(rng: np.random.Generator) -> Pair:
    """Return the cortical surface with two numbers of triangles, or twice with a small change."""
    first, second = rng.choice([100, 150, 200, 400, 1600, 3200], size=2, replace=False)
    a = cortex(int(first))
    return a, cortex(int(second)) if rng.random() < 0.6 else _changed(rng, a)


def _cortex_and_sphere(rng: np.random.Generator) -> Pair:
    return cortex(int(rng.choice([100, 400, 1600]))), _sphere(rng)


@lru_cache
def cortex(triangles: int) -> Mesh:
    """Return the cortical surface with a number of triangles, within the unit ball."""
    (original,) = FileSource(paths=(_CORTEX,), distribution="nilearn").members(Path())
    loaded = DecimatedMember("cortex", 0, original, triangles).load()
    mesh = Similarity.to_unit_ball(loaded).apply(loaded)
    assert isinstance(mesh, Mesh)
    return mesh


KINDS: dict[str, Callable[[np.random.Generator], Pair]] = {
    "near spheres": _near_spheres,
    "far spheres": _far_spheres,
    "near boxes": _near_boxes,
    "far boxes": _far_boxes,
    "box, sphere": _box_and_sphere,
    "icosphere, sphere": _icosphere_and_sphere,
    "icospheres": _icospheres,
    "solids": _solids,
    "cortices": _cortices,
    "cortex, sphere": _cortex_and_sphere,
}
