"""What lies beyond a frequency, against closed forms and heat traces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.fields import Quality, TailQuality
from sobolev_batch.norms.tail.close_points import Sheets
from sobolev_batch.norms.tail.remainder import Remainder, remainder
from sobolev_batch.shapes import Sphere
from sobolev_batch.transform.lattice import smooth_step
from sobolev_batch.transform.probe import Probe
from tests.support.rectangles import Rectangles

BOX = Rectangles.box((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2)).mesh()
ORDERS = (-0.55, -1.0, -2.0)


# Half a pitch apart, plates at a pitch of 1/20 differ from |ξ| = 20 on only.
PLATES, MOVED = (Rectangles.tapered(40, 1 / 20, 0.2, offset) for offset in (0.0, 0.5))


def test_energies_of_one_surface_are_twice_its_area() -> None:
    for surface in (BOX, Sphere(0.7, (0.1, 0.2, 0.3)), sb.shapes.Torus(1.0, 0.4)):
        beyond = remainder([surface], [1], 60.0, ORDERS, points=200)
        assert np.allclose(beyond.energies, 2 * surface.area, rtol=0.02), surface


@pytest.mark.parametrize("cutoff", [1e5, 1e8])
def test_rounding_takes_no_point_off_its_face(cutoff: float) -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for surface in (Mesh(BOX.vertices @ turn, BOX.triangles), Sphere(0.7, (0.1, 0.2, 0.3))):
        energies = remainder([surface], [1], cutoff, ORDERS, points=64).energies
        assert np.allclose(energies, 2 * surface.area, rtol=1e-4), surface


def test_facets_lack_no_area_of_a_smooth_surface() -> None:
    radius, cutoff, orders = 4.0, 1.5, (-1.0, -2.0)
    # ∫ (1 - step) (1 + r²)^s |σ^|² dr for a sphere; beyond the last node the sine is averaged out.
    radii, step = np.linspace(cutoff / 2, 600.0, 400_001, retstep=True)
    squares = (1 - smooth_step(radii, cutoff)) * 16 * np.pi * radius**2 * np.sin(2 * np.pi * radius * radii) ** 2
    ball = sb.shapes.Ellipsoid((radius, radius, radius))
    for order, value, error in zip(orders, *remainder([ball], [1], cutoff, orders).at(orders), strict=True):
        last = 8 * np.pi * radius**2 * radii[-1] ** (2 * order + 1) / (-2 * order - 1)
        exact = step * float(squares @ (1 + radii**2) ** order) + last
        assert abs(value - exact) < error < 3e-4 * exact


def test_facets_lie_on_both_sides_of_a_smooth_surface_alike() -> None:
    for surface, tube in ((sb.shapes.Ellipsoid((0.5, 0.5, 0.5)), 0.0), (sb.shapes.Torus(0.5, 0.2), 0.5)):
        ((mesh, _),) = Sheets.from_surfaces([surface], [1], 9.0).meshes
        shares = np.random.default_rng(0).dirichlet([1, 1, 1], len(mesh.triangles))
        x, y, z = np.einsum("nk,nkd->dn", shares, mesh.vertices[mesh.triangles])
        # From the centre of a ball, or the middle of a tube.
        heights = np.sqrt((np.hypot(x, y) - tube) ** 2 + z**2) - (0.2 if tube else 0.5)
        assert abs(mesh.areas @ heights) < 0.03 * np.sqrt(mesh.areas @ heights**2 * mesh.area) < 3e-6 * mesh.area


def test_what_two_surfaces_share_cancels() -> None:
    same = Mesh(BOX.vertices, BOX.triangles)
    assert np.allclose(remainder([BOX, same], [1, -1], 60.0, ORDERS).energies, 0, atol=1e-9)
    # Moved along x by a quarter of its length: three quarters of the four long faces coincide.
    moved = Mesh(BOX.vertices + np.array([0.25, 0, 0]), BOX.triangles)
    beyond = remainder([BOX, moved], [1, -1], 300.0, ORDERS)
    expected = 2 * (2 * BOX.area - 2 * 0.75 * 2 * (1.0 * 0.6 + 1.0 * 0.4))
    assert np.all(np.abs(np.array(beyond.energies) - expected) < np.array(beyond.errors) + 0.01 * expected)


def test_a_part_that_lies_there_twice_weighs_four_times_as_much() -> None:
    twice = Mesh(np.concatenate([BOX.vertices] * 2), np.concatenate([BOX.triangles, BOX.triangles + len(BOX.vertices)]))
    assert np.allclose(remainder([twice], [1], 60.0, ORDERS).energies, 8 * BOX.area, rtol=0.02)


def test_one_rectangle_cut_along_either_diagonal_is_the_same_surface() -> None:
    along, across = np.array([3.0, 5.0, 0.0]), np.array([0.0, 0.0, 1.0])
    corners = 0.7 * np.array([np.zeros(3), along, along + across, across]) + np.array([0.1, 0.2, 0.3])
    for flipped in ([[0, 1, 3], [1, 2, 3]], [[3, 1, 0], [1, 2, 3]], [[3, 1, 0], [3, 2, 1]]):
        beyond = remainder([Mesh(corners, [[0, 1, 2], [0, 2, 3]]), Mesh(corners, flipped)], [1, -1], 20.0, ORDERS)
        assert np.allclose(beyond.energies, 0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("order", [-0.7, -1.0, -2.0, -3.0, -4.0])
def test_periods_beyond_the_cutoff_are_seen(order: float) -> None:
    square, _ = PLATES.squared_distance(MOVED, [order])
    meshes = [PLATES.mesh(), MOVED.mesh()]
    for seed, cutoff in enumerate((8.0, 6.5)):
        (value,), (error,) = remainder(meshes, [1, -1], cutoff, [order], seed=seed).at([order])
        assert abs(value - square.item()) < error < 0.1 * value


@pytest.mark.slow
def test_lower_orders_are_bounded_by_the_lowest_one_that_is_computed() -> None:
    pair = [PLATES.mesh(), MOVED.mesh()]
    (value,), (error,) = remainder(pair, [1, -1], 12.0, [-6.0]).at([-6.0])
    square, _ = PLATES.squared_distance(MOVED, [-6.0])
    assert value - error <= square.item() <= value + error


def test_vertices_that_no_triangle_uses_and_triangles_without_area_do_not_matter() -> None:
    stray = Mesh(np.concatenate([BOX.vertices, [[1e8, 0, 0]]]), np.concatenate([BOX.triangles, [[0, 0, 1]]]))
    assert remainder([stray], [1], 60.0, ORDERS).energies == pytest.approx(remainder([BOX], [1], 60.0, ORDERS).energies)


@pytest.mark.parametrize(("width", "has_area"), [(1e-19, False), (2e-15, True)])
def test_slivers_no_wider_than_rounding_do_not_matter(width: float, has_area: bool) -> None:
    corners = np.concatenate([BOX.vertices, [[0.1, 0.2, 0.0], [0.1, 0.2, width], [0.4, 0.2, 0.0]]])
    more = Mesh(corners, np.concatenate([BOX.triangles, [len(BOX.vertices) + np.arange(3)]]))
    assert (more.areas[-1] > 0) == has_area
    assert remainder([more], [1], 60.0, ORDERS).energies == pytest.approx(remainder([BOX], [1], 60.0, ORDERS).energies)


def test_a_remainder_survives_the_quality_of_a_field() -> None:
    beyond = remainder([BOX], [1], 60.0, ORDERS, points=100)
    for difference in (beyond, None):
        quality = Quality(BOX.area, BOX.extent, Probe((1, 2), (0.5, 0.25)))
        quality = replace(quality, tail=TailQuality((1.0,), (2.0,), beyond, difference))
        assert Quality.from_json(quality.to_json()) == quality


def test_between_the_orders_of_a_study_energies_are_interpolated() -> None:
    pair: list[Surface] = [sb.shapes.icosphere(3), Sphere()]
    usual = remainder(pair, [1, -1], 60.0, points=1000)
    for order in (-0.6, -0.85, -1.25, -1.75, -2.5):
        (value,), (error,) = usual.at([order])
        (other,), (other_error,) = remainder(pair, [1, -1], 60.0, [order], points=1000).at([order])
        assert abs(value - other) < 0.03 * other + 0.1 * (error + other_error)


@pytest.mark.parametrize("move", [1e-2, 1e-4])
def test_between_orders_the_energies_of_small_moves_are_close_to_powers(move: float) -> None:
    pair: list[Surface] = [BOX, Mesh(BOX.vertices + move * np.array([0.6, -0.7, 0.4]), BOX.triangles)]
    orders = (-0.51, -0.6, -0.8, -0.9, -1.2)
    found, errors = remainder(pair, [1, -1], 96.0).at(orders)
    others, other_errors = remainder(pair, [1, -1], 96.0, orders, points=1000, seed=1).at(orders)
    assert np.all(np.abs(found - others) <= errors + other_errors)
    assert np.all(errors[:4] < 0.08 * found[:4])


def test_an_error_that_nothing_bounds_at_one_order_leaves_the_others() -> None:
    found = Remainder(96.0, (-0.6, -1.0, -2.0), (1.0, 1.0, 1.0), (0.1, 0.1, np.inf)).at([-0.8, -1.5])
    assert np.isfinite(found[0]).all()
    assert np.isfinite(found[1]).tolist() == [True, False]


def test_between_orders_nothing_is_left_of_equal_meshes() -> None:
    assert np.all(np.abs(remainder([BOX, BOX], [1, -1], 96.0).at([-0.51, -0.8])[0]) < 1e-12)


@pytest.mark.parametrize("size", [1e-6, 1e-3])
def test_few_points_tell_apart_meshes_that_moved_a_little(size: float) -> None:
    rng = np.random.default_rng(3)
    moved = Mesh(BOX.vertices + size * rng.normal(size=BOX.vertices.shape), BOX.triangles)
    # In another order of triangles, points have no counterparts.
    many = remainder([Mesh(BOX.vertices, BOX.triangles[::-1]), moved], [1, -1], 20.0, (-1.0,), points=20_000)
    for seed in range(10):
        few = remainder([BOX, moved], [1, -1], 20.0, (-1.0,), points=200, seed=seed)
        assert few.errors[0] < 0.1 * few.energies[0]
        assert abs(few.energies[0] - many.energies[0]) < few.errors[0] + many.errors[0]


def test_a_far_move_among_small_ones_is_seen_by_few_points() -> None:
    sheets = Rectangles.sheets(400, 0.01, 0.0, (0.05, 0.05))
    offsets = 1e-7 * np.random.default_rng(4).normal(size=(400, 3))
    offsets[77] += 2e-3
    surfaces = [sheets.mesh(), Rectangles(sheets.low + offsets, sheets.high + offsets).mesh()]
    many = remainder(surfaces, [1, -1], 60.0, (-1.0, -2.0), points=4000)
    for seed in range(10):
        few = remainder(surfaces, [1, -1], 60.0, (-1.0, -2.0), points=40, seed=seed)
        assert np.all(np.abs(np.subtract(few.energies, many.energies)) < few.errors)
        assert np.all(np.less(few.errors, many.energies))


@pytest.mark.parametrize("cells", [1, 20])
def test_edges_of_sheets_that_are_large_beside_the_unit_are_not_missed(cells: int) -> None:
    size, gap, radii = 400.0, 0.1, np.linspace(0, 6, 60_001)

    def pairs(height: float) -> float:
        """∬ K over pairs of points of squares at a height, by how many are at a distance within the plane."""
        areas = 2 * np.pi * size**2 * radii - 8 * size * radii**2 + 2 * radii**3
        return float(np.trapezoid(np.pi**2 * np.exp(-2 * np.pi * np.hypot(radii, height)) * areas, radii))

    x, y = np.mgrid[: cells + 1, : cells + 1].reshape(2, -1) * size / cells
    corners = np.array([[0, 1, cells + 2], [0, cells + 2, cells + 1]])
    triangles = (np.flatnonzero((x < size) & (y < size))[:, None, None] + corners).reshape(-1, 3)
    high, low = (Mesh(np.stack([x, y, np.full_like(x, height)], axis=1), triangles) for height in (gap, 0.0))
    found = sb.distance(high, low, -2.0, rtol=1e-2)
    assert abs(found["distance"] - np.sqrt(2 * (pairs(0.0) - pairs(gap)))) < found["error"] < 1e-2 * found["distance"]
