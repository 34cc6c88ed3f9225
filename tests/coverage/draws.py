"""Random pieces of random pairs."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sobolev_batch import Mesh, Similarity, Sphere
from sobolev_batch.surfaces.sources.derived import decimated
from sobolev_batch.surfaces.sources.files import FileSource
from sobolev_batch.surfaces.sources.registry import load_mesh
from tests.support.shapes import CENTRED_BOX as BOX

Reals = NDArray[np.float64]

# The cortical surface that the extra `studies` brings.
_CORTEX = "nilearn/datasets/data/fsaverage5/pial_left.gii.gz"


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


def placed(mesh: Mesh, sphere: Sphere) -> Mesh:
    return Mesh(sphere.radius * mesh.vertices + np.asarray(sphere.center), mesh.triangles)


@lru_cache
def cortex(triangles: int) -> Mesh:
    """Return the cortical surface with a number of triangles, within the unit ball."""
    (original,) = FileSource(paths=(_CORTEX,), distribution="nilearn").members(Path())
    loaded = decimated(load_mesh(original), triangles)
    mesh = Similarity.to_unit_ball(loaded).apply(loaded)
    assert isinstance(mesh, Mesh)
    return mesh
