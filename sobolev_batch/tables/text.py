"""Numbers and durations as text, as exact as their errors allow, on lines that fit the terminal."""

import math
import shutil
import textwrap
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from sobolev_batch.visible import visible

Item = TypeVar("Item")

# More digits are hard to read, whatever the error.
_MOST_DIGITS = 7
_DIGITS_WITHOUT_ERROR = 4
# An error that grows by more than this factor where it holds the rounding of its number has a digit more.
_ROUNDED = 1.5
# Beyond these, powers of ten are easier to read.
_SMALLEST_PLAIN, _LARGEST_PLAIN, _LAST_PLAIN = 1e-3, 1e5, -6
# Numbers from it on are shown as whole ones.
_LARGE = 100.0
POWER = " × 10"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

# Length of lines without a terminal, longest line of prose, and the least that remains of a label or a text.
_LINE_LENGTH, _LONGEST_PROSE, SHORTEST_TEXT = 100, 100, 20


def with_error(value: float, error: float = math.nan, unit: str = "") -> str:
    """Return a number with the digits that its error leaves it, and its error; both have one power of ten.

    The error, unknown for NaN, has one digit. It is rounded up and holds the rounding of the number, so that it stays a
    bound; where that would double it, both have a digit more. NaN gives an empty text.

    >>> with_error(2.3149, 0.0033), with_error(2.3145, 0.0038), with_error(6.4, 0.95)
    ('2.315 ± 0.004', '2.314 ± 0.005', '6.4 ± 1.0')
    """
    if not math.isfinite(value):
        return ""
    if not math.isfinite(error) or error == 0:
        return f"{rounded(value, error, unit)} ± {'0' if error == 0 else '?'}"
    last, above = _last_digit(value, error), _rounded_up(error, 1)
    last_of_error = _magnitude(above)
    # Of numbers that are known to more digits than anybody reads, errors are as they are.
    if last_of_error >= last and (held := error + abs(value - round(value, -last))) > above:
        if _rounded_up(held, 1) > _ROUNDED * above:
            last -= 1
            held = error + abs(value - round(value, -last))
        above = _rounded_up(held, max(1, _magnitude(held) - last + 1))
        last_of_error = min(last, _magnitude(above))
    shown = f"{_shown(value, last)}{unit}"
    if POWER in shown and above < abs(value) * 1e3 and last_of_error >= last:
        power = _magnitude(round(value, -last))
        size, decimals = 10.0**power, max(0, power - last)
        return f"({value / size:.{decimals}f} ± {above / size:.{decimals}f}){_power(power)}{unit}"
    return f"{shown} ± {_shown(above, last_of_error)}{unit}"


def rounded(value: float, error: float = math.nan, unit: str = "") -> str:
    """Return a number with the digits that its error leaves it; see `with_error`."""
    return f"{_shown(value, _last_digit(value, error))}{unit}" if math.isfinite(value) else ""


def percent(fraction: float, error: float = math.nan) -> str:
    """Return a fraction in per cent with its error."""
    return with_error(100 * fraction, 100 * error, " %")


def count(number: int) -> str:
    """Return a number of things; nothing for none."""
    return f"{number:,}" if number else ""


def number_text(value: float, unit: str = "") -> str:
    """Return a number with three digits, or a large one as a whole, with ? for one that nothing bounds.

    >>> number_text(2.5041), number_text(2851.3), number_text(math.inf)
    ('2.5', '2,851', '?')
    """
    if not math.isfinite(value):
        return "" if math.isnan(value) else "?"
    return f"{value:,.0f}{unit}" if abs(value) >= _LARGE else f"{value:.3g}{unit}"


def times(factor: float, digits: int = 3) -> str:
    """Return a factor with some digits, or with as many as tell it from 1.

    >>> times(2.5041), times(1.00042), times(1234.5), times(math.inf)
    ('2.5', '1.0004', '1,234', '?')
    """
    if not factor < _LARGE:
        return number_text(factor)
    needed = 1 - math.floor(math.log10(abs(factor - 1))) if factor != 1 else digits
    return f"{factor:.{max(digits, needed)}g}"


def bound(fraction: float) -> str:
    """Return an upper bound in per cent, with two digits, rounded up."""
    rounded = _rounded_up(100 * fraction, 2)
    return f"{_shown(rounded, _magnitude(rounded) - 1)} %"


def between(lower: float, upper: float, unit: str = "", digits: int = 4) -> str:
    """Return two bounds with some digits, as one number where rounding parts them; the upper one may be unknown.

    >>> between(0.33312, 0.33519, " mm"), between(0.25, 0.25), between(0.25, math.nan)
    ('0.3331 to 0.3352 mm', '0.25', '≥ 0.2500')
    """
    if math.isnan(upper):
        return f"≥ {rounded_outwards(lower, lower, digits)[0]}{unit}"
    if math.isclose(lower, upper):
        return f"{lower:.{digits}g}{unit}"
    low, high = rounded_outwards(lower, upper, digits)
    return f"{low} to {high}{unit}"


def rounded_outwards(lower: float, upper: float, digits: int = 2) -> tuple[str, str]:
    """Return two bounds with some digits, the lower one rounded down and the upper one up.

    >>> rounded_outwards(0.01239, 0.1231), rounded_outwards(0.012, 0.13)
    (('0.012', '0.13'), ('0.012', '0.13'))
    """
    low, high = -_rounded_up(-lower, digits), _rounded_up(upper, digits)
    return _shown(low, _magnitude(low) - digits + 1), _shown(high, _magnitude(high) - digits + 1)


def second_digit(value: float) -> float:
    """Return the unit of the second digit of a number.

    >>> second_digit(2312.4)
    100.0
    """
    return 10.0 ** (_magnitude(value) - 1) if math.isfinite(value) else math.nan


def duration(seconds: float, digits: int = 3) -> str:
    """Return a duration in the largest unit that it holds twice or more.

    >>> duration(42), duration(5400), duration(1e6), duration(1e6, digits=2)
    ('42 s', '90 min', '11.6 days', '12 days')
    """
    units = (("days", 86400), ("h", 3600), ("min", 60))
    unit, size = next(((unit, size) for unit, size in units if seconds >= 2 * size), ("s", 1))
    # Rounded first, since the format turns 120 into 1.2e+02.
    rounded = float(f"{max(seconds, 0) / size:.{digits}g}")
    return f"{rounded:g} {unit}"


def place_text(place: Sequence[float], length: float) -> str:
    """Return a point with six digits of its largest coordinate, or up to twelve that show a tenth of a length.

    >>> place_text((60.0, -1e-17, 10.25), 0.3), place_text((512345.678, 4651310.123, 0.0), 0.97)
    ('(60, 0, 10.25)', '(512345.68, 4651310.12, 0)')
    """
    largest = _magnitude(max(*map(abs, place), length))
    decimals = max(5 - largest, min(1 - _magnitude(length), 11 - largest))
    # The sum turns a negative zero into zero.
    return f"({', '.join(f'{round(x, decimals) + 0.0:.15g}' for x in place)})"


def minus(text: str) -> str:
    """Return numbers with minus signs as wide as a digit."""
    return text.replace("-", "−")


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """Return a limited number of items: the first, the last, and others evenly between."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int))]


def middle_cut(label: str, longest: int) -> str:
    """Return a label that is cut in its middle: labels of one family differ at their ends."""
    return label if len(label) <= longest else f"{label[: longest // 2]}…{label[1 - longest // 2 :]}"


def _last_digit(value: float, error: float) -> int:
    """Return the power of ten of the last digit that an error leaves a number."""
    if not math.isfinite(error) or error == 0:
        return _magnitude(value) - (_MOST_DIGITS if error == 0 else _DIGITS_WITHOUT_ERROR) + 1
    above = _rounded_up(error, 1)
    # A value below its error keeps a digit, to be told from zero.
    top = _magnitude(value or above)
    return min(top, max(_magnitude(above), top - _MOST_DIGITS + 1))


def _magnitude(value: float) -> int:
    """Return the power of ten of the first digit."""
    return 0 if value == 0 else int(f"{abs(value):e}".partition("e")[2])


def _rounded_up(value: float, digits: int) -> float:
    unit = 10.0 ** (_magnitude(value) - digits + 1)
    # A little is taken off, so that no rounding error of the division counts.
    return float(f"{math.ceil(value / unit - 1e-9 * abs(value / unit)) * unit:.{digits}g}")


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
    return POWER + str(power).translate(_SUPERSCRIPTS)


def line_length() -> int:
    """Return the length of a line: that of the terminal where there is one."""
    return shutil.get_terminal_size((_LINE_LENGTH, 0)).columns


def wrapped(text: str) -> list[str]:
    """Return the lines of a paragraph that fits the terminal; no-break spaces become spaces within lines."""
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in textwrap.wrap(text, min(line_length(), _LONGEST_PROSE))]


def beside(name: str, text: str) -> str:
    """Return a text beside its name, on lines that fit the terminal; paths and words stay whole."""
    indent = " " * min(len(name), SHORTEST_TEXT)
    wrapper = textwrap.TextWrapper(line_length(), name, indent, break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(visible(text))
