"""Fits: nearer by an independent measure, with the triangles, boundaries and promises kept."""

from __future__ import annotations

import os
import re
import signal
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.extras.fitting import fit as module
from sobolev_batch.extras.fitting.descent import (
    Descent,
    End,
    Smoothing,
    lowest_free_qualities,
    shape_penalty,
    triangle_qualities,
)
from sobolev_batch.extras.fitting.objective import FitSettings
from sobolev_batch.geometry.subdivision import Edges
from sobolev_batch.sources.derived import decimated
from tests.geometry.test_subdivision import open_mesh


def bumpy(level: int) -> sb.Mesh:
    """A ball with bumps, whose decimation loses something."""
    ball = sb.shapes.icosphere(level)
    x, y, z = np.array(ball.vertices).T
    return sb.Mesh(ball.vertices * (0.8 + 0.15 * np.sin(4 * x) * np.cos(3 * y + z))[:, None], ball.triangles)


TARGET = bumpy(3)
TRIANGLE = np.array([[0, 1, 2]])
START = decimated(TARGET, 200)


@pytest.fixture(scope="module")
def fitted() -> sb.fitting.Fit:
    return sb.fit(START, TARGET, -4.0)


def normals(mesh: sb.Mesh) -> np.ndarray:
    a, b, c = mesh.corners()
    return np.cross(b - a, c - a)


@pytest.mark.slow
def test_it_comes_nearer_by_every_sobolev_measure(fitted: sb.fitting.Fit) -> None:
    orders = [-1.5, -2.0, -4.0]
    before, after = (sb.distance(mesh, TARGET, orders, rtol=3e-2)["distance"].values for mesh in (START, fitted.mesh))
    assert (after < 0.8 * before).all()
    assert after[-1] < before[-1] / 3
    assert fitted.before.distance == pytest.approx(before[-1], rel=0.05)
    assert fitted.after.distance == pytest.approx(after[-1], rel=0.05)
    assert fitted.after.error < 0.05 * fitted.after.distance


@pytest.mark.slow
def test_it_keeps_the_triangles_turns_none_over_and_reports_distances_of_points(fitted: sb.fitting.Fit) -> None:
    np.testing.assert_array_equal(fitted.mesh.triangles, START.triangles)
    assert (np.sum(normals(fitted.mesh) * normals(START), axis=1) > 0).all()
    assert fitted.after.smallest_angle > 0.3 * fitted.before.smallest_angle
    near = sb.proximity(fitted.mesh, TARGET)
    # Points are drawn on meshes that were moved to a common centre.
    assert (fitted.after.hausdorff, fitted.after.chamfer) == pytest.approx(
        (near["hausdorff"], near["chamfer"]), rel=1e-3
    )
    assert fitted.remarks == ()


@pytest.mark.slow
def test_moving_both_moves_the_result() -> None:
    by = np.array([30.0, -5.0, 7.0])
    start, target = (sb.Mesh(mesh.vertices + by, mesh.triangles) for mesh in (START, TARGET))
    one, other = sb.fit(START, TARGET, -4.0, steps=5), sb.fit(start, target, -4.0, steps=5)
    assert np.abs(other.mesh.vertices - by - one.mesh.vertices).max() < 1e-4


@pytest.mark.slow
def test_boundaries_stay_if_asked_and_triangles_without_common_vertices_together() -> None:
    cap = np.asarray(START.vertices)[START.triangles][:, :, 2].mean(axis=1) > 0.1
    half = sb.Mesh(START.vertices, START.triangles[cap])
    soup = sb.Mesh(half.vertices[half.triangles].reshape(-1, 3), np.arange(3 * cap.sum()).reshape(-1, 3))
    edges = Edges.from_mesh(half)
    rim = np.unique(edges.ends[edges.on_boundary])
    stray = np.setdiff1d(np.arange(len(half.vertices)), half.triangles)
    free, apart = (sb.fit(mesh, TARGET, -4.0, steps=10).mesh for mesh in (half, soup))
    kept = sb.fit(half, TARGET, -4.0, steps=10, keep_boundary=True).mesh
    np.testing.assert_allclose(kept.vertices[rim], half.vertices[rim], rtol=0, atol=1e-14)
    assert np.abs(free.vertices[rim] - half.vertices[rim]).max() > 1e-3
    for mesh in (free, kept):
        np.testing.assert_allclose(mesh.vertices[stray], half.vertices[stray], rtol=0, atol=1e-14)
        assert np.abs(mesh.vertices - half.vertices).max() > 1e-3
    np.testing.assert_allclose(apart.vertices[apart.triangles], free.vertices[free.triangles], atol=1e-3)


@pytest.mark.slow
def test_an_interrupt_keeps_the_best_so_far() -> None:
    seen: list[sb.fitting.FitProgress] = []

    def interrupt(progress: sb.fitting.FitProgress) -> None:
        seen.append(progress)
        if progress.step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    fitted = sb.fit(START, TARGET, -4.0, on_progress=interrupt)
    assert fitted.end == "it was interrupted"
    assert fitted.steps == len(seen) == 3
    assert fitted.after.distance < fitted.before.distance
    assert [progress.relative for progress in seen] == sorted((one.relative for one in seen), reverse=True)


@pytest.mark.slow
def test_nothing_is_fitted_below_the_error_of_a_field() -> None:
    field = sb.fourier_transform(TARGET, sb.Lattice(4.0, 36), 3e-2, order=[-4.0])
    fitted = sb.fit(START, field, -4.0)
    assert fitted.end == "the distance is down to the error of its fields"
    assert fitted.after.distance > fitted.after.error


@pytest.mark.slow
def test_a_mesh_at_its_target_stays() -> None:
    fitted = sb.fit(START, START, -2.0)
    assert (fitted.before.distance, fitted.after.distance, fitted.steps) == (0, 0, 0)
    np.testing.assert_allclose(fitted.mesh.vertices, START.vertices, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_result_that_is_farther_away_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    def move_away(run: Any, *_: Any) -> None:
        run.vertices = run.vertices * 1.1

    monkeypatch.setattr(module.FitRun, "_descend", move_away)
    fitted = sb.fit(START, TARGET, -4.0)
    np.testing.assert_allclose(fitted.mesh.vertices, START.vertices, rtol=0, atol=1e-14)
    assert fitted.after == fitted.before
    assert fitted.end == "no nearer mesh was found"


@pytest.mark.parametrize(
    ("after", "remark"),
    [
        (sb.fitting.FitQuality(0.5, 0.01, hausdorff=3.1), "the Hausdorff distance grew 1.6 times"),
        (sb.fitting.FitQuality(0.5, 0.6), "the distance is not larger than its error"),
        (sb.fitting.FitQuality(1.5, 0.1), "no nearer mesh was found: this is the start"),
        (KeyboardInterrupt, "interrupted before the mesh was measured"),
    ],
)
def test_what_one_should_know_is_remarked(monkeypatch: pytest.MonkeyPatch, after: Any, remark: str) -> None:
    measure = Mock(side_effect=[sb.fitting.FitQuality(1.0, 0.1, hausdorff=2.0), after])
    monkeypatch.setattr(module, "measure_quality", measure)
    fitted = sb.fit(START, TARGET, -4.0, steps=2)
    assert len(fitted.remarks) == 1
    assert remark in fitted.remarks[0]
    moved = np.abs(fitted.mesh.vertices - START.vertices).max() > 1e-6
    assert moved == ("this is the start" not in remark)
    assert moved or fitted.after == fitted.before
    assert (fitted.end == "it was interrupted") == (after is KeyboardInterrupt)


@pytest.mark.parametrize("distance", [5.0, 1.7])
def test_no_triangle_is_turned_over_on_the_way(distance: float) -> None:
    # The middle vertex of a flat fan is drawn beyond the rim; its first step has the length 1 and ends on the rim.
    turns = np.linspace(0, 2 * np.pi, 7)[:-1]
    fan = np.concatenate([[[0.0, 0, 0]], np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)])
    triangles = np.array([[0, i + 1, (i + 1) % 6 + 1] for i in range(6)])

    class Drawn:
        """Half the squared distance of the middle from a point outside, as an objective."""

        transform = SimpleNamespace(triangles=triangles)
        place = np.array([distance, 0.0, 0.0])

        def value(self, vertices: np.ndarray) -> float:
            return float(np.sum((vertices[0] - self.place) ** 2)) / 2

        def __call__(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
            gradient = np.zeros_like(vertices)
            gradient[0] = vertices[0] - self.place
            return self.value(vertices), gradient

    objective: Any = Drawn()
    smoothing = Smoothing(sb.Mesh(fan, triangles), np.arange(7), 0.0)
    positions = [fan]
    descent = Descent(objective, fan, smoothing, 0.0, lambda vertices, value: positions.append(vertices))
    assert descent.run(20) is End.TURNED
    assert positions[-1][0, 0] < 1
    a, b, c = (positions[-1][corner] for corner in triangles.T)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mesh": sb.shapes.Sphere()}, "expected a Mesh, the path of a mesh file, a pair"),
        (
            {"target": 7},
            "a Sphere, a parametrised surface (Ellipsoid, Torus, ParametrisedSurface) or a Fourier field; found int",
        ),
        ({"target": sb.shapes.Sphere(1.0, (9, 0, 0))}, "do not overlap: move one to the other"),
        ({"target": sb.shapes.Sphere(1000.0)}, "are both in the same unit?"),
        ({"order": -0.5}, "finite only for orders below -1/2, found -0.5"),
        ({"order": [-2.0, -3.0]}, "one order is needed, found 2"),
        ({"steps": 0}, "steps must be a whole number from 1 to 100,000, found 0"),
        ({"steps": 10**30}, "steps must be a whole number from 1 to 100,000, found 1000"),
        ({"smoothing": np.nan}, "smoothing must be a number from 0 to 1e+12, found nan"),
        ({"keep_boundary": "no"}, "keep_boundary must be True or False, found 'no'"),
        ({"threads": 10**6}, "threads must be a whole number from 1 to 1,024, found 1000000"),
        ({"order": "a"}, "an order is a number, such as -2.0, or a list of numbers; found 'a'"),
        ({"lattice": sb.Lattice(8.0, 8)}, "the mesh reaches to |coordinate|"),
        ({"lattice": 3}, "a lattice is a Lattice(xi_max=..., M=...), found int"),
        ({"keep_boundary": True, "mesh": sb.Mesh(np.eye(3), [[0, 1, 2]])}, "all vertices lie on the boundary"),
    ],
)
def test_wrong_arguments_are_named(change: dict[str, Any], message: str) -> None:
    arguments = {"mesh": START, "target": TARGET, "order": -4.0, **change}
    with pytest.raises(sb.errors.SobolevBatchError, match=re.escape(message)):
        sb.fit(**arguments)


def test_a_field_must_be_whole_on_the_lattice_and_serve_the_order() -> None:
    field = sb.fourier_transform(TARGET, sb.Lattice(2.0, 16), order=[-4.0])
    with pytest.raises(sb.errors.LatticeError, match="fields on different lattices cannot be compared"):
        sb.fit(START, field, -4.0, lattice=sb.Lattice(2.0, 18))
    with pytest.raises(sb.errors.InputError, match="take a more negative order, or a field on a larger lattice"):
        sb.fit(START, sb.fourier_transform(TARGET, sb.Lattice(0.5, 8)), -1.0)
    broken = field.copy(deep=True)
    broken[3, 4, 5] = np.nan
    for use in (sb.fit, sb.fitting.gradient, sb.fitting.SquaredDistance.for_mesh):
        with pytest.raises(sb.errors.InputError, match="the field has 1 values that are NaN or infinite"):
            use(START, broken, -4.0)


def test_shapes_that_were_bad_before_cost_nothing_until_they_are_worse() -> None:
    sliver = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    references = lowest_free_qualities(sliver, TRIANGLE)
    value, gradient = shape_penalty(sliver, TRIANGLE, references)
    assert value == 0
    assert not gradient.any()
    assert shape_penalty(sliver * [1, 0.25, 1], TRIANGLE, references)[0] == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize(("height", "quality"), [(np.sqrt(0.75), 1.0), (0.5, 0.5 * np.sqrt(3)), (0.0, 0.0)])
def test_the_quality_of_a_triangle_and_its_penalty(height: float, quality: float) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, height, 0]])
    assert triangle_qualities(corners, TRIANGLE) == pytest.approx([quality], abs=1e-12)
    assert shape_penalty(corners, TRIANGLE, np.ones(1))[0] == pytest.approx((1 - quality) ** 2, abs=1e-12)


def test_its_derivative_is_that_of_differences() -> None:
    ball, rng, step = sb.shapes.icosphere(1), np.random.default_rng(1), 1e-6
    references = lowest_free_qualities(np.array(ball.vertices), ball.triangles)
    vertices = ball.vertices + 0.3 * rng.normal(size=ball.vertices.shape)
    direction = rng.normal(size=vertices.shape)
    value, gradient = shape_penalty(vertices, ball.triangles, references)
    ends = [shape_penalty(vertices + sign * step * direction, ball.triangles, references)[0] for sign in (1, -1)]
    assert value > 0.1
    assert np.sum(gradient * direction) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


def test_smoothing_solves_with_the_graph_laplacian() -> None:
    ball, rng = sb.shapes.icosphere(1), np.random.default_rng(2)
    mesh = sb.Mesh(ball.vertices, ball.triangles[:60])
    free = np.array([0, 2, 3, 5, 8, 13, 21])
    smoothing = Smoothing(mesh, free, 3.0)
    steps, slopes = rng.normal(size=(7, 3)), rng.normal(size=mesh.vertices.shape)
    graph = np.zeros((len(mesh.vertices),) * 2)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        graph[mesh.triangles[:, [a, b]], mesh.triangles[:, [b, a]]] = -1
    matrix = np.eye(7) + 3.0 * (graph - np.diag(graph.sum(axis=1)))[np.ix_(free, free)]
    movement = smoothing.movement(steps)
    np.testing.assert_allclose(movement[free], np.linalg.solve(matrix, steps), rtol=1e-10)
    assert not np.delete(movement, free, axis=0).any()
    assert np.sum(smoothing.pulled_back(slopes) * steps) == pytest.approx(np.sum(slopes * movement), rel=1e-10)
    without = Smoothing(mesh, free, 0.0)
    np.testing.assert_array_equal(without.movement(steps)[free], steps)


def test_narrow_integers_of_numpy_do_not_overflow() -> None:
    steps: Any = np.int8(100)
    smoothing: Any = np.float32(0.5)
    settings = FitSettings(steps=steps, smoothing=smoothing)
    assert 3 * settings.steps == 300
    assert type(settings.smoothing) is float


@pytest.mark.parametrize("wanted", [320, 321, 330, 500, 1000, 1279, 1280, 10_000])
def test_the_best_triangles_are_as_many_as_fit(wanted: int) -> None:
    edges = Edges.from_mesh(sb.shapes.icosphere(2))
    # Scores that fall from one point on, as those of a place with much detail do.
    scores = -np.linalg.norm(np.asarray(edges.mesh.vertices)[edges.mesh.triangles].mean(axis=1) - [0.1, 0.2, 1], axis=1)
    marks = module.best_edges(edges, scores, wanted)
    count = len(edges.split(marks).triangles)
    assert count == 1280 if wanted > 1280 else wanted - 20 < count <= wanted
    split = marks[edges.sides].all(axis=1)
    if 330 < wanted < 1279:
        assert np.quantile(scores[split], 0.1) > np.median(scores[~split])
    longest = edges.lengths[edges.sides].argmax(axis=1)
    touched = marks[edges.sides].any(axis=1)
    assert marks[edges.sides[np.arange(len(longest)), longest]][touched].all()


def test_triangles_do_not_become_ever_thinner() -> None:
    mesh = open_mesh()
    first = mesh.smallest_angles.min()
    rng = np.random.default_rng(5)
    for _ in range(8):
        edges = Edges.from_mesh(mesh)
        # Always near one place, where thin triangles would pile up.
        distances = np.linalg.norm(np.asarray(mesh.vertices)[mesh.triangles].mean(axis=1) - [0, 0, 1], axis=1)
        mesh = edges.split(
            module.best_edges(edges, -distances + 0.01 * rng.random(len(distances)), len(mesh.triangles) + 40)
        )
    assert mesh.smallest_angles.min() > first / 2.5
