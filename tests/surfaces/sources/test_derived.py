"""Meshes with vertices elsewhere: `moved` and `noisy` ones, and those of a `flow`, against its integrated velocity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sobolev_batch as sb
from sobolev_batch import Mesh, icosphere
from sobolev_batch.surfaces.sources.derived import carried, with_noise
from sobolev_batch.surfaces.sources.registry import parse_source
from tests.support.members import BALL, listed, loaded, members

# The ball has radius 1.
MOVED: dict[str, Any] = {"source": "moved", "mesh": BALL, "distances": [0.3, 0.1], "direction": [0, 3, 4]}
NOISY: dict[str, Any] = {"source": "noisy", "mesh": BALL, "amplitudes": [0.02, 0.01], "seed": 5}
FLOW: dict[str, Any] = {"source": "flow", "mesh": {"source": "icosphere", "levels": [2]}, "times": [0.0]}


def displacements(table: dict[str, Any]) -> list[np.ndarray]:
    start = np.asarray(icosphere(3).vertices)
    return [np.asarray(loaded(member).vertices) - start for member in members(table)]


def test_every_vertex_moves_by_a_fraction_of_the_radius() -> None:
    assert listed(members(MOVED)) == [("0.1", -1), ("0.3", -1)]
    for distance, moves in zip((0.1, 0.3), displacements(MOVED), strict=True):
        np.testing.assert_allclose(moves, np.broadcast_to([0, 0.6 * distance, 0.8 * distance], moves.shape), atol=1e-12)
    # A torus of radius 5, whose tube has corners at 60 degrees.
    torus = {"source": "torus", "R": 4, "r": 1, "levels": [0]}
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


def positions(time: float, **settings: Any) -> np.ndarray:
    (member,) = members({**FLOW, **settings, "times": [time]})
    return np.asarray(loaded(member).vertices)


def velocity(time: float, angles: np.ndarray, strength: float, period: float) -> np.ndarray:
    """The fourth case of Nair and Lauritzen, as rates of longitude and latitude."""
    longitudes, latitudes = angles.reshape(2, -1)
    turned = longitudes - 2 * np.pi * time / period
    share = np.cos(np.pi * time / period)
    east = strength * np.sin(turned) ** 2 * np.sin(2 * latitudes) * share + 2 * np.pi * np.cos(latitudes) / period
    north = strength * np.sin(2 * turned) * np.cos(latitudes) * share
    return np.concatenate([east / np.cos(latitudes), north])


@pytest.mark.parametrize(("time", "strength", "period"), [(0.7, 2.0, 5.0), (2.5, 2.0, 5.0), (3.1, 0.5, 4.0)])
def test_vertices_follow_the_velocity(time: float, strength: float, period: float) -> None:
    x, y, z = np.asarray(sb.icosphere(2).vertices).T
    # Longitudes mean nothing at the poles, which no vertex meets on its way.
    start = np.concatenate([np.arctan2(y, x), np.arcsin(z)])
    path = solve_ivp(velocity, (0, time), start, "DOP853", rtol=1e-11, atol=1e-11, args=(strength, period))
    longitudes, latitudes = path.y[:, -1].reshape(2, -1)
    expected = np.stack(
        [np.cos(latitudes) * np.cos(longitudes), np.cos(latitudes) * np.sin(longitudes), np.sin(latitudes)], axis=1
    )
    # One that passes near a pole is hard for the oracle.
    np.testing.assert_allclose(positions(time, strength=strength, period=period), expected, rtol=0, atol=1e-6)


def test_vertices_stay_on_their_sphere_and_come_back() -> None:
    mesh = {"source": "ellipsoid", "axes": [3.0, 2.0, 1.0], "levels": [2]}
    start, half, end = (positions(time, mesh=mesh) for time in (0.0, 2.5, 5.0))
    np.testing.assert_allclose(np.linalg.norm(half, axis=1), np.linalg.norm(start, axis=1), rtol=1e-14)
    assert np.abs(half - start).max() > 0.5
    np.testing.assert_allclose(end, start, rtol=0, atol=1e-14)


def test_members_are_in_the_order_of_their_times() -> None:
    found = members({**FLOW, "times": [1.5, 0, 0.25]})
    assert [(member.name, member.level, member.time) for member in found] == [
        ("0.0", -1, 0.0),
        ("0.25", -1, 0.25),
        ("1.5", -1, 1.5),
    ]


WRONG: list[tuple[dict[str, Any], str, list[Any]]] = [
    (MOVED, "distances", [[], [0.0]]),
    (MOVED, "direction", [[0, 0, 0], [1, 2]]),
    (NOISY, "amplitudes", [[-0.1], "many"]),
    (NOISY, "seed", [-1, 0.5]),
    (FLOW, "times", [[], "0, 1", [0.0, True], [1.0, 2.0, 1.0], [float("nan")]]),
    (FLOW, "period", [0.0]),
    (FLOW, "strength", [float("inf")]),
]


@pytest.mark.parametrize(("table", "key", "values"), WRONG)
def test_wrong_parameters_are_refused(table: dict[str, Any], key: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(ValueError, match=key):
            parse_source({**table, key: value})


def test_what_the_vertices_depend_on_is_in_the_fingerprint() -> None:
    changes: list[dict[str, Any]] = [{}, {"times": [0.5]}, {"strength": 1.0}, {"period": 4.0}]
    found = {members({**FLOW, **change})[0].fingerprint_digest() for change in changes}
    assert len(found) == len(changes)


def test_a_vertex_at_the_centre_stays() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]])
    np.testing.assert_array_equal(carried(points, 1.0, 5.0, 2.0)[0], 0.0)
