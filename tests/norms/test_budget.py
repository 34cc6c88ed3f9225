"""Errors of norms and distances: they cover the truth, and are not many times larger."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, distance, fourier_transform, norm
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.budget import Sums, Support, truncated
from sobolev_batch.norms.estimate import NormEstimate, Tail, estimate_norms
from sobolev_batch.norms.fields import Quality
from sobolev_batch.norms.images import NearAxes
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.transform.lattice import SobolevWeights
from sobolev_batch.transform.probe import draw
from sobolev_batch.transform.spheres import sphere_inner_product
from tests.support.rectangles import Rectangles
from tests.support.shapes import CENTRED_BOX as BOX

ORDERS = (-2.0, -3.0, -5.0, -10.0)
STICK = Mesh(BOX.vertices * np.array([1.0, 0.15, 0.1]), BOX.triangles)
PAIRS: dict[str, tuple[Surface, Surface]] = {
    "icosphere and sphere": (icosphere(2), Sphere()),
    "icospheres": (icosphere(0), icosphere(1)),
    "box and sphere": (BOX, Sphere()),
    "boxes": (BOX, Mesh(0.9 * BOX.vertices, BOX.triangles)),
    "sticks": (STICK, Mesh(0.97 * STICK.vertices, STICK.triangles)),
    "moved spheres": (Sphere(0.8, (0.2, 0.0, 0.0)), Sphere(0.8, (-0.2, 0.0, 0.0))),
    "near spheres": (Sphere(0.8), Sphere(0.79)),
}
FINE = Lattice(16.0, 160)
COARSE = (Lattice(2.0, 12), Lattice(3.0, 20), Lattice(4.0, 24), Lattice(4.0, 36), Lattice(6.0, 54))


@pytest.mark.slow
def test_reported_errors_cover_the_true_ones_and_stay_near_them() -> None:
    ratios = []
    for name, (a, b) in PAIRS.items():
        truth = distance(a, b, ORDERS, lattice=FINE)
        for lattice in COARSE:
            dataset = distance(a, b, ORDERS, lattice=lattice)
            true_errors = np.abs(dataset["distance"].values - truth["distance"].values)
            # Where the fine lattice cannot tell, there is nothing to compare with.
            telling = true_errors > 20 * truth["error"].values
            ratio = dataset["error"].values[telling] / true_errors[telling]
            assert (ratio > 1).all(), (name, lattice, ratio)
            ratios.append(ratio)
    every = np.concatenate(ratios)
    assert len(every) > 35
    assert np.median(every) < 10


@pytest.mark.parametrize(
    ("lattice", "radius", "near"),
    [
        (Lattice(3.0, 20), 0.5, Sphere(0.5003, (1e-4, 0.0, 0.0))),
        (Lattice(4.0, 36), 0.8, Sphere(0.8, (1e-3, 0.0, 0.0))),
        (Lattice(5.4, 24), 0.9, Sphere(0.899, (5e-4, 0.0, 0.0))),
    ],
)
def test_what_lies_between_near_surfaces_grows_beyond_a_given_lattice(
    lattice: Lattice, radius: float, near: Sphere
) -> None:
    orders = (-0.75, -1.0, -1.5, -2.0)
    found, exact = distance(Sphere(radius), near, orders, lattice=lattice), distance(Sphere(radius), near, orders)
    # The outer ranges of the lattice show less growth than there is, since the energy oscillates.
    ratios = found["error"].values / np.abs(found["distance"].values - exact["distance"].values)
    assert (ratios > 1).all()
    assert (ratios < 10).all()


def test_images_of_near_duplicates_that_cancel_by_chance_are_in_the_error() -> None:
    # Moved a little, a surface meets second derivatives of the kernel, whose signs change within its peak.
    orders, shares = (-6.0, -8.0, -10.0, -14.0, -20.0), []
    for seed in range(70):
        rng = np.random.default_rng([5, seed])
        radius, move, growth = rng.uniform(0.2, 0.9), 1e-3 * rng.normal(size=3), 1e-3 * rng.uniform(-1, 1)
        pair = Sphere(radius), Sphere(radius * (1 + growth), tuple(move.tolist()))
        xi_max = rng.uniform(2, 3)
        count = 2 * int(np.ceil(xi_max * (2 * radius + rng.uniform(0.3, 2.0))))
        found, wide = (distance(*pair, orders, lattice=Lattice(xi_max, M)) for M in (count, 3 * count))
        shares.append(np.abs(found["distance"].values - wide["distance"].values) / found["error"].values)
    assert np.max(shares) < 1
    assert np.median(shares) > 0.05


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("period", [2.5, 3.0, 4.0])
def test_ends_that_moved_meet_their_images_nearer_than_at_half_the_period(period: float, axis: int) -> None:
    # At half the period these ends are farther apart than at all of it.
    a, orders, offset = Rectangles.sheets(2, 2.2, -1.1), (-2.0, -3.0, -4.0, -6.0), 0.03
    truth = a.distance(a.moved(0, 0, offset), orders)
    mesh, moved = (
        Mesh(np.roll(one.vertices, axis + 1, axis=1), one.triangles) for one in (a.mesh(), a.moved(0, 0, offset).mesh())
    )
    found = distance(mesh, moved, orders, lattice=Lattice(8.0, int(16 * period)))
    ratios = found["error"].values / np.abs(found["distance"].values - truth)
    assert (ratios > 1).all()
    assert np.median(ratios) < 5


@pytest.mark.parametrize("period", [0.1, 0.3, 0.8])
def test_a_period_far_shorter_than_a_unit_is_in_the_error(period: float) -> None:
    # Between samples so far apart lies nearly all of the difference, whose value is 1e-7 of the true one at times.
    a, orders = Rectangles.box(*(sign * period / 4 * np.array([1.0, 0.8, 0.6]) for sign in (-1, 1))), (-3, -5, -12, -25)
    b = a.moved(0.01 * period, 0, 0)
    found = distance(a.mesh(), b.mesh(), orders, lattice=Lattice(2 / period, 4))
    ratios = found["error"].values / np.abs(found["distance"].values - a.distance(b, orders))
    assert (ratios > 1).all()
    assert (ratios < 100).all()


def test_a_narrow_gap_to_images_is_in_the_error() -> None:
    a, orders = Rectangles.sheets(1, 1.0, 0.0), (-4.0, -6.0, -9.0)
    b = a.moved(0.05, 0, 0)
    found = distance(a.mesh(), b.mesh(), orders, lattice=Lattice(4.5, 10))
    ratios = found["error"].values / np.abs(found["distance"].values - a.distance(b, orders))
    assert (ratios > 1).all()
    assert (ratios < 10).all()


@pytest.mark.parametrize("M", [40, 48, 64])
def test_norms_of_ends_meet_their_images_too(M: int) -> None:
    mesh, orders = Rectangles.sheets(2, 2.2, -1.1).mesh(), (-2.0, -3.0, -4.0, -6.0)
    found, wide = (norm(mesh, orders, lattice=Lattice(8.0, intervals)) for intervals in (M, 3 * M))
    images = found["error_part"].sel(part="aliasing").values
    ratios = images / np.abs(found["norm"].values - wide["norm"].values)
    assert (ratios > 1).all()
    assert np.median(ratios) < 4
    of_reference = distance(mesh, Sphere(0.9), orders, lattice=Lattice(8.0, M))
    truth = distance(mesh, Sphere(0.9), orders, lattice=Lattice(8.0, 3 * M))
    for name in ("relative", "area_share"):
        off = np.abs(of_reference[name] - truth[name])
        assert not (off > of_reference[f"{name}_error"] + truth[f"{name}_error"]).any()


def test_ends_meet_their_images_along_a_diagonal() -> None:
    turn = np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    a, orders = Rectangles.sheets(2, 3.6, -1.8, (0.4, 0.4)), (-2.0, -3.0, -4.0)
    b = a.moved(0, 0, 0.03)
    mesh, moved = (Mesh(one.mesh().vertices[:, [2, 0, 1]] @ turn.T, one.mesh().triangles) for one in (a, b))
    found = distance(mesh, moved, orders, lattice=Lattice(8.0, 48))
    ratios = found["error"].values / np.abs(found["distance"].values - a.distance(b, orders))
    assert (ratios > 1).all()
    assert (ratios < 10).all()


def test_values_near_axes_are_the_same_block_by_block() -> None:
    lattice = Lattice(4.0, 24)
    values = np.random.default_rng(0).normal(size=(2, *lattice.shape)) + 0j
    whole, gathered = NearAxes(lattice, 2), NearAxes(lattice, 2)
    whole.take(slice(2), lattice.half, values)
    for block in lattice.half.split(500):
        x, y, z = block.place_in(lattice.half)
        gathered.take(slice(1, 2), block, values[1:, x, y, z])
    assert whole.images()[1].tolist() == gathered.images()[1].tolist()
    assert not gathered.images()[0].any()


@pytest.mark.parametrize("xi_max", [5.0, 6.0])
def test_steep_growth_at_the_end_of_a_given_lattice_goes_on(xi_max: float) -> None:
    # Half a pitch of 1/8 apart, plates hardly differ below |ξ| = 8.
    a, b = Rectangles.tapered(12, 1 / 8, 0.3), Rectangles.tapered(12, 1 / 8, 0.3, 0.5)
    orders = (-1.0, -2.0, -3.0, -5.0)
    truth = np.sqrt(a.squared_distance(b, orders)[0])
    found = distance(a.mesh(), b.mesh(), orders, lattice=Lattice(xi_max, 28))
    assert (np.abs(found["distance"].values - truth) <= found["error"].values).all()


@pytest.mark.parametrize("xi_max", [5.0, 7.0])
@pytest.mark.parametrize("part", [0.1, 0.5])
def test_plates_that_repeat_beyond_a_given_lattice_have_the_energy_of_their_peaks(part: float, xi_max: float) -> None:
    # A pitch of 1/8: peaks at multiples of 8, between which the lattice shows that of the plates at both ends alone.
    a, orders = Rectangles.sheets(30, 1 / 8, -29 / 16, (0.8, 0.8)), (-0.75, -1.0, -2.0, -3.0)
    b = a.moved(0, 0, part / 8)
    found = distance(a.mesh(), b.mesh(), orders, lattice=Lattice(xi_max, int(16 * xi_max)))
    ratios = found["error"].values / np.abs(found["distance"].values - a.distance(b, orders))
    assert (ratios > 1).all()
    assert (ratios < 2).all()


def test_closed_forms_lie_within_the_error() -> None:
    a, b = Sphere(), Sphere(0.9, (0.3, 0.0, 0.0))
    exact = distance(a, b, ORDERS)
    assert (exact["error"] <= 1e-12 * norm(a, ORDERS)["norm"] ** 2 / exact["distance"]).all()
    for lattice in (Lattice(3.0, 20), Lattice(5.0, 64)):
        dataset = distance(a, b, ORDERS, lattice=lattice)
        assert (np.abs(dataset["distance"] - exact["distance"]) <= dataset["error"] + exact["error"]).all()
        assert np.allclose(dataset["error"], dataset["error_part"].sum("part"), rtol=1e-14, atol=0)


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_coarse_quadrature_is_noticed(degree: int) -> None:
    regular, lattice = icosphere(3), Lattice(5.0, 64)
    # Regular meshes have errors in few frequencies, which drawn ones may miss.
    noise = np.random.default_rng(1).normal(scale=0.02, size=regular.vertices.shape)
    mesh = Mesh(regular.vertices + noise, regular.triangles)
    exact = fourier_transform(mesh, lattice, 1e-13)
    rough = fourier_transform(mesh, lattice, 1e-10, quadrature=degree)
    true_error = norm((rough - exact), ORDERS)["norm"].values
    reported = norm(rough, ORDERS)["error_part"].sel(part="discretisation").values
    assert (reported > true_error).all()
    assert (reported < 6 * true_error).all()


def test_probe_draws_depend_on_the_mesh_alone_and_leave_the_orders_open() -> None:
    lattice = Lattice(4.0, 32)
    first, again = (Quality.from_json(fourier_transform(icosphere(2), lattice).attrs["quality"]) for _ in range(2))
    assert first.probe.shells == again.probe.shells
    other = Quality.from_json(fourier_transform(icosphere(1), lattice).attrs["quality"])
    assert other.probe.shells != first.probe.shells
    assert (first.probe.norms(SobolevWeights(lattice, (-1.3, -7.7))) > 0).all()


def test_points_are_drawn_by_the_weights_of_the_trapezoidal_rule() -> None:
    count, lattice = 40_000, Lattice(1.0, 8)
    draws = draw(lattice, (-2.0,), 2, count, seed=3)
    places = tuple((draws.indices - lattice.half.start).T)
    found = np.zeros(lattice.half.shape)
    np.add.at(found, places, draws.scales)
    # The mean of each point is its weight, and its variance that of rare events of this scale.
    weights = lattice.trapezoid_weights(lattice.half)
    assert (np.abs(found - weights)[places] <= 6 * np.sqrt(weights[places] * draws.scales)).all()
    assert len(np.unique(draws.indices, axis=0)) == weights.size


def test_fields_of_unknown_origin_have_numbers_without_errors() -> None:
    lattice = Lattice(4.0, 32)
    field = fourier_transform(BOX, lattice)
    dataset = norm(2 * field.drop_attrs(), ORDERS)
    assert np.isnan(dataset["error"]).all()
    assert np.allclose(dataset["norm"], 2 * norm(field, ORDERS)["norm"], rtol=1e-13)


@pytest.mark.parametrize("growth", [1e-4, 3e-4, 1e-3, 1e-2])
def test_energies_that_hardly_grow_have_a_bound(growth: float) -> None:
    lattice = Lattice(4.0, 16)
    sums = Sums(np.ones((2, 1)), np.ones((2, 4, 1)), np.array([[1.5 / (1 + growth)], [1.5]]))
    weights, support = SobolevWeights(lattice, (-2.0, -0.6)), Support(np.ones(1), np.full(13, 2.0))
    bound = truncated(sums, weights, support)
    flat = truncated(sums._replace(outer=np.full((2, 1), 1.5)), weights, support)
    assert bound == pytest.approx(flat, rel=0.3)


@pytest.mark.parametrize("settings", [{"lattice": Lattice(5.0, 64)}, {"rtol": 1e-2}])
@pytest.mark.parametrize("radius", [0.9, 1.2])
def test_relative_distances_and_shares_of_area(settings: dict[str, Any], radius: float) -> None:
    orders = [-1.0, -1.5, -2.0, -4.0]
    found = distance(Sphere(radius, (0.1, 0.0, 0.0)), Sphere(), orders, **settings)
    for order in orders:
        one = found.sel(order=order)
        squared = sphere_inner_product(Sphere(), Sphere(), order)
        other = Sphere(radius, (0.1, 0.0, 0.0))
        product = sphere_inner_product(other, Sphere(), order) - squared
        relative = ((sphere_inner_product(other, other, order) - squared - 2 * product) / squared) ** 0.5
        assert abs(one["relative"] - relative) <= one["relative_error"]
        assert abs(one["area_share"] - (product / squared / relative) ** 2) <= one["area_share_error"]
        if "rtol" in settings:
            assert one["relative_error"] <= 1.1e-2 * relative
            assert one["area_share_error"] <= 0.02
            assert one["excess"].item() == pytest.approx(product / squared, rel=0.02)


def test_equal_surfaces_differ_by_nothing() -> None:
    # Whatever the order of vertices and triangles, and their orientation.
    order = np.random.default_rng(0).permutation(len(BOX.vertices))
    shuffled = Mesh(BOX.vertices[order], np.argsort(order)[BOX.triangles[::-1, [2, 0, 1]]])
    for settings in ({"lattice": Lattice(2.0, 16)}, {"rtol": 1e-2}):
        found = distance(shuffled, BOX, -2.0, **settings)
        assert [found[name].item() for name in ("distance", "error", "relative", "relative_error")] == [0.0] * 4
        assert np.isnan(found["area_share"].item())


def test_norms_below_their_errors_give_no_relative_error() -> None:
    values, errors = NormEstimate(*np.full((4, 1), 0.1)).relative_to(NormEstimate(*np.full((4, 1), 0.2))).values()
    assert (values.item(), np.isnan(errors.item())) == (0.5, True)
    distances, norms = (
        NormEstimate(np.array([value]), *np.full((3, 1), error)) for value, error in ((0.5, 0.01), (2, 0.1))
    )
    close, off = distances.relative_to(norms).values()
    # The largest quotient that both errors permit.
    assert close.item() + off.item() == pytest.approx((0.5 + 0.03) / (2.0 - 0.3))


def test_errors_of_one_square_change_its_root_together() -> None:
    lattice = Lattice(2.0, 8)
    sums = Sums.zeros(1)._replace(totals=np.array([0.2]))
    tail = Tail(*(np.array([part]) for part in (0.3, 0.45, 0.5, 0.45)))
    found = estimate_norms(
        sums, SobolevWeights(lattice, (-2.0,), 2.0), Support(np.ones(()), np.ones(13)), np.zeros(1), tail
    )
    assert found.values - found.errors == pytest.approx(np.sqrt(1 - 0.9))
    assert found.truncation == found.statistical


def test_points_of_a_distance_tell_the_share_of_area_too() -> None:
    box, order = Rectangles.box((-0.5, -0.35, -0.25), (0.5, 0.35, 0.25)), -2.0
    moved, nothing = box.moved(0.003, 0.002, 0.001), Rectangles(np.zeros((0, 3)), np.zeros((0, 3)))
    found = distance(moved.mesh(), box.mesh(), order, rtol=1e-2)
    square, own = (box.squared_distance(other, [order])[0].item() for other in (moved, nothing))
    # Of a mere move, the product with the surface is minus half of the squared distance.
    truth = square / (4 * own)
    assert abs(found["area_share"].item() - truth) < found["area_share_error"].item() < 0.4 * truth
