"""Spheres in closed form."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest

from sobolev_batch import InputError, Sphere


@pytest.mark.parametrize(("radius", "area"), [(1.0, 12.566370614359172), (0.5, math.pi), (10, 1256.6370614359173)])
def test_the_area_grows_with_the_squared_radius(radius: float, area: float) -> None:
    assert Sphere(radius).area == pytest.approx(area, rel=1e-15)
    assert Sphere(radius, (5.0, -6.0, 7.0)).area == Sphere(radius).area


@pytest.mark.parametrize("radius", [0, 0.0, -1.0, math.nan, math.inf, -math.inf])
def test_a_radius_must_be_positive_and_finite(radius: float) -> None:
    with pytest.raises(InputError, match="radius must be positive and finite"):
        Sphere(radius)


@pytest.mark.parametrize(
    "center", [(0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (), (math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf)]
)
def test_a_center_must_be_three_finite_numbers(center: Any) -> None:
    with pytest.raises(InputError, match="center must be three finite numbers"):
        Sphere(1.0, center)


def test_numbers_of_any_kind_become_floats() -> None:
    given: Any = np.array([1, 2, 3], dtype=np.int8)
    radius: Any = np.float32(2)
    sphere = Sphere(radius, given)
    assert sphere == Sphere(2.0, (1.0, 2.0, 3.0))
    assert type(sphere.radius) is float
    assert type(sphere.center) is tuple
    assert [type(x) for x in sphere.center] == [float] * 3
    assert hash(sphere) == hash(Sphere(2.0, (1.0, 2.0, 3.0)))


def test_spheres_are_values() -> None:
    sphere: Any = Sphere(0.1, (1 / 3, -0.0, 1e-300))
    again = pickle.loads(pickle.dumps(sphere))
    assert again == sphere
    assert math.copysign(1, again.center[1]) == -1
    with pytest.raises(FrozenInstanceError):
        sphere.radius = 2.0
