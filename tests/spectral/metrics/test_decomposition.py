"""Decompositions into area and shape against direct projections and closed forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from scipy.integrate import quad

from sobolev_batch import Lattice, Mesh, Sphere, distance, fourier_transform, icosphere, proportion
from sobolev_batch.spectral import fields as operands
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.spheres import sphere_inner_product
from tests.support.oracles import full_lattice_norm
from tests.support.shapes import CENTRED_BOX as BOX

Complexes = NDArray[np.complex128]

LATTICE = Lattice(2.0, 16)
ORDERS = [-0.6, -2.0, -5.0, -10.0]


def random_values(rng: np.random.Generator) -> Complexes:
    return rng.standard_normal(LATTICE.shape) + 1j * rng.standard_normal(LATTICE.shape)


def as_field(values: Complexes) -> xr.DataArray:
    return fourier_transform(Sphere(0.1), LATTICE).copy(data=values)


@pytest.mark.parametrize("seed", range(3))
def test_is_the_projection_spelt_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = random_values(rng)
    a = rng.uniform(-2, 2) * b + rng.uniform(0, 2) * random_values(rng)
    dataset = proportion(as_field(a), as_field(b), ORDERS)
    for order in ORDERS:
        row = dataset.sel(order=order)

        def norm(values: Complexes, order: float = order) -> float:
            return full_lattice_norm(values, LATTICE, order)

        # The inner product by polarisation.
        multiple = (norm(a + b) ** 2 - norm(a - b) ** 2) / (4 * norm(b) ** 2)
        assert row["excess"].item() == pytest.approx(multiple - 1, rel=1e-10, abs=1e-12)
        assert row["area_part"].item() == pytest.approx(abs(multiple - 1) * norm(b), rel=1e-10)
        assert row["shape_part"].item() == pytest.approx(norm(a - multiple * b), rel=1e-10)
        # Any other multiple is farther away.
        assert all(norm(a - (multiple + d) * b) > row["shape_part"].item() for d in (-1e-3, 1e-3))


def test_parts_add_up_to_the_squared_distance() -> None:
    rng = np.random.default_rng(7)
    a, b = as_field(random_values(rng)), as_field(random_values(rng))
    dataset = proportion(a, b, ORDERS)
    squares = distance(a, b, ORDERS)["distance"].values ** 2
    assert (dataset["area_part"] ** 2 + dataset["shape_part"] ** 2).values == pytest.approx(squares, rel=1e-12)
    assert dataset["distance"].values ** 2 == pytest.approx(squares, rel=1e-12)
    assert dataset["area_share"].values == pytest.approx(dataset["area_part"].values ** 2 / squares, rel=1e-12)


def test_near_twins_keep_their_digits() -> None:
    # Values on grids of powers of two, so that a = b + e and a - b are exact: e is known to all digits.
    rng = np.random.default_rng(8)
    b = np.round(random_values(rng) * 2**10) / 2**10
    e = np.round((0.3 * b + random_values(rng)) * 2**6) / 2**42
    assert np.array_equal((b + e) - b, e)
    dataset = proportion(as_field(b + e), as_field(b), -3.0)
    larger = proportion(as_field(b + 2**30 * e), as_field(b), -3.0)
    for name in ("excess", "area_part", "shape_part"):
        assert 2**30 * dataset[name].item() == pytest.approx(larger[name].item(), rel=1e-12)


def test_spheres_of_two_radii_against_their_closed_forms() -> None:
    a, b = Sphere(0.9), Sphere()
    dataset = proportion(a, b, [-10.0, -4.0], lattice=Lattice(5.0, 64))
    for order in (-10.0, -4.0):
        row = dataset.sel(order=order)
        multiple = sphere_inner_product(a, b, order) / sphere_inner_product(b, b, order)
        assert row["excess"].item() == pytest.approx(multiple - 1, rel=1e-4)
        left_over = sphere_inner_product(a, a, order) - multiple * sphere_inner_product(a, b, order)
        assert row["shape_part"].item() ** 2 == pytest.approx(left_over, rel=1e-3)


def share_in_the_limit(mesh: Mesh, radius: float, order: float) -> float:
    """Return the area share of a mesh close to a sphere, from its mean displacement and lack of area alone.

    To first order the difference is -α σ^ - β ∂/∂R 4πr² sinc(2R|ξ|), α the relative lack of area and β
    the mean displacement: radial integrals, no lattice and no NUFFT.
    """
    lack = 1 - mesh.area / Sphere(radius).area
    inside, weights = 0.0, 0.0
    for batch in kind_of(mesh).plan(1.0, 1e-9, 8).batches(1 << 20):
        inside += batch.weights @ (radius - np.linalg.norm(batch.coordinates, axis=0))
        weights += batch.weights.sum()
    displacement = inside / weights

    def reference(r: float) -> float:
        return float(np.sinc(2 * radius * r))

    def difference(r: float) -> float:
        derivative = (np.cos(2 * np.pi * radius * r) - np.sinc(2 * radius * r)) / radius
        return float(lack * reference(r) + displacement * derivative)

    def product(f: Callable[[float], float], g: Callable[[float], float]) -> float:
        return float(quad(lambda r: r**2 * (1 + r**2) ** order * f(r) * g(r), 0, 30, limit=500)[0])

    return product(difference, reference) ** 2 / product(difference, difference) / product(reference, reference)


@pytest.mark.parametrize("radius", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("order", [-10.0, -5.0])
def test_icospheres_against_the_sphere(radius: float, order: float) -> None:
    lattice = Lattice(6.0, 60)
    mesh = Mesh(radius * icosphere(3).vertices, icosphere(3).triangles)
    sphere = fourier_transform(Sphere(radius), lattice)
    field = fourier_transform(mesh, lattice, 1e-11)
    dataset = proportion(field, sphere, order)
    square = distance(field, sphere, order)["distance"].item() ** 2
    assert (dataset["area_part"] ** 2 + dataset["shape_part"] ** 2).item() == pytest.approx(square, rel=1e-10)
    assert dataset["area_share"].item() == pytest.approx(share_in_the_limit(mesh, radius, order), rel=0.04)


def test_a_moved_surface_differs_in_shape_alone() -> None:
    dataset = proportion(Sphere(0.7, (0.05, 0, 0)), Sphere(0.7), -4.0, lattice=Lattice(4.0, 40))
    # <a, b> < <b, b>: of what has moved, a little less of the reference is the best.
    assert dataset["excess"].item() < 0
    assert dataset["area_share"].item() < 0.05


def test_equal_and_missing_fields() -> None:
    a = fourier_transform(BOX, LATTICE)
    same = proportion(a, a, -2.0)
    assert (same["distance"].item(), same["area_part"].item(), same["shape_part"].item()) == (0, 0, 0)
    assert np.isnan(same["area_share"].item())
    damaged = a.copy()
    damaged[1, 2, 3] = np.nan
    assert np.isnan(proportion(damaged, a, -2.0)["area_part"].item())
    assert np.isnan(proportion(damaged, a, -2.0)["shape_part"].item())


def test_blocks_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(10)
    a, b = as_field(random_values(rng)), as_field(random_values(rng))
    whole = proportion(a, b, ORDERS)
    read = operands.read_blocks
    monkeypatch.setattr(
        "sobolev_batch.spectral.fields.read_blocks",
        lambda lattice, *fields: read(lattice, *fields, largest=200),
    )
    in_blocks = proportion(a, b, ORDERS)
    xr.testing.assert_allclose(in_blocks, whole, rtol=1e-12)
