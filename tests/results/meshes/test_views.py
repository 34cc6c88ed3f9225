"""Sides from which pictures show meshes, and the ends of their colours."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import icosphere
from sobolev_batch.results.figures.views import FRONT, MeshView

BALL = icosphere(4)
TRIANGLES = BALL.triangles.astype(np.int32)


def view(values: np.ndarray, vertices: np.ndarray = BALL.vertices, triangles: np.ndarray = TRIANGLES) -> MeshView:
    return MeshView("a", vertices, triangles, values[None], (-2.0,), len(triangles)).towards_worst()


@pytest.mark.parametrize("sign", [1, -1])
def test_the_worst_place_is_in_front_whatever_the_orientation(sign: int) -> None:
    rng = np.random.default_rng(8)
    for place in [*rng.normal(size=(10, 3)), FRONT, -FRONT, np.array([0.0, 0.0, -1.0])]:
        place = place / np.linalg.norm(place)
        values = sign * np.exp(-30 * (1 - BALL.vertices @ place)) + 0.1
        eye = view(values, triangles=TRIANGLES[:, ::sign]).eye
        assert np.linalg.norm(eye) == pytest.approx(1)
        assert eye @ place > 0.35, place
        assert (eye == FRONT).all() or eye @ place > 0.85


def test_nothing_turns_what_is_the_same_all_around() -> None:
    assert (view(np.ones(len(BALL.vertices))).eye == FRONT).all()
    assert (view(np.zeros(len(BALL.vertices))).eye == FRONT).all()


def test_single_vertices_do_not_take_the_colours() -> None:
    values = BALL.vertices[:, 0].copy()
    assert view(values).color_limits == np.abs(values).max()
    values[:5] = 1e6
    assert view(values).color_limits == pytest.approx(0.99, abs=0.02)
    assert view(0 * values).color_limits == 1


def test_the_area_counts_and_not_the_number_of_vertices() -> None:
    # Half of the vertices lie in a ball of a hundredth of the area.
    vertices = np.vstack([BALL.vertices, 0.05 * BALL.vertices])
    triangles = np.vstack([TRIANGLES, TRIANGLES + len(BALL.vertices)])
    assert view(np.repeat([1.0, 100.0], len(BALL.vertices)), vertices, triangles).color_limits == 1
