"""Figures of K. Koga's paper, "Computing weak distance between the 2-sphere and its nonsmooth approximations"."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import Lattice, Sphere, distance, fourier_transform, icosphere, norm
from sobolev_batch.spectral.exact import sphere_block
from sobolev_batch.spectral.lattice import SobolevWeights, shell_sums

FIGURE_1B = {
    16: (2.755e00, 4.426e00),
    32: (1.2646e-02, 7.6406e-02),
    48: (4.4007e-06, 1.9550e-04),
    64: (3.408e-08, 1.357e-07),
    96: (3.476e-08, 9.4e-15),
    128: (3.476e-08, 1.1e-15),
}
FIGURE_3B = (
    0.2354249746,
    0.07095855160,
    0.01860583580,
    0.004707221284,
    0.001180314969,
    0.0002952984745,
    7.383836e-05,
    1.846045e-05,
)


@pytest.mark.parametrize("intervals", FIGURE_1B)
def test_figure_1b_trapezoidal_rule_for_the_sphere(intervals: int) -> None:
    exact = norm(Sphere(), [-5.0, -10.0])["norm"].values ** 2
    # Sums of the closed form: with M = 16 the sphere is larger than the period, which `fourier_transform` refuses.
    lattice = Lattice(5.0, intervals)
    sums = shell_sums(sphere_block(Sphere(), lattice, lattice.half), None, lattice, lattice.half)
    computed = SobolevWeights(lattice, (-5.0, -10.0)).per_shell @ sums
    errors = np.abs(exact - computed) / exact
    for error, expected in zip(errors, FIGURE_1B[intervals], strict=True):
        # The two smallest are a few roundings of the sum itself.
        assert error == pytest.approx(expected, rel=1e-3, abs=5e-15)


@pytest.mark.slow
def test_figure_3b_icospheres_converge_with_second_order() -> None:
    lattice = Lattice(5.0, 128)
    sphere = fourier_transform(Sphere(), lattice)
    meshes = [icosphere(level) for level in range(8)]
    errors = (
        np.array([distance(fourier_transform(mesh, lattice), sphere, -10.0)["distance"].item() for mesh in meshes])
        / norm(sphere, -10.0)["norm"].item()
    )
    assert errors == pytest.approx(FIGURE_3B, rel=1e-6)
    lengths = np.array([mesh.edge_lengths.mean() for mesh in meshes])
    slope = np.polyfit(np.log(lengths[3:]), np.log(errors[3:]), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.01)
    assert errors[3] / errors[7] == pytest.approx(4.0**4, rel=0.01)
