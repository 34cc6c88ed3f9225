"""The largest deviation of two meshes lies between its bounds, which close."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

import sobolev_batch as sb
from sobolev_batch import compiled
from sobolev_batch.arrays import Indices, Reals
from sobolev_batch.geometry import deviation
from sobolev_batch.geometry.closest import Triangles
from sobolev_batch.geometry.proximity import proximity_and_deviations
from sobolev_batch.geometry.subdivision import subdivided
from tests.support.shapes import CENTRED_BOX


def distance_from_triangles(points: Reals, mesh: sb.Mesh) -> Reals:
    """Distances (n,) by minimising over each triangle's plane, sides and corners, in barycentric coordinates."""
    least = np.full(len(points), np.inf)
    for corners in mesh.vertices[mesh.triangles]:
        sides = corners[1:] - corners[0]
        weights = np.linalg.lstsq(sides.T, (points - corners[0]).T, rcond=None)[0].T
        inside = (weights >= 0).all(axis=1) & (weights.sum(axis=1) <= 1)
        flat = np.linalg.norm(points - corners[0] - weights @ sides, axis=1)
        candidates = [np.where(inside, flat, np.inf)]
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = np.clip((points - start) @ (end - start) / max(((end - start) ** 2).sum(), 1e-300), 0, 1)
            candidates.append(np.linalg.norm(points - start - along[:, None] * (end - start), axis=1))
        least = np.minimum(least, np.min(candidates, axis=0))
    return np.asarray(least)


def grid(mesh: sb.Mesh, steps: int) -> Reals:
    """Points on every triangle, the corners among them."""
    weights = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    points: Reals = np.einsum("wk,tkd->twd", weights, mesh.vertices[mesh.triangles])
    return points.reshape(-1, 3)


def plate(hole: bool) -> sb.Mesh:
    """A plate of 1,000 x 1,000, with a round hole of 6 or without."""
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = 3 * np.column_stack([np.cos(angles), np.sin(angles)])
    flat = np.vstack([ring, [[-500, -500], [500, -500], [500, 500], [-500, 500]]])
    triangles = Delaunay(flat).simplices
    if hole:
        triangles = triangles[(triangles >= len(ring)).any(axis=1)]
    return sb.Mesh(np.column_stack([flat, np.zeros(len(flat))]), triangles)


@pytest.fixture
def pieces(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many pairs of a point and a triangle each step measures."""
    counts: list[int] = []
    squares = Triangles.squares

    def counted(self: Triangles, at: Reals, triangles: Indices) -> Reals:
        counts.append(len(triangles))
        return squares(self, at, triangles)

    monkeypatch.setattr(Triangles, "squares", counted)
    return counts


@pytest.mark.parametrize("seed", range(50))
def test_bounds_hold_for_random_triangles_and_are_as_close_as_requested(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Far apart, beside each other, and through each other.
    a, b = (
        sb.Mesh(rng.normal(size=(3 * count, 3)) + shift, np.arange(3 * count).reshape(-1, 3))
        for count, shift in zip(rng.integers(1, 12, 2), (0.0, rng.choice([0.0, 0.1, 3.0])), strict=True)
    )
    gap = float(rng.choice([1e-1, 1e-2, 1e-3]))
    found = sb.largest_deviation(a, b, gap=gap)
    for way, own, other in ((found.forward, a, b), (found.backward, b, a)):
        assert way.upper <= (1 + gap) * way.lower + 1e-12
        assert distance_from_triangles(grid(own, 20), other).max() <= way.upper * (1 + 1e-12)
        # The lower bound is the distance of a point of the mesh.
        place = np.array([way.place])
        assert distance_from_triangles(place, own)[0] < 1e-12
        assert distance_from_triangles(place, other)[0] == pytest.approx(way.lower, rel=1e-9)
    assert found.both.lower == max(found.forward.lower, found.backward.lower)
    assert found.both.upper == max(found.forward.upper, found.backward.upper)


def test_simple_cases_are_exact() -> None:
    box = sb.Mesh(*box_of((1.0, 2.0, 3.0)))
    raised = sb.Mesh(box.vertices + np.array([0, 0, 0.25]), box.triangles)
    assert sb.largest_deviation(box, raised).both.lower == sb.largest_deviation(box, raised).both.upper == 0.25
    same = sb.largest_deviation(box, box).both
    assert (same.lower, same.upper) == (0, 0)
    # The other corner of each triangle is in the same plane.
    other = sb.Mesh(*box_of((1.0, 2.0, 3.0), turn=1))
    assert sb.largest_deviation(box, other).both.upper < 1e-15


def box_of(sizes: tuple[float, float, float], turn: int = 0) -> tuple[Reals, Reals]:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * sizes
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    turned = [quad[turn:] + quad[:turn] for quad in quads]
    return corners, np.array([[q[0], q[i], q[i + 1]] for q in turned for i in (1, 2)])


def test_a_hole_that_was_closed_is_found_between_all_vertices() -> None:
    found = sb.largest_deviation(plate(hole=False), plate(hole=True))
    assert 2.9 <= found.forward.lower <= found.forward.upper <= 3.1
    assert np.linalg.norm(found.forward.place) < 0.1
    assert found.backward.upper < 1e-9
    # No vertex and hardly a sample sees it: a mean that is so small, and yet the bounds.
    near = sb.proximity(plate(hole=False), plate(hole=True))
    assert near["mean"] < 1e-3
    assert (near["hausdorff"], near["hausdorff_upper"]) == (found.both.lower, found.both.upper)
    assert (near["hausdorff_backward"], near["hausdorff_upper_backward"]) == (
        found.backward.lower,
        found.backward.upper,
    )


def test_bounds_are_closer_where_a_length_lies_between_them() -> None:
    meshes = sb.shapes.icosphere(4), sb.shapes.icosphere(2)
    usual, close = sb.proximity(*meshes, points=100), sb.largest_deviation(*meshes, gap=1e-4).both
    length = (close.upper + usual["hausdorff_upper"]) / 2
    assert usual["hausdorff"] < close.lower < close.upper < length < usual["hausdorff_upper"]
    found, _ = proximity_and_deviations(*meshes, points=100, within=length)
    assert close.lower <= found["hausdorff_upper"] <= length
    assert {name for name in usual if usual[name] != found[name]} <= {
        f"hausdorff_upper{way}" for way in ("", "_forward", "_backward")
    }


def test_spheres_against_their_refinements() -> None:
    coarse, fine = sb.shapes.icosphere(2), sb.shapes.icosphere(4)
    found = sb.largest_deviation(coarse, fine, gap=1e-3)
    # The middle of a flat triangle is farthest below the sphere, that of the largest by its circumscribed circle.
    corners = coarse.vertices[coarse.triangles]
    depth = 1 - np.linalg.norm(corners.mean(axis=1), axis=1).min()
    assert found.forward.lower == pytest.approx(depth, rel=0.1)
    assert found.backward.lower == pytest.approx(depth, rel=0.1)


@pytest.mark.parametrize("size", [1e-60, 1e-9, 1e9, 1e60])
def test_any_unit_gives_the_same_digits(size: float) -> None:
    ball, egg = sb.shapes.icosphere(2), sb.shapes.Ellipsoid((1.0, 0.9, 0.8)).mesh(2)
    found = sb.largest_deviation(ball, egg).both
    scaled = sb.largest_deviation(*(sb.Mesh(size * mesh.vertices, mesh.triangles) for mesh in (ball, egg))).both
    assert scaled.lower == pytest.approx(size * found.lower, rel=0.011)
    assert scaled.upper <= 1.01 * scaled.lower


def test_triangles_without_area_and_needles_hide_nothing() -> None:
    ball = sb.shapes.icosphere(2)
    line = np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.5]])
    with_line = sb.Mesh(
        np.vstack([ball.vertices, line]), np.vstack([ball.triangles, len(ball.vertices) + np.arange(3)])
    )
    found = sb.largest_deviation(with_line, ball)
    assert found.forward.lower == pytest.approx(2.0, abs=0.01)
    assert found.forward.place == pytest.approx((0, 0, 3))
    # Distances from a segment are those from its points.
    assert sb.largest_deviation(ball, with_line).forward.upper < 1e-12


def wire(radius: float, sides: int, parts: int) -> sb.Mesh:
    """A wire of length 1 along no axis, cut in parts."""
    angles, heights = 2 * np.pi * np.arange(sides) / sides, np.repeat(np.linspace(0, 1, parts + 1), sides)
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.column_stack([np.tile(ring, (parts + 1, 1)), heights])
    first = np.arange(sides * parts)
    after = first - first % sides + (first + 1) % sides
    triangles = np.concatenate([[first, after, after + sides], [first, after + sides, first + sides]], axis=1).T
    return sb.Mesh(vertices @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0], triangles)


@pytest.mark.parametrize("radius", [1e-5, 1e-7])
def test_thin_wires_deviate_by_the_height_of_an_arc(radius: float) -> None:
    pair, height = (wire(radius, 16, 1), wire(radius, 32, 7)), radius * (1 - np.cos(np.pi / 16))
    found = sb.largest_deviation(*pair)
    assert found.backward.lower == pytest.approx(height, rel=1e-6)
    assert found.both.upper <= 1.01 * height
    assert [sb.largest_deviation(*pair, within=x * height).both.is_within(x * height) for x in (0.95, 1.05)] == [0, 1]


@pytest.mark.parametrize("height", 10.0 ** np.arange(-12, 0, 2))
def test_points_of_a_thin_triangle_have_the_distance_zero(height: float) -> None:
    rng = np.random.default_rng(3)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.4, height, 0]]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    triangles, points = Triangles(sb.Mesh(vertices, [[0, 1, 2]])), rng.dirichlet([1, 1, 1], size=100) @ vertices
    with compiled.by_itself(loops=False):
        assert triangles.squares(points.T / triangles.scale, np.zeros(100, dtype=int)).max() < 1e-31
    with compiled.by_itself(loops=True):
        assert triangles.closest(points)[0].max() < 3e-16


def test_a_clear_question_takes_fewer_pieces(pieces: list[int]) -> None:
    ball, egg = sb.shapes.icosphere(3), sb.shapes.Ellipsoid((1.0, 0.95, 0.9)).mesh(4)
    value = sb.largest_deviation(ball, egg).both.lower
    of_value = sum(pieces)
    # A no is known from the corners, but each piece is bounded once.
    for length, answer, most in ((2 * value, True, of_value / 2), (value / 2, False, 1.5 * of_value)):
        pieces.clear()
        found = sb.largest_deviation(ball, egg, within=length).both
        assert found.is_within(length) is answer
        assert sum(pieces) < most
    # A length between two bounds that are far apart.
    assert deviation.Deviation(0.1, 0.3, (0, 0, 0)).is_within(0.2) is None


@pytest.mark.parametrize("factor", [1.05, 2])
def test_a_yes_searches_each_triangle_once_where_many_others_cover_it(
    factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[int] = []
    closest = Triangles.closest

    def counted(self: Triangles, points: Reals) -> tuple[Reals, Indices]:
        searched.append(len(points))
        return closest(self, points)

    monkeypatch.setattr(Triangles, "closest", counted)
    coarse, fine = sb.shapes.icosphere(3), Triangles(sb.shapes.icosphere(5))
    value = deviation.directed_deviation(coarse, fine).lower
    of_value, least = sum(searched), len(coarse.vertices) + len(coarse.triangles)
    searched.clear()
    found = deviation.directed_deviation(coarse, fine, within=factor * value)
    assert value <= found.upper <= factor * value
    # Its corners and its center.
    assert sum(searched) == least < of_value / 10


@pytest.mark.parametrize("size", [1e-60, 1.0, 1e60])
def test_vertices_that_moved_less_than_a_length_take_no_search(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    ball, rng = sb.shapes.icosphere(3), np.random.default_rng(0)
    moves = rng.normal(scale=0.01, size=ball.vertices.shape)
    # No triangle uses the last one.
    rows = np.append(ball.vertices, [[0, 0, 0]], axis=0), np.append(ball.vertices + moves, [[9, 9, 9]], axis=0)
    pair = [sb.Mesh(size * vertices, ball.triangles) for vertices in rows]
    value, longest = sb.largest_deviation(*pair), size * np.linalg.norm(moves, axis=1).max()
    monkeypatch.delattr(Triangles, "closest")
    found = sb.largest_deviation(*pair, within=1.001 * longest)
    for way, of_value in ((found.forward, value.forward), (found.backward, value.backward)):
        assert 0 < way.lower <= of_value.upper <= way.upper
        assert way.upper == pytest.approx(longest)
    with pytest.raises(AttributeError, match="closest"):
        sb.largest_deviation(*pair, within=0.999 * longest)


def test_a_question_on_the_edge_is_decided() -> None:
    ball, egg = sb.shapes.icosphere(2), sb.shapes.Ellipsoid((1.0, 0.9, 0.8)).mesh(2)
    found = sb.largest_deviation(ball, egg, gap=1e-4).both
    for factor, answer in ((0.999, False), (1.001, True)):
        assert (
            sb.largest_deviation(ball, egg, within=factor * found.lower).both.is_within(factor * found.lower) is answer
        )


def test_a_clear_question_far_from_the_origin_is_decided() -> None:
    tubes = [tube(turn, sides=12, parts=1) for turn in (0.0, 1e-5)]
    pair = [sb.Mesh(mesh.vertices + np.array([3e6, -5e6, 4e6]), mesh.triangles) for mesh in tubes]
    value = sb.largest_deviation(*pair).both.upper
    for length in value * np.linspace(1.2, 3, 10):
        assert sb.largest_deviation(*pair, within=length).both.is_within(length)


def test_the_compiled_loop_gives_the_distances_of_the_arrays() -> None:
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(300, 3, 3)) * 10.0 ** rng.integers(-6, 6, (300, 1, 1))
    corners[:50, 2] = corners[:50, 1]
    corners[50:100, 2] = corners[50:100, 0] + 1e-9 * corners[50:100, 1]
    triangles = Triangles(sb.Mesh(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)))
    points = np.concatenate([corners.mean(axis=1), corners[:, 0], rng.normal(size=(300, 3))]).T / triangles.scale
    tried = np.tile(np.arange(300), 3)
    with compiled.by_itself(loops=False):
        arrays = triangles.squares(points, tried)
    with compiled.by_itself(loops=True):
        loop = triangles.squares(points, tried)
    np.testing.assert_allclose(loop, arrays, rtol=1e-9, atol=1e-28)
    assert not loop[300:600].any()


@pytest.mark.parametrize("wrong", [{"gap": 0}, {"gap": "1"}, {"within": -1.0}, {"within": float("nan")}])
def test_refuses_what_is_no_length(wrong: dict[str, float]) -> None:
    with pytest.raises(sb.errors.InputError, match="must be a positive number, found"):
        sb.largest_deviation(sb.shapes.icosphere(0), sb.shapes.icosphere(1), **wrong)


@pytest.mark.parametrize("is_forward", [True, False])
def test_thin_triangles_cut_finer_in_single_precision_take_few_pieces(is_forward: bool, pieces: list[int]) -> None:
    ring = 2 * np.pi * np.arange(48) / 48
    points = np.concatenate([[[40.0, 25.0]], np.c_[6 * np.cos(ring) - 25, 6 * np.sin(ring) + 5]])
    coarse = sb.Mesh(np.c_[points, 0.1 * points[:, 0]].astype(np.float32), [[0, k, k % 48 + 1] for k in range(1, 49)])
    fine = subdivided(subdivided(subdivided(coarse)))
    fine = sb.Mesh(fine.vertices.astype(np.float32), fine.triangles)
    pair = (fine, coarse) if is_forward else (coarse, fine)
    found = deviation.directed_deviation(pair[0], Triangles(pair[1]))
    # Rounding along the three axes, and the gap that it permits.
    assert 0 < found.lower <= found.upper <= 3 * 2.0**-22 * 40
    assert sum(pieces) < 600 * len(fine.triangles)


def test_a_flat_part_turned_by_a_millionth_takes_few_pieces(pieces: list[int]) -> None:
    part = plate(hole=True)
    cosine, sine = np.cos(1e-6), np.sin(1e-6)
    turned = part.vertices @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    found = sb.largest_deviation(part, sb.Mesh(turned, part.triangles)).both
    # A corner moves by 500e-6 along each axis: it leaves the square by that.
    assert found.lower == pytest.approx(500e-6, rel=1e-3)
    assert found.upper <= 1.01 * found.lower
    assert sum(pieces) < 500 * len(part.triangles)


def strips(count: int, axis: int, height: float) -> sb.Mesh:
    """A square of side 1 in long thin strips along an axis, one corner of it raised."""
    ends = np.linspace(0, 1, count + 1)
    flat = np.stack([np.tile([0.0, 1.0], count + 1), np.repeat(ends, 2)], axis=1)
    first = 2 * np.arange(count)[:, None]
    triangles = np.concatenate([first + np.array(corners) for corners in ([0, 1, 2], [1, 3, 2])])
    raised = np.where(np.all(flat == 1, axis=1), height, 0.0)
    return sb.Mesh(np.column_stack([flat if axis == 0 else flat[:, ::-1], raised]), triangles)


def test_planes_cut_into_strips_across_each_other_take_few_pieces(pieces: list[int]) -> None:
    pair = strips(700, 0, 1e-5), strips(700, 1, 0.0)
    found = sb.largest_deviation(*pair)
    assert found.both.lower == pytest.approx(1e-5)
    assert found.both.upper <= 1.01 * found.both.lower
    # They cross each other half a million times.
    assert sum(pieces) < 2_500_000


@pytest.mark.parametrize("is_open", [False, True])
def test_the_inside_of_a_thin_wall_takes_few_pieces(is_open: bool, pieces: list[int]) -> None:
    vertices = CENTRED_BOX.vertices * [1, 0.7, 1e-3] @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    wall, triangles = sb.Mesh(vertices, CENTRED_BOX.triangles), CENTRED_BOX.triangles
    changed = sb.Mesh(vertices, triangles[1:]) if is_open else sb.Mesh(1.003 * vertices, triangles)
    found = sb.largest_deviation(wall, changed).both
    assert found.upper <= 1.01 * found.lower * (1 + 1e-9)
    assert sum(pieces) < 10_000


def test_lines_beside_a_triangle_take_few_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [[0.4, 0.5, -1.3], [0.7, -0.1, -0.2], [0.2, -1.2, -0.7], [-1.1, -1.0, 1.3]]
    small, large = (
        [[0.9, 0.3, 0.3], [-0.2, 1.1, 0.7], [0.5, 0.3, -0.3]],
        [[0.5, 1.8, 0.0], [-0.2, 0.6, -1.2], [1.5, -1.7, -1.3]],
    )
    other = Triangles(sb.Mesh([*lines, *small], [[0, 1, 1], [2, 3, 3], [4, 5, 6]]))
    monkeypatch.setattr(deviation, "_MOST_PIECES", 1000)
    found = deviation.directed_deviation(sb.Mesh(large, [[0, 1, 2]]), other)
    assert found.upper <= 1.01 * found.lower


def tube(turn: float, sides: int = 48, parts: int = 10) -> sb.Mesh:
    """A tube of radius 1, turned by so many of its sides."""
    angles, heights = 2 * np.pi * (np.arange(sides) + turn) / sides, np.repeat(np.linspace(0, 1, parts + 1), sides)
    vertices = np.column_stack([np.tile([np.cos(angles), np.sin(angles)], parts + 1).T, heights])
    first = np.arange(sides * parts)
    after = first - first % sides + (first + 1) % sides
    corners = [[first, after, after + sides], [first, after + sides, first + sides]]
    return sb.Mesh(vertices, np.concatenate(corners, axis=1).T)


@pytest.mark.parametrize("turns", [(0.0, 0.5), (0.5, 0.0), (0.3, 0.0)])
@pytest.mark.parametrize("gap", [1e-3, 1e-6])
def test_close_bounds_end_where_the_distance_is_the_same_along_lines(
    turns: tuple[float, float], gap: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deviation, "_MOST_PIECES", 30_000)
    pair = [tube(turn) for turn in turns]
    found = deviation.directed_deviation(pair[0], Triangles(pair[1]), gap)
    assert found.upper <= (1 + gap) * found.lower * (1 + 1e-9)
    # Its edges are above the middles of the other one's faces.
    if 0.5 in turns:
        assert found.lower == pytest.approx(1 - np.cos(np.pi / 48), rel=gap)
