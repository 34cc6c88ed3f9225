"""Yardsticks against moves of known length, whose distances are computed by themselves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sobolev_batch import Lattice, Mesh, distance, yardsticks
from sobolev_batch.errors import InputError
from sobolev_batch.shapes import Sphere, icosphere

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
    for name in ("moved", "relative", "excess", "area_share"):
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


@pytest.mark.parametrize("order", [-1.0, -2.0])
def test_the_error_of_a_move_grows_where_far_moves_are_all_as_far(order: float) -> None:
    lattice = Lattice(2.0, 48)
    ball = icosphere(1)
    lengths = (1.0, 1.3, 1.6, 2.0)
    meshes = [Mesh(ball.vertices + np.array([length, 0, 0]), ball.triangles) for length in lengths]
    for length, mesh in zip(lengths, meshes, strict=True):
        found = yardsticks(mesh, ball, order, lattice=lattice)
        assert not abs(found["moved"].item() - length) > found["moved_error"].item()
    beyond = Mesh(ball.vertices + np.array([3.5, 0, 0]), ball.triangles)
    assert np.isnan(yardsticks(beyond, ball, order, lattice=lattice)["moved"].item())


def test_the_error_of_a_move_holds_what_a_lattice_leaves_out() -> None:
    """A move is at higher frequencies than a face that is missing."""
    ball = icosphere(0)
    part = Mesh(ball.vertices, ball.triangles[1:])
    coarse = yardsticks(part, ball, -2.5, lattice=Lattice(4.0, 64))
    fine = yardsticks(part, ball, -2.5, rtol=0.01)
    gap = abs(coarse["moved"] - fine["moved"]).item()
    assert fine["moved_error"].item() < gap <= coarse["moved_error"].item()
