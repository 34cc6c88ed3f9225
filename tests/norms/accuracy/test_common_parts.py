"""Distances of meshes that have much in common, in other triangles: what cancels costs nothing and hides nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gamma
from scipy.stats import special_ortho_group

import sobolev_batch as sb
from sobolev_batch.geometry import overlap
from sobolev_batch.geometry.overlap import Rests, rests_of
from sobolev_batch.geometry.subdivision import icosphere, subdivided
from sobolev_batch.norms.accuracy.problem import Problem, are_equal
from sobolev_batch.norms.accuracy.solve import solve
from sobolev_batch.norms.accuracy.threshold import relative_distance
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.bounds import norm_of_moves
from tests.support.rectangles import Rectangles

BOX = Rectangles.box([0.0, 0.0, 0.0], [1.0, 0.8, 0.5])
BOSS = Rectangles.box([0.3, 0.4, 0.5], [0.34, 0.44, 0.54])
TURN: NDArray[np.float64] = special_ortho_group.rvs(3, random_state=np.random.default_rng(4))


def cut_anew(mesh: sb.Mesh, seed: int) -> sb.Mesh:
    """Each triangle in three, around a random point of it."""
    shares = np.random.default_rng(seed).dirichlet([2, 2, 2], size=len(mesh.triangles))
    middles = np.einsum("ij,jik->ik", shares, np.array(mesh.corners()))
    number, n = np.arange(len(mesh.triangles)), len(mesh.vertices)
    thirds = [np.c_[mesh.triangles[:, [k, (k + 1) % 3]], n + number] for k in range(3)]
    return sb.Mesh(np.concatenate([mesh.vertices, middles]), np.concatenate(thirds))


def turned(mesh: sb.Mesh, *, single: bool = False) -> sb.Mesh:
    vertices = mesh.vertices @ TURN
    return sb.Mesh(vertices.astype(np.float32) if single else vertices, mesh.triangles)


def rounded(mesh: sb.Mesh) -> sb.Mesh:
    return sb.Mesh(mesh.vertices.astype(np.float32), mesh.triangles)


def part_and_edited() -> tuple[sb.Mesh, sb.Mesh]:
    """A box, and the same with a boss whose bottom covers it once more, in other triangles."""
    return turned(BOX.mesh()), turned(cut_anew(BOX.joined(BOSS).mesh(), 1))


# A small edit costs as little as its own faces.
@pytest.mark.slow
@pytest.mark.parametrize("order", [-0.75, -1.0, -2.0])
def test_an_edit_of_a_part_is_measured_by_what_it_adds(order: float) -> None:
    first, second = part_and_edited()
    true, nothing = (
        sb.norm(BOSS.mesh(), order, rtol=1e-2),
        sb.distance(first, turned(cut_anew(BOX.mesh(), 2)), order, rtol=0.1),
    )
    found = sb.distance(second, first, order, rtol=0.05)
    gap = abs(found["distance"] - true["norm"])
    assert gap <= found["error"] + true["error"]
    assert found["within"]
    assert nothing["distance"] == 0
    # The reference is whole.
    own = sb.norm(BOX.mesh(), order, rtol=1e-2)
    relative = found["distance"] / own["norm"]
    assert abs(found["relative"] - relative) <= found["relative_error"] + relative * own["error"] / own["norm"]
    product = sb.distance(turned(BOX.joined(BOSS).mesh()), first, order, rtol=0.01)
    assert abs(found["area_share"] - product["area_share"]) <= found["area_share_error"] + product["area_share_error"]


def test_only_what_differs_is_computed() -> None:
    first, second = part_and_edited()
    problem = Problem.from_surfaces([second, first], (-2.0,), Accuracy(0.1), "the distance", 1)
    (boss,) = problem.surfaces
    assert problem.signs == (1,)
    assert boss.area == pytest.approx(BOSS.mesh().area, rel=1e-10)
    assert [surface.area for surface in problem.pair] == pytest.approx([second.area, first.area])


def test_many_faces_are_clipped_only_where_a_lattice_leaves_a_verdict_open(monkeypatch: pytest.MonkeyPatch) -> None:
    clipped: list[int] = []

    def counted(first: sb.Mesh, second: sb.Mesh) -> Rests:
        clipped.append(len(first.triangles) + len(second.triangles))
        return rests_of(first, second)

    def judged(surface: sb.Mesh, reference: sb.Mesh, order: float) -> tuple[float, float, str]:
        clipped.clear()
        bounds, method = relative_distance(surface, reference, order, 1e-3, Accuracy(1e-3), 2, 0)
        return bounds.lower, bounds.upper, method

    monkeypatch.setattr(overlap, "rests_of", counted)
    ball = icosphere(3)
    few, many = cut_anew(ball, 1), cut_anew(subdivided(ball), 2)
    lower, upper, method = judged(many, few, -4.0)
    assert (lower, method, clipped) == (0.0, "lattice", [])
    assert 0 < upper <= 1e-3
    # A lattice cannot tell at a high order that two surfaces are the same, nor in any unit of length.
    assert judged(many, few, -1.0) == (0.0, 0.0, "identical")
    assert clipped == [len(many.triangles) + len(few.triangles)]
    huge = [sb.Mesh(1e60 * mesh.vertices, mesh.triangles) for mesh in (many, few)]
    assert judged(huge[0], huge[1], -4.0) == (0.0, 0.0, "identical")
    # Few are clipped at once.
    assert judged(subdivided(ball), few, -4.0) == (0.0, 0.0, "identical")
    # What differs is told from the whole surfaces.
    lost, left = (sb.Mesh(ball.vertices, ball.triangles[part]) for part in (slice(13), slice(13, None)))
    lower, upper, method = judged(cut_anew(subdivided(left), 3), few, -4.0)
    truth = float(sb.norm(lost, -4.0, rtol=1e-3)["norm"] / sb.norm(ball, -4.0, rtol=1e-3)["norm"])
    assert 1e-3 < lower <= truth <= upper
    assert (method, clipped) == ("lattice", [])


def test_edits_far_apart_on_one_part_are_no_surfaces_far_apart() -> None:
    """The norm of the reference is not among theirs."""
    plate = Rectangles.from_corners(([0.0, 0.0, 0.0], [12.0, 1.0, 0.0]))
    ends = [Rectangles.box([x, 0.4, 0.0], [x + 0.1, 0.5, 0.1]) for x in (0.1, 11.8)]
    first, second = (cut_anew(plate.joined(end).mesh(), seed) for seed, end in enumerate(ends))
    problem = Problem.from_surfaces([first, second], (-2.0,), Accuracy(0.1), "the distance", 1)
    assert problem.area == pytest.approx(sum(end.mesh().area for end in ends))
    assert problem.apart is None


@pytest.mark.parametrize("formula", [sb.shapes.Sphere(0.7), sb.shapes.Ellipsoid((1.0, 0.8, 0.6))])
def test_equal_formulas_differ_by_nothing_for_certain(formula: sb.shapes.Sphere | sb.shapes.Ellipsoid) -> None:
    found = sb.distance(formula, replace(formula), [-1.5, -4.0], rtol=0.1)
    assert (found["distance"] == 0).all()
    assert (found["error"] == 0).all()
    assert found["within"].all()
    assert sb.testing.same_surface(formula, replace(formula)).method == "identical"


def test_equal_surfaces_are_equal_in_any_triangles() -> None:
    first, second = part_and_edited()
    assert are_equal(first, turned(cut_anew(BOX.mesh(), 5)))
    assert not are_equal(first, second)
    smaller = sb.Mesh(first.vertices * (1 + 1e-9), first.triangles)
    assert not are_equal(first, smaller)
    lattice = sb.Lattice(3.0, 24)
    assert sb.distance(first, turned(cut_anew(BOX.mesh(), 5)), -2.0, lattice=lattice)["distance"] == 0


def test_faces_apart_by_single_precision_are_left_out_with_an_error() -> None:
    first, second = (turned(mesh, single=True) for mesh in (BOX.mesh(), cut_anew(BOX.joined(BOSS).mesh(), 1)))
    low = Problem.from_surfaces([second, first], (-3.0,), Accuracy(0.1), "the distance", 1)
    assert low.area < 2 * BOSS.mesh().area
    assert 0 < np.max(low.moved) < 1e-5
    found, true = sb.distance(second, first, -3.0, rtol=0.1), sb.norm(BOSS.mesh(), -3.0, rtol=1e-3)
    assert abs(found["distance"] - true["norm"]) <= found["error"] + true["error"]
    with_error, without = (solve(problem).estimate.errors for problem in (low, replace(low, moved=0.0)))
    assert with_error > without
    # At high orders it is no small error that these faces are apart.
    high = Problem.from_surfaces([second, first], (-0.6,), Accuracy(0.1), "the distance", 1)
    assert high.area > BOX.mesh().area
    assert high.moved == 0


@pytest.mark.parametrize("order", [-0.6, -0.75, -1.0, -1.5, -2.0, -4.0])
def test_moved_faces_change_no_norm_by_more_than_the_bound(order: float) -> None:
    plate = Rectangles.from_corners(([0.0, 0.0, 0.0], [1.0, 1.0, 0.0]))
    for gap in (1e-2, 1e-4):
        squared, uncertainty = plate.squared_distance(plate.moved(0.0, 0.0, gap), [order])
        bound = norm_of_moves(np.ones(1), np.array([gap]), [order]).item()
        assert bound**2 >= squared.item() - uncertainty.item()
        assert bound**2 <= 3 * (squared.item() + uncertainty.item())
    # However far apart, no plate is more than this from another one, and bounds of planes add.
    far = 2 * np.sqrt(np.sqrt(np.pi) * gamma(-order - 0.5) / gamma(-order))
    found = norm_of_moves(np.ones(3), np.array([1e9, 0.0, 1e9]), [order]).item()
    assert found == pytest.approx(2 * far)


# Else octaves would measure the rounding, for minutes.
@pytest.mark.parametrize("order", [-1.0, -2.0, -4.0])
@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("similarity", [sb.shapes.Similarity(), sb.shapes.Similarity(0.31, (0.2, -0.1, 0.7))])
def test_a_mesh_that_is_cut_finer_and_rounded_is_the_same_up_to_rounding(
    order: float, times: int, similarity: sb.shapes.Similarity
) -> None:
    coarse = turned(BOX.mesh(), single=True) if times else icosphere(3)
    fine = coarse
    for _ in range(times):
        fine = subdivided(fine)
    a, b = similarity.apply(rounded(fine)), similarity.apply(coarse)
    found, norm = sb.distance(a, b, order, rtol=1e-2), float(sb.norm(b, order, rtol=1e-2)["norm"])
    error = float(found["error"])
    assert found["distance"] == 0
    assert "M" not in found.attrs
    # On a lattice it is measured, as far as that reaches.
    known = float(sb.distance(a, b, order, lattice=sb.Lattice(6.0, 48))["distance"])
    assert 0 < known <= error < 1e-2 * norm
    assert float(found["relative_error"]) == pytest.approx(error / norm, rel=0.1)


@pytest.mark.parametrize("order", [-2.0, -4.0])
def test_plates_that_a_rounding_moves_alike_are_no_farther_apart_than_the_error(order: float) -> None:
    plates = Rectangles.sheets(60, 2.0**-8, -0.125).mesh()
    moved = sb.Mesh(plates.vertices + np.array([0, 0, 0.9 * plates.rounding]), plates.triangles)
    found = sb.distance(moved, plates, order, rtol=1e-2)
    known = float(sb.distance(moved, plates, order, lattice=sb.Lattice(6.0, 48))["distance"])
    assert found["distance"] == 0
    assert 0 < known <= found["error"] < 30 * known
