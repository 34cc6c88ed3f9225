"""Meshes that are moved, and meshes with noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sobolev_batch import Mesh, icosphere
from sobolev_batch.surfaces.sources.derived.displacement import with_noise
from tests.support.members import BALL, listed, loaded, members

# The ball has radius 1.
MOVED: dict[str, Any] = {"source": "moved", "mesh": BALL, "distances": [0.3, 0.1], "direction": [0, 3, 4]}
NOISY: dict[str, Any] = {"source": "noisy", "mesh": BALL, "amplitudes": [0.02, 0.01], "seed": 5}


def displacements(table: dict[str, Any]) -> list[np.ndarray]:
    start = np.asarray(icosphere(3).vertices)
    return [np.asarray(loaded(member).vertices) - start for member in members(table)]


def test_every_vertex_moves_by_a_fraction_of_the_radius() -> None:
    assert listed(members(MOVED)) == [("0.1", -1), ("0.3", -1)]
    for distance, moves in zip((0.1, 0.3), displacements(MOVED), strict=True):
        np.testing.assert_allclose(moves, np.broadcast_to([0, 0.6 * distance, 0.8 * distance], moves.shape), atol=1e-12)
    # A torus of radius 5, whose tube has corners at 60 degrees.
    torus = {"source": "torus-grid", "R": 4, "r": 1, "levels": [0]}
    (member,) = members({**MOVED, "mesh": torus, "distances": [0.1]})
    assert loaded(member).extent.box[1][2] == pytest.approx(3**0.5 / 2 + 0.8 * 0.5)


def test_noise_is_gaussian_along_the_normals() -> None:
    small, large = displacements(NOISY)
    np.testing.assert_allclose(large, 2 * small, atol=1e-12)
    normals = np.asarray(icosphere(3).vertices)
    sizes = np.einsum("ij,ij->i", small, normals)
    # Vertices of the icosphere lie along its normals, to the accuracy of the mesh.
    assert np.abs(small - sizes[:, None] * normals).max() < 1e-3
    assert sizes.std() == pytest.approx(0.01, rel=0.1)
    assert abs(sizes.mean()) < 3 * 0.01 / np.sqrt(len(sizes))
    assert not np.allclose(displacements({**NOISY, "seed": 6})[0], small)


def test_noise_opens_no_cracks() -> None:
    ball = icosphere(1)
    corners = np.asarray(ball.vertices)[ball.triangles].reshape(-1, 3)
    torn = Mesh(corners, np.arange(len(corners)).reshape(-1, 3))
    places = np.asarray(with_noise(torn, 0.1, 0).vertices).round(12)
    assert len(np.unique(places, axis=0)) == len(ball.vertices)


@pytest.mark.parametrize(
    "change",
    [
        {"distances": []},
        {"distances": [0.0]},
        {"direction": [0, 0, 0]},
        {"direction": [1, 2]},
        {"direction": ["x", 0, 0]},
    ],
)
def test_wrong_parameters_of_moves(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        members({**MOVED, **change})


@pytest.mark.parametrize("change", [{"amplitudes": [-0.1]}, {"amplitudes": "many"}, {"seed": -1}, {"seed": 0.5}])
def test_wrong_parameters_of_noise(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        members({**NOISY, **change})
