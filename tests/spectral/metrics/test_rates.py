"""Observed rates."""

from __future__ import annotations

import numpy as np

from sobolev_batch.spectral.metrics.datasets import observed_rates


def test_rates_follow_the_sizes_not_the_order_of_the_meshes() -> None:
    sizes = np.array([0.1, 0.4, 0.2])
    rates, errors = observed_rates(5 * sizes**1.5, np.zeros(3), sizes)
    assert np.isnan(rates[1])
    assert np.allclose(rates[[2, 0]], 1.5, rtol=0, atol=1e-14)
    assert np.array_equal(errors[[2, 0]], [0.0, 0.0])


def test_errors_of_rates_cover_what_the_distances_allow() -> None:
    sizes, distances, errors = np.array([0.2, 0.1]), np.array([0.4, 0.1]), np.array([0.02, 0.01])
    rates, uncertainties = observed_rates(distances, errors, sizes)
    extremes = [
        observed_rates(distances + a * errors * [1, 0] + b * errors * [0, 1], np.zeros(2), sizes)[0][1]
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    assert rates[1] - uncertainties[1] <= min(extremes)
    assert rates[1] + uncertainties[1] >= max(extremes)
    assert uncertainties[1] < 1.2 * (max(extremes) - min(extremes)) / 2


def test_missing_meshes_are_bridged() -> None:
    sizes = np.array([0.4, 0.2, 0.1, np.nan])
    rates, _ = observed_rates(np.array([0.16, np.nan, 0.01, 0.001]), np.zeros(4), sizes)
    assert np.isnan(rates[[0, 1, 3]]).all()
    assert np.isclose(rates[2], 2.0)


def test_distances_below_their_error_carry_no_rate() -> None:
    sizes, distances = np.array([0.4, 0.2, 0.1]), np.array([0.16, 0.04, 0.01])
    rates, uncertainties = observed_rates(distances, np.array([0.0, 0.0, 0.011]), sizes)
    assert np.isnan(rates[2])
    assert np.isnan(uncertainties[2])
    assert np.isclose(rates[1], 2.0)


def test_equal_sizes_and_zero_distances_have_no_rate() -> None:
    assert np.isnan(observed_rates(np.array([1.0, 2.0]), np.zeros(2), np.array([0.1, 0.1]))[0]).all()
    assert np.isnan(observed_rates(np.array([1.0, 0.0]), np.zeros(2), np.array([0.2, 0.1]))[0]).all()


def test_nearly_equal_sizes_are_bridged() -> None:
    sizes = np.array([0.4, 0.2, 0.19])
    rates, _ = observed_rates(np.array([0.16, 0.04, 0.0361]), np.zeros(3), sizes)
    assert np.allclose(rates[1:], 2.0), "the third one is compared with the first: the second is as fine"
