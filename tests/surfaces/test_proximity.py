"""Hausdorff and Chamfer distances against geometry that is known, and against another library's search."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

import sobolev_batch as sb
from sobolev_batch.surfaces.proximity import MOST_POINTS, proximity


def square(side: float, height: float = 0.0, *, stray: tuple[float, float, float] | None = None) -> sb.Mesh:
    corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    vertices = [[0.5 * side * x, 0.5 * side * y, height] for x, y in corners]
    return sb.Mesh(np.array([*vertices, *([stray] if stray else [])], dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize(
    ("a", "b", "hausdorff", "chamfer"),
    [
        (square(2.0), square(2.0, 0.25), 0.25, 0.5),
        # A vertex that no triangle uses is not on the surface.
        (square(2.0), square(2.0, 0.25, stray=(50.0, 0.0, 0.0)), 0.25, 0.5),
        (sb.shapes.icosphere(3), sb.shapes.icosphere(3), 0.0, 0.0),
    ],
)
def test_surfaces_that_are_parallel_or_the_same(a: sb.Mesh, b: sb.Mesh, hausdorff: float, chamfer: float) -> None:
    found = proximity(a, b, points=500)
    assert found.hausdorff == pytest.approx(hausdorff, rel=1e-12, abs=1e-15)
    assert found.chamfer == pytest.approx(chamfer, rel=1e-12, abs=1e-15)
    assert found.chamfer_error < 1e-12


@pytest.mark.slow
def test_a_square_within_a_larger_one() -> None:
    found = proximity(square(2.0), square(4.0), points=200_000)
    # The corner of the larger is the farthest point; from the smaller one all distances are zero.
    assert found.hausdorff == pytest.approx(np.sqrt(2), rel=1e-12)
    # Mean over the square [-2, 2]²: four strips of mean 1/2 and four corner squares of mean
    # (√2 + asinh 1)/3, over 16.
    exact = (4 * 2 * 0.5 + 4 * (np.sqrt(2) + np.arcsinh(1)) / 3) / 16
    assert 0 < found.chamfer_error < 0.01
    assert abs(found.chamfer - exact) < 4 * found.chamfer_error
    assert proximity(square(4.0), square(2.0), points=200_000).hausdorff == found.hausdorff


@pytest.mark.slow
def test_the_error_is_that_of_the_drawing() -> None:
    a, b = square(2.0), square(4.0)
    exact = proximity(a, b, points=400_000).chamfer
    drawn = [proximity(a, b, points=400, seed=seed) for seed in range(60)]
    deviations = np.array([found.chamfer - exact for found in drawn]) / [found.chamfer_error for found in drawn]
    assert 0.7 < deviations.std() < 1.4
    assert abs(deviations.mean()) < 0.5


def test_distances_of_vertices_as_another_search_finds_them() -> None:
    rng = np.random.default_rng(3)
    a, b = (
        sb.Mesh(rng.normal(size=(30, 3)), np.array([rng.choice(30, 3, replace=False) for _ in range(25)]))
        for _ in range(2)
    )
    farthest = 0.0
    for mesh, other in ((a, b), (b, a)):
        surface = trimesh.Trimesh(other.vertices, other.triangles, process=False)
        on_mesh = mesh.vertices[np.unique(mesh.triangles)]
        _, distances, _ = trimesh.proximity.closest_point_naive(surface, on_mesh)
        farthest = max(farthest, float(distances.max()))
    found = proximity(a, b, points=2000)
    assert farthest - 1e-12 <= found.hausdorff < 1.3 * farthest


@pytest.mark.parametrize("scale", [1e-60, 1e-12, 1.0, 1e12, 1e60])
def test_lengths_scale(scale: float) -> None:
    a, b = square(2.0), square(3.0, 0.25)
    plain = proximity(a, b, points=300)
    scaled = proximity(*(sb.Mesh(scale * mesh.vertices, mesh.triangles) for mesh in (a, b)), points=300)
    assert scaled.hausdorff == pytest.approx(scale * plain.hausdorff, rel=1e-9)
    assert scaled.chamfer == pytest.approx(scale * plain.chamfer, rel=1e-9)


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("points", [0, 1, -5, MOST_POINTS + 1, 2.5, True], "points must be an integer"),
        ("seed", [-1, 0.5, "1", True, None], "seed must be a whole number from 0 on"),
    ],
)
def test_wrong_points_and_seeds_are_refused(key: str, values: list[Any], message: str) -> None:
    for value in values:
        with pytest.raises(sb.errors.InputError, match=message):
            proximity(square(1.0), square(2.0), **{key: value})
