"""Causes of distances: area, wavelengths, places, against sums over the whole lattice and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.norms import fields
from sobolev_batch.transform.lattice import Block
from sobolev_batch.transform.nufft import evaluate_at
from sobolev_batch.transform.nufft_costs import NufftSpec
from tests.support.oracles import full_lattice_norm, on_whole_cube
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = sb.Lattice(4.0, 32)
ORDERS = [-0.7, -2.0, -10.0]
SMALL = sb.Lattice(2.0, 16)
SMALL_ORDERS = [-0.6, -2.0, -5.0, -10.0]
RANDOM = sb.Lattice(3.0, 12)
WITNESS_ORDERS = [-0.8, -3.0, -10.0]


def as_field(values: Complexes, lattice: sb.Lattice) -> xr.DataArray:
    return sb.fourier_transform(sb.shapes.Sphere(0.1), lattice).copy(data=values)


def random_values(rng: np.random.Generator) -> Complexes:
    return rng.standard_normal(SMALL.shape) + 1j * rng.standard_normal(SMALL.shape)


@pytest.mark.parametrize("seed", range(3))
def test_the_share_of_area_is_the_projection_spelt_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = random_values(rng)
    a = rng.uniform(-2, 2) * b + rng.uniform(0, 2) * random_values(rng)
    dataset = sb.distance(as_field(a, SMALL), as_field(b, SMALL), SMALL_ORDERS)
    for order in SMALL_ORDERS:
        row = dataset.sel(order=order)
        plus, minus, own = (full_lattice_norm(values, SMALL, order) for values in (a + b, a - b, b))
        # The inner product by polarisation.
        multiple = (plus**2 - minus**2) / (4 * own**2)
        assert row["excess"].item() == pytest.approx(multiple - 1, rel=1e-10, abs=1e-12)
        assert row["area_share"].item() == pytest.approx((multiple - 1) ** 2 * own**2 / minus**2, rel=1e-10)


def test_near_twins_keep_their_digits() -> None:
    # Values on grids of powers of two, so that a = b + e and a - b are exact: e is known to all digits.
    rng = np.random.default_rng(8)
    b = np.round(random_values(rng) * 2**10) / 2**10
    e = np.round((0.3 * b + random_values(rng)) * 2**6) / 2**42
    assert np.array_equal((b + e) - b, e)
    near, larger = (sb.distance(as_field(b + factor * e, SMALL), as_field(b, SMALL), -3.0) for factor in (1, 2**30))
    assert 2**30 * near["excess"].item() == pytest.approx(larger["excess"].item(), rel=1e-12)
    assert near["area_share"].item() == pytest.approx(larger["area_share"].item(), rel=1e-12)


@pytest.mark.parametrize("bands", [None, 1, 7, 40])
def test_bands_add_up_to_the_squared_distance(bands: int | None) -> None:
    a, b = sb.fourier_transform(BOX, LATTICE), sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    dataset = sb.spectrum(a, b, ORDERS, bands=bands)
    squares = sb.distance(a, b, ORDERS)["distance"].values ** 2
    assert dataset["squared"].sum("band").values == pytest.approx(squares, rel=1e-12)
    assert dataset["share"].sum("band").values == pytest.approx(1, rel=1e-12)
    assert dataset["total"].values == pytest.approx(squares, rel=1e-12)
    assert sb.spectrum(a, None, -2.0, bands=bands)["squared"].sum().item() == pytest.approx(
        sb.norm(a, -2.0)["norm"].item() ** 2, rel=1e-12
    )


def test_bands_are_sums_over_the_whole_lattice() -> None:
    rng = np.random.default_rng(0)
    lattice = sb.Lattice(1.5, 6)
    values = rng.standard_normal(lattice.shape) + 1j * rng.standard_normal(lattice.shape)
    field = sb.fourier_transform(sb.shapes.Sphere(0.1), lattice).copy(data=values)
    edges = [0.0, 0.5, 0.8, 1.5, 2.1]  # the shells |k|² = 1 and 9 lie on edges, those beyond 17 in no band
    dataset = sb.spectrum(field, None, -2.0, bands=edges)
    whole, weights = on_whole_cube(values, lattice, 0.0)
    squares = np.abs(whole) ** 2
    radii = np.round(np.linalg.norm(np.meshgrid(*[lattice.axes[0]] * 3), axis=0), 12)
    for i in range(4):
        inside = (radii >= edges[i]) & (radii < edges[i + 1])
        expected = np.sum((weights * (1 + radii**2) ** -2.0 * squares)[inside])
        assert dataset["squared"].values[i] == pytest.approx(expected, rel=1e-12)
        mean = np.average(squares[inside], weights=weights[inside])
        assert dataset["mean_square"].values[i] == pytest.approx(mean, rel=1e-12)
    assert dataset["squared"].sum().item() < dataset["total"].item()


def test_energy_of_a_sphere_is_twice_its_area_in_the_mean() -> None:
    whole = sb.spectrum(sb.shapes.Sphere(), None, -2.0, bands=[1.0, 5.0], lattice=sb.Lattice(5.0, 160))
    assert whole["energy"].item() == pytest.approx(2 * sb.shapes.Sphere().area, rel=0.02)


def test_default_bands_and_wavelengths() -> None:
    similarity = sb.shapes.Similarity(0.02)
    dataset = sb.spectrum(sb.shapes.icosphere(2), sb.shapes.Sphere(), -3.0, lattice=LATTICE, similarity=similarity)
    assert dataset["upper"].values == pytest.approx([0.5, 1, 2, 4, 4 * 3**0.5])
    assert dataset["lower"].values[0] == 0
    assert dataset["longest_wavelength"].values == pytest.approx([np.inf, 2, 1, 0.5, 0.25])
    assert dataset["own_shortest_wavelength"].values[:4] == pytest.approx([100, 50, 25, 12.5])
    assert dataset["squared"].dims == ("band",)
    assert "own_longest_wavelength" not in sb.spectrum(sb.shapes.Sphere(), None, -3.0, lattice=LATTICE).coords


def test_equal_fields_have_no_shares_and_missing_samples_no_numbers() -> None:
    a = sb.fourier_transform(sb.shapes.Sphere(), LATTICE)
    assert np.isnan(sb.spectrum(a, a, -2.0)["share"].values).all()
    assert np.isnan(sb.distance(a, a, -2.0)["area_share"].item())
    damaged = a.copy()
    damaged[16, 16, 0] = np.nan
    bands, whole = sb.spectrum(damaged, a, -2.0), sb.distance(damaged, a, -2.0)
    numbers = [bands["total"].item(), bands["squared"].values[0], *(whole[n].item() for n in ("distance", "excess"))]
    assert np.isnan(numbers).all()


@pytest.mark.parametrize(
    "bands", [0, -3, [1.0], [1.0, 1.0], [2.0, 1.0], [-1.0, 1.0], [0.0, np.inf], "octaves", [[0, 1]]]
)
def test_refuses_bands(bands: object) -> None:
    with pytest.raises(sb.errors.InputError, match="band"):
        sb.spectrum(sb.shapes.Sphere(), None, -2.0, lattice=LATTICE, bands=bands)  # type: ignore[arg-type]


def random_pair(seed: int) -> tuple[Complexes, Complexes]:
    """Return two fields of random points: real measures that are not smooth."""
    rng = np.random.default_rng(seed)
    fields: list[Complexes] = []
    for _ in range(2):
        points, weights = rng.uniform(-0.9, 0.9, (3, 7)), rng.uniform(0, 1, 7)
        turns = [np.exp(-2j * np.pi * np.outer(*pair)) for pair in zip(RANDOM.axes, points, strict=True)]
        fields.append(np.einsum("xp,yp,zp,p->xyz", *turns, weights))
    return fields[0], fields[1]


def direct_sum(difference: Complexes, lattice: sb.Lattice, order: float, points: Reals) -> Reals:
    """Return the witness function by the trapezoidal rule on the whole cube, conjugate half included."""
    weighted = np.multiply(*on_whole_cube(difference, lattice, order))
    turns = [np.exp(2j * np.pi * np.multiply.outer(points[:, i], lattice.axes[0])) for i in range(3)]
    values = np.einsum("ijk,ni,nj,nk->n", weighted, *turns, optimize=True)
    assert np.abs(values.imag).max() < 1e-12 * np.abs(weighted).sum()
    return np.asarray(values.real)


@pytest.mark.parametrize("seed", [0, 1])
def test_is_the_direct_sum_over_the_whole_lattice(seed: int) -> None:
    a, b = random_pair(seed)
    points = np.random.default_rng(seed).uniform(-0.99, 0.99, (23, 3)) * RANDOM.half_period
    evaluated = sb.witness(as_field(a, RANDOM), as_field(b, RANDOM), WITNESS_ORDERS, points, eps=1e-13)
    assert evaluated.dims == ("order", "point")
    for order in WITNESS_ORDERS:
        expected = direct_sum(a - b, RANDOM, order, points)
        # A lattice of so few samples: the sum of all terms is not much above the largest values.
        assert evaluated.sel(order=order).values == pytest.approx(expected, rel=0, abs=1e-11 * np.abs(expected).max())


@pytest.mark.slow
def test_blocks_batches_and_parts_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = (as_field(values, RANDOM) for values in random_pair(3))
    points = np.random.default_rng(3).uniform(-0.9, 0.9, (50, 3))
    whole, distances = sb.witness(a, b, -2.0, points, eps=1e-13).values, sb.distance(a, b, WITNESS_ORDERS)
    monkeypatch.setattr(fields, "BLOCK_SAMPLES", 100)
    assert len(RANDOM.half.split(100)) > 10
    in_blocks = sb.witness(a, b, -2.0, points, eps=1e-13).values
    assert in_blocks == pytest.approx(whole, rel=0, abs=1e-11 * np.abs(whole).max())
    xr.testing.assert_allclose(sb.distance(a, b, WITNESS_ORDERS), distances, rtol=1e-12)
    block = Block((-3, 1, 2), (5, 4, 4))
    coefficients = np.random.default_rng(4).standard_normal((2, *block.shape)) + 1j
    one, many = (
        evaluate_at(points.T, coefficients, RANDOM, block, spec)
        for spec in (NufftSpec(block.shape, 1e-13), NufftSpec((2, 3, 3), 1e-13, oversampling=2.0, batch=7))
    )
    assert many == pytest.approx(one, rel=0, abs=1e-11 * np.abs(one).max())


def test_is_positive_where_the_first_has_more() -> None:
    lattice = sb.Lattice(4.0, 40)
    right = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    evaluated = sb.witness(
        sb.shapes.Sphere(0.5, (0.5, 0, 0)), sb.shapes.Sphere(0.5, (-0.5, 0, 0)), -4.0, right, lattice=lattice
    ).values
    assert evaluated[0] > 0 > evaluated[1]
    assert evaluated[0] == pytest.approx(-evaluated[1], rel=1e-9)
    assert sb.witness(sb.shapes.Sphere(), sb.shapes.Sphere(), -4.0, right, lattice=lattice).values == pytest.approx(
        [0, 0], abs=1e-15
    )


def test_single_precision() -> None:
    lattice = sb.Lattice(4.0, 40)
    points = np.random.default_rng(8).uniform(-1, 1, (5_000, 3))
    a, b = (sb.fourier_transform(surface, lattice) for surface in (BOX, sb.shapes.Sphere()))
    exact = sb.witness(a, b, -3.0, points, eps=1e-13, threads=1)
    scale = float(np.abs(exact).max())
    single = sb.witness(a, b, -3.0, points, dtype="complex64", threads=1)
    assert single.dtype == np.float32
    assert 1e-9 * scale < float(np.abs(single - exact).max()) < 1e-4 * scale


def test_missing_samples_and_no_points() -> None:
    a, b = random_pair(1)
    a[3, 4, 5] = np.nan
    assert np.isnan(sb.witness(as_field(a, RANDOM), as_field(b, RANDOM), -2.0, np.zeros((3, 3))).values).all()
    assert sb.witness(as_field(b, RANDOM), as_field(b, RANDOM), [-2.0], np.empty((0, 3))).shape == (1, 0)


def test_refusals() -> None:
    field = as_field(random_pair(0)[0], RANDOM)
    with pytest.raises(sb.errors.LatticeError, match=r"points reach to \|coordinate\| = 1\.2, .* < 1/\(2h\) = 1;"):
        sb.witness(field, field, -2.0, [[0, -1.2, 0]])
    for points, message in (([[1.0, 2.0]], r"\(1, 2\)"), ([[np.nan, 0, 0]], "1 of 1 points"), ("x", "real numbers")):
        with pytest.raises(sb.errors.InputError, match=message):
            sb.witness(field, field, -2.0, points)
    with pytest.raises(sb.errors.OrderError):
        sb.witness(field, field, -0.5, np.zeros((1, 3)))
    with pytest.raises(sb.errors.InputError, match="dtype"):
        sb.witness(field, field, -2.0, np.zeros((1, 3)), dtype="float32")  # type: ignore[arg-type]
