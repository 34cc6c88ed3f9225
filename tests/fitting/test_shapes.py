"""Penalties of triangles that degenerate, and the smoothing of steps, against differences and dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.fitting.descent import (
    Smoothing,
    lowest_free_qualities,
    shape_penalty,
    smallest_angle,
    triangle_qualities,
)

TRIANGLE = np.array([[0, 1, 2]])


def test_shapes_that_hardly_change_cost_nothing() -> None:
    ball, rng = sb.icosphere(2), np.random.default_rng(0)
    references = lowest_free_qualities(np.array(ball.vertices), ball.triangles)
    vertices = ball.vertices + 0.01 * rng.normal(size=ball.vertices.shape)
    value, gradient = shape_penalty(vertices, ball.triangles, references)
    assert value == 0
    assert not gradient.any()


def test_triangles_that_were_bad_before_may_stay_so() -> None:
    sliver = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    references = lowest_free_qualities(sliver, TRIANGLE)
    assert shape_penalty(sliver, TRIANGLE, references)[0] == 0
    assert shape_penalty(sliver * [1, 0.25, 1], TRIANGLE, references)[0] == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize(("height", "quality"), [(np.sqrt(0.75), 1.0), (0.5, 0.5 * np.sqrt(3)), (0.0, 0.0)])
def test_the_quality_of_a_triangle_and_its_penalty(height: float, quality: float) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, height, 0]])
    assert triangle_qualities(corners, TRIANGLE) == pytest.approx([quality], abs=1e-12)
    assert shape_penalty(corners, TRIANGLE, np.ones(1))[0] == pytest.approx((1 - quality) ** 2, abs=1e-12)


def test_its_derivative_is_that_of_differences() -> None:
    ball, rng, step = sb.icosphere(1), np.random.default_rng(1), 1e-6
    references = lowest_free_qualities(np.array(ball.vertices), ball.triangles)
    vertices = ball.vertices + 0.3 * rng.normal(size=ball.vertices.shape)
    direction = rng.normal(size=vertices.shape)
    value, gradient = shape_penalty(vertices, ball.triangles, references)
    ends = [shape_penalty(vertices + sign * step * direction, ball.triangles, references)[0] for sign in (1, -1)]
    assert value > 0.1
    assert np.sum(gradient * direction) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


@pytest.mark.parametrize(
    ("corners", "degrees"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], 45.0),
        ([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]], 60.0),
        ([[0, 0, 0], [2, 0, 0], [1, np.tan(np.radians(2)), 0]], 2.0),
    ],
)
def test_the_smallest_angle(corners: list[list[float]], degrees: float) -> None:
    assert smallest_angle(sb.Mesh(corners, [[0, 1, 2]])) == pytest.approx(degrees, rel=1e-9)


def test_a_triangle_without_an_area_has_no_angle() -> None:
    mesh = sb.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [0, 1, 3]])
    assert smallest_angle(mesh) == 0


def dense(mesh: sb.Mesh) -> np.ndarray:
    """The graph Laplacian of a mesh, edge by edge."""
    found = np.zeros((len(mesh.vertices),) * 2)
    for i, j in {(int(t[a]), int(t[b])) for t in mesh.triangles for a in range(3) for b in range(3) if a != b}:
        found[i, j] = -1
    return found - np.diag(found.sum(axis=1))


def test_smoothing_solves_with_the_graph_laplacian() -> None:
    mesh, rng = sb.Mesh(sb.icosphere(1).vertices, sb.icosphere(1).triangles[:60]), np.random.default_rng(2)
    free = np.array([0, 2, 3, 5, 8, 13, 21])
    smoothing = Smoothing.from_mesh(mesh, free, 3.0)
    steps, slopes = rng.normal(size=(7, 3)), rng.normal(size=mesh.vertices.shape)
    matrix = np.eye(7) + 3.0 * dense(mesh)[np.ix_(free, free)]
    movement = smoothing.movement(steps)
    np.testing.assert_allclose(movement[free], np.linalg.solve(matrix, steps), rtol=1e-10)
    assert not np.delete(movement, free, axis=0).any()
    assert np.sum(smoothing.pulled_back(slopes) * steps) == pytest.approx(np.sum(slopes * movement), rel=1e-10)


def test_without_smoothing_steps_are_movements() -> None:
    smoothing = Smoothing.from_mesh(sb.icosphere(0), np.array([1, 4]), 0.0)
    np.testing.assert_array_equal(smoothing.movement(np.ones((2, 3)))[[1, 4]], 1.0)
