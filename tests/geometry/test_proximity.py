"""Hausdorff and Chamfer distances against geometry that is known, and against another library's search."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

import sobolev_batch as sb
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.proximity import MOST_POINTS, proximity, sampled_numbers, share_beyond
from tests.support.shapes import CENTRED_BOX


def square(side: float, height: float = 0.0, *, stray: tuple[float, float, float] | None = None) -> sb.Mesh:
    corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    vertices = [[0.5 * side * x, 0.5 * side * y, height] for x, y in corners]
    return sb.Mesh(np.array([*vertices, *([stray] if stray else [])], dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize(
    ("a", "b", "hausdorff", "chamfer"),
    [
        (square(2.0), square(2.0, 0.25), 0.25, 0.5),
        # A vertex that no triangle uses is not on the surface.
        (square(2.0), square(2.0, 0.25, stray=(50.0, 0.0, 0.0)), 0.25, 0.5),
        (sb.shapes.icosphere(3), sb.shapes.icosphere(3), 0.0, 0.0),
    ],
)
def test_surfaces_that_are_parallel_or_the_same(a: sb.Mesh, b: sb.Mesh, hausdorff: float, chamfer: float) -> None:
    found = proximity(a, b, points=500)
    assert found["hausdorff"] == pytest.approx(hausdorff, rel=1e-12, abs=1e-15)
    assert found["chamfer"] == pytest.approx(chamfer, rel=1e-12, abs=1e-15)
    assert found["chamfer_error"] < 1e-12


@pytest.mark.slow
def test_a_square_within_a_larger_one() -> None:
    found = proximity(square(2.0), square(4.0), points=200_000, threshold=0.5)
    # The corner of the larger is the farthest point; from the smaller one all distances are zero.
    assert found["hausdorff"] == found["hausdorff_backward"] == pytest.approx(np.sqrt(2), rel=1e-12)
    assert found["hausdorff_forward"] == found["mean_forward"] == 0
    # Mean over the square [-2, 2]²: four strips of mean 1/2 and four corner squares of mean
    # (√2 + asinh 1)/3, over 16. Squares have the mean 1/3 in a strip and 2/3 in a corner.
    exact = (4 * 2 * 0.5 + 4 * (np.sqrt(2) + np.arcsinh(1)) / 3) / 16
    assert 0 < found["chamfer_error"] < 0.01
    assert abs(found["chamfer"] - exact) < 4 * found["chamfer_error"]
    assert abs(found["rms"] - np.sqrt(1 / 3)) < 4 * found["rms_error"] < 0.01
    # A square with round corners is within the threshold.
    recall = (4 + 4 * 2 * 0.5 + np.pi * 0.5**2) / 16
    assert found["precision"] == 1
    assert found["recall"] == pytest.approx(recall, abs=5e-3)
    assert found["fscore"] == pytest.approx(2 * recall / (1 + recall), abs=5e-3)
    # A quarter of the area is at a distance of 0, so half of it within the distance with (2 + 2d)² - (4 - π) d² = 8.
    assert (4 + 8 * found["p50"] + np.pi * found["p50"] ** 2) / 16 == pytest.approx(0.5, abs=5e-3)
    assert proximity(square(4.0), square(2.0), points=200_000)["hausdorff"] == found["hausdorff"]


@pytest.mark.parametrize("flipped", [False, True])
def test_planes_at_an_angle(flipped: bool) -> None:
    flat, angle = square(2.0), np.radians(20)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    tilted = sb.Mesh(flat.vertices @ turn, flat.triangles[:, ::-1] if flipped else flat.triangles)
    found = proximity(tilted, flat, points=100)
    assert (found["normal_mean"], found["normal_max"]) == pytest.approx((20, 20), rel=1e-12)
    # The farthest point of the one is over the other, the mean height is half of it.
    assert found["hausdorff_forward"] == pytest.approx(np.sin(angle), rel=1e-12)


def test_concentric_spheres() -> None:
    inner, outer = (
        sb.Mesh(radius * sb.shapes.icosphere(5).vertices, sb.shapes.icosphere(5).triangles) for radius in (1, 1.5)
    )
    found = proximity(outer, inner, points=2000, threshold=0.4)
    for name in ("hausdorff", "mean", "rms", "p50", "p99", "mean_forward", "mean_backward"):
        assert found[name] == pytest.approx(0.5, abs=2e-3)
    assert (found["fscore"], proximity(outer, inner, points=2000, threshold=0.6)["fscore"]) == (0, 1)
    # Between facets are 2.4 degrees or less, and a point beside an edge is as close to both of them.
    assert found["normal_max"] < 3


@pytest.mark.slow
def test_the_error_is_that_of_the_drawing() -> None:
    a, b = square(2.0), square(4.0)
    exact = proximity(a, b, points=400_000)["chamfer"]
    drawn = [proximity(a, b, points=400, seed=seed) for seed in range(60)]
    deviations = np.array([found["chamfer"] - exact for found in drawn]) / [found["chamfer_error"] for found in drawn]
    assert 0.7 < deviations.std() < 1.4
    assert abs(deviations.mean()) < 0.5


def test_numbers_of_random_points_are_within_their_errors() -> None:
    a, b = Triangles(sb.shapes.icosphere(0)), Triangles(sb.shapes.icosphere(2))
    many, drawn = sampled_numbers(a, b, 60_000, seed=99), [sampled_numbers(a, b, 900, seed=seed) for seed in range(80)]
    for name in ("mean", "rms_forward", "p50_backward", "p95", "bias", "chamfer", "normal_mean"):
        errors = np.array([found[f"{name}_error"] for found in drawn])
        # 99 % are expected of these.
        assert np.mean(np.abs([found[name] - many[name] for found in drawn]) <= 2.58 * errors) >= 0.95, name
        assert (errors < 0.03 * abs(many[name])).all(), name
    # Half of the area is 0.25 off, so the median is zero or 0.25, by chance.
    corners, sides = square(2.0).vertices, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    flat, raised = (Triangles(sb.Mesh(np.vstack([corners, corners + np.array([5, 0, z])]), sides)) for z in (0.0, 0.25))
    steps = [sampled_numbers(raised, flat, 400, seed=seed) for seed in range(100)]
    assert {0.0, 0.25} <= {found["p50_forward"] for found in steps}
    covered = [
        abs(found["p50_forward"] - height) <= 2.58 * found["p50_forward_error"]
        for found in steps
        for height in (0.0, 0.25)
    ]
    assert np.mean(covered) >= 0.95


@pytest.mark.parametrize("expected_points", [0.5, 2.0, 4.0])
def test_errors_allow_for_a_spot_that_all_points_miss(expected_points: float) -> None:
    flat, share = square(2.0), expected_points / 500
    side, corners = 2 * np.sqrt(share / (1 - share)), square(1.0).vertices
    vertices = [*flat.vertices, *(side * corners + [0, 0, 9.0])]
    whole = sb.Mesh(np.array(vertices), [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    drawn = [proximity(whole, flat, points=500, seed=seed) for seed in range(60)]
    for name, exact in (("mean", 9 * share), ("bias", 9 * share), ("rms", 9 * np.sqrt(share))):
        assert min(found[name] for found in drawn) < 0.6 * exact
        assert np.mean([abs(found[name] - exact) <= 2.58 * found[f"{name}_error"] for found in drawn]) >= 0.98


def test_distances_of_vertices_as_another_search_finds_them() -> None:
    rng = np.random.default_rng(3)
    a, b = (
        sb.Mesh(rng.normal(size=(30, 3)), np.array([rng.choice(30, 3, replace=False) for _ in range(25)]))
        for _ in range(2)
    )
    farthest = 0.0
    for mesh, other in ((a, b), (b, a)):
        surface = trimesh.Trimesh(other.vertices, other.triangles, process=False)
        on_mesh = mesh.vertices[np.unique(mesh.triangles)]
        _, distances, _ = trimesh.proximity.closest_point_naive(surface, on_mesh)
        farthest = max(farthest, float(distances.max()))
    found = proximity(a, b, points=2000)
    assert farthest - 1e-12 <= found["hausdorff"] < 1.3 * farthest


def test_triangles_of_all_sizes_are_searched() -> None:
    rng = np.random.default_rng(8)
    sizes = 10.0 ** rng.uniform(-3, 1, size=(400, 1, 1))
    corners = rng.normal(size=(400, 1, 3)) + sizes * rng.normal(size=(400, 3, 3)) * [1, 1, 0.01]
    many = sb.Mesh(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3))
    points = sb.Mesh(np.vstack([3 * rng.normal(size=(300, 3)), [[9.0, 9.0, 9.0]]]), np.arange(300).reshape(-1, 3))
    surface = trimesh.Trimesh(many.vertices, many.triangles, process=False)
    _, expected, _ = trimesh.proximity.closest_point_naive(surface, points.vertices[:300])
    found = sb.vertex_distances(points, many)
    assert found[:300] == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert np.isnan(found[300])


@pytest.mark.parametrize("unit", [1e-3, 1.0, 25.4])
def test_vertices_of_spheres_and_plates_have_distances_in_closed_form(unit: float) -> None:
    ball = sb.shapes.icosphere(3)
    inner, outer = (sb.Mesh(unit * radius * ball.vertices + 7 * unit, ball.triangles) for radius in (1.0, 1.5))
    # The closest point of a convex body is its vertex on the same ray.
    assert sb.vertex_distances(outer, inner) == pytest.approx(np.full(len(ball.vertices), 0.5 * unit), rel=1e-12)
    # From within a convex body the closest plane of a triangle decides.
    first, second, third = ball.corners()
    normals = np.cross(second - first, third - first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = 1.5 * (normals * first).sum(axis=1) - ball.vertices @ normals.T
    assert sb.vertex_distances(inner, outer) == pytest.approx(unit * heights.min(axis=1), rel=1e-12)
    plate, raised = square(2.0 * unit), square(2.0 * unit, 0.25 * unit, stray=(9.0, 9.0, 9.0))
    assert sb.vertex_distances(plate, raised) == pytest.approx(np.full(4, 0.25 * unit), rel=1e-12)
    assert sb.vertex_distances(raised, plate)[:4] == pytest.approx(np.full(4, 0.25 * unit), rel=1e-12)
    # A larger plate reaches beyond a smaller one: its corners have a diagonal to go.
    larger = square(8.0 * unit, 4.0 * unit)
    assert sb.vertex_distances(larger, plate) == pytest.approx(np.full(4, np.sqrt(9 + 9 + 16) * unit), rel=1e-12)


def in_box(points: Any, side: float = 1.0) -> Any:
    return np.abs(points).max(axis=1) < side / 2


def in_needle(points: Any) -> Any:
    # The sides of this pyramid over a thin triangle meet at angles of a few degrees.
    return (np.c_[points, np.ones(len(points))] @ np.linalg.inv(np.c_[NEEDLE.vertices, np.ones(4)]) > 0).all(axis=1)


def as_mesh(made: Any, *, turned: bool = False) -> sb.Mesh:
    return sb.Mesh(np.asarray(made.vertices), np.asarray(made.faces)[:, :: -1 if turned else 1])


def apart(mesh: sb.Mesh) -> sb.Mesh:
    return sb.Mesh(mesh.vertices[mesh.triangles].reshape(-1, 3), np.arange(3 * len(mesh.triangles)).reshape(-1, 3))


NEEDLE = sb.Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.05, 0], [0.5, 0.02, 1]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
)
BOX, HOLE = as_mesh(trimesh.creation.box((1, 1, 1))), as_mesh(trimesh.creation.box((0.6, 0.6, 0.6)), turned=True)
HOLLOW = sb.Mesh(np.vstack([BOX.vertices, HOLE.vertices]), np.vstack([BOX.triangles, HOLE.triangles + 8]))


@pytest.mark.parametrize(
    ("mesh", "is_inside"),
    [
        (BOX, in_box),
        (sb.Mesh(BOX.vertices, BOX.triangles[:, ::-1]), in_box),
        (HOLLOW, lambda points: in_box(points) & ~in_box(points, 0.6)),
        (NEEDLE, in_needle),
        # Every triangle has vertices of its own: across sharp edges, normals of single triangles mislead.
        (apart(NEEDLE), in_needle),
        # What is above a sheet is where its triangles face; beyond its ends, on the side of its plane.
        (square(2.0), lambda points: points[:, 2] < 0),
    ],
)
@pytest.mark.parametrize(("unit", "origin"), [(1.0, 0.0), (1e-60, 0.0), (1e30, 0.0), (1.0, 2.0**20)])
def test_distances_are_negative_inside(mesh: sb.Mesh, is_inside: Any, unit: float, origin: float) -> None:
    points = np.random.default_rng(5).uniform(-1.2, 1.2, (3000, 3))
    points[2000:] = 1.0001 * mesh.vertices[np.arange(1000) % len(mesh.vertices)] + 1e-3 * points[2000:]
    cloud, other = (
        sb.Mesh(unit * one.vertices + origin, one.triangles)
        for one in (sb.Mesh(points, np.arange(3000).reshape(-1, 3)), mesh)
    )
    found = sb.vertex_distances(cloud, other, signed=True)
    np.testing.assert_array_equal(np.abs(found), sb.vertex_distances(cloud, other))
    np.testing.assert_array_equal(found < 0, is_inside(points))


def test_the_bias_is_the_mean_distance_with_its_sign() -> None:
    ball = sb.shapes.icosphere(4)
    larger = sb.Mesh(1.5 * ball.vertices, ball.triangles)
    for a, b, expected in ((larger, ball, 0.5), (ball, larger, -0.5)):
        assert proximity(a, b, points=2000)["bias"] == pytest.approx(expected, abs=4e-3)
    # Noise is outside as often as inside.
    factors = 1 + 0.01 * np.random.default_rng(1).normal(size=(len(ball.vertices), 1))
    noisy = proximity(sb.Mesh(factors * ball.vertices, ball.triangles), ball, points=2000)
    assert abs(noisy["bias"]) < 4 * noisy["bias_error"] < noisy["mean_forward"] / 5
    # One triangle faces the other side, so that there is no outside.
    turned = ball.triangles.copy()
    turned[0] = turned[0, ::-1]
    assert np.isnan(proximity(larger, sb.Mesh(ball.vertices, turned), points=100)["bias"])
    with pytest.raises(sb.errors.InputError, match="no outside: 3 edges"):
        sb.vertex_distances(larger, sb.Mesh(ball.vertices, turned), signed=True)


def test_the_share_of_the_area_beyond_a_length() -> None:
    # A square of side 4 around one of side 2: all but what is within the threshold of the smaller one.
    share, error, of = share_beyond(square(2.0), square(4.0), 0.5)
    assert of == 1
    assert share_beyond(square(4.0), square(2.0), 0.5)[2] == 0
    assert 0 < error < 0.01
    assert abs(share - (1 - (4 + 4 * 2 * 0.5 + np.pi * 0.5**2) / 16)) < 4 * error
    share, error, _ = share_beyond(square(4.0), square(4.0, 0.25), 0.26)
    assert (share, error) == pytest.approx((0.0, 1e-4), rel=0.01)


def test_distances_of_vertices_are_measured_between_meshes_alone() -> None:
    with pytest.raises(sb.errors.InputError, match="mesh"):
        sb.vertex_distances(sb.shapes.icosphere(1), sb.shapes.Sphere())


@pytest.mark.parametrize("scale", [1e-60, 1e-12, 1.0, 1e12, 1e60])
def test_lengths_scale(scale: float) -> None:
    a, b = square(2.0), square(3.0, 0.25)
    plain = proximity(a, b, points=300)
    scaled = proximity(*(sb.Mesh(scale * mesh.vertices, mesh.triangles) for mesh in (a, b)), points=300)
    assert scaled["hausdorff"] == pytest.approx(scale * plain["hausdorff"], rel=1e-9)
    assert scaled["chamfer"] == pytest.approx(scale * plain["chamfer"], rel=1e-9)


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("points", [0, 1, -5, MOST_POINTS + 1, 2.5, True], "points must be an integer"),
        ("threshold", [0, -1.0, np.nan, np.inf, "1"], "threshold must be a positive number"),
        ("seed", [-1, 0.5, "1", True, None], "seed must be a whole number from 0 on"),
    ],
)
def test_wrong_points_and_seeds_are_refused(key: str, values: list[Any], message: str) -> None:
    for value in values:
        with pytest.raises(sb.errors.InputError, match=message):
            proximity(square(1.0), square(2.0), **{key: value})


def test_points_in_the_planes_of_a_plate_beside_it_are_outside() -> None:
    plate, rng = CENTRED_BOX.vertices * [1, 0.7, 0.01], np.random.default_rng(0)
    beside = np.concatenate([plate * factors for factors in ([1.01, 1, 1], [1, 1.01, 1], [1, 1, 1.5])])
    for _ in range(200):
        turn, place = np.linalg.qr(rng.normal(size=(3, 3)))[0], 100 * rng.normal(size=3)
        points = sb.Mesh(beside @ turn + place, np.arange(24).reshape(-1, 3))
        mesh = sb.Mesh(plate @ turn + place, CENTRED_BOX.triangles)
        assert sb.vertex_distances(points, mesh, signed=True).min() > 0


def test_beside_the_border_of_a_flat_sheet_is_outside() -> None:
    rng, beside = np.random.default_rng(0), np.array([[2, 0, 0], [1.5, 1.2, 0], [-1.001, 0.3, 0]])
    for _ in range(50):
        turn, place = np.linalg.qr(rng.normal(size=(3, 3)))[0], 100 * rng.normal(size=3)
        points = sb.Mesh(beside @ turn + place, [[0, 1, 2]])
        sheet = sb.Mesh(square(2.0).vertices @ turn + place, square(2.0).triangles)
        assert sb.vertex_distances(points, sheet, signed=True).min() > 0


@pytest.mark.parametrize(
    ("radius", "place", "turned"), [(0.8, 2.5, True), (0.8, 2.5, False), (0.5, 0.0, False), (0.8, 1.0, False)]
)
def test_parts_turned_inside_out_within_others_or_across_them_have_the_same_inside(
    radius: float, place: float, turned: bool
) -> None:
    ball, rng = sb.shapes.icosphere(3), np.random.default_rng(0)
    other = ball.triangles[:, ::-1] if turned else ball.triangles
    vertices = np.vstack([ball.vertices, radius * ball.vertices + [place, 0, 0]])
    both = sb.Mesh(vertices, np.vstack([ball.triangles, other + len(ball.vertices)]))
    points = rng.uniform([-1.5, -1.5, -1.5], [3.5, 1.5, 1.5], size=(600, 3))
    depths = [np.linalg.norm(points - [at, 0, 0], axis=1) - size for at, size in ((0, 1), (place, radius))]
    points = points[np.min(np.abs(depths), axis=0) > 0.02][:300]
    cloud = sb.Mesh(points, np.arange(len(points) // 3 * 3).reshape(-1, 3))
    used, is_inside = cloud.used_vertices, np.zeros(len(points), dtype=bool)
    for at, size in ((0, 1), (place, radius)):
        is_inside |= np.linalg.norm(points - [at, 0, 0], axis=1) < size
    np.testing.assert_array_equal(sb.vertex_distances(cloud, both, signed=True)[used] < 0, is_inside[used])


@pytest.mark.parametrize("width", [0.0, 1e-16, 1e-12, 1e-9, 1e-6])
def test_sides_do_not_depend_on_triangles_without_area(width: float) -> None:
    # A corner divides one side of an edge of a box, and a sliver closes the gap to the other side.
    rng, box, faces = np.random.default_rng(3), BOX.vertices, BOX.triangles
    for number, (a, b, c) in enumerate(faces.tolist()):
        slit = [[a, 8, c], [8, b, c], [b, 8, a]]
        corners = np.vstack([box, (box[a] + box[b]) / 2 + width * rng.normal(size=3)])
        points, turn = corners[8] + 0.2 * rng.normal(size=(300, 3)), np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = points[np.abs(np.abs(points).max(axis=1) - 0.5) > 1e-4][:297]
        cloud = sb.Mesh(points @ turn, np.arange(len(points) // 3 * 3).reshape(-1, 3))
        mesh = sb.Mesh(corners @ turn, np.vstack([np.delete(faces, number, axis=0), slit]))
        found = sb.vertex_distances(cloud, mesh, signed=True)
        np.testing.assert_array_equal(found[cloud.used_vertices] < 0, in_box(points)[cloud.used_vertices])
