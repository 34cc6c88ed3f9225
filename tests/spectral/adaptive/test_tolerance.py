"""Distances to an accuracy instead of on a lattice."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from sobolev_batch import (
    AccuracyError,
    InputError,
    Lattice,
    Mesh,
    OrderError,
    Sphere,
    distance,
    fourier_transform,
    icosphere,
    norm,
)
from sobolev_batch.spectral.adaptive.tolerance import Accuracy, first_lattice, good_intervals
from tests.support.shapes import CENTRED_BOX as BOX


@pytest.mark.parametrize(("order", "rtol"), [(-3.0, 1e-2), (-3.0, 1e-4), (-5.0, 1e-3), (-5.0, 1e-6), (-10.0, 1e-9)])
def test_spheres_are_as_far_apart_as_their_closed_form_says(order: float, rtol: float) -> None:
    a, b = Sphere(0.8, (0.2, 0.0, 0.0)), Sphere(0.7, (-0.2, 0.1, 0.0))
    exact = distance(a, b, order)["distance"].item()
    found = distance(a, b, order, rtol=rtol)
    assert found["within"].item()
    assert abs(found["distance"].item() - exact) <= found["error"].item() <= rtol * found["distance"].item()


def test_the_papers_finest_icosphere_but_one_to_five_digits() -> None:
    found = distance(icosphere(6), Sphere(), -10.0, rtol=1e-5)
    relative = found["distance"].item() / norm(Sphere(), -10.0)["norm"].item()
    assert relative == pytest.approx(7.383836e-05, rel=1e-5)
    # Far fewer samples and points than the paper's 129³ and 64 a triangle.
    assert found.attrs["M"] <= 48
    assert found.attrs["points"][0] <= 6 * 81_920
    assert found.attrs["rtol"] == 1e-5


def test_several_orders_share_what_the_most_demanding_needs() -> None:
    box = Mesh(0.9 * BOX.vertices, BOX.triangles)
    together = distance(BOX, box, [-3.0, -10.0], rtol=1e-3)
    assert together["within"].all()
    assert together["within"].dims == ("order",)
    alone = distance(BOX, box, -10.0, rtol=1e-3)
    assert alone.attrs["xi_max"] < together.attrs["xi_max"]
    difference = abs(together["distance"].values[1] - alone["distance"].item())
    assert difference <= together["error"].values[1] + alone["error"].item()


def test_norms_too() -> None:
    exact = norm(Sphere(0.5), -4.0)["norm"].item()
    found = norm(Sphere(0.5), -4.0, rtol=1e-5)
    assert abs(found["norm"].item() - exact) <= found["error"].item() <= 1e-5 * exact
    assert norm(icosphere(2), -4.0, rtol=1e-4)["within"].item()


def test_low_accuracy_is_computed_in_single_precision() -> None:
    assert distance(icosphere(1), Sphere(), -5.0, rtol=1e-2).attrs["dtype"] == "complex64"
    assert distance(icosphere(1), Sphere(), -5.0, rtol=1e-6).attrs["dtype"] == "complex128"


def test_what_is_out_of_reach_is_refused_with_what_can_be_had() -> None:
    pair = icosphere(0), icosphere(1)
    with pytest.raises(
        AccuracyError, match=r"rtol 1e-06 is out of reach at order -2: within 0\.6 GB .* about"
    ) as caught:
        distance(*pair, -2.0, rtol=1e-6, memory=6e8)
    assert caught.value.requested == 1e-6
    assert 1e-6 < caught.value.reachable < 0.1
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.reachable) == (str(caught.value), caught.value.reachable)
    assert distance(*pair, -2.0, rtol=1.2 * caught.value.reachable, memory=6e8)["within"].item()


def test_equal_surfaces_have_a_distance_below_rounding() -> None:
    found = distance(BOX, Mesh(BOX.vertices, BOX.triangles), -3.0, rtol=1e-3)
    assert found["distance"].item() <= found["error"].item()


def test_refuses_what_has_no_meaning() -> None:
    lattice = Lattice(2.0, 16)
    field = fourier_transform(BOX, lattice)
    for rtol, memory in ((0.0, None), (1.0, None), (np.nan, None), (1e-3, -1.0), (None, 1e9)):
        with pytest.raises(InputError, match=r"rtol|memory"):
            distance(BOX, Sphere(), -2.0, rtol=rtol, memory=memory)
    with pytest.raises(InputError, match="an rtol chooses the lattice"):
        distance(BOX, Sphere(), -2.0, rtol=1e-3, lattice=lattice)
    with pytest.raises(InputError, match="an rtol chooses the lattice"):
        distance(field, Sphere(), -2.0, rtol=1e-3)
    for wrong in ({"rtol": "a"}, {"rtol": True}, {"rtol": 1e-3, "memory": "2GB"}):
        with pytest.raises(InputError, match=r"(rtol|memory) must be a number"):
            distance(BOX, Sphere(), -2.0, **wrong)
    with pytest.raises(InputError, match="expected a Mesh"):
        distance("box.ply", Sphere(), -2.0, rtol=1e-3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"1e-06 GB of memory are too little"):
        distance(BOX, Sphere(), -2.0, rtol=1e-3, memory=1e3)


def test_surfaces_far_from_the_origin_are_compared_where_they_are() -> None:
    a, b = icosphere(2), icosphere(3)
    here = distance(a, b, -3.0, rtol=1e-3)
    away = np.array([1000.0, -2000.0, 500.0])
    there = distance(Mesh(a.vertices + away, a.triangles), Mesh(b.vertices + away, b.triangles), -3.0, rtol=1e-3)
    assert there["within"].item()
    assert abs(here["distance"].item() - there["distance"].item()) <= here["error"].item() + there["error"].item()
    apart = distance(Sphere(1.0, (500.0, 0, 0)), Sphere(1.0, (497.0, 0, 0)), -5.0, rtol=1e-4)
    exact = distance(Sphere(), Sphere(1.0, (3.0, 0, 0)), -5.0)["distance"].item()
    assert abs(apart["distance"].item() - exact) <= apart["error"].item()


def test_a_larger_pilot_looks_before_an_accuracy_is_refused() -> None:
    # The first pilot, up to some 8 cycles, sees the distance of near meshes still growing.
    found = distance(icosphere(3), icosphere(4), -2.0, rtol=0.1)
    assert found["within"].item()
    assert found.attrs["M"] > 64


def test_what_lies_below_rounding_is_refused() -> None:
    with pytest.raises(AccuracyError, match=r"rtol 1e-12 of about .* at order -10 is below the rounding") as caught:
        distance(icosphere(3), Sphere(), -10.0, rtol=1e-12)
    assert 1e-12 < caught.value.reachable < 1e-8
    assert distance(icosphere(3), Sphere(), -10.0, rtol=1.5 * caught.value.reachable)["within"].item()


@pytest.mark.parametrize("order", [-40.0, -100.0])
def test_very_negative_orders(order: float) -> None:
    exact = distance(Sphere(), Sphere(0.9), order)["distance"].item()
    found = distance(Sphere(), Sphere(0.9), order, rtol=1e-4)
    assert abs(found["distance"].item() - exact) <= found["error"].item() <= 1e-4 * exact
    with pytest.raises(OrderError, match="orders go down to -100"):
        distance(Sphere(), Sphere(0.9), [order, -1e6], rtol=1e-4)


def test_many_orders_at_once_end_soon() -> None:
    with pytest.raises(AccuracyError, match=r"not even one digit|can be reached"):
        distance(Sphere(), Sphere(1.01), [-0.6, -2.0, -20.0], rtol=1e-4)


def test_memory_limits_the_lattice() -> None:
    sizes = [Accuracy(1e-3, memory).largest_intervals for memory in (5e8, 2e9, 2e10)]
    assert sizes == sorted(sizes)
    assert sizes[0] < 150 < sizes[1] < 300 < sizes[2]


def test_intervals_suit_ffts() -> None:
    for least in (2, 17, 30.5, 100, 211, 416):
        found = good_intervals(least)
        assert found % 2 == 0
        assert least <= found <= 1.13 * least + 8
        grid = 2 * (found + 1)
        # The grid of the oversampled axis is at most a twentieth larger than twice its modes.
        assert any(grid <= 2**a * 3**b * 5**c <= 1.08 * grid for a in range(10) for b in range(7) for c in range(5))


def test_first_lattices_hold_the_surfaces_with_room_for_their_images() -> None:
    widths = Sphere().extent.widths
    for order in (-3.0, -6.0, -12.0):
        loose, tight = (first_lattice(widths, 1.0, [order], Accuracy(rtol))[0] for rtol in (1e-2, 1e-6))
        assert 1 / loose.spacing > 2.5
        assert tight.spacing < loose.spacing
        far, _ = first_lattice(widths, 40.0, [order], Accuracy(1e-2))
        assert far.half_period > 40.0
    assert first_lattice(widths, 1.0, [-1.0], Accuracy(1e-2))[1]  # the tail has no closed form: a pilot
    assert not first_lattice(widths, 1.0, [-10.0], Accuracy(1e-4))[1]
