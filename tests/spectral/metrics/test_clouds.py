"""Norms and distances of point clouds against sums of Matérn kernels over all pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sobolev_batch import (
    InputError,
    Lattice,
    OrderError,
    PointCloud,
    Sphere,
    distance,
    fit,
    fourier_transform,
    icosphere,
    inner_product,
    norm,
    same_surface,
    witness,
    yardsticks,
)
from tests.coverage.clouds import true_distance
from tests.coverage.matern import double_sum, sphere_potential

Reals = NDArray[np.float64]

RNG = np.random.default_rng(3)
LATTICE = Lattice(5.0, 40)


def cloud(count: int, scale: float = 0.5) -> PointCloud:
    return PointCloud(RNG.uniform(-scale, scale, (count, 3)), RNG.uniform(0.5, 1.5, count) / count)


RANDOM, OTHER = cloud(60), cloud(40)
GRID = PointCloud.uniform(np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 4)] * 3), -1).reshape(-1, 3), 1.0)
CLOSE = PointCloud(np.array([[0, 0, 0], [1e-6, 0, 0]]), [1.0, 2.0])
SHARING = PointCloud(np.concatenate([RANDOM.points[:20], OTHER.points]), np.full(60, 0.02))
ON_SPHERE = PointCloud.uniform(icosphere(1).vertices, Sphere().area)


@pytest.mark.slow
@pytest.mark.parametrize(
    "pair",
    [
        (RANDOM, OTHER),
        (GRID, PointCloud(np.add(GRID.points, [1e-4, 0, 0]), GRID.weights)),
        (CLOSE, PointCloud([[0.5, 0, 0]], [3.0])),
        (ON_SPHERE, Sphere()),
    ],
    ids=["random", "grid", "close", "sphere"],
)
def test_errors_cover_the_true_distance(pair: tuple[PointCloud, PointCloud]) -> None:
    orders = [-1.6, -2.0, -3.0]
    found = distance(*pair, orders, rtol=3e-2)
    true = np.array([true_distance(*pair, order)[0] for order in orders])
    assert np.all(np.abs(found["distance"] - true) <= found["error"])
    assert np.all(found["error"] <= 3e-2 * true)


@pytest.mark.parametrize("order", [-2.0, -4.0])
def test_errors_on_a_given_lattice_cover_what_points_add_beyond_it(order: float) -> None:
    for other in (OTHER, CLOSE):
        found = distance(RANDOM, other, order, lattice=LATTICE)
        true, _ = true_distance(RANDOM, other, order)
        assert 0 < true - found["distance"].item() <= found["error"].item()


def squared_norms(surface: PointCloud | Sphere, orders: list[float]) -> Reals:
    """Squared norms in real space (orders,)."""
    if isinstance(surface, PointCloud):
        return double_sum(surface.points, surface.weights, [-order for order in orders])
    pole = np.add(surface.center, [[0.0, 0.0, surface.radius]])
    return np.array([surface.area * sphere_potential(surface, pole, -order).item() for order in orders])


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"rtol": 3e-2}, {"lattice": LATTICE}], ids=["octaves", "lattice"])
@pytest.mark.parametrize(
    "pair",
    [(RANDOM, OTHER), (RANDOM, SHARING), (ON_SPHERE, Sphere()), (Sphere(), ON_SPHERE)],
    ids=["apart", "sharing", "to a sphere", "to a cloud"],
)
def test_errors_cover_what_is_relative_to_the_reference(
    pair: tuple[PointCloud | Sphere, PointCloud | Sphere], settings: dict[str, Any]
) -> None:
    orders = [-1.6, -2.0, -3.0]
    found = distance(*pair, orders, **settings)
    cloud, other = sorted(pair, key=lambda surface: isinstance(surface, Sphere))
    assert isinstance(cloud, PointCloud)
    squares = np.array([true_distance(cloud, other, order)[0] ** 2 for order in orders])
    norms, own = (squared_norms(surface, orders) for surface in pair)
    shares = ((norms - own - squares) / 2) ** 2 / (own * squares)
    # Where the norm may be zero for all that the lattice tells, errors are unknown.
    assert not np.any(np.abs(found["relative"] - np.sqrt(squares / own)) > found["relative_error"])
    assert not np.any(np.abs(found["area_share"] - shares) > found["area_share_error"])
    if "rtol" in settings:
        assert np.all(found["relative_error"] < 3e-2 * found["relative"])
        assert np.all(found["area_share_error"] < 0.05)


def test_fields_are_sums_of_plane_waves() -> None:
    field = fourier_transform(RANDOM, LATTICE, 1e-12)
    for ijk in ((3, 5, 7), (20, 20, 0), (40, 0, 20)):
        xi = np.array([field[axis].values[i] for axis, i in zip(field.dims, ijk, strict=True)])
        expected = RANDOM.weights @ np.exp(-2j * np.pi * RANDOM.points @ xi)
        assert abs(field.values[ijk] - expected) < 1e-11


def test_a_single_point_has_the_norm_of_the_kernel() -> None:
    found = norm(PointCloud([[1.0, 2.0, 3.0]], [2.0]), -2, rtol=1e-2)
    assert abs(found["norm"].item() - 2 * np.pi) <= found["error"].item()


def test_equal_clouds_are_at_no_distance() -> None:
    shuffled = RNG.permutation(60)
    same = PointCloud(RANDOM.points[shuffled], RANDOM.weights[shuffled])
    for settings in ({"rtol": 1e-3}, {"lattice": LATTICE}):
        found = distance(RANDOM, same, [-2, -5], **settings)
        assert not found["distance"].values.any()
        assert not found["error"].values.any()
    assert same_surface(same, RANDOM).method == "identical"


def test_verdicts_lie_on_the_side_of_the_true_distance() -> None:
    near = PointCloud(np.add(RANDOM.points, [1e-2, 0, 0]), RANDOM.weights)
    true = true_distance(near, RANDOM, -4.0)[0] / float(squared_norms(RANDOM, [-4.0])[0]) ** 0.5
    for rtol, outcome in ((2 * true, "same"), (0.5 * true, "different")):
        verdict = same_surface(near, RANDOM, rtol=rtol, order=-4.0, scaling=False)
        assert verdict.outcome == outcome
        assert abs(verdict.distance - true) <= verdict.error


@pytest.mark.parametrize("order", [-1.5, -0.7, [-2, -1]])
def test_orders_at_which_points_have_no_norm_are_refused(order: float | list[float]) -> None:
    field = fourier_transform(RANDOM, LATTICE)
    message = "the norm of a point cloud is finite only for orders below -3/2"
    for call in (
        lambda: norm(RANDOM, order, rtol=1e-2),
        lambda: norm(field, order),
        lambda: distance(Sphere(0.5), RANDOM, order, lattice=LATTICE),
        lambda: inner_product(RANDOM, Sphere(), order, rtol=1e-2),
        lambda: same_surface(RANDOM, OTHER, order=np.max(order)),
        lambda: witness(RANDOM, OTHER, order, [[0, 0, 0]], lattice=LATTICE),
    ):
        with pytest.raises(OrderError, match=message):
            call()


def test_meshes_are_not_fitted_to_points() -> None:
    for target in (RANDOM, fourier_transform(RANDOM, LATTICE)):
        with pytest.raises(InputError, match="meshes are fitted to surfaces and not to points"):
            fit(icosphere(1), target, -2)


def test_yardsticks_are_of_meshes() -> None:
    no_mesh: Any = ON_SPHERE
    with pytest.raises(InputError, match=r"expected a Mesh.*; found PointCloud"):
        yardsticks(icosphere(1), no_mesh, -2, lattice=LATTICE)
