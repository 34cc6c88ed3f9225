"""Numbers as people read them: with the digits that their errors leave them."""

from __future__ import annotations

import math
from dataclasses import dataclass

# More are of no use to anybody who reads, whatever the error.
_MOST_DIGITS = 7
_DIGITS_WITHOUT_ERROR = 4
# Beyond these, powers of ten are easier to read.
_SMALLEST_PLAIN, _LARGEST_PLAIN, _LAST_PLAIN = 1e-3, 1e5, -6
_POWER = " × 10"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Digits:
    """A number and its error in words, empty where there is none.

    Attributes:
        value: with as many digits as the error leaves it.
        error: with two digits, rounded up: the true value still lies within it.
        together: both, in units of the same power of ten.
    """

    value: str
    error: str = ""
    together: str = ""

    @classmethod
    def of(cls, value: float, error: float = math.nan) -> Digits:
        """The digits of a value whose error may be unknown (NaN)."""
        if not math.isfinite(value):
            return cls("")
        if not math.isfinite(error) or error == 0:
            digits, word = (_MOST_DIGITS, "0") if error == 0 else (_DIGITS_WITHOUT_ERROR, "")
            shown = _shown(value, _magnitude(value) - digits + 1)
            return cls(shown, word, f"{shown} ± {word or '?'}")
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
    """A number with its error in brackets, in units of the last digit: 1.234(5)e-02 is 0.01234 ± 0.00005.

    The error is rounded up. Empty where there is no number; "?" stands for an unknown error.
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


def _magnitude(value: float) -> int:
    """The power of ten of the first digit."""
    return 0 if value == 0 else int(f"{abs(value):e}".partition("e")[2])


def _rounded_up(value: float, digits: int) -> float:
    unit = 10.0 ** (_magnitude(value) - digits + 1)
    return float(f"{math.ceil(value / unit * (1 - 1e-9)) * unit:.{digits}g}")


def _shown(value: float, last: int) -> str:
    """A value down to a power of ten."""
    value = round(value, -last)
    if value == 0:
        return "0"
    if abs(value) < _LARGEST_PLAIN and (abs(value) >= _SMALLEST_PLAIN or last >= _LAST_PLAIN):
        return f"{value:.{max(0, -last)}f}"
    power = _magnitude(value)
    return f"{value / 10.0**power:.{max(0, power - last)}f}{_power(power)}"


def _power(power: int) -> str:
    return _POWER + str(power).translate(_SUPERSCRIPTS)
