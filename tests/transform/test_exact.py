"""Exact transforms: of triangles against arithmetic with 60 digits, of spheres against integrals and each other."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from sobolev_batch import Mesh, norm
from sobolev_batch.arrays import Reals
from sobolev_batch.errors import OrderError
from sobolev_batch.shapes import Sphere
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.spheres import sphere_inner_product


def oracle(corners: Reals, frequency: Reals) -> complex:
    """The textbook formula in 60 digits, where its cancellation does no harm.

    Coinciding nodes are pulled apart by 1e-25, which changes the value by far less than a double can
    hold and leaves ten good digits more than it needs.
    """
    with mpmath.workdps(90):
        p = [[mpmath.mpf(float(x)) for x in corner] for corner in corners]
        xi = [mpmath.mpf(float(x)) for x in frequency]
        dots = [mpmath.fsum(x * k for x, k in zip(corner, xi, strict=True)) for corner in p]
        for i in range(3):
            dots[i] += i * mpmath.mpf(10) ** -25
        u = [b - a for a, b in zip(p[0], p[1], strict=True)]
        v = [b - a for a, b in zip(p[0], p[2], strict=True)]
        normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        doubled = mpmath.sqrt(mpmath.fsum(x * x for x in normal))
        total = mpmath.mpc(0)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            total += mpmath.expjpi(-2 * dots[i]) / ((dots[i] - dots[j]) * (dots[i] - dots[k]))
        return complex(-doubled / (4 * mpmath.pi**2) * total)


def relative_error(corners: Reals, frequency: Reals) -> float:
    expected = oracle(corners, frequency)
    found = exact_transform(Mesh(corners, [[0, 1, 2]]), frequency[None, :]).item()
    return abs(found - expected) / abs(expected)


SHAPES = {
    "ordinary": np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 0.8, 0.0]]),
    "needle": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1e-7, 0.0]]),
    "cap": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, 1e-7, 0.0]]),
    "tiny": 1e-6 * np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 0.8, 0.0]]),
    "huge": 300.0 * np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.3, 0.8, 0.0]]),
    # Phases of hundreds of cycles are kept.
    "far": np.array([[400.0, -300.0, 200.0], [401.0, -299.9, 200.0], [400.3, -299.2, 200.0]]),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("magnitude", [1e-3, 0.3, 1.0, 8.0])
def test_agrees_with_sixty_digits(shape: str, magnitude: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(10):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        corners = SHAPES[shape] @ rotation.T + rng.normal(scale=0.2, size=3)
        frequency = rng.normal(size=3)
        frequency *= magnitude / np.linalg.norm(frequency)
        assert relative_error(corners, frequency) < 1e-12


@pytest.mark.parametrize("shape", SHAPES)
def test_frequencies_orthogonal_to_an_edge_or_the_plane(shape: str) -> None:
    corners = SHAPES[shape]
    for edge in (corners[1] - corners[0], corners[2] - corners[1], corners[0] - corners[2]):
        across = np.array([-edge[1], edge[0], 0.0]) / np.linalg.norm(edge)
        for frequency in (2.7 * across, 2.7 * across + np.array([0.0, 0.0, 1.3]), np.array([0.0, 0.0, 3.1])):
            assert relative_error(corners, frequency) < 1e-12


def test_both_branches_agree_where_they_meet() -> None:
    corners = SHAPES["ordinary"]
    longest = np.linalg.norm(corners[1] - corners[0])
    direction = (corners[1] - corners[0]) / longest
    for phase in (0.49, 0.51, 0.99, 1.01, 1.99, 1.9999999, 2.0000001, 2.01):
        frequency = direction * phase / (2 * np.pi * longest)
        assert relative_error(corners, frequency) < 1e-14


@pytest.mark.parametrize(
    ("order", "squared"),
    [(-1, 39.478279929599566), (-2, 19.738274928783976), (-5, 10.77576620890553), (-10, 7.160757451355634)],
)
def test_squared_norms_of_the_unit_sphere(order: float, squared: float) -> None:
    assert norm(Sphere(), order)["norm"].item() ** 2 == pytest.approx(squared, rel=1e-14)


def radial_integral(first: Sphere, second: Sphere, order: float) -> float:
    """The inner product as an integral over |ξ|, in 25 digits; for orders at which it converges fast."""
    apart = math.dist(first.center, second.center)
    with mpmath.workdps(25):
        two_pi = 2 * mpmath.pi

        def integrand(r: mpmath.mpf) -> mpmath.mpf:
            sines = mpmath.sin(two_pi * first.radius * r) * mpmath.sin(two_pi * second.radius * r)
            mean = mpmath.sincpi(2 * apart * r) if apart else mpmath.mpf(1)
            return 16 * mpmath.pi * first.radius * second.radius * (1 + r * r) ** order * sines * mean

        return float(mpmath.quad(integrand, [k * mpmath.mpf(0.5) for k in range(60)]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"),
    [
        (Sphere(), Sphere()),
        (Sphere(), Sphere(0.9)),
        (Sphere(), Sphere(0.9, (0.3, 0.0, 0.0))),
        (Sphere(0.5, (0.0, 1.0, 0.0)), Sphere(2.0, (0.0, 0.0, 1.0))),
        (Sphere(), Sphere(1.0, (1e-3, 0.0, 0.0))),
        (Sphere(1e-4), Sphere(2e-4, (1e-4, 0.0, 0.0))),
        (Sphere(0.05), Sphere(0.05)),
        (Sphere(0.8, (0.2, 0.0, 0.0)), Sphere(0.7, (-0.2, 0.1, 0.0))),
    ],
)
@pytest.mark.parametrize("order", [-7.25, -10.0, -79.5, -100.0])
def test_inner_products_against_the_radial_integral(first: Sphere, second: Sphere, order: float) -> None:
    assert sphere_inner_product(first, second, order) == pytest.approx(radial_integral(first, second, order), rel=1e-12)


def test_says_when_its_functions_overflow() -> None:
    with pytest.raises(OrderError, match="too low"):
        sphere_inner_product(Sphere(), Sphere(), -1000.0)
