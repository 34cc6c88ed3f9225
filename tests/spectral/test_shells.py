"""Sums over shells and their weights."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from sobolev_batch import Lattice, fourier_transform, norm
from sobolev_batch.spectral.shells import SobolevWeights, shell_sums, shell_volumes
from tests.support.shapes import CENTRED_BOX as BOX

LATTICE = Lattice(4.0, 32)


def test_shell_sums_of_blocks_add_up() -> None:
    field = fourier_transform(BOX, LATTICE)
    parts = sum(shell_sums(field.values[LATTICE.place(block)], None, LATTICE, block) for block in LATTICE.split(5_000))
    whole = shell_sums(field.values, None, LATTICE, LATTICE.half)
    assert np.allclose(parts, whole, rtol=1e-13, atol=0)
    assert SobolevWeights(LATTICE, (-2.0,)).per_shell @ whole == pytest.approx(
        norm(field, -2)["norm"].item() ** 2, rel=1e-14
    )


def test_volumes_are_the_sums_of_ones() -> None:
    ones = np.ones(LATTICE.shape, dtype=np.complex128)
    assert shell_volumes(LATTICE) == pytest.approx(shell_sums(ones, None, LATTICE, LATTICE.half), rel=1e-13)
    assert shell_volumes(LATTICE).sum() == pytest.approx(8.0**3, rel=1e-13)


def test_weights_travel_without_what_they_can_compute_again() -> None:
    weights = SobolevWeights(LATTICE, (-2.0, -0.6))
    radii = LATTICE.spacing * np.sqrt(np.arange(LATTICE.shell_count))
    assert weights.per_shell[1] == pytest.approx((1 + radii**2) ** -0.6, rel=1e-14)
    assert weights.per_shell is weights.per_shell
    copy = pickle.loads(pickle.dumps(weights))
    assert copy == weights
    assert "per_shell" not in vars(copy)
    assert np.array_equal(copy.per_shell, weights.per_shell)
