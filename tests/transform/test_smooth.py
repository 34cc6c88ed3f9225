"""Transforms of parametrised surfaces: against closed forms and Bessel integrals, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

import sobolev_batch as sb
from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.smooth import Smooth
from sobolev_batch.transform import kinds, resolution
from sobolev_batch.transform.backends import CPU
from sobolev_batch.transform.fourier import Execution, TransformSettings, transform_block
from sobolev_batch.transform.kinds import kind_of
from sobolev_batch.transform.resolution import direct_transform, exact_counts, resolution_of
from tests.support.fake_device import Device
from tests.support.oracles import spheroid_value, torus_value
from tests.support.shapes import HALF_TURN, TURN, Roof, angular_ball, turned_torus

LATTICE = sb.Lattice(4.0, 32)
SMOOTH = [
    sb.shapes.Ellipsoid((1.0, 0.7, 0.4), (0.1, -0.2, 0.3)),
    sb.shapes.Torus(1.0, 0.4, (0.1, -0.2, 0.3)),
    turned_torus(sb.shapes.Torus(0.9, 0.3)),
]


def frequencies(count: int = 12, highest: float = 7.0) -> Reals:
    """Random ones, zero among them."""
    found = np.random.default_rng(4).normal(size=(count, 3))
    found *= highest * np.linspace(0, 1, count)[:, None] / np.linalg.norm(found, axis=1, keepdims=True)
    return found


def half_values(surface: Smooth, eps: float = 1e-14) -> NDArray[np.complex128]:
    return np.asarray(sb.fourier_transform(surface, LATTICE, eps, threads=1).values)


@pytest.mark.slow
def test_the_sphere_as_a_parametrised_surface_is_the_closed_form() -> None:
    exact = sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    for surface in (sb.shapes.Ellipsoid(), angular_ball()):
        field = sb.fourier_transform(surface, LATTICE, 1e-14, threads=1)
        assert np.abs(field.values - exact.values).max() < 1e-12 * 4 * math.pi


# Surfaces, and their transforms at any frequency: integrals of Bessel functions. Ellipsoids with another axis as the
# pole's have other nodes.
INTEGRALS: dict[str, tuple[Smooth, Callable[[float, float, float], float]]] = {
    "torus": (sb.shapes.Torus(1.0, 0.4), lambda x, y, z: torus_value(1.0, 0.4, math.hypot(x, y), z)),
    "oblate": (sb.shapes.Ellipsoid((1.0, 1.0, 0.4)), lambda x, y, z: spheroid_value(1.0, 0.4, math.hypot(x, y), z)),
    "prolate": (sb.shapes.Ellipsoid((0.4, 0.4, 1.0)), lambda x, y, z: spheroid_value(0.4, 1.0, math.hypot(x, y), z)),
    "lying": (sb.shapes.Ellipsoid((0.4, 1.0, 1.0)), lambda x, y, z: spheroid_value(1.0, 0.4, math.hypot(y, z), x)),
}


@pytest.mark.parametrize("name", INTEGRALS)
def test_solids_of_revolution_are_their_bessel_integrals(name: str) -> None:
    surface, exact = INTEGRALS[name]
    points = frequencies()
    expected = np.array([exact(*point) for point in points.tolist()])
    assert kind_of(surface).exact_values(points) == pytest.approx(expected, abs=1e-12 * surface.area)
    assert expected[0] == pytest.approx(surface.area, rel=1e-13)
    # On the lattice, through the NUFFT: along x, where the two sides of a tube interfere.
    found = half_values(surface)[[16, 21, 32], 16, 0]
    along_x = [exact(k * LATTICE.spacing, 0.0, 0.0) for k in (0, 5, 16)]
    assert found == pytest.approx(np.array(along_x), abs=1e-12 * surface.area)


@pytest.mark.slow
@pytest.mark.parametrize("surface", [*SMOOTH, angular_ball()], ids=lambda surface: type(surface).__name__)
@pytest.mark.parametrize("highest", [0.5, 7.0, 20.0])
def test_the_nodes_are_enough_and_not_many_more(surface: Smooth, highest: float) -> None:
    counts, change = resolution_of(surface, highest, 1e-9)
    assert change <= 1e-9
    points = highest * np.random.default_rng(9).normal(size=(20, 3))
    points *= highest / np.linalg.norm(points, axis=1, keepdims=True)
    error = np.abs(direct_transform(surface, counts, points) - kind_of(surface).exact_values(points)).max()
    assert error <= 1e-9 * surface.area
    finer = exact_counts(surface, highest)
    assert math.prod(finer) < 3 * math.prod(resolution_of(surface, highest, 1e-12)[0])
    fewer = (2 * counts[0] // 3 | 1, 2 * counts[1] // 3 | 1)
    if highest > 1:
        error = np.abs(direct_transform(surface, fewer, points) - kind_of(surface).exact_values(points)).max()
        assert error > 1e-9 * surface.area


def test_waves_that_the_first_nodes_cannot_see_are_seen_when_they_are_doubled() -> None:
    def rippled(u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
        radii = 1 + 0.02 * np.cos(62 * v)
        return radii * np.sin(u) * np.cos(v), radii * np.sin(u) * np.sin(v), np.cos(u)

    surface = sb.shapes.ParametrisedSurface(rippled, HALF_TURN, TURN)
    assert resolution_of(surface, 0.01, 1e-9)[0][1] > 2 * 62
    assert surface.area > 1.2 * 4 * math.pi


def test_a_kink_is_refused_with_both_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resolution, "MOST_NODES", 1 << 14)
    surface = Roof()
    with pytest.raises(
        sb.errors.InputError, match=r"not settled to 1e-09 of its area with 16384 nodes.* it still changes by .*kink"
    ):
        sb.fourier_transform(surface, LATTICE)
    # One that is large beside the wavelength is refused at once.
    with pytest.raises(sb.errors.InputError, match="it would take more to begin with"):
        resolution_of(sb.shapes.Torus(1.0, 0.4), 1e4, 1e-9)
    # Where less is asked for, it converges, if slowly.
    assert resolution_of(surface, 2.0, 1e-4)[1] <= 1e-4


def test_too_few_nodes_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = SMOOTH[1]
    exact = sb.fourier_transform(surface, LATTICE, 1e-14, threads=1)
    monkeypatch.setattr(kinds, "resolution_of", lambda *_: ((91, 25), 0.0))
    field = sb.fourier_transform(surface, LATTICE, 1e-12, threads=1)
    orders = [-2.0, -5.0]
    truth = sb.distance(field, exact, orders)["distance"].values
    reported = sb.norm(field, orders)["error_part"].sel(part="discretisation").values
    assert (truth > 1e-8).all()
    assert (truth <= reported).all()
    assert (reported < 30 * truth).all()


@pytest.mark.slow
def test_what_doubling_the_nodes_changes_is_reported() -> None:
    surface = Roof()
    corners = [[u, v, -abs(u)] for u in (-0.9, 0.0, 1.0) for v in (-0.9, 1.0)]
    mesh = sb.Mesh(corners, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    assert mesh.area == pytest.approx(surface.area, rel=1e-12)
    orders = [-2.0, -5.0]
    exact = sb.fourier_transform(mesh, LATTICE, 1e-13, threads=1)
    field = sb.fourier_transform(surface, LATTICE, 1e-4, threads=1)
    truth = sb.distance(field, exact, orders)["distance"].values
    reported = sb.norm(field, orders)["error_part"].sel(part="discretisation").values
    assert (truth <= reported).all()
    assert (truth > 1e-6).all()
    _, change = resolution_of(surface, LATTICE.highest_frequency, 1e-4)
    assert (reported > change * surface.area).all()


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-2, 1e-5])
def test_a_norm_to_an_accuracy(rtol: float) -> None:
    exact = sb.norm(sb.shapes.Sphere(0.8), [-3.0, -6.0])["norm"].values
    found = sb.norm(sb.shapes.Ellipsoid((0.8, 0.8, 0.8), (3.0, 0.0, 1.0)), [-3.0, -6.0], rtol=rtol)
    assert found["within"].all()
    assert (np.abs(found["norm"].values - exact) <= found["error"].values).all()
    assert (found["error"].values <= rtol * exact).all()


def test_a_gpu_gets_the_same_nodes() -> None:
    device = Device()
    for surface in SMOOTH:
        found, expected = (
            transform_block(surface, LATTICE, LATTICE.half, TransformSettings(1e-13), Execution(backend, batch=1 << 13))
            for backend in (device.backend(), CPU)
        )
        assert (found.backend, expected.backend) == ("cufinufft", "finufft")
        assert found.points == expected.points > 1 << 12
        assert np.abs(found.values - expected.values).max() < 1e-12 * surface.area


@pytest.mark.slow
def test_thin_ellipsoids_take_nodes_in_proportion_and_end_in_a_refusal() -> None:
    fewer, more = (
        resolution_of(sb.shapes.Ellipsoid((1.0, 1.0, thickness)), 2.0, 1e-9)[0][0] for thickness in (0.04, 0.01)
    )
    assert 2 * fewer < more < 8 * fewer
    with pytest.raises(
        sb.errors.InputError, match=r"2048 along a parameter that is not periodic: with \d+ x \d+ it still"
    ):
        resolution_of(sb.shapes.Ellipsoid((1.0, 1.0, 1e-5)), 2.0, 1e-9)
