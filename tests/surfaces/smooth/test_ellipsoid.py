"""Ellipsoids: areas, extents, how they move, and their triangulations."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipe

from sobolev_batch import Ellipsoid, InputError, Similarity, Sphere, icosphere
from sobolev_batch.surfaces.shapes.surface import DIRECTIONS
from sobolev_batch.surfaces.smooth.smooth import Smooth

AXES = [(1.0, 1.0, 1.0), (1.0, 0.7, 0.4), (0.4, 1.0, 0.7), (2.0, 2.0, 0.5), (0.3, 0.3, 1.5)]


def area_by_elliptic_integrals(a: float, b: float, c: float) -> float:
    """The area, ring by ring: each is a complete elliptic integral."""

    def ring(t: float) -> float:
        first = c**2 * (1 - t * t) * b**2 + (a * b * t) ** 2
        second = c**2 * (1 - t * t) * a**2 + (a * b * t) ** 2
        return float(4 * math.sqrt(first) * ellipe(1 - second / first))

    return float(2 * quad(ring, 0, 1, epsabs=0, epsrel=1e-13)[0])


@pytest.mark.parametrize("axes", AXES)
def test_the_area_is_the_elliptic_integral_and_that_of_the_nodes(axes: tuple[float, float, float]) -> None:
    ellipsoid = Ellipsoid(axes, (5.0, -1.0, 2.0))
    assert ellipsoid.area == pytest.approx(area_by_elliptic_integrals(*axes), rel=1e-12)
    assert ellipsoid.area == pytest.approx(Smooth.area.func(ellipsoid), rel=1e-12)  # type: ignore[attr-defined]


def test_the_area_of_a_sphere_and_of_a_flat_one() -> None:
    assert Ellipsoid((3.0, 3.0, 3.0)).area == pytest.approx(Sphere(3.0).area, rel=1e-15)
    assert Ellipsoid((1.0, 1.0, 1e-9)).area == pytest.approx(2 * math.pi, rel=1e-12)
    assert Ellipsoid((1e120, 1e120, 1e120)).area == pytest.approx(4 * math.pi * 1e240, rel=1e-14)


@pytest.mark.parametrize("axes", AXES)
def test_extents_are_those_that_the_points_reach(axes: tuple[float, float, float]) -> None:
    ellipsoid = Ellipsoid(axes, (0.1, -0.2, 0.3))
    assert ellipsoid.highest_along(DIRECTIONS) == pytest.approx(Smooth.highest_along(ellipsoid, DIRECTIONS), abs=1e-11)
    lower, upper = ellipsoid.bounds
    assert lower == pytest.approx(np.array(ellipsoid.center) - axes, abs=1e-15)
    assert upper == pytest.approx(np.array(ellipsoid.center) + axes, abs=1e-15)
    center, radius = Smooth.bounding_sphere.fget(ellipsoid)  # type: ignore[attr-defined]
    assert (center, radius) == (pytest.approx(ellipsoid.center, abs=1e-15), pytest.approx(max(axes), rel=1e-11))
    assert ellipsoid.bounding_sphere == (ellipsoid.center, max(axes))


def test_the_derivatives_are_those_of_the_positions() -> None:
    ellipsoid = Ellipsoid((1.0, 0.7, 0.4), (0.1, -0.2, 0.3))
    u, v = np.random.default_rng(3).uniform((-0.9, 0.0), (0.9, 6.0), (20, 2)).T
    step = 1e-5
    for given, (du, dv) in zip(ellipsoid.tangents(u, v), ((step, 0.0), (0.0, step)), strict=True):
        difference = (ellipsoid.positions(u + du, v + dv) - ellipsoid.positions(u - du, v - dv)) / (2 * step)
        assert given == pytest.approx(difference, abs=1e-7)


def test_a_similarity_moves_it() -> None:
    ellipsoid = Ellipsoid((2.0, 4.0, 1.0), (1.0, 2.0, 3.0))
    assert Similarity(0.5, (1.0, 0.0, 1.0)).apply(ellipsoid) == Ellipsoid((1.0, 2.0, 0.5), (0.0, 1.0, 1.0))
    assert Similarity.to_unit_ball(ellipsoid) == Similarity(0.25, (1.0, 2.0, 3.0))
    assert Similarity().apply(ellipsoid) is ellipsoid


def test_its_meshes_are_stretched_icospheres() -> None:
    ellipsoid = Ellipsoid((1.0, 0.7, 0.4), (0.1, -0.2, 0.3))
    mesh = ellipsoid.mesh(2)
    radii = (mesh.vertices - ellipsoid.center) / ellipsoid.axes
    assert np.linalg.norm(radii, axis=1) == pytest.approx(np.ones(162), rel=1e-14)
    assert np.array_equal(mesh.triangles, icosphere(2).triangles)
    gaps = [ellipsoid.area - ellipsoid.mesh(level).area for level in (2, 3, 4)]
    assert gaps[1] / gaps[2] == pytest.approx(4, rel=0.02)
    assert gaps[0] > gaps[1] > gaps[2] > 0


def test_ellipsoids_are_values() -> None:
    ellipsoid = Ellipsoid((3, 2, 1))
    assert pickle.loads(pickle.dumps(ellipsoid)) == ellipsoid == Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.0, 0.0))
    assert hash(ellipsoid) == hash(Ellipsoid((3.0, 2.0, 1.0)))


@pytest.mark.parametrize(
    "axes",
    [(1.0, 1.0), (1.0, 1.0, 0.0), (1.0, -1.0, 1.0), (1.0, math.nan, 1.0), (1.0, math.inf, 1.0), (1.0, True, 1.0)],
)
def test_semi_axes_must_be_positive_and_finite(axes: Any) -> None:
    with pytest.raises(InputError, match="three positive finite numbers"):
        Ellipsoid(axes)


def test_semi_axes_and_centers_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="between 1e-150 and 1e\\+150"):
        Ellipsoid((1.0, 1.0, 1e200))
    with pytest.raises(InputError, match="center must be three finite numbers"):
        Ellipsoid((1.0, 1.0, 1.0), (0.0, math.nan, 0.0))
