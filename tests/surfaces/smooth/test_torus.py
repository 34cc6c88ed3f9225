"""Tori: areas, extents, how they move, and their grids of triangles."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest

from sobolev_batch import InputError, Mesh, Similarity, Torus
from sobolev_batch.surfaces.shapes.surface import DIRECTIONS
from sobolev_batch.surfaces.smooth.smooth import Smooth

TORUS = Torus(1.0, 0.4, (0.1, -0.2, 0.3))


def volume(mesh: Mesh) -> float:
    """Signed, positive where triangles face outwards."""
    a, b, c = mesh.corners()
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("radii", [(1.0, 0.4), (3.0, 0.2), (1.0, 0.95)])
def test_the_area_is_the_closed_form_and_that_of_the_nodes(radii: tuple[float, float]) -> None:
    torus = Torus(*radii)
    assert torus.area == 4 * math.pi**2 * radii[0] * radii[1]
    assert torus.area == pytest.approx(Smooth.area.func(torus), rel=1e-13)  # type: ignore[attr-defined]


def test_extents_are_those_that_the_points_reach() -> None:
    assert TORUS.highest_along(DIRECTIONS) == pytest.approx(Smooth.highest_along(TORUS, DIRECTIONS), abs=1e-11)
    lower, upper = TORUS.bounds
    assert (upper - lower) / 2 == pytest.approx([1.4, 1.4, 0.4], rel=1e-15)
    assert (upper + lower) / 2 == pytest.approx(TORUS.center, abs=1e-15)
    center, radius = Smooth.bounding_sphere.fget(TORUS)  # type: ignore[attr-defined]
    assert (center, radius) == (pytest.approx(TORUS.center, abs=1e-15), pytest.approx(1.4, rel=1e-11))


def test_the_derivatives_are_those_of_the_positions() -> None:
    u, v = np.random.default_rng(3).uniform(0, 6, (2, 20))
    step = 1e-5
    for given, (du, dv) in zip(TORUS.tangents(u, v), ((step, 0.0), (0.0, step)), strict=True):
        difference = (TORUS.positions(u + du, v + dv) - TORUS.positions(u - du, v - dv)) / (2 * step)
        assert given == pytest.approx(difference, abs=1e-9)


def test_a_similarity_moves_it() -> None:
    moved = Similarity(2.0, (0.1, 0.3, 0.3)).apply(TORUS)
    assert isinstance(moved, Torus)
    assert (moved.R, moved.r) == (2.0, 0.8)
    assert moved.center == pytest.approx((0.0, -1.0, 0.0), abs=1e-15)
    assert Similarity.to_unit_ball(TORUS) == Similarity(1 / 1.4, TORUS.center)


def test_its_grids_are_closed_and_face_outwards() -> None:
    mesh = TORUS.mesh(12, 6)
    assert (len(mesh.vertices), len(mesh.triangles)) == (72, 144)
    counts = mesh.counts
    assert (counts.zero_area, counts.duplicate, counts.boundary_edges, counts.nonmanifold_edges) == (0, 0, 0, 0)
    # Neighbours run along a shared edge in opposite directions.
    edges = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(edges, axis=0)) == len(edges)
    exact = 2 * math.pi**2 * 0.4**2
    gaps = [exact - volume(TORUS.mesh(12 << k, 6 << k)) for k in (1, 2, 3)]
    assert gaps[0] > gaps[1] > gaps[2] > 0
    assert gaps[1] / gaps[2] == pytest.approx(4, rel=0.02)


def test_tori_are_values() -> None:
    assert pickle.loads(pickle.dumps(TORUS)) == TORUS
    assert len({TORUS, Torus(1, 0.4, (0.1, -0.2, 0.3)), Torus()}) == 2


@pytest.mark.parametrize(
    ("R", "r"), [(1.0, 1.0), (1.0, 1.2), (1.0, 0.0), (1.0, -0.4), (math.inf, 1.0), (1.0, math.nan), (True, 0.5)]
)
def test_radii_must_make_a_ring(R: Any, r: Any) -> None:
    with pytest.raises(InputError, match="0 < r < R"):
        Torus(R, r)


def test_radii_and_centers_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="at most 1e\\+150"):
        Torus(1e200, 1.0)
    center: Any = (0.0, 0.0)
    with pytest.raises(InputError, match="center must be three finite numbers"):
        Torus(1.0, 0.4, center)


def test_grids_need_cells() -> None:
    for counts in ((2, 6), (12, 2), (12, True), (12.0, 6)):
        around, across = counts
        with pytest.raises(InputError, match="at least 3 cells each way"):
            TORUS.mesh(around, across)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="at most 1000000000 triangles"):
        TORUS.mesh(10**5, 10**5)
