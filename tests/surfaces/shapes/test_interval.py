"""Intervals: their rules integrate, and their interpolants are differentiated, to rounding."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.special import eval_legendre

from sobolev_batch import InputError, Interval


def test_the_trapezoidal_rule_is_exact_on_waves() -> None:
    interval = Interval(-1.0, 2.0, periodic=True)
    nodes, weights = interval.rule(15)
    assert nodes[0] == -1.0
    for wave in range(15):
        exact = 3.0 if wave == 0 else 0.0
        found = np.sum(weights * np.exp(2j * np.pi * wave * (nodes + 1) / 3))
        assert abs(found - exact) < 1e-14
    # The first that the nodes cannot tell from a constant.
    assert np.sum(weights * np.cos(2 * np.pi * 15 * (nodes + 1) / 3)) == pytest.approx(3.0)


@pytest.mark.parametrize("count", [2, 8, 31, 400, 1500])
def test_gauss_legendre_is_exact_on_polynomials(count: int) -> None:
    nodes, weights = Interval(-1.0, 3.0).rule(count)
    assert -1 < nodes.min() < nodes.max() < 3
    # Legendre polynomials instead of powers, which weigh the ends alone.
    for degree in (0, 1, 2, 2 * count - 1):
        exact = 4.0 if degree == 0 else 0.0
        assert np.sum(weights * eval_legendre(degree, (nodes - 1) / 2)) == pytest.approx(exact, abs=2e-14)
    # The first that is integrated wrongly.
    assert abs(np.sum(weights * eval_legendre(2 * count, (nodes - 1) / 2))) > 1e-4


@pytest.mark.parametrize(("periodic", "count"), [(True, 41), (True, 401), (False, 60), (False, 401)])
def test_derivatives_of_resolved_functions_are_exact_to_rounding(periodic: bool, count: int) -> None:
    interval = Interval(0.5, 0.5 + math.pi, periodic)
    nodes, weights = interval.rule(count)
    values = np.stack([np.exp(np.sin(2 * nodes)), np.ones(count)])
    exact = np.stack([2 * np.cos(2 * nodes) * np.exp(np.sin(2 * nodes)), np.zeros(count)])
    for axis, turned in ((1, values), (0, values.T)):
        found = interval.derivative(turned, axis)
        errors = np.abs(np.moveaxis(found, axis, 1) - exact)
        # Weighted as in an integral: near the ends of a Gauss rule rounding is amplified, and weighs little.
        assert (errors @ weights).max() < 1e-14 * count
        assert errors[1].max() < 1e-12 * count


@pytest.mark.parametrize(
    ("low", "high"),
    [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.inf), ("0", 1.0), (False, True), (-1e308, 1e308)],
)
def test_an_interval_has_two_ends(low: Any, high: Any) -> None:
    with pytest.raises(InputError, match="an interval"):
        Interval(low, high)


def test_periodic_is_a_truth_value() -> None:
    flag: Any = 1
    with pytest.raises(InputError, match="expected True or False, found 1"):
        Interval(0.0, 1.0, flag)
