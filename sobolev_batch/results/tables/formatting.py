"""Numbers and durations as people read them; a number has the digits that its error leaves it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

# More digits are hard to read, whatever the error.
_MOST_DIGITS = 7
_DIGITS_WITHOUT_ERROR = 4
# Beyond these, powers of ten are easier to read.
_SMALLEST_PLAIN, _LARGEST_PLAIN, _LAST_PLAIN = 1e-3, 1e5, -6
_LARGEST_BRACKETED = 3
_POWER = " × 10"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN = {ord(raised): plain for plain, raised in zip("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹", strict=True)}


@dataclass(frozen=True)
class Digits:
    """A number and its error as text, which is empty for NaN.

    Attributes:
        value: Number with as many digits as the error leaves it.
        error: Error with one digit, rounded up, so that it stays a bound.
        together: Both, in units of the same power of ten.
    """

    value: str
    error: str = ""
    together: str = ""

    @classmethod
    def of(cls, value: float, error: float = math.nan, unit: str = "") -> Digits:
        """Return the digits of a value whose error may be unknown (NaN), followed by a unit."""
        if not math.isfinite(value):
            return cls("")
        if not math.isfinite(error) or error == 0:
            digits, shown_error = (_MOST_DIGITS, "0") if error == 0 else (_DIGITS_WITHOUT_ERROR, "")
            shown = f"{_shown(value, _magnitude(value) - digits + 1)}{unit}"
            return cls(shown, shown_error, f"{shown} ± {shown_error or '?'}")
        rounded = _rounded_up(error, 1)
        # A value below its error keeps a digit, to be told from zero.
        top = _magnitude(value or rounded)
        last = min(top, max(_magnitude(rounded), top - _MOST_DIGITS + 1))
        shown, shown_error = f"{_shown(value, last)}{unit}", f"{_shown(rounded, _magnitude(rounded))}{unit}"
        together = f"{shown} ± {shown_error}"
        if _POWER in shown and rounded < value * 1e3 and _magnitude(rounded) >= last:
            power = _magnitude(round(value, -last))
            size, decimals = 10.0**power, max(0, power - last)
            together = f"({value / size:.{decimals}f} ± {rounded / size:.{decimals}f}){_power(power)}{unit}"
        return cls(shown, shown_error, together)

    @classmethod
    def percent(cls, fraction: float, error: float = math.nan) -> Digits:
        """Return the digits of a fraction in per cent.

        >>> Digits.percent(0.010203, 0.000094).together
        '1.02 % ± 0.01 %'
        """
        return cls.of(100 * fraction, 100 * error, " %")


def bound(fraction: float) -> str:
    """Return an upper bound in per cent, with two digits, rounded up.

    >>> bound(0.00301)
    '0.31 %'
    """
    rounded = _rounded_up(100 * fraction, 2)
    return f"{_shown(rounded, _magnitude(rounded) - 1)} %"


def rounded_outwards(lower: float, upper: float) -> tuple[str, str]:
    """Return two bounds with two digits, the lower one rounded down and the upper one up.

    >>> rounded_outwards(0.01239, 0.1231)
    ('0.012', '0.13')
    """
    low, high = _rounded_down(lower, 2), _rounded_up(upper, 2)
    return _shown(low, _magnitude(low) - 1), _shown(high, _magnitude(high) - 1)


def count_text(count: float, error: float) -> str:
    """Return a large number of things with the digits that its error leaves it.

    >>> count_text(2312.4, 36.0)
    '2,310'
    """
    return "" if math.isnan(count) else f"{round(count, -max(0, _magnitude(_rounded_up(error, 1)))):,.0f}"


def second_digit(value: float) -> float:
    """Return the unit of the second digit of a number.

    >>> second_digit(2312.4)
    100.0
    """
    return 10.0 ** (_magnitude(value) - 1) if math.isfinite(value) else math.nan


def concise(value: float, error: float) -> str:
    """Return a number with its error in brackets, in units of the last digit.

    The error is rounded up. NaN gives an empty text; "?" stands for an unknown error.

    >>> concise(0.012341, 0.00005), concise(1.2341e-7, 5e-10)
    ('0.01234(5)', '1.234(5)e-07')
    """
    if not math.isfinite(value):
        return ""
    power = _magnitude(value)
    if not math.isfinite(error):
        return _bracketed(value, "?", power, power - _DIGITS_WITHOUT_ERROR + 1)
    if error == 0:
        return f"{value:.4g}"
    rounded = _rounded_up(error, 1)
    power = _magnitude(value or rounded)
    last = max(_magnitude(rounded), power - _MOST_DIGITS + 1)
    # Rounding may carry into the next power, or leave nothing of a value below its error.
    power = max(_magnitude(round(value, -last)) if round(value, -last) else last, last)
    # Where digits were left out, the error is that of the last one shown.
    shown = max(1, math.ceil(rounded / 10.0**last * (1 - 1e-9)))
    return _bracketed(value, str(shown), power, last)


def _bracketed(value: float, error: str, power: int, last: int) -> str:
    """Return a value of a power of ten, down to the last one, with the digit of its error."""
    if _magnitude(_SMALLEST_PLAIN) <= power <= _LARGEST_BRACKETED and last <= power:
        return f"{round(value, -last):.{max(0, -last)}f}({error}{'0' * last})"
    return f"{value / 10.0**power:.{power - last}f}({error})e{power:+03d}"


def duration(seconds: float, digits: int = 3) -> str:
    """Return a duration in the largest unit of which it has two or more.

    >>> duration(42), duration(5400), duration(1e6), duration(1e6, digits=2)
    ('42 s', '90 min', '11.6 days', '12 days')
    """
    units = (("days", 86400), ("h", 3600), ("min", 60))
    unit, size = next(((unit, size) for unit, size in units if seconds >= 2 * size), ("s", 1))
    # Rounded first, since the format turns 120 into 1.2e+02.
    rounded = float(f"{max(seconds, 0) / size:.{digits}g}")
    return f"{rounded:g} {unit}"


def latex_powers(text: str) -> str:
    r"""Return a text whose powers of ten are formulas of LaTeX, which has no raised digits.

    >>> latex_powers("1.2 × 10⁻⁵ %")
    '1.2 $\\times 10^{-5}$ %'
    """
    return re.sub(
        rf"{_POWER.strip()}([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", lambda found: rf"$\times 10^{{{found[1].translate(_PLAIN)}}}$", text
    )


def minus(text: str) -> str:
    """Return numbers with minus signs as wide as a digit."""
    return text.replace("-", "−")


def middle_cut(label: str, longest: int) -> str:
    """Return a label that is cut in its middle: labels of one family differ at their ends."""
    return label if len(label) <= longest else f"{label[: longest // 2]}…{label[1 - longest // 2 :]}"


def _magnitude(value: float) -> int:
    """Return the power of ten of the first digit."""
    return 0 if value == 0 else int(f"{abs(value):e}".partition("e")[2])


def _rounded_up(value: float, digits: int) -> float:
    unit = 10.0 ** (_magnitude(value) - digits + 1)
    return float(f"{math.ceil(value / unit * (1 - 1e-9)) * unit:.{digits}g}")


def _rounded_down(value: float, digits: int) -> float:
    unit = 10.0 ** (_magnitude(value) - digits + 1)
    return float(f"{math.floor(value / unit * (1 + 1e-9)) * unit:.{digits}g}")


def _shown(value: float, last: int) -> str:
    """Return a value down to a power of ten."""
    value = round(value, -last)
    if value == 0:
        return "0"
    if abs(value) < _LARGEST_PLAIN and (abs(value) >= _SMALLEST_PLAIN or last >= _LAST_PLAIN):
        return f"{value:.{max(0, -last)}f}"
    power = _magnitude(value)
    return f"{value / 10.0**power:.{max(0, power - last)}f}{_power(power)}"


def _power(power: int) -> str:
    return _POWER + str(power).translate(_SUPERSCRIPTS)
