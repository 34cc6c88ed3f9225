"""Refinement: more triangles where they help, nearer than other meshes of as many."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.extras.fitting import fit as module
from sobolev_batch.geometry.subdivision import Edges

# A ball with a sharp bump at its top: most triangles belong there.
BALL = sb.shapes.icosphere(5)
BUMP = 1 + 0.5 * np.exp(-200 * (1 - np.asarray(BALL.vertices)[:, 2:]))
TARGET = sb.Mesh(np.asarray(BALL.vertices) * BUMP, BALL.triangles)


@pytest.mark.all
def test_the_mesh_is_nearer_than_a_fitted_ball_of_as_many_triangles() -> None:
    start = sb.shapes.icosphere(1)
    refined = sb.fitting.refine(start, TARGET, -2.0, triangles=320, steps=40)
    assert 300 < len(refined.mesh.triangles) <= 320
    even = sb.fit(sb.shapes.icosphere(2), TARGET, -2.0, steps=80)
    assert refined.after.distance < 0.8 * even.after.distance
    assert refined.before.distance == pytest.approx(sb.distance(start, TARGET, -2.0, rtol=0.02)["distance"].item())
    assert refined.steps > 40


@pytest.mark.slow
def test_the_target_can_be_a_field_alone() -> None:
    field = sb.fourier_transform(TARGET, sb.Lattice(4.0, 48))
    refined = sb.fitting.refine(sb.shapes.icosphere(1), field, -4.0, triangles=160, steps=20)
    assert 145 < len(refined.mesh.triangles) <= 160
    assert refined.after.distance < refined.before.distance / 5


@pytest.mark.slow
def test_progress_counts_all_rounds() -> None:
    seen: list[sb.fitting.FitProgress] = []
    found = sb.fitting.refine(
        sb.shapes.icosphere(0), sb.shapes.Ellipsoid((1.3, 1, 1)), -4.0, triangles=70, steps=5, on_progress=seen.append
    )
    assert [progress.step for progress in seen] == list(range(1, found.steps + 1))
    assert {progress.steps for progress in seen} == {15}


@pytest.mark.slow
def test_an_interrupt_keeps_the_best_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(progress: sb.fitting.FitProgress) -> None:
        if progress.step == 7:
            raise KeyboardInterrupt

    start, target = sb.shapes.icosphere(0), sb.shapes.Ellipsoid((1.3, 1, 1))
    found = sb.fitting.refine(start, target, -4.0, triangles=70, steps=5, on_progress=interrupt)
    assert found.end == "it was interrupted"
    assert 20 < len(found.mesh.triangles) < 70
    assert found.after.distance < found.before.distance

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module.FitRun, "_split", interrupted)
    found = sb.fitting.refine(start, target, -4.0, triangles=70, steps=5)
    assert found.end == "it was interrupted"
    assert len(found.mesh.triangles) == 20


@pytest.mark.slow
def test_vertices_at_one_place_become_one_and_boundaries_stay() -> None:
    sheet = sb.shapes.icosphere(1)
    upper = np.asarray(sheet.triangles)[np.asarray(sheet.vertices)[sheet.triangles][..., 2].mean(axis=1) > -0.3]
    soup = sb.Mesh(np.asarray(sheet.vertices)[upper].reshape(-1, 3), np.arange(3 * len(upper)).reshape(-1, 3))
    target = sb.Mesh(1.1 * np.asarray(sheet.vertices), upper)
    found = sb.fitting.refine(soup, target, -4.0, triangles=2 * len(upper), steps=5, keep_boundary=True).mesh
    assert len(found.vertices) < 3 * len(found.triangles) / 4
    edges = Edges.from_mesh(sb.Mesh(sheet.vertices, upper))
    kept = np.asarray(sheet.vertices)[np.unique(edges.ends[edges.on_boundary])]
    distances = np.linalg.norm(np.asarray(found.vertices)[:, None] - kept, axis=2).min(axis=0)
    assert distances.max() < 1e-12


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (20, "the mesh has 20 triangles already: ask for more than that, found 20"),
        (5, "the mesh has 20 triangles already"),
        *((goal, f"a whole number up to 1,000,000, found {goal}") for goal in (0, 40.0, True, 10**7)),
    ],
)
def test_goals_that_cannot_be_reached_are_refused(goal: Any, message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        sb.fitting.refine(sb.shapes.icosphere(0), sb.shapes.Sphere(), -4.0, triangles=goal)
