"""Labels of logarithmic axes, as they are drawn."""

from __future__ import annotations

from itertools import pairwise

import pytest
from matplotlib.figure import Figure

from sobolev_batch.results.figures.ticks import set_log_ticks, tick_labels


@pytest.mark.slow
@pytest.mark.parametrize("inches", [(6.4, 3.6), (3.3, 2.4)])
@pytest.mark.parametrize(
    ("low", "high"),
    [
        (1e-20, 1e5),
        (1e-10, 1),
        (2e-5, 3e-3),
        (0.07, 0.6),
        (0.299, 0.313),
        (0.15076, 0.15079),
        (3e-7, 4e-7),
        (20, 327680),
    ],
)
def test_every_range_has_labels_that_do_not_overlap(low: float, high: float, inches: tuple[float, float]) -> None:
    figure = Figure(figsize=inches, layout="constrained")
    axes = figure.subplots()
    axes.loglog([low, high], [low, high])
    for axis in (axes.xaxis, axes.yaxis):
        set_log_ticks(axis)
    figure.draw_without_rendering()
    for axis in (axes.xaxis, axes.yaxis):
        boxes = [label.get_window_extent() for label in axis.get_ticklabels() if label.get_text()]
        assert len(boxes) >= 2
        assert not any(one.overlaps(other) for one, other in pairwise(boxes))


def test_an_inverted_axis_has_the_same_ticks() -> None:
    axes = Figure(layout="constrained").subplots()
    axes.loglog([0.1, 4], [1, 10])
    set_log_ticks(axes.xaxis)
    ticks = list(axes.get_xticks())
    axes.invert_xaxis()
    assert list(axes.get_xticks()) == ticks


def test_labels_tell_ticks_apart() -> None:
    assert tick_labels([0.1, 0.15, 0.2]) == ["0.10", "0.15", "0.20"]
    assert tick_labels([0.001, 1, 1000]) == ["0.001", "1", "1,000"]
    assert tick_labels([2e-7, 2.5e-7]) == [r"$2\times10^{-7}$", r"$2.5\times10^{-7}$"]
    assert tick_labels([]) == []
