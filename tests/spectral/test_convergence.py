"""Observed rates."""

from __future__ import annotations

import numpy as np

from sobolev_batch.spectral.convergence import observed_rates


def test_rates_follow_the_sizes_not_the_order_of_the_meshes() -> None:
    sizes = np.array([0.1, 0.4, 0.2])
    rates = observed_rates(5 * sizes**1.5, sizes)
    assert np.isnan(rates[1])
    assert np.allclose(rates[[2, 0]], 1.5, rtol=0, atol=1e-14)


def test_missing_meshes_are_bridged() -> None:
    sizes = np.array([0.4, 0.2, 0.1, np.nan])
    errors = np.array([0.16, np.nan, 0.01, 0.001])
    rates = observed_rates(errors, sizes)
    assert np.isnan(rates[[0, 1, 3]]).all()
    assert np.isclose(rates[2], 2.0)


def test_equal_sizes_and_zero_errors_have_no_rate() -> None:
    assert np.isnan(observed_rates(np.array([1.0, 2.0]), np.array([0.1, 0.1]))).all()
    assert np.isnan(observed_rates(np.array([1.0, 0.0]), np.array([0.2, 0.1]))).all()
