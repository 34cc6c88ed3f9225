"""Numbers with the digits that their errors leave them."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sobolev_batch.results.tables.text import bound, concise, percent, with_error

_NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (0.66889, 0.0213, "0.67 ± 0.03"),
        (6.299876e-01, 1e-10, "0.6299876 ± 1 × 10⁻¹⁰"),
        (0.001, 0.005, "0.001 ± 0.005"),
        (2.6e-9, 9.99e-8, "(3 ± 100) × 10⁻⁹"),
        (0.2654, 0.0994, "0.3 ± 0.1"),
        (0.0, 0.0, "0 ± 0"),
        (0.0, 5.97e-10, "0 ± 6 × 10⁻¹⁰"),
        (12.0, _NAN, "12.00 ± ?"),
        (_NAN, 1.0, ""),
        (0.04733, 4.6e-4, "0.0473 ± 0.0005"),
        (2.0123e-5, 1.23e-8, "(2.012 ± 0.002) × 10⁻⁵"),
        (1.84604e-5, 1.1e-12, "1.846040 × 10⁻⁵ ± 2 × 10⁻¹²"),
    ],
)
def test_errors_decide_on_digits_and_both_have_one_power_of_ten(value: float, error: float, shown: str) -> None:
    assert with_error(value, error) == shown


@pytest.mark.parametrize(
    ("fraction", "error", "shown"),
    [
        (9.87, 0.12, "990 % ± 20 %"),
        (0.0102, 0.0001, "1.02 % ± 0.01 %"),
        (1.234e-4, 7.2e-7, "0.01234 % ± 0.00008 %"),
        (1.2341e-8, 4.4e-12, "(1.2341 ± 0.0005) × 10⁻⁶ %"),
        (0.0102, _NAN, "1.020 % ± ?"),
        (0.0, 0.0, "0 % ± 0"),
    ],
)
def test_fractions_in_per_cent(fraction: float, error: float, shown: str) -> None:
    assert percent(fraction, error) == shown


def test_bounds_are_rounded_up() -> None:
    assert bound(0.01011) == "1.1 %"
    assert bound(3.1e-13) == "3.1 × 10⁻¹¹ %"


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (0.66889, 0.0213, "0.67(3)"),
        (0.0992, 0.03, "0.10(3)"),
        (9.9996e-3, 9.6e-6, "0.01000(1)"),
        (9.9996e-6, 9.6e-9, "1.000(1)e-05"),
        (1234.0, 120.0, "1200(200)"),
        (53.0, 26.0, "50(30)"),
        (53210.0, 26.0, "5.321(3)e+04"),
        (0.0, 0.0, "0"),
        (12.0, _NAN, "12.00(?)"),
        (_NAN, 1.0, ""),
    ],
)
def test_errors_in_brackets(value: float, error: float, shown: str) -> None:
    assert concise(value, error) == shown


@given(st.floats(1e-12, 1e6), st.floats(1e-12, 10.0))
def test_what_is_shown_keeps_the_promise_of_the_error(value: float, ratio: float) -> None:
    """The interval that is shown reaches as far as the error says, but for the rounding of the value."""
    error = value * ratio
    found = re.fullmatch(r"(\d+(?:\.(\d+))?)\((\d+)\)(?:e([+-]\d+))?", concise(value, error))
    assert found is not None
    power = int(found[4] or 0)
    unit = 10.0 ** (power - len(found[2] or ""))
    assert float(found[1]) * 10.0**power == pytest.approx(value, abs=0.51 * unit * 10.0 ** (len(found[3]) - 1))
    assert int(found[3]) * unit >= error * (1 - 1e-6)
    assert 1 <= int(found[3].rstrip("0")) <= 9
    shown, shown_error = _parsed(with_error(value, error))
    assert shown_error >= error * (1 - 1e-6)
    assert math.isclose(shown, value, rel_tol=0.51, abs_tol=error / 10)


def _parsed(text: str) -> tuple[float, float]:
    inner, power = text, ""
    if text.startswith("("):
        inner, _, power = text[1:].partition(")")
    first, _, second = inner.partition(" ± ")
    return _number(first + power), _number(second + power)


def _number(text: str) -> float:
    number, _, power = text.partition(" × 10")
    return float(number) * 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)


def test_zero_has_its_own_error() -> None:
    assert concise(0.0, 5.97e-10) == concise(1e-12, 5.97e-10) == "0(6)e-10"
