"""Numbers with the digits that their errors leave them."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sobolev_batch.results.tables.formatting import Digits, concise

_NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "error", "shown", "shown_error"),
    [
        (0.66889, 0.0213, "0.669", "0.022"),
        (6.299876e-01, 1e-10, "0.6299876", "1.0 × 10⁻¹⁰"),
        (2.0123e-5, 1.23e-8, "2.0123 × 10⁻⁵", "1.3 × 10⁻⁸"),
        (0.001, 0.005, "0.0010", "0.0050"),
        (2.6e-9, 9.99e-8, "3 × 10⁻⁹", "1.0 × 10⁻⁷"),
        (0.2654, 0.0994, "0.27", "0.10"),
        (0.0, 0.0, "0", "0"),
        (0.0, 5.97e-10, "0", "6.0 × 10⁻¹⁰"),
        (12.0, _NAN, "12.00", ""),
        (_NAN, 1.0, "", ""),
    ],
)
def test_errors_decide_on_digits(value: float, error: float, shown: str, shown_error: str) -> None:
    found = Digits.of(value, error)
    assert (found.value, found.error) == (shown, shown_error)


def test_both_have_one_power_of_ten() -> None:
    assert Digits.of(0.04733, 4.6e-4).together == "0.04733 ± 0.00046"
    assert Digits.of(2.0123e-5, 1.23e-8).together == "(2.0123 ± 0.0013) × 10⁻⁵"
    assert Digits.of(1.84604e-5, 1.1e-12).together == "1.846040 × 10⁻⁵ ± 1.1 × 10⁻¹²"
    assert Digits.of(12.0).together == "12.00 ± ?"


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (0.66889, 0.0213, "6.7(3)e-01"),
        (0.0992, 0.03, "1.0(3)e-01"),
        (9.9996e-3, 9.6e-6, "1.000(1)e-02"),
        (0.0, 0.0, "0"),
        (12.0, _NAN, "1.200(?)e+01"),
        (_NAN, 1.0, ""),
    ],
)
def test_errors_in_brackets(value: float, error: float, shown: str) -> None:
    assert concise(value, error) == shown


@given(st.floats(1e-12, 1e6), st.floats(1e-12, 10.0))
def test_what_is_shown_keeps_the_promise_of_the_error(value: float, ratio: float) -> None:
    """The interval that is shown reaches as far as the error says, but for the rounding of the value."""
    error = value * ratio
    found = re.fullmatch(r"(\d+(?:\.(\d+))?)\((\d+)\)e([+-]\d+)", concise(value, error))
    assert found is not None
    unit = 10.0 ** (int(found[4]) - len(found[2] or ""))
    assert float(found[1]) * 10.0 ** int(found[4]) == pytest.approx(value, abs=0.51 * unit)
    assert int(found[3]) * unit >= error * (1 - 1e-6)
    assert 1 <= int(found[3]) <= 10
    shown = Digits.of(value, error)
    assert _parsed(shown.error) >= error * (1 - 1e-6)
    assert math.isclose(_parsed(shown.value), value, rel_tol=0.51, abs_tol=error / 10)


def _parsed(text: str) -> float:
    number, _, power = text.partition(" × 10")
    return float(number) * 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)


def test_zero_has_its_own_error() -> None:
    assert concise(0.0, 5.97e-10) == concise(1e-12, 5.97e-10) == "0(6)e-10"
    assert Digits.of(0.0, 5.97e-10).together == "0 ± 6.0 × 10⁻¹⁰"
