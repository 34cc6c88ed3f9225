"""Clusters and maps of points whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from sobolev_batch.results.figures.embedding import Embedding, clustered_order


def test_groups_stand_together() -> None:
    places = np.array([0.0, 10.0, 0.2, 10.1, 0.1, 9.9])[:, None]
    order = clustered_order(cdist(places, places))
    sorted_places = places[order, 0]
    assert (np.diff(sorted_places) > 0).all() or (np.diff(sorted_places) < 0).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_meshes(count: int) -> None:
    places = np.arange(count, dtype=float)[:, None]
    distances = cdist(places, places) if count else np.zeros((0, 0))
    assert clustered_order(distances).tolist() == list(range(count))
    assert Embedding.of(distances).points.shape == (count, 2)


def test_a_plane_is_found_again() -> None:
    rng = np.random.default_rng(3)
    points = np.zeros((20, 5))
    points[:, :2] = rng.normal(size=(20, 2)) * [3, 1]
    turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    distances = cdist(points @ turn, points @ turn)
    found = Embedding.of(distances)
    assert np.allclose(cdist(found.points, found.points), distances, atol=1e-12)
    assert found.explained == pytest.approx(1.0)
    assert found.points[:, 0].var() >= found.points[:, 1].var()


def test_a_map_never_exaggerates() -> None:
    points = np.random.default_rng(4).normal(size=(15, 6))
    distances = cdist(points, points)
    found = Embedding.of(distances)
    assert (cdist(found.points, found.points) <= distances + 1e-12).all()
    assert 0.3 < found.explained < 1


def test_equal_meshes_have_no_variance() -> None:
    assert np.isnan(Embedding.of(np.zeros((4, 4))).explained)
