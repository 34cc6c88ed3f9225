"""The lattice, its half and blocks of it; sums over its shells."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from sobolev_batch import Lattice, fourier_transform, norm
from sobolev_batch.errors import LatticeError
from sobolev_batch.shapes import Sphere
from sobolev_batch.transform.lattice import SobolevWeights, shell_sums, shell_volumes
from tests.support.shapes import CENTRED_BOX as BOX


def test_frequencies_run_over_the_half_lattice_with_both_ends() -> None:
    lattice = Lattice(5.0, 128)
    x, y, z = lattice.axes
    assert lattice.shape == (129, 129, 65)
    assert lattice.spacing == pytest.approx(0.078125, abs=0)
    assert (x[0], x[64], x[-1]) == (-5.0, 0.0, 5.0)
    assert np.array_equal(x, y)
    assert (z[0], z[-1]) == (0.0, 5.0)
    shells = lattice.shells(lattice.half)
    assert (shells[64, 64, 0], shells[0, 0, 64], shells.max()) == (0, 3 * 64**2, lattice.shell_count - 1)


@pytest.mark.parametrize(
    ("xi_max", "intervals"),
    [(0.0, 8), (-1.0, 8), (np.nan, 8), (np.inf, 8), (5.0, 7), (5.0, 0), (5.0, 4096), (5.0, 8.0)],
)
def test_refuses_malformed_lattices(xi_max: float, intervals: Any) -> None:
    with pytest.raises(LatticeError, match=r"must be"):
        Lattice(xi_max, intervals)


def test_trapezoid_weights_of_the_half_integrate_the_whole_cube() -> None:
    lattice = Lattice(3.0, 6)
    x, y, z = lattice.axes
    # Of even integrands, and exactly of 1 and of products of piecewise linear |x|.
    weights = lattice.trapezoid_weights(lattice.half)
    assert weights.sum() == pytest.approx(6.0**3, rel=1e-14)
    product = np.abs(x)[:, None, None] * np.abs(y)[:, None] * np.abs(z)
    assert (weights * product).sum() == pytest.approx(9.0**3, rel=1e-14)


@pytest.mark.parametrize("largest", [1, 7, 50, 300, 10_000])
def test_blocks_cover_the_half_once_and_respect_their_bound(largest: int) -> None:
    lattice = Lattice(1.0, 8)
    seen = np.zeros(lattice.shape, dtype=int)
    blocks = lattice.half.split(largest)
    for block in blocks:
        assert block.size <= largest
        # As the chunks of a regular grid do, they differ at the high ends alone.
        for axis, part in enumerate(block.place_in(lattice.half)):
            assert part.start % blocks[0].shape[axis] == 0
            assert block.shape[axis] == blocks[0].shape[axis] or part.stop == lattice.shape[axis]
        seen[block.place_in(lattice.half)] += 1
        frequencies = lattice.frequencies(block)
        for axis, part in enumerate(block.place_in(lattice.half)):
            assert np.array_equal(frequencies[axis], lattice.axes[axis][part])
    assert (seen == 1).all()


def test_parts_of_fields_are_not_taken_for_fields() -> None:
    field = fourier_transform(Sphere(), Lattice(2.5, 16))
    assert Lattice.from_field(field) == Lattice(2.5, 16)
    with pytest.raises(LatticeError, match="select whole fields"):
        Lattice.from_field(field.isel(xi_z=slice(0, 5)))
    with pytest.raises(LatticeError, match="needs the coordinates"):
        Lattice.from_field(field.drop_vars("xi_x"))


LATTICE = Lattice(4.0, 32)


def test_shell_sums_of_blocks_add_up() -> None:
    field = fourier_transform(BOX, LATTICE)
    parts = sum(
        shell_sums(field.values[block.place_in(LATTICE.half)], None, LATTICE, block)
        for block in LATTICE.half.split(5_000)
    )
    whole = shell_sums(field.values, None, LATTICE, LATTICE.half)
    assert np.allclose(parts, whole, rtol=1e-13, atol=0)
    weights = SobolevWeights(LATTICE, (-2.0,))
    assert weights.per_shell @ whole == pytest.approx(norm(field, -2)["norm"].item() ** 2, rel=1e-14)
    # They travel without what they can compute again.
    copy = pickle.loads(pickle.dumps(weights))
    assert copy == weights
    assert "per_shell" not in vars(copy)


def test_volumes_are_the_sums_of_ones() -> None:
    ones = np.ones(LATTICE.shape, dtype=np.complex128)
    assert shell_volumes(LATTICE) == pytest.approx(shell_sums(ones, None, LATTICE, LATTICE.half), rel=1e-13)
    assert shell_volumes(LATTICE).sum() == pytest.approx(8.0**3, rel=1e-13)
