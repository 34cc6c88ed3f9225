"""Ticks of logarithmic axes: labels at every range, and as many as there is room for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axis import Axis, XAxis
from matplotlib.font_manager import FontProperties
from matplotlib.ticker import Formatter, Locator, LogLocator, MaxNLocator, NullFormatter

# Numbers between these are written without powers of ten.
_SMALLEST_PLAIN, _LARGEST_PLAIN = 1e-3, 1e5
# Ticks within a decade, from many to few.
_WITHIN_DECADES = ((1, 2, 3, 4, 5, 6, 8), (1, 2, 5), (1, 3))
_MOST_LABELS, _ENOUGH_LABELS = 9, 3
# Sizes of characters, as multiples of the size of the font.
_CHARACTER_WIDTH, _LINE_HEIGHT, _GAP = 0.62, 1.5, 0.8


class LogTicks(Locator):
    """Round numbers on a logarithmic axis whose labels do not overlap, for 20 decades and for a part of one.

    Matplotlib's own labels of a part of a decade overlap, or leave the axis with a single one.
    """

    def __call__(self) -> list[float]:
        """Return the ticks of the axis as it is."""
        return self.tick_values(*self.axis.get_view_interval())  # type: ignore[union-attr]

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        """Return the ticks between two positive numbers, in either order."""
        low, high = sorted((vmin, vmax))
        if not 0 < low < high:
            return []
        most: list[float] = []
        for candidate in _candidates(low, high):
            ticks = [float(tick) for tick in candidate if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
            if len(ticks) <= _MOST_LABELS and _fit(self.axis, ticks, low, high):  # type: ignore[arg-type]
                if len(ticks) >= _ENOUGH_LABELS:
                    return ticks
                most = max(most, ticks, key=len)
        return most


class LogLabels(Formatter):
    """Labels of `LogTicks`: all of them plain numbers, or all of them with powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of one tick, as if there were no other."""
        return tick_labels([x])[0]

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of all ticks."""
        return tick_labels(values)


def set_log_ticks(axis: Axis) -> None:
    """Give a logarithmic axis the labels of this module; the ticks between them have none."""
    axis.set_major_locator(LogTicks())
    axis.set_major_formatter(LogLabels())
    axis.set_minor_locator(LogLocator(subs=range(1, 10), numticks=12))
    axis.set_minor_formatter(NullFormatter())


def tick_labels(ticks: Sequence[float]) -> list[str]:
    """Return labels with as many digits as tell the ticks apart.

    >>> tick_labels([0.3, 0.3025]), tick_labels([10, 1000])
    (['0.3000', '0.3025'], ['10', '1,000'])
    >>> tick_labels([1e-6, 1e-4])
    ['$10^{-6}$', '$10^{-4}$']
    """
    values = np.asarray(ticks, dtype=np.float64)
    if not len(values):
        return []
    if values.min() < _SMALLEST_PLAIN or values.max() >= _LARGEST_PLAIN:
        return [_power_of_ten(value) for value in values]
    labels = [f"{value:,.10f}".rstrip("0").rstrip(".") for value in values]
    if values.max() > 10 * values.min():
        return labels
    decimals = max(len(label.partition(".")[2]) for label in labels)
    return [f"{value:,.{decimals}f}" for value in values]


def _power_of_ten(value: float) -> str:
    mantissa, exponent = f"{value:.10e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".")
    power = f"10^{{{int(exponent)}}}"
    return f"${power}$" if mantissa == "1" else rf"${mantissa}\times{power}$"


def _candidates(low: float, high: float) -> Iterator[np.ndarray]:
    """Yield sets of ticks, from the best to the worst."""
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    decades = np.arange(first, last + 1)
    if last - first > 2:
        for stride in (1, 2, 3, 4, 5, 10, 20, 50):
            # Multiples of the stride, so that neighbouring plots have the same ticks.
            yield 10.0 ** decades[decades % stride == 0]
    for factors in _WITHIN_DECADES:
        yield np.sort(np.outer(10.0**decades, factors).ravel())
    for count in range(7, 0, -1):
        yield np.asarray(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))


def _fit(axis: Axis, ticks: Sequence[float], low: float, high: float) -> bool:
    """Return True if the labels of the ticks stand beside each other without overlapping."""
    if len(ticks) < 2:
        return True
    is_horizontal = isinstance(axis, XAxis)
    box, figure = axis.axes.bbox, axis.get_figure()
    pixels = (box.width if is_horizontal else box.height) * np.log(np.divide(ticks, low)) / np.log(high / low)
    points = FontProperties(size=axis.get_major_ticks(1)[0].label1.get_fontsize()).get_size_in_points()
    font = points * figure.dpi / 72  # type: ignore[union-attr]
    if is_horizontal:
        widths = np.array([len(re.sub(r"\\times|[${}^]", "", label)) for label in tick_labels(ticks)])
        needed = font * (_CHARACTER_WIDTH * (widths[1:] + widths[:-1]) / 2 + _GAP)
    else:
        needed = font * _LINE_HEIGHT
    return bool((np.diff(pixels) >= needed).all())
