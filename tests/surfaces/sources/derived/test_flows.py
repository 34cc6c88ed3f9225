"""The source `flow`, against the velocity of the paper, integrated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sobolev_batch as sb
from sobolev_batch.surfaces.sources.derived.flows import carried
from sobolev_batch.surfaces.sources.registry import parse_source
from tests.support.members import loaded, members

FLOW: dict[str, Any] = {"source": "flow", "mesh": {"source": "icosphere", "levels": [2]}, "times": [0.0]}


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
    mesh = {"source": "ellipsoid-levels", "axes": [3.0, 2.0, 1.0], "levels": [2]}
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times": []}, r"must be a list of numbers, such as \[0.0, 0.5, 1.0\]"),
        ({"times": "0, 1"}, "must be a list of numbers"),
        ({"times": [0.0, True]}, "each time must be a finite number, found True among them"),
        ({"times": [1.0, 2.0, 1.0]}, "each time can be there once, found 1 again"),
        ({"times": [float("nan")]}, "each time must be a finite number, found nan among them"),
        ({"period": 0.0}, "period"),
        ({"strength": float("inf")}, "strength"),
    ],
)
def test_settings_are_checked(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_source({**FLOW, **change})


def test_what_the_vertices_depend_on_is_in_the_fingerprint() -> None:
    changes: list[dict[str, Any]] = [{}, {"times": [0.5]}, {"strength": 1.0}, {"period": 4.0}]
    found = {members({**FLOW, **change})[0].fingerprint_digest() for change in changes}
    assert len(found) == len(changes)


def test_a_vertex_at_the_centre_stays() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]])
    np.testing.assert_array_equal(carried(points, 1.0, 5.0, 2.0)[0], 0.0)


def test_the_flow_needs_one_mesh() -> None:
    with pytest.raises(sb.StudyError, match="exactly one surface is needed here, but the source makes 2"):
        members({**FLOW, "mesh": {"source": "icosphere", "levels": [1, 2]}})
    (member,) = members({**FLOW, "mesh": {"source": "sphere"}})
    with pytest.raises(sb.MeshError, match="sphere is no mesh"):
        member.load()
