"""Polygons have one area, whichever corner a file lists first; what leaves it open is noted."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Mesh
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.formats.polygons import cut_polygons

# Outlines in the plane, with their areas by hand; holes are joined to outlines by bridges.
FLAT: dict[str, tuple[list[tuple[float, float]], float]] = {
    "square": ([(0, 0), (2, 0), (2, 2), (0, 2)], 4),
    "arrow": ([(0, 0), (4, 0), (4, 4), (3, 1)], 4),
    "triangle with a corner amid a side": ([(0, 0), (2, 0), (4, 0), (0, 4)], 8),
    "triangle with a corner twice": ([(0, 0), (4, 0), (0, 4), (0, 4)], 8),
    "pentagon": ([(0, 0), (2, 0), (3, 1), (1, 3), (0, 2)], 6),
    "square with corners amid sides": ([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)], 4),
    "L": ([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], 5),
    "U": ([(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)], 7),
    "comb": ([(0, 0), (9, 0), *((x, 1 + 3 * (x % 2)) for x in range(9, -1, -1))], 22.5),
    "comb with inner corners twice": (
        [(0, 0), (9, 0), *((x, 1 + 3 * (x % 2)) for x in (9, 8, 8, 7, 6, 6, 5, 4, 4, 3, 2, 2, 1, 0))],
        22.5,
    ),
    "triangle with all corners twice": ([(0, 0), (0, 0), (4, 0), (4, 0), (0, 4), (0, 4)], 8),
    "hole": ([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], 12),
    "back and forth": ([(0, 0), (1, 0), (2, 0), (1, 0), (0.5, 0)], 0),
}
TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def placed(outline: Any, offset: float = 0.0) -> Reals:
    points = np.array(outline, dtype=np.float64)
    return np.asarray(np.column_stack([points, np.zeros(len(points))]) @ TURN + offset)


def area_of(vertices: Reals, corners: Any) -> float:
    """Return the area of one polygon by itself, beside a far triangle of area 1/2, which a mesh needs."""
    far = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float64) + vertices.max() + 9
    indices = np.concatenate([np.arange(3), 3 + np.asarray(corners)])
    raw = cut_polygons(np.concatenate([far, vertices]), indices, np.array([3, len(corners)]))
    assert raw.notes == ()
    return Mesh(*raw).area - 0.5


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_flat_polygons_have_their_area_from_every_corner_on_and_seen_from_both_sides(name: str, offset: float) -> None:
    outline, area = FLAT[name]
    for turned in (outline, outline[::-1]):
        for first in range(len(outline)):
            corners = np.roll(np.arange(len(outline)), first)
            assert area_of(placed(turned, offset), corners) == pytest.approx(area, rel=1e-9 * (1 + offset), abs=1e-9)


def test_a_long_outline_may_have_bridges_from_one_corner_to_all_of_its_holes() -> None:
    # Each hole is a triangle of area 1/20.
    hole = np.array([(9, 0), (10, 0.05), (10, -0.05), (9, 0), (0, 0)])
    turns = [np.array([(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))]) for a in np.linspace(1.56, 0.01, 80)]
    outline = np.concatenate([[(0, 0)], *(hole @ turn for turn in turns), [(20, 0), (20, 20), (0, 20)]])
    assert area_of(placed(outline), np.arange(len(outline))) == pytest.approx(396)


@pytest.mark.parametrize("name", [name for name, (_, area) in FLAT.items() if area])
def test_triangles_face_the_side_of_their_polygon(name: str) -> None:
    outline, _ = FLAT[name]
    for vertices, side in ((placed(outline), 1.0), (placed(outline[::-1]), -1.0)):
        raw = cut_polygons(vertices, np.arange(len(outline)), np.array([len(outline)]))
        a, b, c = Mesh(*raw).corners()
        assert (np.cross(b - a, c - a) @ TURN[2] * side * np.linalg.det(TURN) >= -1e-12).all()


def bent(size: int, seed: int) -> Reals:
    """A regular polygon whose corners stand above and below its plane."""
    angles = 2 * np.pi * np.arange(size) / size
    heights = np.random.default_rng(seed).normal(scale=0.3, size=size)
    return np.asarray(np.column_stack([np.cos(angles), np.sin(angles), heights]) @ TURN)


@pytest.mark.parametrize("size", [4, 5, 8])
@pytest.mark.parametrize("seed", range(5))
def test_bent_polygons_are_one_surface_from_every_corner_on(size: int, seed: int) -> None:
    vertices = bent(size, seed)
    found = set()
    for first in range(size):
        raw = cut_polygons(vertices, np.roll(np.arange(size), first), np.array([size]))
        found.add(frozenset(frozenset(triangle) for triangle in raw.triangles.tolist()))
        assert [note[:25] for note in raw.notes] == ["1 of 1 faces are not flat"]
    assert len(found) == 1


def test_quadrilaterals_bend_along_the_diagonal_of_the_smaller_angle_and_the_effect_is_told() -> None:
    # Over its diagonal from the origin the face is bent by a right angle, over the other one by less.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 0]], dtype=np.float64)
    raw = cut_polygons(np.tile(vertices, (2, 1)), np.arange(8), np.array([4, 4]))
    assert {*raw.triangles[0].tolist()} & {*raw.triangles[1].tolist()} == {1, 3}
    areas = 0.5 + np.sqrt(3) / 2, np.sqrt(2)
    assert Mesh(*raw).area == pytest.approx(2 * areas[0], rel=1e-14)
    # The diagonals are 1 / sqrt(6) apart.
    assert raw.notes == (
        "2 of 2 faces are not flat: the other way to cut them moves them by up to 0.41 and changes their area of 2.73 "
        f"by {2 * abs(areas[1] - areas[0]):.2g}",
    )


@pytest.mark.parametrize("unused", [[0.0, 0.0, 0.0], [np.inf, 0.0, 0.0], [np.nan, np.nan, np.nan]], ids=str)
@pytest.mark.parametrize("size", [4, 7])
def test_vertices_that_no_face_uses_hide_nothing(unused: list[float], size: int) -> None:
    raw = cut_polygons(np.vstack([bent(size, 0) + 5e6, [unused]]), np.arange(size), np.array([size]))
    assert [note[:25] for note in raw.notes] == ["1 of 1 faces are not flat"]


def test_saddles_that_bend_alike_are_cut_from_their_lowest_corner() -> None:
    # Rounding alone would choose a diagonal of these.
    saddle = np.array([[0, 0, 0.1], [1, 0, -0.1], [1, 1, 0.1], [0, 1, -0.1]])
    places = [saddle @ TURN + shift for shift in np.random.default_rng(2).normal(size=(64, 3))]
    vertices, corners = np.concatenate(places), np.arange(256).reshape(64, 4)
    found = set()
    for first in range(4):
        triangles = cut_polygons(vertices, np.roll(corners, first, 1).ravel(), np.full(64, 4)).triangles
        found.add(frozenset(frozenset(triangle) for triangle in triangles.tolist()))
    assert len(found) == 1
    assert len({tuple(sorted(triangle % 4)) for triangle in triangles}) == 2


@pytest.mark.parametrize(
    "outline",
    [
        [(0, 0), (2, 2), (2, 0), (0, 2)],
        [(0, 0), (3, 2), (3, 0), (0, 2)],
        [(0, 0), (2, 2), (2, 0), (0, 2), (-1, 1)],
        [(np.cos(t), np.sin(t)) for t in 4 * np.pi * np.arange(5) / 5],
        [(0, 0), (2, 0), (2, 2), (0, 2)] * 2,
        [(np.cos(t), np.sin(t)) for t in 4 * np.pi * np.arange(14) / 14],
    ],
    ids=["bow tie", "larger on one side", "of five corners", "star", "a square twice", "a heptagon twice"],
)
def test_outlines_that_cross_themselves_are_noted(outline: Any) -> None:
    for first in range(len(outline)):
        raw = cut_polygons(placed(outline), np.roll(np.arange(len(outline)), first), np.array([len(outline)]))
        assert [note[:25] for note in raw.notes] == ["1 of 1 faces cross themse"]


@pytest.mark.parametrize("axis", range(3))
def test_an_outline_whose_lobes_cancel_out_is_noted_in_each_plane(axis: int) -> None:
    lobes = [(1, 1, 0), (2, 0, 0), (1, -1, 0), (-1, 1, 0), (-2, 0, 0), (-1, -1, 0)]
    raw = cut_polygons(np.roll(np.array(lobes, float), axis, 1), np.arange(6), np.array([6]))
    assert [note[:25] for note in raw.notes] == ["1 of 1 faces cross themse"]


def test_faces_of_all_sizes_keep_their_order() -> None:
    parts = [FLAT[name][0] for name in ("L", "square", "pentagon", "arrow")] + [[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]]
    parts = [parts[i] for i in np.random.default_rng(1).integers(0, 5, 50)]
    vertices = np.concatenate([placed(part, 10.0 * i) for i, part in enumerate(parts)])
    sizes = np.array([len(part) for part in parts])
    raw = cut_polygons(vertices, np.arange(len(vertices)), sizes)
    owners = np.repeat(np.arange(50), sizes)[raw.triangles]
    assert (owners == np.repeat(np.arange(50), sizes - 2)[:, None]).all()


def test_polygons_in_the_ten_thousands_take_little_more_memory_than_their_triangles() -> None:
    # Between them stand triangles, and the area of each part is its own.
    part, rows = np.array([*FLAT["L"][0], *FLAT["pentagon"][0], (0, 0), (1, 0), (0, 1)]), 15_000
    vertices = np.concatenate([np.pad(part, ((0, 0), (0, 1)), constant_values=row) for row in range(rows)])
    corners, sizes = np.arange(len(vertices)), np.tile([6, 5, 3], rows)
    tracemalloc.start()
    raw = cut_polygons(vertices, corners, sizes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(Mesh(*raw).areas.reshape(rows, 8).sum(axis=1), 5 + 6 + 0.5, rtol=1e-12)
    assert peak / len(raw.triangles) < 250
