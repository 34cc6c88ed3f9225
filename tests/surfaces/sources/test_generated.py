"""The sources of generated surfaces: what they make, and what identifies it."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from sobolev_batch import Ellipsoid, Sphere, Torus, icosphere
from sobolev_batch.surfaces.sources.registry import ExpectedSize
from tests.support.members import listed, loaded, members

BALL: dict[str, Any] = {"source": "sphere", "radius": 2, "center": [1, 2.5, -3]}
EGG: dict[str, Any] = {"source": "ellipsoid", "axes": [3, 2, 1], "center": [0.0, 0.5, 0.0]}
RING: dict[str, Any] = {"source": "torus", "R": 2, "r": 0.5, "center": [0.0, 0.5, 0.0]}


def identity(table: dict[str, Any], member: int = 0) -> str:
    """The fingerprint of a member, as it enters keys."""
    return json.dumps(dict(members(table)[member].fingerprint()), sort_keys=True)


def test_smooth_surfaces_are_one_member_each() -> None:
    (ball,), (egg,), (ring,) = members(BALL), members(EGG), members(RING)
    assert listed((ball, egg, ring)) == [("sphere", -1), ("ellipsoid", -1), ("torus", -1)]
    assert ball.load() == Sphere(2.0, (1.0, 2.5, -3.0))
    assert ball.fingerprint() == {"sphere": [2.0, 1.0, 2.5, -3.0]}
    assert egg.load() == Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.5, 0.0))
    assert ring.load() == Torus(2.0, 0.5, (0.0, 0.5, 0.0))
    assert egg.fingerprint() == {"ellipsoid": [3.0, 2.0, 1.0, 0.0, 0.5, 0.0]}
    assert ring.fingerprint() == {"torus": [2.0, 0.5, 0.0, 0.5, 0.0]}
    assert egg.expected_size() == ring.expected_size() == ExpectedSize()


def test_icospheres_go_from_coarse_to_fine_and_once_each() -> None:
    found = members({"source": "icosphere", "levels": [3, 0, 10, 3, 2]})
    assert listed(found) == [("0", 0), ("2", 2), ("3", 3), ("10", 10)]
    assert loaded(found[1]).digest == icosphere(2).digest
    assert found[1].fingerprint() == {"icosphere": 2}


def test_levels_of_an_ellipsoid() -> None:
    found = members({**EGG, "source": "ellipsoid", "levels": [3, 1, 1]})
    assert listed(found) == [("1", 1), ("3", 3)]
    assert loaded(found[1]).digest == Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.5, 0.0)).mesh(3).digest
    assert found[1].expected_size().triangles == len(loaded(found[1]).triangles)


def test_levels_of_a_torus() -> None:
    found = members({**RING, "source": "torus", "levels": [2, 0], "around": 10, "across": 4})
    assert listed(found) == [("0", 0), ("2", 2)]
    assert loaded(found[0]).digest == Torus(2.0, 0.5, (0.0, 0.5, 0.0)).mesh(10, 4).digest
    assert loaded(found[1]).digest == Torus(2.0, 0.5, (0.0, 0.5, 0.0)).mesh(40, 16).digest
    assert found[1].expected_size().triangles == len(loaded(found[1]).triangles)
    usual = members({**RING, "source": "torus", "levels": [0]})
    assert len(loaded(usual[0]).triangles) == 2 * 12 * 6


@pytest.mark.parametrize("table", [EGG, {**EGG, "levels": [1]}, RING, {**RING, "levels": [1]}], ids=str)
def test_every_parameter_is_part_of_the_fingerprint(table: dict[str, Any]) -> None:
    changes: list[dict[str, Any]] = [{"center": [0.0, 0.0, 0.5]}]
    changes += (
        [{"axes": axes} for axes in ([3, 1, 2], [3, 2, 1.0000001])] if "axes" in table else [{"R": 3}, {"r": 0.6}]
    )
    changes += [{"levels": [2]}] if "levels" in table else []
    changes += [{"around": 13}, {"across": 7}] if {"R", "levels"} <= set(table) else []
    found = [identity(table), *(identity({**table, **change}) for change in changes)]
    assert len(set(found)) == len(found)
    assert identity(dict(table)) == found[0]


def test_parameters_that_make_no_surface_say_why() -> None:
    with pytest.raises(ValidationError, match=r"0 < r < R, found R = 1\.0 and r = 1\.5"):
        members({"source": "torus", "R": 1.0, "r": 1.5})
    with pytest.raises(ValidationError, match="between 1e-150 and"):
        members({"source": "ellipsoid", "axes": [1.0, 1.0, 1e-200]})
    with pytest.raises(ValidationError, match="level 12 of 12 x 6 cells has 2415919104 triangles, at most 1000000000"):
        members({"source": "torus", "R": 1.0, "r": 0.5, "levels": [12]})
