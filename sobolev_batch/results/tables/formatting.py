"""Numbers and durations as people read them; a number has the digits that its error leaves it."""

from __future__ import annotations

import math
from dataclasses import dataclass

# More digits are hard to read, whatever the error.
_MOST_DIGITS = 7
_DIGITS_WITHOUT_ERROR = 4
# Beyond these, powers of ten are easier to read.
_SMALLEST_PLAIN, _LARGEST_PLAIN, _LAST_PLAIN = 1e-3, 1e5, -6
_POWER = " × 10"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Digits:
    """A number and its error as text, which is empty for NaN.

    Attributes:
        value: Number with as many digits as the error leaves it.
        error: Error with two digits, rounded up, so that the true value still lies within it.
        together: Both, in units of the same power of ten.
    """

    value: str
    error: str = ""
    together: str = ""

    @classmethod
    def of(cls, value: float, error: float = math.nan) -> Digits:
        """Return the digits of a value whose error may be unknown (NaN)."""
        if not math.isfinite(value):
            return cls("")
        if not math.isfinite(error) or error == 0:
            digits, shown_error = (_MOST_DIGITS, "0") if error == 0 else (_DIGITS_WITHOUT_ERROR, "")
            shown = _shown(value, _magnitude(value) - digits + 1)
            return cls(shown, shown_error, f"{shown} ± {shown_error or '?'}")
        rounded = _rounded_up(error, 2)
        # A value below its error keeps a digit, to be told from zero.
        top = _magnitude(value or rounded)
        last = min(top, max(_magnitude(rounded) - 1, top - _MOST_DIGITS + 1))
        shown, shown_error = _shown(value, last), _shown(rounded, _magnitude(rounded) - 1)
        together = f"{shown} ± {shown_error}"
        if _POWER in shown and rounded < value * 1e3 and _magnitude(rounded) - 1 >= last:
            power = _magnitude(round(value, -last))
            unit, decimals = 10.0**power, max(0, power - last)
            together = f"({value / unit:.{decimals}f} ± {rounded / unit:.{decimals}f}){_power(power)}"
        return cls(shown, shown_error, together)


def concise(value: float, error: float) -> str:
    """Return a number with its error in brackets, in units of the last digit.

    The error is rounded up. NaN gives an empty text; "?" stands for an unknown error.

    >>> concise(0.012341, 0.00005)
    '1.234(5)e-02'
    """
    if not math.isfinite(value):
        return ""
    power = _magnitude(value)
    if not math.isfinite(error):
        return f"{value:.{_DIGITS_WITHOUT_ERROR - 1}e}"[:-4] + f"(?)e{power:+03d}"
    if error == 0:
        return f"{value:.4g}"
    rounded = _rounded_up(error, 1)
    power = _magnitude(value or rounded)
    last = max(_magnitude(rounded), power - _MOST_DIGITS + 1)
    # Rounding may carry into the next power, or leave nothing of a value below its error.
    power = max(_magnitude(round(value, -last)) if round(value, -last) else last, last)
    # Where digits were left out, the error is that of the last one shown.
    shown = max(1, math.ceil(rounded / 10.0**last * (1 - 1e-9)))
    return f"{value / 10.0**power:.{power - last}f}({shown})e{power:+03d}"


def duration(seconds: float) -> str:
    """Return a duration in the largest unit of which it has two or more.

    >>> duration(42), duration(5400), duration(1e6)
    ('42 s', '90 min', '11.6 days')
    """
    for unit, size in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{max(seconds, 0):.3g} s"


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
