"""What two meshes have in common, taken out of both: as much as there is, and what is left is the same measure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from scipy.stats import special_ortho_group

from sobolev_batch import Mesh
from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.geometry.overlap import Rests, rests_of
from sobolev_batch.shapes import icosphere
from sobolev_batch.transform.exact import exact_transform
from tests.coverage.solids import edited
from tests.support.rectangles import Rectangles
from tests.support.shapes import soup

FREQUENCIES: Reals = np.random.default_rng(3).normal(size=(40, 3)) * np.geomspace(0.1, 30, 40)[:, None]

# Rounding to single precision.
SINGLE_ROUNDING = 2.0**-22


def values(mesh: Mesh | None) -> Complexes:
    return np.zeros(len(FREQUENCIES), complex) if mesh is None else exact_transform(mesh, FREQUENCIES)


def areas(rests: Rests) -> Reals:
    return np.array([0.0 if mesh is None else mesh.area for mesh in rests.meshes])


def excess(rests: Rests) -> float:
    first, second = areas(rests)
    return float(first - second)


def area(rectangles: Rectangles) -> float:
    sides = np.sort(rectangles.high - rectangles.low, axis=1)
    return float((sides[:, 1] * sides[:, 2]).sum())


def assert_same_difference(first: Mesh, second: Mesh, rests: Rests, tolerance: float = 1e-12) -> None:
    """Check that the measures of two meshes differ by what is left of them."""
    gap = values(first) - values(second) - (values(rests.meshes[0]) - values(rests.meshes[1]))
    scale = tolerance * (first.area + second.area)
    # Phases at high frequencies turn with the rounding of coordinates.
    reach = max(float(np.abs(mesh.vertices).max()) for mesh in (first, second))
    assert np.all(np.abs(gap) <= scale * (1 + reach * np.linalg.norm(FREQUENCIES, axis=1)))
    assert abs(first.area - second.area - excess(rests)) <= scale


def square(side: float, *, at: Sequence[float] = (0.0, 0.0, 0.0), fan: int = 0) -> Mesh:
    """A square across the last axis: in two triangles, or a fan around a point and further corners on its sides."""
    if not fan:
        return Mesh(np.array([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]]) + at, [[0, 1, 2], [0, 2, 3]])
    rng = np.random.default_rng(fan)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    along = np.concatenate([np.zeros((4, 1)), np.sort(rng.random((4, fan)), axis=1)], axis=1)[..., None]
    ring = (corners[:, None] + along * (np.roll(corners, -1, axis=0) - corners)[:, None]).reshape(-1, 2)
    flat = side * np.concatenate([[rng.uniform(0.2, 0.8, size=2)], ring])
    n = np.arange(len(ring))
    return Mesh(np.c_[flat, np.zeros(len(flat))] + at, np.c_[np.zeros_like(n), 1 + n, 1 + (n + 1) % len(ring)])


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def moved(mesh: Mesh, seed: int) -> Mesh:
    """The mesh, turned and moved at random, as all of a seed are."""
    rng = np.random.default_rng(seed)
    turn = special_ortho_group.rvs(3, random_state=rng)
    return Mesh(mesh.vertices @ turn + rng.normal(size=3), mesh.triangles)


def test_a_face_of_very_many_triangles_is_taken_out() -> None:
    # One by one, so many equal areas add up to 4e-12 too much.
    count = 289
    places, (i, j) = np.linspace(0, 1, count + 1), np.divmod(np.arange(count**2), count)
    first = i * (count + 1) + j
    triangles = np.concatenate(
        [np.c_[first, first + count + 1, first + 1], np.c_[first + 1 + count, first + count + 2, first + 1]]
    )
    grid = np.stack(np.meshgrid(places, places, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    assert rests_of(Mesh(grid, triangles), square(1.0)).meshes == (None, None)


@pytest.mark.parametrize("seed", range(12))
def test_what_an_edit_left_as_it_was_is_taken_out(seed: int) -> None:
    pair = edited(np.random.default_rng(seed))
    assert pair.rectangles is not None
    meshes = cast(Sequence[Mesh], pair.surfaces)
    for first, second in (meshes, [moved(mesh, seed) for mesh in meshes]):
        rests = rests_of(first, second)
        assert_same_difference(first, second, rests)
        # A plane that both hardly share stays.
        assert np.all(areas(rests) - [area(one) for one in pair.rectangles] <= 0.02 * first.area)
        assert not rests.distances.any()


def test_an_edit_leaves_only_its_own_faces() -> None:
    plate = square(1.0, fan=20)
    boss = Rectangles.box([0.3, 0.4, 0.0], [0.32, 0.42, 0.02])
    others = square(1.0, fan=7), boss.mesh()
    # The bottom of the boss covers the plate once more.
    rests = rests_of(plate, joined(*others))
    assert areas(rests) == pytest.approx([0.0, area(boss)], abs=1e-12)
    assert rests.meshes[1] is not None
    assert len(rests.meshes[1].triangles) == 12


@pytest.mark.parametrize("counts", [(2, 1), (1, 3), (4, 4)])
def test_what_is_covered_more_often_is_left_so_often(counts: tuple[int, int]) -> None:
    first, second = (
        moved(joined(*(square(1.0, fan=3 * number + which) for number in range(1, count + 1))), 5)
        for which, count in enumerate(counts)
    )
    small = moved(square(0.5, at=(0.75, 0.75, 0.0), fan=3), 5)
    turned = Mesh(second.vertices, second.triangles[:, ::-1])
    rests = rests_of(joined(first, small), turned)
    expected = np.maximum([counts[0] - counts[1], counts[1] - counts[0]], 0).astype(float)
    # A quarter of the small square lies on the others.
    expected += [0.25 - 0.0625, 0.0] if counts[0] < counts[1] else [0.25, 0.0]
    expected[1] -= 0.0625 if counts[0] < counts[1] else 0.0
    assert areas(rests) == pytest.approx(expected, abs=1e-12)
    assert_same_difference(joined(first, small), turned, rests)


def test_the_same_surface_in_other_triangles_leaves_nothing() -> None:
    ball = icosphere(2)
    # Midpoints are rounded, so that the planes of the quarters are.
    corners = np.stack(ball.corners(), axis=1)
    middles = (corners + corners[:, [1, 2, 0]]) / 2
    quarters = np.concatenate([np.stack([corners[:, k], middles[:, k], middles[:, k - 1]], 1) for k in range(3)])
    quarters = np.concatenate([quarters, middles]).reshape(-1, 3)
    finer = Mesh(quarters, np.arange(len(quarters)).reshape(-1, 3))
    assert rests_of(ball, finer).meshes == (None, None)


def test_curved_meshes_stay_as_they_are() -> None:
    first, second = icosphere(4), icosphere(3)
    for tolerance in ({}, {"tolerance": SINGLE_ROUNDING}):
        rests = rests_of(first, second, **tolerance)
        assert rests.meshes[0] is first
        assert rests.meshes[1] is second


@pytest.mark.parametrize("seed", range(4))
def test_files_in_single_precision_tell_how_far_their_faces_are_apart(seed: int) -> None:
    first, second = (
        Mesh(moved(mesh, seed).vertices.astype(np.float32), mesh.triangles)
        for mesh in (square(1.0), square(1.0, fan=9))
    )
    assert rests_of(first, second).meshes == (first, second)
    rests = rests_of(first, second, SINGLE_ROUNDING)
    assert areas(rests).sum() < 1e-5
    assert abs(first.area - second.area - excess(rests)) < 1e-11
    assert 0 < rests.distances.item() < 1e-6
    assert rests.areas.item() >= 2 * (first.area + second.area) - 1e-6
    # No point is moved farther.
    gap = values(first) - values(second) - (values(rests.meshes[0]) - values(rests.meshes[1]))
    apart = 2 * np.pi * np.linalg.norm(FREQUENCIES, axis=1) * rests.distances.item()
    assert np.all(np.abs(gap) <= apart * (first.area + second.area))


def test_planes_that_are_close_are_not_one() -> None:
    first, second = square(1.0), square(1.0, at=(0.0, 0.0, 1e-12), fan=5)
    assert rests_of(first, second).meshes == (first, second)


def test_slivers_and_triangles_without_area_are_no_obstacle() -> None:
    plain, cut = square(1.0, fan=4), square(1.0, fan=6)
    thin = [[0.2, 0.5, 0], [0.8, 0.5, 0], [0.5, 0.5, 0], [0.1, 0.1, 0], [0.9, 0.1, 0], [0.5, 0.1 + 1e-15, 0]]
    slivers = Mesh.from_checked(np.array(thin), np.array([[0, 1, 2], [3, 4, 5], [0, 0, 1]]))
    assert rests_of(joined(plain, Mesh.from_checked(slivers.vertices, slivers.triangles)), cut).meshes == (None, None)
    flat = joined(plain, square(1.0, at=(0.0, 0.0, 1.0)))
    wide = Mesh(np.concatenate([flat.vertices, [[0.5, 0.5, 0.5]]]), flat.triangles)
    assert areas(rests_of(wide, cut)) == pytest.approx([1.0, 0.0], abs=1e-12)


def test_combs_across_each_other_stay_whole() -> None:
    bars = [square(1.0).vertices * [1.0, 0.02, 1.0] + [0.0, 0.04 * number, 0.0] for number in range(25)]
    comb = joined(*(Mesh(bar, square(1.0).triangles) for bar in bars))
    across = Mesh(comb.vertices[:, [1, 0, 2]], comb.triangles)
    rests = rests_of(comb, across)
    assert rests.meshes == (comb, across)
    half = joined(*(Mesh(bar, square(1.0).triangles) for bar in bars[:12]))
    assert areas(rests_of(comb, half)) == pytest.approx([13 * 0.02, 0.0], abs=1e-12)


def test_a_plane_that_is_refused_stays_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    place = (0.0, 0.0, 1.0)
    first = joined(square(1.0), square(2.0, at=place))
    second = joined(square(1.0, fan=3), square(2.0, at=place, fan=4))
    difference = shapely.difference

    def refusing(a: NDArray[np.object_], b: NDArray[np.object_], **settings: float) -> object:
        if (shapely.area(a) > 0.5).any():
            raise shapely.errors.GEOSException("TopologyException")
        return difference(a, b, **settings)

    monkeypatch.setattr(shapely, "difference", refusing)
    rests = rests_of(first, second)
    assert areas(rests) == pytest.approx([4.0, 4.0])
    assert rests.meshes[0] is not None
    assert soup(rests.meshes[0]) == soup(square(2.0, at=place))


def test_a_plane_that_loses_area_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = square(1.0), square(0.8, fan=3)
    union, nothing = shapely.union_all, np.array([[shapely.Polygon()]])
    monkeypatch.setattr(shapely, "difference", lambda *_, **__: nothing)
    assert rests_of(first, second).meshes == (first, second)
    monkeypatch.undo()
    monkeypatch.setattr(shapely, "union_all", lambda *a, **s: shapely.buffer(union(*a, **s), -0.01))
    assert rests_of(first, second).meshes == (first, second)
