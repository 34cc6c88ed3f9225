"""Witness functions against direct sums, the kernel in real space, and the squared distance."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from scipy.special import gamma, kv

from sobolev_batch import (
    InputError,
    Lattice,
    LatticeError,
    Mesh,
    OrderError,
    Sphere,
    distance,
    fourier_transform,
    icosphere,
    witness,
)
from sobolev_batch.spectral.backends import NufftSpec
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.quadrature.kinds import kind_of
from sobolev_batch.spectral.quadrature.meshes import WeightedPoints
from sobolev_batch.spectral.transform.nufft import evaluate_at, transform_points
from tests.support.shapes import CENTRED_BOX as BOX

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LATTICE = Lattice(3.0, 12)
ORDERS = [-0.8, -3.0, -10.0]


def random_pair(seed: int) -> tuple[Complexes, Complexes]:
    """Return two fields of random points: real measures that are not smooth."""
    rng = np.random.default_rng(seed)
    fields: list[Complexes] = []
    for _ in range(2):
        points, weights = rng.uniform(-0.9, 0.9, (7, 3)), rng.uniform(0, 1, 7)
        x, y, z = LATTICE.axes
        phases = np.multiply.outer(x, points[:, 0])[:, None, None] + np.multiply.outer(y, points[:, 1])[:, None]
        turns = np.exp(-2j * np.pi * (phases + np.multiply.outer(z, points[:, 2])))
        fields.append(np.asarray(turns @ weights, dtype=np.complex128))
    return fields[0], fields[1]


def direct_sum(difference: Complexes, lattice: Lattice, order: float, points: Reals) -> Reals:
    """Return the witness function by the trapezoidal rule on the whole cube, conjugate half included."""
    whole = np.concatenate([np.conj(difference[::-1, ::-1, :0:-1]), difference], axis=2)
    axis = lattice.axes[0]
    ends = np.where(np.abs(axis) == lattice.xi_max, 0.5, 1.0) * lattice.spacing
    squares = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    weighted = whole * ends[:, None, None] * ends[:, None] * ends * (1 + squares) ** order
    turns = [np.exp(2j * np.pi * np.multiply.outer(points[:, i], axis)) for i in range(3)]
    values = np.einsum("ijk,ni,nj,nk->n", weighted, *turns, optimize=True)
    assert np.abs(values.imag).max() < 1e-12 * np.abs(weighted).sum()
    return np.asarray(values.real)


def as_field(values: Complexes) -> xr.DataArray:
    return fourier_transform(Sphere(0.1), LATTICE).copy(data=values)


@pytest.mark.parametrize("seed", [0, 1])
def test_is_the_direct_sum_over_the_whole_lattice(seed: int) -> None:
    a, b = random_pair(seed)
    points = np.random.default_rng(seed).uniform(-0.99, 0.99, (23, 3)) * LATTICE.half_period
    evaluated = witness(as_field(a), as_field(b), ORDERS, points, eps=1e-13)
    assert evaluated.dims == ("order", "point")
    for order in ORDERS:
        expected = direct_sum(a - b, LATTICE, order, points)
        # A lattice of so few samples: the sum of all terms is not much above the largest values.
        assert evaluated.sel(order=order).values == pytest.approx(expected, rel=0, abs=1e-11 * np.abs(expected).max())


@pytest.mark.slow
def test_blocks_batches_and_parts_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = random_pair(3)
    points = np.random.default_rng(3).uniform(-0.9, 0.9, (50, 3))
    whole = witness(as_field(a), as_field(b), -2.0, points, eps=1e-13).values
    monkeypatch.setattr("sobolev_batch.spectral.metrics.causes.BLOCK_SAMPLES", 100)
    assert len(LATTICE.split(100)) > 10
    in_blocks = witness(as_field(a), as_field(b), -2.0, points, eps=1e-13).values
    assert in_blocks == pytest.approx(whole, rel=0, abs=1e-11 * np.abs(whole).max())
    block = Block((-3, 1, 2), (5, 4, 4))
    coefficients = np.random.default_rng(4).standard_normal((2, *block.shape)) + 1j
    one, many = (
        evaluate_at(points.T, coefficients, LATTICE, block, spec)
        for spec in (NufftSpec(block.shape, 1e-13), NufftSpec((2, 3, 3), 1e-13, oversampling=2.0, batch=7))
    )
    assert many == pytest.approx(one, rel=0, abs=1e-11 * np.abs(one).max())


def test_evaluation_is_the_adjoint_of_the_transform() -> None:
    rng = np.random.default_rng(5)
    block = Block((-6, -2, 1), (7, 6, 4))
    points, weights = rng.uniform(-1, 1, (3, 40)), rng.standard_normal(40)
    coefficients = rng.standard_normal((1, *block.shape)) + 1j * rng.standard_normal((1, *block.shape))
    transformed, _ = transform_points([WeightedPoints(points, weights)], LATTICE, block, NufftSpec(block.shape, 1e-13))
    (values,) = evaluate_at(points, coefficients, LATTICE, block, NufftSpec(block.shape, 1e-13))
    assert weights @ values == pytest.approx(np.vdot(transformed, coefficients).real, rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("other", [Mesh(0.7 * icosphere(1).vertices, icosphere(1).triangles), BOX])
def test_its_integral_against_the_difference_is_the_squared_distance(other: Mesh) -> None:
    lattice, mesh = Lattice(4.0, 32), icosphere(2)
    a, b = (fourier_transform(surface, lattice, 1e-14) for surface in (mesh, other))
    total = np.zeros(len(ORDERS))
    for surface, sign in ((mesh, 1.0), (other, -1.0)):
        for batch in kind_of(surface).plan(lattice.highest_frequency, 1e-14).batches(1 << 20):
            values = witness(a, b, ORDERS, batch.coordinates.T, eps=1e-14).values
            total += sign * values @ batch.weights
    assert total == pytest.approx(distance(a, b, ORDERS)["distance"].values ** 2, rel=1e-10)


def test_is_the_difference_smoothed_by_the_matern_kernel() -> None:
    # No Fourier transform on this side: w(x) = ∫ K(|x - y|) d(a - b)(y) over points of a high degree.
    order, power = -6.0, 6.0
    shrunk = Mesh(0.8 * BOX.vertices, BOX.triangles)
    points = np.random.default_rng(7).uniform(-1, 1, (9, 3))
    expected = np.zeros(len(points))
    for mesh, sign in ((BOX, 1.0), (shrunk, -1.0)):
        for batch in kind_of(mesh).plan(1.0, 1e-9, 22).batches(1 << 20):
            r = np.linalg.norm(points[:, None] - batch.coordinates.T, axis=2)
            kernel = 2 * np.pi**power / gamma(power) * r ** (power - 1.5) * kv(1.5 - power, 2 * np.pi * r)
            expected += sign * kernel @ batch.weights
    evaluated = witness(BOX, shrunk, order, points, lattice=Lattice(7.0, 80)).values
    assert evaluated == pytest.approx(expected, rel=0, abs=1e-7 * np.abs(expected).max())


def test_is_positive_where_the_first_has_more() -> None:
    lattice = Lattice(4.0, 40)
    right = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    evaluated = witness(Sphere(0.5, (0.5, 0, 0)), Sphere(0.5, (-0.5, 0, 0)), -4.0, right, lattice=lattice).values
    assert evaluated[0] > 0 > evaluated[1]
    assert evaluated[0] == pytest.approx(-evaluated[1], rel=1e-9)
    assert witness(Sphere(), Sphere(), -4.0, right, lattice=lattice).values == pytest.approx([0, 0], abs=1e-15)


def test_single_precision_and_little_memory() -> None:
    lattice = Lattice(4.0, 40)
    points = np.random.default_rng(8).uniform(-1, 1, (5_000, 3))
    a, b = (fourier_transform(surface, lattice) for surface in (BOX, Sphere()))
    exact = witness(a, b, -3.0, points, eps=1e-13, threads=1)
    scale = float(np.abs(exact).max())
    single = witness(a, b, -3.0, points, dtype="complex64", threads=1)
    assert single.dtype == np.float32
    assert 1e-9 * scale < float(np.abs(single - exact).max()) < 1e-4 * scale
    little = witness(a, b, -3.0, points, eps=1e-12, memory="15MB")
    assert float(np.abs(little - exact).max()) < 1e-9 * scale
    with pytest.raises(InputError, match="give at least"):
        witness(a, b, -3.0, points, memory=1e5)


def test_accuracy_follows_eps() -> None:
    lattice = Lattice(4.0, 40)
    points = np.random.default_rng(9).uniform(-1, 1, (200, 3))
    a, b = (fourier_transform(surface, lattice) for surface in (BOX, Sphere()))
    exact = witness(a, b, -3.0, points, eps=1e-14)
    errors = [float(np.abs(witness(a, b, -3.0, points, eps=eps) - exact).max()) for eps in (1e-3, 1e-6, 1e-9)]
    assert all(fine < 1e-2 * coarse for coarse, fine in pairwise(errors))


def test_missing_samples_and_no_points() -> None:
    a, b = random_pair(1)
    a[3, 4, 5] = np.nan
    assert np.isnan(witness(as_field(a), as_field(b), -2.0, np.zeros((3, 3))).values).all()
    assert witness(as_field(b), as_field(b), [-2.0], np.empty((0, 3))).shape == (1, 0)


def test_refusals() -> None:
    field = as_field(random_pair(0)[0])
    with pytest.raises(LatticeError, match=r"points reach to \|coordinate\| = 1\.2, .* < 1/\(2h\) = 1;"):
        witness(field, field, -2.0, [[0, -1.2, 0]])
    for points, message in (([[1.0, 2.0]], r"\(1, 2\)"), ([[np.nan, 0, 0]], "1 of 1 points"), ("x", "real numbers")):
        with pytest.raises(InputError, match=message):
            witness(field, field, -2.0, points)
    with pytest.raises(OrderError):
        witness(field, field, -0.5, np.zeros((1, 3)))
    with pytest.raises(InputError, match="dtype"):
        witness(field, field, -2.0, np.zeros((1, 3)), dtype="float32")  # type: ignore[arg-type]
