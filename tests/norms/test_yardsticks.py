"""Yardsticks against changes of known size, whose distances are computed by themselves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sobolev_batch import Lattice, Mesh, distance, yardsticks
from sobolev_batch.errors import InputError
from sobolev_batch.shapes import Sphere, icosphere
from sobolev_batch.sources.derived import decimated, with_noise

LATTICE = Lattice(3.0, 32)
ORDERS = [-3.0, -5.0]
BALL = icosphere(3)


def moved(length: float) -> Mesh:
    """The ball is nearly the same from all directions."""
    return Mesh(BALL.vertices + length * np.array([0.36, 0.48, 0.8]), BALL.triangles)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.002, 0.3])
def test_a_move_is_found_again(length: float) -> None:
    found = yardsticks(moved(length), BALL, ORDERS, lattice=LATTICE)
    np.testing.assert_allclose(found["moved"], length, rtol=0.01)


@pytest.mark.slow
def test_noise_is_found_again() -> None:
    found = yardsticks(with_noise(BALL, 0.01, 4), BALL, ORDERS, lattice=LATTICE, seed=4)
    np.testing.assert_allclose(found["noise"], 0.01, rtol=0.03)
    assert (abs(found["noise"] - 0.01) <= found["noise_error"] + 1e-4).all()


# The distance from the noisy ball changes little between 170 and 190 triangles, and much between 150 and 160.
@pytest.mark.slow
@pytest.mark.parametrize(("reference", "triangles"), [(BALL, 300), (with_noise(BALL, 0.03, 1), 160)])
def test_decimation_is_found_again(reference: Mesh, triangles: int) -> None:
    found = yardsticks(decimated(reference, triangles), reference, -2.0, lattice=LATTICE)
    assert found["decimated"].dims == ()
    assert found["decimated"].item() == pytest.approx(triangles, rel=0.05)


@pytest.mark.slow
def test_yardsticks_come_with_the_distance() -> None:
    a, b = moved(0.1), BALL
    found, alone = yardsticks(a, b, ORDERS, rtol=0.05), distance(a, b, ORDERS, rtol=0.05)
    for name, variable in alone.items():
        np.testing.assert_array_equal(found[name], variable)
    assert found.attrs == alone.attrs
    np.testing.assert_allclose(found["moved"], 0.1, rtol=0.05)


@pytest.mark.slow
def test_shared_triangles_change_nothing() -> None:
    """The reference is whole though most of it cancels."""
    part = Mesh(BALL.vertices, BALL.triangles[:-40])
    quarters = Mesh(*trimesh.remesh.subdivide(part.vertices, part.triangles))
    together, apart = (yardsticks(mesh, BALL, -2.0, rtol=0.02) for mesh in (part, quarters))
    for name in ("moved", "noise", "relative", "excess", "area_share"):
        assert together[name].item() == pytest.approx(apart[name].item(), rel=0.03), name


def test_what_is_like_nothing() -> None:
    same = yardsticks(BALL, BALL, ORDERS, lattice=LATTICE)
    assert (same["distance"] == 0).all()
    assert np.isnan(same["moved"]).all()
    # No move of a ball is as far from it as a ball of twice the radius.
    far = yardsticks(Mesh(2 * np.asarray(BALL.vertices), BALL.triangles), BALL, -4.0, lattice=Lattice(3.0, 48))
    assert np.isnan(far["moved"].item())
    with pytest.raises(InputError, match="found Sphere"):
        yardsticks(Sphere(), BALL, -2.0, lattice=LATTICE)
    with pytest.raises(InputError, match="seed must be a whole number from 0 on, found -1"):
        yardsticks(moved(0.1), BALL, -2.0, lattice=LATTICE, seed=-1)


@pytest.mark.slow
def test_a_move_is_as_far_beyond_all_frequencies_too() -> None:
    part = Mesh(BALL.vertices, BALL.triangles[:-40])
    found = yardsticks(part, BALL, -2.0, rtol=0.02)
    direct = distance(moved(found["moved"].item()), BALL, -2.0, rtol=0.01)
    share = found["moved_error"].item() / found["moved"].item()
    assert direct["distance"].item() == pytest.approx(found["distance"].item(), rel=share + 0.01)


def test_changes_are_chosen() -> None:
    found = yardsticks(moved(0.1), BALL, ORDERS, lattice=LATTICE, changes="moved")
    np.testing.assert_allclose(found["moved"], 0.1, rtol=0.05)
    assert not {"noise", "decimated_error"} & set(found)
    with pytest.raises(InputError, match="'turned'"):
        yardsticks(moved(0.1), BALL, lattice=LATTICE, changes=["turned"])  # type: ignore[list-item]


@pytest.mark.parametrize("order", [-1.0, -2.0])
def test_the_error_of_a_move_grows_where_far_moves_are_all_as_far(order: float) -> None:
    lattice = Lattice(2.0, 48)
    ball = icosphere(1)
    lengths = (1.0, 1.3, 1.6, 2.0)
    meshes = [Mesh(ball.vertices + np.array([length, 0, 0]), ball.triangles) for length in lengths]
    for length, mesh in zip(lengths, meshes, strict=True):
        found = yardsticks(mesh, ball, order, lattice=lattice, changes="moved")
        assert not abs(found["moved"].item() - length) > found["moved_error"].item()
    beyond = Mesh(ball.vertices + np.array([3.5, 0, 0]), ball.triangles)
    assert np.isnan(yardsticks(beyond, ball, order, lattice=lattice, changes="moved")["moved"].item())


def test_the_error_of_a_move_holds_what_a_lattice_leaves_out() -> None:
    """A move is at higher frequencies than a face that is missing."""
    ball = icosphere(0)
    part = Mesh(ball.vertices, ball.triangles[1:])
    coarse = yardsticks(part, ball, -2.5, lattice=Lattice(4.0, 64), changes="moved")
    fine = yardsticks(part, ball, -2.5, rtol=0.01, changes="moved")
    gap = abs(coarse["moved"] - fine["moved"]).item()
    assert fine["moved_error"].item() < gap <= coarse["moved_error"].item()


@pytest.mark.slow
def test_errors_of_noise_hold_those_of_its_distance() -> None:
    """Most of both surfaces cancels, so that distances are less exact than the one wanted."""
    ball = icosphere(2)
    part = Mesh(ball.vertices, ball.triangles[:-20])
    found = yardsticks(part, ball, -1.2, rtol=0.03, best_effort=True, changes="noise")
    amount, error = found["noise"].item(), found["noise_error"].item()
    ends = [distance(with_noise(ball, one, 0), ball, -1.2, rtol=0.02) for one in (amount - error, amount + error)]
    lower, higher = ((one["distance"] + sign * one["error"]).item() for one, sign in zip(ends, (-1, 1), strict=True))
    assert lower <= found["distance"].item() <= higher


@pytest.mark.parametrize("triangles", [1, 4])
def test_meshes_of_few_triangles_have_no_fewer(triangles: int) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    few = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])[:triangles])
    found = yardsticks(Mesh(few.vertices + 0.1, few.triangles), few, -2.0, lattice=LATTICE)
    assert np.isnan(found["decimated"].item())
    assert 0.05 < found["moved"].item() < 0.5
