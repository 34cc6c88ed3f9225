"""Accuracies and what they allow."""

from __future__ import annotations

import numpy as np
import pytest

from sobolev_batch import InputError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.budget import NormEstimate


def test_memory_limits_the_lattice() -> None:
    sizes = [Accuracy(1e-3, memory).largest_intervals for memory in (5e8, 2e9, 2e10)]
    assert sizes == sorted(sizes)
    assert sizes[0] < 150 < sizes[1] < 300 < sizes[2]


def test_parts_add_up_to_the_accuracy() -> None:
    accuracy = Accuracy(1e-3)
    for order in (-0.6, -2.0, -5.0, -40.0):
        parts = accuracy.aliasing_part, accuracy.truncation_part(order), accuracy.discretisation_part(order)
        assert sum(parts) == pytest.approx(1e-3, rel=1e-14)
        assert min(parts) > 0


def test_below_the_floor_errors_are_relative_to_it() -> None:
    values, errors = np.array([4.0, 0.1, 0.0]), np.array([0.5, 0.15, 0.25])
    found = NormEstimate(values, errors, *np.zeros((2, 3)))
    assert Accuracy(0.1).met(found).tolist() == [False, False, False]
    assert Accuracy(0.1, floor=2.0).met(found).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("rtol", "allowed_bytes"), [(0.0, 1e9), (1.0, 1e9), (float("nan"), 1e9), (True, 1e9), (1e-3, 0), (1e-3, "2GB")]
)
def test_refuses_numbers_out_of_range(rtol: float, allowed_bytes: float) -> None:
    with pytest.raises(InputError, match=r"rtol|memory"):
        Accuracy(rtol, allowed_bytes)
