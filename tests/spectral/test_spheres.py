"""Closed forms of spheres."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from sobolev_batch import Lattice, OrderError, Sphere, norm
from sobolev_batch.spectral.exact import sphere_block, sphere_inner_product, sphere_transform


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
    ],
)
@pytest.mark.parametrize("order", [-7.25, -10.0])
def test_inner_products_against_the_radial_integral(first: Sphere, second: Sphere, order: float) -> None:
    assert sphere_inner_product(first, second, order) == pytest.approx(radial_integral(first, second, order), rel=1e-12)


def test_block_and_pointwise_transform_agree() -> None:
    lattice, sphere = Lattice(2.0, 8), Sphere(0.7, (0.1, -0.2, 0.3))
    grid = np.stack(np.meshgrid(*lattice.axes, indexing="ij"), axis=-1)
    assert np.allclose(sphere_block(sphere, lattice, lattice.half), sphere_transform(sphere, grid), rtol=0, atol=1e-14)


def test_says_when_its_functions_overflow() -> None:
    with pytest.raises(OrderError, match="too low"):
        sphere_inner_product(Sphere(), Sphere(), -1000.0)
