"""Legends with many entries, as they are drawn."""

from __future__ import annotations

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from sobolev_batch.results.figures.legends import add_legend, add_shared_legend
from sobolev_batch.results.figures.style import style_of


def lines(axes: Axes, count: int) -> None:
    for i in range(count):
        axes.plot([0, 1], [i, i + 1], label=f"family number {i}")


def texts(legend: Legend | None) -> list[str]:
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 8, 30])
@pytest.mark.parametrize("width", [3.3, 6.4])
def test_every_family_is_named_and_no_data_are_hidden(count: int, width: float) -> None:
    figure = Figure(figsize=(width, 2.6), layout="constrained")
    axes = figure.subplots()
    lines(axes, count)
    add_legend(axes, may_grow=True)
    figure.draw_without_rendering()
    legend = axes.get_legend()
    assert texts(legend) == [f"family number {i}" for i in range(count)]
    assert legend is not None
    box = legend.get_window_extent()
    assert not box.overlaps(axes.bbox)
    assert not any(box.overlaps(label.get_window_extent()) for label in axes.get_xticklabels())
    assert figure.bbox.containsx(box.x0)
    assert figure.bbox.containsx(box.x1)
    assert figure.bbox.containsy(box.y0)


def test_panels_share_a_legend() -> None:
    figure = Figure(figsize=(6.4, 5), layout="constrained")
    panels = figure.subplots(2)
    for axes in panels:
        lines(axes, 3)
    panels[1].plot([0, 1], label="another")
    add_shared_legend(figure, panels, may_grow=False)
    (legend,) = figure.legends
    assert texts(legend) == ["family number 0", "family number 1", "family number 2", "another"]
    figure.draw_without_rendering()
    assert not any(legend.get_window_extent().overlaps(axes.bbox) for axes in panels)


def test_a_legend_without_room_counts_the_rest() -> None:
    figure = Figure(figsize=(3.3, 2.4), layout="constrained")
    axes = figure.subplots()
    lines(axes, 200)
    add_shared_legend(figure, [axes], may_grow=False)
    names = texts(figure.legends[0])
    assert names[-1] == f"and {200 - len(names) + 1} more"
    assert figure.get_figheight() == 2.4


def test_forty_families_have_styles_of_their_own() -> None:
    assert len({style_of(i) for i in range(49)}) == 49
