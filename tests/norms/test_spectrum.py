"""Radial spectra: norms and errors of every order are those of all samples."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sobolev_batch import Lattice
from sobolev_batch.norms.images import NearAxes
from sobolev_batch.norms.spectrum import ComparedSpectra, RadialAxis, Spectra
from sobolev_batch.norms.tail.integrals import OctaveWeights, integral_over
from sobolev_batch.norms.tail.sampling import TailSampling
from tests.support.shapes import box

ORDERS = (-0.51, -1.0, -2.0, -3.0, -5.0, -10.0, -12.0)
LATTICE = Lattice(xi_max=3.0, M=16)


@pytest.fixture(scope="module")
def axis() -> RadialAxis:
    """Return an axis with two octaves, of lattices and drawn samples."""
    return RadialAxis(LATTICE, TailSampling.usual(3.0, 2, [box()]))


@pytest.fixture(scope="module")
def squares(axis: RadialAxis) -> NDArray[np.float64]:
    """Return |field|² of a falling and a rising field at all samples, with some that are much larger than others."""
    assert axis.sampling is not None
    radii = np.linalg.norm(axis.sampling.frequencies, axis=1)
    noise = np.random.default_rng(0).exponential(size=(2, len(radii))) ** 3
    return np.asarray(noise * np.stack([radii**-2, radii**2]))


@pytest.fixture(scope="module")
def spectra(axis: RadialAxis, squares: NDArray[np.float64]) -> Spectra:
    return axis.spectra(np.ones((2, LATTICE.shell_count)), squares)


def test_integrals_and_errors_over_octaves_are_those_of_all_samples(
    axis: RadialAxis, spectra: Spectra, squares: NDArray[np.float64]
) -> None:
    assert axis.sampling is not None
    totals, errors = axis.octave_integrals(spectra, ORDERS)
    for field, values in enumerate(squares):
        parts = zip(axis.sampling.octaves, axis.sampling.split(values), strict=True)
        sums = [OctaveWeights(octave, ORDERS).sums(part) for octave, part in parts]
        expected, error = integral_over(sums)
        assert totals[:, field] == pytest.approx(expected, rel=1e-13)
        # Between the orders at which the largest samples are known their bound is used.
        assert (errors[:, field] >= (1 - 1e-8) * error).all()
        assert errors[:, field] == pytest.approx(error, rel=0.05)
        assert axis.energies(spectra)[field] == pytest.approx([one.energy for one in sums], rel=1e-12)


def test_one_weighted_sum_over_the_axis_is_the_squared_norm(axis: RadialAxis, spectra: Spectra) -> None:
    for order in ORDERS:
        total = spectra.sums @ (axis.weights * (1 + axis.radii**2) ** order)
        shells = slice(0, LATTICE.shell_count)
        core = (axis.weights[shells] * (1 + axis.radii[shells] ** 2) ** order).sum()
        assert total == pytest.approx(core + axis.octave_integrals(spectra, [order])[0][0], rel=1e-13)


def test_spectra_have_the_arrays_that_the_axis_describes_and_come_back_from_them(axis: RadialAxis) -> None:
    for radial_axis in (RadialAxis(LATTICE), axis):
        samples = 0 if radial_axis.sampling is None else radial_axis.sampling.size
        ones = np.ones((2, LATTICE.shell_count)), np.ones((2, samples))
        images = NearAxes(LATTICE, 2).images() if radial_axis.sampling is None else None
        norm, product = radial_axis.spectra(*ones, images), radial_axis.spectra(*ones, is_square=False)
        arrays = {**norm.named("norm"), **norm.named("distance"), **product.named("product")}
        assert {name: values.shape[1] for name, values in arrays.items()} == {
            name: width for name, (width, *_) in radial_axis.arrays().items()
        }
        again = ComparedSpectra(arrays)
        # The product of a field with itself is its square.
        for found in (again.norm, again.product(again.norm)):
            assert np.maximum(found.moments, 0) == pytest.approx(np.maximum(norm.moments, 0), rel=1e-14)
            assert found.peaks == pytest.approx(norm.peaks, rel=1e-14)
