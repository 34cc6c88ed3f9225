"""Icosahedral triangulations against the definition of each level and closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sobolev_batch import InputError, Mesh, icosphere
from sobolev_batch.surfaces.shapes.subdivision import FINEST_LEVEL

LEVELS = range(6)


def edges(mesh: Mesh) -> list[tuple[int, int]]:
    pairs = {tuple(sorted(pair)) for a, b, c in mesh.triangles.tolist() for pair in ((a, b), (b, c), (c, a))}
    return [(a, b) for a, b in sorted(pairs)]


@pytest.mark.parametrize("level", LEVELS)
def test_counts(level: int) -> None:
    mesh = icosphere(level)
    assert mesh.vertices.shape == (10 * 4**level + 2, 3)
    assert mesh.triangles.shape == (20 * 4**level, 3)
    assert len(edges(mesh)) == 30 * 4**level
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))


@pytest.mark.parametrize("level", LEVELS)
def test_the_surface_is_closed_and_lies_on_the_sphere(level: int) -> None:
    mesh = icosphere(level)
    counts = mesh.counts
    assert (counts.zero_area, counts.duplicate, counts.boundary_edges, counts.nonmanifold_edges) == (0, 0, 0, 0)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 4 * np.finfo(float).eps
    # Symmetric about the origin.
    assert np.abs(mesh.vertices.mean(axis=0)).max() < 1e-15
    a, b, c = mesh.corners()
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    assert (np.sign(volumes) == np.sign(volumes[0])).all()
    assert abs(volumes.sum()) < 4 / 3 * math.pi


def test_level_0_is_the_icosahedron() -> None:
    mesh = icosphere(0)
    edge = 4 / math.sqrt(10 + 2 * math.sqrt(5))
    assert mesh.edge_lengths == pytest.approx(np.full((20, 3), edge), rel=1e-14)
    assert mesh.area == pytest.approx(5 * math.sqrt(3) * edge**2, rel=1e-14)
    assert mesh.areas == pytest.approx(np.full(20, mesh.area / 20), rel=1e-14)


@pytest.mark.parametrize("level", range(4))
def test_each_level_adds_the_projected_midpoints_of_the_last(level: int) -> None:
    coarse, fine = icosphere(level), icosphere(level + 1)
    count = len(coarse.vertices)
    assert np.abs(fine.vertices[:count] - coarse.vertices).max() < 1e-15
    midpoints = np.array([coarse.vertices[a] + coarse.vertices[b] for a, b in edges(coarse)])
    midpoints /= np.linalg.norm(midpoints, axis=1)[:, None]
    distances = np.linalg.norm(midpoints[:, None] - fine.vertices[None, count:], axis=2)
    assert distances.min(axis=0).max() < 1e-15
    assert distances.min(axis=1).max() < 1e-15


def test_the_area_converges_with_second_order() -> None:
    errors = np.array([4 * math.pi - icosphere(level).area for level in LEVELS])
    assert (errors > 0).all()
    slopes = np.log2(errors[:-1] / errors[1:])
    assert slopes[-1] == pytest.approx(2, abs=0.01)
    assert errors[-1] < 4 * math.pi * 1e-3


def test_the_same_level_is_the_same_mesh() -> None:
    assert icosphere(3).digest == icosphere(3).digest
    assert len({icosphere(level).digest for level in LEVELS}) == len(LEVELS)


@pytest.mark.parametrize("level", [-1, FINEST_LEVEL + 1, 10**9, 1.0, "1", True, None])
def test_levels_must_be_small_integers(level: Any) -> None:
    with pytest.raises(InputError, match=f"level must be an integer from 0 to 12, found {level!r}"):
        icosphere(level)
