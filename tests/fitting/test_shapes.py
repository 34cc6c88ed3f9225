"""Penalties of triangles that degenerate, and the smoothing of steps, against differences and dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.fitting.descent import ShapePenalty, Smoothing, smallest_angle


def test_shapes_that_hardly_change_cost_nothing() -> None:
    ball, rng = sb.icosphere(2), np.random.default_rng(0)
    penalty = ShapePenalty.from_shapes(np.array(ball.vertices), ball.triangles)
    value, gradient = penalty.value_and_gradient(ball.vertices + 0.01 * rng.normal(size=ball.vertices.shape))
    assert value == 0
    assert not gradient.any()


def test_triangles_that_were_bad_before_may_stay_so() -> None:
    sliver = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    penalty = ShapePenalty.from_shapes(sliver, np.array([[0, 1, 2]]))
    assert penalty.value_and_gradient(sliver)[0] == 0
    assert penalty.value_and_gradient(sliver * [1, 0.25, 1])[0] == pytest.approx(0.25, rel=1e-3)


def test_the_penalty_grows_to_one_for_a_triangle_without_an_area() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.8, 0]])
    penalty = ShapePenalty.from_shapes(corners, np.array([[0, 1, 2]]))
    values = [penalty.value_and_gradient(corners * [1, factor, 1])[0] for factor in (0.3, 0.2, 0.1, 1e-9)]
    assert values == sorted(values)
    assert values[-1] == pytest.approx(1.0, abs=1e-6)


def test_its_derivative_is_that_of_differences() -> None:
    ball, rng, step = sb.icosphere(1), np.random.default_rng(1), 1e-6
    penalty = ShapePenalty.from_shapes(np.array(ball.vertices), ball.triangles)
    vertices = ball.vertices + 0.3 * rng.normal(size=ball.vertices.shape)
    direction = rng.normal(size=vertices.shape)
    value, gradient = penalty.value_and_gradient(vertices)
    ends = [penalty.value_and_gradient(vertices + sign * step * direction)[0] for sign in (1, -1)]
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
