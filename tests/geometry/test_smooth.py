"""Surfaces of one's own and their intervals: rules, derivatives, extents, and what is refused."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from scipy.special import eval_legendre

from sobolev_batch.errors import InputError
from sobolev_batch.shapes import Interval, ParametrisedSurface, Similarity, Torus
from tests.support.shapes import HALF_TURN, ROTATION, TURN, angular_ball, ball, plate, turned_torus

TORUS = Torus(1.0, 0.4)
PLATE = ParametrisedSurface(plate, Interval(-1.0, 2.0), Interval(0.0, 0.5))


@pytest.mark.parametrize(
    ("surface", "area", "lower", "upper", "radius"),
    [
        (angular_ball(), 4 * math.pi, -np.ones(3), np.ones(3), 1.0),
        # Its height is a number, which stands for a constant coordinate.
        (PLATE, 1.5, [-1.0, 0.0, 0.0], [2.0, 0.5, 0.0], math.hypot(1.5, 0.25)),
        # Along an axis it reaches as far as the torus does along that axis turned back.
        (turned_torus(TORUS), TORUS.area, -TORUS.highest_along(ROTATION), TORUS.highest_along(ROTATION), 1.4),
    ],
    ids=["ball", "plate", "torus"],
)
def test_areas_boxes_and_bounding_spheres(surface: Any, area: float, lower: Any, upper: Any, radius: float) -> None:
    assert surface.area == pytest.approx(area, rel=1e-12)
    np.testing.assert_allclose(surface.extent.box, [lower, upper], rtol=0, atol=1e-11)
    middle = np.add(lower, upper) / 2
    assert surface.bounding_sphere == (pytest.approx(middle, abs=1e-11), pytest.approx(radius, rel=1e-11))


def test_similarities_follow_each_other_and_survive_pickling() -> None:
    surface = turned_torus(TORUS)
    first, second = Similarity(2.0, (1.0, 2.0, 3.0)), Similarity(0.3, (-1.0, 0.5, 0.0))
    moved = pickle.loads(pickle.dumps(second.apply(first.apply(surface))))
    u, v = np.random.default_rng(8).uniform(0, 6, (2, 5))
    once = 2.0 * (surface.positions(u, v) - np.reshape((1.0, 2.0, 3.0), (3, 1)))
    twice = 0.3 * (once - np.reshape((-1.0, 0.5, 0.0), (3, 1)))
    assert isinstance(moved, ParametrisedSurface)
    assert moved.positions(u, v) == pytest.approx(twice, abs=1e-13)
    assert moved.area == pytest.approx(0.36 * surface.area, rel=1e-12)


SIDE, HALF = Interval(0.0, 1.0), Interval(0.0, math.pi, periodic=True)
THREE = "position must return three arrays of real numbers .* found "


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize(
    ("position", "u", "v", "message"),
    [
        (lambda u, v: (u, v), SIDE, SIDE, f"{THREE}2: float64"),
        (lambda u, v: None, SIDE, SIDE, f"{THREE}1: NoneType"),
        (lambda u, v: (u, v, 1j * u), SIDE, SIDE, f"{THREE}3: .* complex128"),
        (lambda u, v: (u, v, np.zeros(5)), SIDE, SIDE, rf"{THREE}3: .*\(5,\)"),
        (lambda u, v: u, SIDE, SIDE, rf"{THREE}1: float64 \("),
        (lambda u, v: (u, v, "height"), SIDE, SIDE, f"{THREE}3: .* str"),
        (lambda u, v: (np.where(u < 0.5, u, np.nan), v, 0.0), SIDE, SIDE, "position is not finite everywhere"),
        (lambda u, v: (1 / u, v, 0.0), SIDE, SIDE, "not finite everywhere|not smooth"),
        (lambda u, v: (u, u, u), SIDE, SIDE, "positive and finite, found 0"),
        (lambda u, v: (u, v, np.sin(1 / (u + 1e-5))), SIDE, SIDE, "not smooth, or oscillates too fast"),
        (ball, HALF_TURN, HALF, r"periodic in v, but its positions at the ends 0 and 3\.14159 are up to"),
        (ball, HALF, TURN, "periodic in u"),
        (ball, HALF_TURN, (0.0, 1.0), r"v must run over an Interval, found \(0\.0, 1\.0\)"),
    ],
)
def test_what_makes_no_smooth_surface_is_refused(position: Any, u: Any, v: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        ParametrisedSurface(position, u, v)


def test_similarities_of_surfaces_are_checked() -> None:
    with pytest.raises(InputError, match="scale must be positive"):
        ParametrisedSurface(ball, HALF_TURN, TURN, scale=0.0)
    with pytest.raises(InputError, match="origin must be three finite numbers"):
        ParametrisedSurface(ball, HALF_TURN, TURN, origin=(0.0, math.inf, 0.0))


def test_the_trapezoidal_rule_is_exact_on_waves() -> None:
    interval = Interval(-1.0, 2.0, periodic=True)
    nodes, weights = interval.rule(15)
    assert nodes[0] == -1.0
    for wave in range(15):
        exact = 3.0 if wave == 0 else 0.0
        found = np.sum(weights * np.exp(2j * np.pi * wave * (nodes + 1) / 3))
        assert abs(found - exact) < 1e-14
    # The first that the nodes cannot tell from a constant.
    assert np.sum(weights * np.cos(2 * np.pi * 15 * (nodes + 1) / 3)) == pytest.approx(3.0)


@pytest.mark.parametrize("count", [2, 8, 31, 400, 1500])
def test_gauss_legendre_is_exact_on_polynomials(count: int) -> None:
    nodes, weights = Interval(-1.0, 3.0).rule(count)
    assert -1 < nodes.min() < nodes.max() < 3
    # Legendre polynomials instead of powers, which weigh the ends alone.
    for degree in (0, 1, 2, 2 * count - 1):
        exact = 4.0 if degree == 0 else 0.0
        assert np.sum(weights * eval_legendre(degree, (nodes - 1) / 2)) == pytest.approx(exact, abs=2e-14)
    # The first that is integrated wrongly.
    assert abs(np.sum(weights * eval_legendre(2 * count, (nodes - 1) / 2))) > 1e-4


@pytest.mark.parametrize(("periodic", "count"), [(True, 41), (True, 401), (False, 60), (False, 401)])
def test_derivatives_of_resolved_functions_are_exact_to_rounding(periodic: bool, count: int) -> None:
    interval = Interval(0.5, 0.5 + math.pi, periodic)
    nodes, weights = interval.rule(count)
    values = np.stack([np.exp(np.sin(2 * nodes)), np.ones(count)])
    exact = np.stack([2 * np.cos(2 * nodes) * np.exp(np.sin(2 * nodes)), np.zeros(count)])
    for axis, turned in ((1, values), (0, values.T)):
        found = interval.derivative(turned, axis)
        errors = np.abs(np.moveaxis(found, axis, 1) - exact)
        # Weighted as in an integral: near the ends of a Gauss rule rounding is amplified, and weighs little.
        assert (errors @ weights).max() < 1e-14 * count
        assert errors[1].max() < 1e-12 * count


@pytest.mark.parametrize(
    "arguments",
    [(1, 1), (2, 1), (math.nan, 1), (0, math.inf), ("0", 1.0), (False, True), (-1e308, 1e308), (0.0, 1.0, 1)],
)
def test_an_interval_has_two_ends(arguments: tuple[Any, ...]) -> None:
    with pytest.raises(InputError, match=r"an interval|periodic must be True or False"):
        Interval(*arguments)
