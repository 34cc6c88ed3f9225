"""Figures of K. Koga's paper, "Computing weak distance between the 2-sphere and its nonsmooth approximations",
and a table of docs/numerics.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from sobolev_batch import Lattice, Mesh, distance, fourier_transform, norm
from sobolev_batch.shapes import Ellipsoid, Sphere, Torus, icosphere
from sobolev_batch.transform.lattice import SobolevWeights, shell_sums
from sobolev_batch.transform.spheres import sphere_transform
from tests.support.repository import ROOT

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
    field = sphere_transform(Sphere(), lattice.points(lattice.half)).reshape(lattice.shape)
    sums = shell_sums(field, None, lattice, lattice.half)
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


TORUS, ELLIPSOID = Torus(1.0, 0.4), Ellipsoid((1.0, 0.7, 0.4))


def numbers_of(shape: str) -> list[float]:
    (line,) = re.findall(rf"^\| {shape} .*\|$", (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8"), re.M)
    return [float(entry) for entry in line.strip("|").split("|")[1:]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "surface", "mesh"),
    [("torus", TORUS, lambda level: TORUS.mesh(12 << level, 6 << level)), ("ellipsoid", ELLIPSOID, ELLIPSOID.mesh)],
)
def test_refinements_converge_with_second_order(
    shape: str, surface: Torus | Ellipsoid, mesh: Callable[[int], Mesh]
) -> None:
    lattice = Lattice(5.0, 64)
    exact = fourier_transform(surface, lattice)
    meshes = [mesh(level) for level in range(5)]
    datasets = [distance(fourier_transform(mesh, lattice), exact, [-5.0, -10.0]) for mesh in meshes]
    distances = np.array([dataset["distance"].values for dataset in datasets])
    assert distances[:, 0] == pytest.approx(numbers_of(shape)[:5], rel=5e-3)
    sizes = np.array([mesh.edge_lengths.mean() for mesh in meshes])
    for column in distances.T:
        assert column[3] / column[4] == pytest.approx(4.0, rel=0.005)
        assert np.polyfit(np.log(sizes[2:]), np.log(column[2:]), 1)[0] == pytest.approx(2.0, abs=0.02)
