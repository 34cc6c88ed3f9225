"""Spheres, ellipsoids and tori: areas, extents, how they move, and their triangulations."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipe

from sobolev_batch import Mesh
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.geometry.surface import DIRECTIONS
from sobolev_batch.shapes import Ellipsoid, Similarity, Sphere, Torus, icosphere
from tests.support.shapes import mesh_counts

EGG = Ellipsoid((1.0, 0.7, 0.4), (0.1, -0.2, 0.3))
TORUS = Torus(1.0, 0.4, (0.1, -0.2, 0.3))
AXES = [(1.0, 1.0, 1.0), (1.0, 0.7, 0.4), (0.4, 1.0, 0.7), (2.0, 2.0, 0.5), (0.3, 0.3, 1.5)]
# Surfaces with half the sides of their boxes, and the radii of their bounding spheres.
PLACED = [(Ellipsoid(axes, EGG.center), axes, max(axes)) for axes in AXES] + [(TORUS, (1.4, 1.4, 0.4), 1.4)]


def area_by_elliptic_integrals(a: float, b: float, c: float) -> float:
    """The area, ring by ring: each is a complete elliptic integral."""

    def ring(t: float) -> float:
        first = c**2 * (1 - t * t) * b**2 + (a * b * t) ** 2
        second = c**2 * (1 - t * t) * a**2 + (a * b * t) ** 2
        return float(4 * math.sqrt(first) * ellipe(1 - second / first))

    return float(2 * quad(ring, 0, 1, epsabs=0, epsrel=1e-13)[0])


def volume(mesh: Mesh) -> float:
    """Signed, positive where triangles face outwards."""
    a, b, c = mesh.corners()
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("surface", "area"),
    [
        *((Ellipsoid(axes, (5.0, -1.0, 2.0)), area_by_elliptic_integrals(*axes)) for axes in AXES),
        *((Torus(*radii), 4 * math.pi**2 * radii[0] * radii[1]) for radii in ((1.0, 0.4), (3.0, 0.2), (1.0, 0.95))),
    ],
)
def test_the_area_is_the_closed_form_and_that_of_the_nodes(surface: Smooth, area: float) -> None:
    assert surface.area == pytest.approx(area, rel=1e-12)
    assert surface.area == pytest.approx(Smooth.area.func(surface), rel=1e-12)  # type: ignore[attr-defined]


def test_areas_of_spheres_and_of_extreme_ellipsoids() -> None:
    assert Sphere(10, (5.0, -6.0, 7.0)).area == pytest.approx(1256.6370614359173, rel=1e-15)
    assert Ellipsoid((3.0, 3.0, 3.0)).area == pytest.approx(Sphere(3.0).area, rel=1e-15)
    assert Ellipsoid((1.0, 1.0, 1e-9)).area == pytest.approx(2 * math.pi, rel=1e-12)
    assert Ellipsoid((1e120, 1e120, 1e120)).area == pytest.approx(4 * math.pi * 1e240, rel=1e-14)


@pytest.mark.parametrize(("surface", "halves", "radius"), PLACED)
def test_extents_are_those_that_the_points_reach(surface: Any, halves: Any, radius: float) -> None:
    assert surface.highest_along(DIRECTIONS) == pytest.approx(Smooth.highest_along(surface, DIRECTIONS), abs=1e-11)
    lower, upper = surface.extent.box
    assert lower == pytest.approx(np.subtract(surface.center, halves), abs=1e-15)
    assert upper == pytest.approx(np.add(surface.center, halves), abs=1e-15)
    by_points = Smooth.bounding_sphere.fget(surface)  # type: ignore[attr-defined]
    assert by_points == (pytest.approx(surface.center, abs=1e-15), pytest.approx(radius, rel=1e-11))
    assert surface.bounding_sphere == (surface.center, pytest.approx(radius, rel=1e-15))


@pytest.mark.parametrize(("surface", "most"), [(EGG, 0.9), (TORUS, 6.0)])
def test_the_derivatives_are_those_of_the_positions(surface: Any, most: float) -> None:
    u, v = np.random.default_rng(3).uniform((-most, 0.0), (most, 6.0), (20, 2)).T
    step = 1e-5
    for given, (du, dv) in zip(surface.tangents(u, v), ((step, 0.0), (0.0, step)), strict=True):
        difference = (surface.positions(u + du, v + dv) - surface.positions(u - du, v - dv)) / (2 * step)
        assert given == pytest.approx(difference, abs=1e-7)


def test_a_similarity_moves_them() -> None:
    ellipsoid = Ellipsoid((2.0, 4.0, 1.0), (1.0, 2.0, 3.0))
    assert Similarity(0.5, (1.0, 0.0, 1.0)).apply(ellipsoid) == Ellipsoid((1.0, 2.0, 0.5), (0.0, 1.0, 1.0))
    assert Similarity.to_unit_ball(ellipsoid) == Similarity(0.25, (1.0, 2.0, 3.0))
    assert Similarity().apply(ellipsoid) is ellipsoid
    moved = Similarity(2.0, (0.1, 0.3, 0.3)).apply(TORUS)
    assert isinstance(moved, Torus)
    assert (moved.R, moved.r) == (2.0, 0.8)
    assert moved.center == pytest.approx((0.0, -1.0, 0.0), abs=1e-15)
    assert Similarity.to_unit_ball(TORUS) == Similarity(1 / 1.4, TORUS.center)


def test_meshes_of_ellipsoids_are_stretched_icospheres() -> None:
    mesh = EGG.mesh(2)
    radii = (mesh.vertices - EGG.center) / EGG.axes
    assert np.linalg.norm(radii, axis=1) == pytest.approx(np.ones(162), rel=1e-14)
    assert np.array_equal(mesh.triangles, icosphere(2).triangles)
    gaps = [EGG.area - EGG.mesh(level).area for level in (2, 3, 4)]
    assert gaps[1] / gaps[2] == pytest.approx(4, rel=0.02)
    assert gaps[0] > gaps[1] > gaps[2] > 0


def test_grids_of_tori_are_closed_and_face_outwards() -> None:
    mesh = TORUS.mesh(12, 6)
    assert (len(mesh.vertices), len(mesh.triangles)) == (72, 144)
    assert mesh.counts == mesh_counts(0, 0, 0, 0, euler=0)
    # Neighbours run along a shared edge in opposite directions.
    edges = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(edges, axis=0)) == len(edges)
    exact = 2 * math.pi**2 * 0.4**2
    gaps = [exact - volume(TORUS.mesh(12 << k, 6 << k)) for k in (1, 2, 3)]
    assert gaps[0] > gaps[1] > gaps[2] > 0
    assert gaps[1] / gaps[2] == pytest.approx(4, rel=0.02)


NOT_POSITIVE = (0, 0.0, -1.0, math.nan, math.inf, -math.inf)
NO_POINTS: list[tuple[float, ...]] = [(0.0, 0.0), (0.0,) * 4, (), (math.nan, 0.0, 0.0), (0.0, 0.0, -math.inf)]


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        *(
            (Ellipsoid, (axes,), "three (finite numbers|numbers between 1e-150 and 1e\\+150)")
            for axes in ((1.0, 1.0), (1.0, 1.0, 0.0), (1.0, math.nan, 1.0), (1.0, math.inf, 1.0), (1.0, True, 1.0))
        ),
        (Ellipsoid, ((1.0, 1.0, 1e200),), "three numbers between"),
        (Ellipsoid, ((1.0, 1.0, 1.0), (0.0, math.nan, 0.0)), "center must be three finite numbers"),
        *(
            (Torus, radii, "0 < r < R")
            for radii in ((1.0, 1.0), (1.0, 0.0), (1.0, -0.4), (math.inf, 1.0), (1.0, math.nan), (True, 0.5))
        ),
        (Torus, (1e200, 1.0), "0 < r < R, R at most 1e\\+150"),
        (Torus, (1.0, 0.4, (0.0, 0.0)), "center must be three finite numbers"),
        *((Sphere, (x,), "radius must be positive, at most 1e\\+150") for x in NOT_POSITIVE),
        *((Similarity, (x,), "scale must be positive and finite") for x in NOT_POSITIVE),
        *((Sphere, (1.0, point), "center must be three finite numbers") for point in NO_POINTS),
        *((Similarity, (1.0, point), "origin must be three finite numbers") for point in NO_POINTS),
        *((TORUS.mesh, counts, "at least 3 cells") for counts in ((2, 6), (12, 2), (12, True), (12.0, 6))),
        (TORUS.mesh, (10**5, 10**5), "at most 1000000000 triangles"),
        *((icosphere, (level,), "an integer from 0 to 12, found") for level in (-1, 13, 10**9, 1.0, "1", True, None)),
    ],
)
def test_what_makes_no_surface_is_refused(kind: Any, arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        kind(*arguments)


ANY_NUMBERS: Any = np.float32(2), np.array([1, 2, 3], dtype=np.int8)


@pytest.mark.parametrize(
    ("surface", "same"),
    [
        (Ellipsoid((3, 2, 1)), Ellipsoid((3.0, 2.0, 1.0), (0.0, 0.0, 0.0))),
        (Torus(1), Torus()),
        (Sphere(*ANY_NUMBERS), Sphere(2.0, (1.0, 2.0, 3.0))),
        (Sphere(0.1, (1 / 3, -0.0, 1e-300)), Sphere(0.1, (1 / 3, -0.0, 1e-300))),
    ],
)
def test_they_are_values(surface: Any, same: Any) -> None:
    again = pickle.loads(pickle.dumps(surface))
    assert again == surface == same
    assert [math.copysign(1, x) for x in again.center] == [math.copysign(1, x) for x in surface.center]
    assert hash(surface) == hash(same)
    assert {type(x) for x in surface.center} == {float}
    assert surface not in (EGG, TORUS, Sphere())
    with pytest.raises(FrozenInstanceError):
        surface.center = (0.0, 0.0, 0.0)
