"""Norms and distances to an accuracy, what it allows, and the lattices that follow from it."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.norms.accuracy.problem import Problem, support_of
from sobolev_batch.norms.accuracy.solve import run_pilot
from sobolev_batch.norms.accuracy.tolerance import Accuracy, first_lattice
from sobolev_batch.norms.budget import Support
from sobolev_batch.norms.estimate import NormEstimate
from tests.support.shapes import CENTRED_BOX as BOX
from tests.support.shapes import tetrahedron


@pytest.mark.parametrize(
    ("order", "rtol"),
    [
        *((order, 1e-2) for order in (-0.6, -1.0, -1.5, -2.0, -3.0)),
        *((-3.0, 1e-4), (-5.0, 1e-3), (-5.0, 1e-6), (-10.0, 1e-9)),
    ],
)
def test_spheres_are_as_far_apart_as_their_closed_form_says(order: float, rtol: float) -> None:
    a, b = sb.shapes.Sphere(0.8, (0.2, 0.0, 0.0)), sb.shapes.Sphere(0.7, (-0.2, 0.1, 0.0))
    exact = sb.distance(a, b, order)["distance"].item()
    dataset = sb.distance(a, b, order, rtol=rtol)
    assert dataset["within"].item()
    assert abs(dataset["distance"].item() - exact) <= dataset["error"].item() <= rtol * dataset["distance"].item()
    exact, found = sb.norm(a, order)["norm"].item(), sb.norm(a, order, rtol=rtol)
    assert abs(found["norm"].item() - exact) <= found["error"].item() <= rtol * found["norm"].item()


@pytest.mark.slow
def test_the_papers_finest_icosphere_but_one_to_five_digits() -> None:
    dataset = sb.distance(sb.shapes.icosphere(6), sb.shapes.Sphere(), -10.0, rtol=1e-5)
    relative = dataset["distance"].item() / sb.norm(sb.shapes.Sphere(), -10.0)["norm"].item()
    assert relative == pytest.approx(7.383836e-05, rel=1e-5)
    # Far fewer points than the paper's 64 a triangle, on a lattice beyond which nothing can hide.
    assert dataset.attrs["M"] <= 150
    assert dataset.attrs["points"][0] <= 6 * 81_920
    assert dataset.attrs["rtol"] == 1e-5


def test_several_orders_share_what_the_most_demanding_needs() -> None:
    box = sb.Mesh(0.9 * BOX.vertices, BOX.triangles)
    together = sb.distance(BOX, box, [-3.0, -10.0], rtol=1e-3)
    assert together["within"].all()
    assert together["within"].dims == ("order",)
    alone = sb.distance(BOX, box, -10.0, rtol=1e-3)
    assert alone.attrs["xi_max"] < together.attrs["xi_max"]
    difference = abs(together["distance"].values[1] - alone["distance"].item())
    assert difference <= together["error"].values[1] + alone["error"].item()


def test_low_accuracy_is_computed_in_single_precision() -> None:
    assert sb.distance(sb.shapes.icosphere(1), sb.shapes.Sphere(), -5.0, rtol=1e-2).attrs["dtype"] == "complex64"
    assert sb.distance(sb.shapes.icosphere(1), sb.shapes.Sphere(), -5.0, rtol=1e-6).attrs["dtype"] == "complex128"


@pytest.mark.slow
def test_what_is_out_of_reach_is_refused_with_what_can_be_had() -> None:
    pair = sb.shapes.icosphere(0), sb.shapes.icosphere(1)
    with pytest.raises(
        sb.errors.AccuracyError,
        match=r"rtol 1e-06 is out of reach at order -2 within 0\.6 GB .* about .* on one lattice; .* octaves",
    ) as caught:
        sb.distance(*pair, -2.0, rtol=1e-6, memory=6e8)
    assert caught.value.requested == 1e-6
    assert 1e-6 < caught.value.reachable < 0.1
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.reachable) == (str(caught.value), caught.value.reachable)
    assert sb.distance(*pair, -2.0, rtol=1.2 * caught.value.reachable, memory=6e8)["within"].item()


@pytest.mark.slow
def test_a_best_effort_is_the_nearest_that_can_be_had() -> None:
    a, b, rtol = sb.shapes.icosphere(3), sb.shapes.Sphere(), 1e-12
    with pytest.raises(sb.errors.AccuracyError, match="a best effort") as caught:
        sb.distance(a, b, -10.0, rtol=rtol, memory=6e8)
    found = sb.distance(a, b, -10.0, rtol=rtol, memory=6e8, best_effort=True)
    assert not found["within"].item()
    relative = found["error"].item() / found["distance"].item()
    assert rtol < relative < 1.5 * caught.value.reachable


@pytest.mark.slow
def test_a_best_effort_that_succeeds_is_the_same() -> None:
    a, b = sb.shapes.icosphere(1), sb.shapes.Sphere()
    strict, best = (sb.distance(a, b, -3.0, rtol=1e-2, best_effort=best) for best in (False, True))
    # Sums in threads differ by rounding.
    xr.testing.assert_allclose(strict, best, rtol=1e-3)
    assert strict.attrs.keys() == best.attrs.keys()
    with pytest.raises(sb.errors.InputError, match="a best effort is made for an rtol"):
        sb.distance(a, b, -3.0, lattice=sb.Lattice(2.0, 16), best_effort=True)


@pytest.mark.slow
def test_what_surfaces_share_cancels() -> None:
    ball = sb.shapes.icosphere(2)
    less = sb.Mesh(ball.vertices, ball.triangles[5:])
    patch = sb.Mesh(ball.vertices, ball.triangles[:5])
    found, expected = sb.distance(ball, less, -1.5, rtol=2e-2), sb.norm(patch, -1.5, rtol=2e-2)
    assert found["distance"].item() == pytest.approx(expected["norm"].item(), rel=1e-6)
    # One vertex moved by little: six thin triangles, of which lattices see next to nothing.
    vertices = ball.vertices.copy()
    vertices[7] *= 1 + 1e-6
    near = sb.distance(ball, sb.Mesh(vertices, ball.triangles), -2.0, rtol=5e-2)
    assert near["within"].item()
    assert 0 < near["distance"].item() < 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(({"rtol": rtol}, "rtol must be a number between 0 and 1") for rtol in (0.0, 1.0, np.nan, "a", True)),
        ({"memory": -1.0}, "memory must be a positive number"),
        ({"memory": "much"}, r"memory must be a positive number of bytes, or a size .* found 'much'"),
        ({"memory": 1e3}, "1e-06 GB of memory are too little"),
        ({"order": [-40.0, -1e6]}, "orders go down to -100"),
        ({"rtol": None, "memory": 1e9}, "memory limits the computation for an rtol"),
        ({"lattice": sb.Lattice(2.0, 16)}, "an rtol chooses the lattice"),
        ({"a": sb.fourier_transform(BOX, sb.Lattice(2.0, 16))}, "an rtol chooses the lattice"),
        ({"a": 7}, r"expected a Mesh, the path of a mesh file, .*; found int"),
    ],
)
def test_refuses_what_has_no_meaning(change: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        sb.distance(**{"a": BOX, "b": sb.shapes.Sphere(), "order": -2.0, "rtol": 1e-3, **change})


@pytest.mark.slow
@pytest.mark.parametrize("offset", [1e4, 1e8])
def test_surfaces_far_apart_are_no_endless_search(offset: float) -> None:
    far = sb.Mesh(BOX.vertices + offset, BOX.triangles)
    expected = np.sqrt(2) * sb.norm(BOX, -4.0, rtol=1e-3)["norm"].item()
    assert sb.distance(BOX, far, -4.0, rtol=1e-2)["distance"].item() == pytest.approx(expected, rel=1e-2)
    with pytest.raises(sb.errors.AccuracyError, match="below the rounding"):
        sb.distance(BOX, sb.shapes.Sphere(), -4.0, rtol=1e-300)


def test_memory_as_text() -> None:
    as_text, as_number = (
        sb.distance(BOX, sb.shapes.Sphere(), -5.0, rtol=0.1, memory=memory) for memory in ("600MB", 6e8)
    )
    assert as_text.identical(as_number)


@pytest.mark.slow
def test_surfaces_far_from_the_origin_are_compared_where_they_are() -> None:
    a, b = sb.shapes.icosphere(2), sb.shapes.icosphere(3)
    centred = sb.distance(a, b, -3.0, rtol=1e-3)
    away = np.array([1000.0, -2000.0, 500.0])
    moved = sb.distance(
        sb.Mesh(a.vertices + away, a.triangles), sb.Mesh(b.vertices + away, b.triangles), -3.0, rtol=1e-3
    )
    assert moved["within"].item()
    assert abs(centred["distance"].item() - moved["distance"].item()) <= centred["error"].item() + moved["error"].item()
    apart = sb.distance(sb.shapes.Sphere(1.0, (500.0, 0, 0)), sb.shapes.Sphere(1.0, (497.0, 0, 0)), -5.0, rtol=1e-4)
    exact = sb.distance(sb.shapes.Sphere(), sb.shapes.Sphere(1.0, (3.0, 0, 0)), -5.0)["distance"].item()
    assert abs(apart["distance"].item() - exact) <= apart["error"].item()


def test_what_lies_below_rounding_is_refused() -> None:
    with pytest.raises(
        sb.errors.AccuracyError, match=r"rtol 1e-12 of about .* at order -10 is below the rounding"
    ) as caught:
        sb.distance(sb.shapes.icosphere(3), sb.shapes.Sphere(), -10.0, rtol=1e-12)
    assert 1e-12 < caught.value.reachable < 1e-8
    assert sb.distance(sb.shapes.icosphere(3), sb.shapes.Sphere(), -10.0, rtol=1.5 * caught.value.reachable)[
        "within"
    ].item()


@pytest.mark.parametrize("order", [-40.0, -100.0])
def test_very_negative_orders(order: float) -> None:
    exact = sb.distance(sb.shapes.Sphere(), sb.shapes.Sphere(0.9), order)["distance"].item()
    dataset = sb.distance(sb.shapes.Sphere(), sb.shapes.Sphere(0.9), order, rtol=1e-4)
    assert abs(dataset["distance"].item() - exact) <= dataset["error"].item() <= 1e-4 * exact


def test_a_pilot_without_a_digit_needs_no_larger_lattice() -> None:
    ball = sb.shapes.icosphere(2)
    again = sb.Mesh(ball.vertices.copy(), ball.triangles)
    problem = Problem((again, ball), (-4.0, -10.0), Accuracy(1e-2), support_of((again, ball)), "a copy")
    assert not run_pilot(problem)[0].any()


def test_a_pilot_that_happens_to_be_exact_enough_refuses_nothing() -> None:
    # Its coarse field just meets the accuracy, which leaves no room for what may lie beyond the lattice.
    fine = sb.norm(tetrahedron(), -5.0, rtol=1e-6)["norm"].item()
    for rtol in (3.08e-5, 3.1e-5, 3.14e-5):
        found = sb.norm(tetrahedron(), -5.0, rtol=rtol)
        assert abs(found["norm"].item() - fine) <= found["error"].item() <= rtol * fine


def test_memory_limits_the_lattice() -> None:
    sizes = [Accuracy(1e-3, memory).largest_intervals for memory in (5e8, 2e9, 2e10)]
    assert sizes == sorted(sizes)
    assert sizes[0] < 150 < sizes[1] < 300 < sizes[2]


def test_below_the_floor_errors_are_relative_to_it() -> None:
    values, errors = np.array([4.0, 0.1, 0.0]), np.array([0.5, 0.15, 0.25])
    found = NormEstimate(values, errors, *np.zeros((2, 3)))
    assert Accuracy(0.1).met(found).tolist() == [False, False, False]
    assert Accuracy(0.1, floor=2.0).met(found).tolist() == [False, True, False]


def test_first_lattices_hold_the_surfaces_with_room_for_their_images() -> None:
    support = Support(np.array(sb.shapes.Sphere().area), sb.shapes.Sphere().extent.widths, 1.0)
    for order in (-3.0, -6.0, -12.0):
        loose, tight = (first_lattice(support, [order], Accuracy(rtol))[0] for rtol in (1e-2, 1e-6))
        assert 1 / loose.spacing > 2.5
        assert tight.spacing < loose.spacing
        far, _ = first_lattice(replace(support, reach=40.0), [order], Accuracy(1e-2))
        assert far.half_period > 40.0
    assert first_lattice(support, [-1.0], Accuracy(1e-2))[1]  # the tail has no closed form: a pilot
    assert not first_lattice(support, [-10.0], Accuracy(1e-4))[1]


@pytest.mark.slow
def test_a_best_effort_does_not_resolve_the_rounding_of_coordinates() -> None:
    # As after a motion from far away: to resolve this takes octaves, and a minute.
    ball = sb.shapes.icosphere(1)
    noise = np.random.default_rng(0).uniform(-1e-10, 1e-10, ball.vertices.shape)
    moved = sb.Mesh(ball.vertices + noise, ball.triangles)
    found = sb.distance(moved, ball, -2.0, rtol=1e-2, best_effort=True, memory=4e8)
    assert found.attrs["octaves"] == 0
    assert not found["within"]
    # As octaves found it.
    assert abs(found["distance"] - 1.139e-9) <= found["error"] + 0.018e-9
