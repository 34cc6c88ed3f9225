"""Sides from which pictures show meshes, and the ends of their colours."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import icosphere
from sobolev_batch.results.meshes.viewpoint import FRONT, best_viewpoint, color_limit, seen_of_worst

BALL = icosphere(4)
TRIANGLES = BALL.triangles.astype(np.int32)


def viewed(vertices: np.ndarray, triangles: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The direction to the viewer of a mesh with these values."""
    limits = np.array([color_limit(vertices, triangles, values)])
    return best_viewpoint(seen_of_worst(vertices, triangles, values[None], limits)).direction


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1, -1])
def test_the_worst_place_is_in_front(sign: int) -> None:
    rng = np.random.default_rng(8)
    for place in rng.normal(size=(10, 3)):
        place /= np.linalg.norm(place)
        values = sign * np.exp(-30 * (1 - BALL.vertices @ place)) + 0.1
        assert viewed(BALL.vertices, TRIANGLES, values) @ place > 0.7, place


def test_nothing_turns_what_is_the_same_all_around() -> None:
    assert (viewed(BALL.vertices, TRIANGLES, np.ones(len(BALL.vertices))) == FRONT.direction).all()
    assert (viewed(BALL.vertices, TRIANGLES, np.zeros(len(BALL.vertices))) == FRONT.direction).all()
    assert FRONT.direction == pytest.approx(np.array([1.25, -1.4, 0.8]) / np.linalg.norm([1.25, -1.4, 0.8]))
    assert str(FRONT) == ""


def test_a_place_that_something_hides_is_seen_from_where_nothing_does() -> None:
    # A small ball, red towards the front, and between it and the viewer there a larger one.
    front = FRONT.direction
    vertices = np.vstack([0.3 * BALL.vertices, BALL.vertices + 2 * front])
    triangles = np.vstack([TRIANGLES, TRIANGLES + len(BALL.vertices)])
    values = np.concatenate([np.exp(-4 * (1 - BALL.vertices @ front)), np.zeros(len(BALL.vertices))])
    eye = viewed(vertices, triangles, values)
    assert 0.2 < eye @ front < 0.9


def test_single_vertices_do_not_take_the_colours() -> None:
    values = BALL.vertices[:, 0].copy()
    assert color_limit(BALL.vertices, TRIANGLES, values) == np.abs(values).max()
    values[:5] = 1e6
    assert color_limit(BALL.vertices, TRIANGLES, values) == pytest.approx(0.99, abs=0.02)
    assert color_limit(BALL.vertices, TRIANGLES, 0 * values) == 1


def test_the_area_counts_and_not_the_number_of_vertices() -> None:
    # Half of the vertices lie in a ball of a hundredth of the area.
    vertices = np.vstack([BALL.vertices, 0.05 * BALL.vertices])
    triangles = np.vstack([TRIANGLES, TRIANGLES + len(BALL.vertices)])
    values = np.repeat([1.0, 100.0], len(BALL.vertices))
    assert color_limit(vertices, triangles, values) == 1
