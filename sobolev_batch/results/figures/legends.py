"""Legends beside or below the data, with every family in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from sobolev_batch.results.figures.style import Size, figure_of, inches

# Sizes of text, as multiples of the size of the font; a handle stands before each label.
_CHARACTER_WIDTH, _LINE_HEIGHT, _HANDLE_WIDTH, _COLUMN_GAP = 0.58, 1.4, 3.2, 2.0
# Fractions of the size of axes that a legend may take.
_WIDEST_BESIDE, _HIGHEST_BESIDE, _HIGHEST_BELOW = 0.4, 0.8, 0.4
_NARROWEST_AXES_INCHES, _MARGIN_INCHES = 2.3, 0.15
_FONT_SIZES = ("small", "x-small", "xx-small")
# Room for tick labels and the label of the axis between axes and a legend below them, in sizes of the font.
_BELOW_AXES = 3.6


def add_legend(axes: Axes, *, may_grow: bool = False) -> None:
    """Add a legend to axes, beside them if that leaves them room enough, else below.

    Args:
        axes: Axes whose labels are shown.
        may_grow: Make their figure higher by a legend below.
    """
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return
    figure = figure_of(axes)
    layout = _Layout.of(labels, inches(axes), may_grow=may_grow)
    handles, labels = layout.cut(handles, labels)
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.02, 1.0)}
    if not layout.is_beside:
        down = _BELOW_AXES * FontProperties(size="medium").get_size_in_points() / 72
        below = axes.transAxes + ScaledTranslation(0, -down, figure.dpi_scale_trans)
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": below}
        if may_grow:
            figure.set_size_inches(figure.get_figwidth(), figure.get_figheight() + layout.height)
    axes.legend(handles, labels, frameon=False, ncols=layout.columns, fontsize=layout.font, borderaxespad=0.0, **place)


def add_shared_legend(figure: Figure, panels: Sequence[Axes], *, may_grow: bool) -> None:
    """Add one legend for all panels of a figure, beside or below them.

    Args:
        figure: Figure of the panels, with constrained layout.
        panels: Axes whose labels are shown, each once.
        may_grow: Make the figure higher by a legend below.
    """
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if not entries:
        return
    width, height = figure.get_size_inches()
    layout = _Layout.of(list(entries), (width, height), may_grow=may_grow)
    handles, labels = layout.cut(list(entries.values()), list(entries))
    if may_grow and not layout.is_beside:
        figure.set_size_inches(width, height + layout.height)
    loc: Literal["outside right upper", "outside lower center"] = (
        "outside right upper" if layout.is_beside else "outside lower center"
    )
    figure.legend(handles, labels, frameon=False, loc=loc, ncols=layout.columns, fontsize=layout.font)


@dataclass(frozen=True)
class _Layout:
    """Place of a legend.

    Attributes:
        is_beside: Beside the axes, not below.
        columns: Number of columns.
        font: Size of the font.
        height: Height in inches.
        shown: Number of entries that have room.
        has_room: All have.
    """

    is_beside: bool
    columns: int
    font: str
    height: float
    shown: int
    has_room: bool

    @classmethod
    def of(cls, labels: Sequence[str], size: Size, *, may_grow: bool) -> _Layout:
        """Return the layout with the largest font in which everything has room, or else the smallest."""
        layouts = [cls._with_font(font, labels, size, may_grow) for font in _FONT_SIZES]
        return next((layout for layout in layouts if layout.has_room), layouts[-1])

    @classmethod
    def _with_font(cls, font: str, labels: Sequence[str], size: Size, may_grow: bool) -> _Layout:
        width, height = size
        points = FontProperties(size=font).get_size_in_points() / 72
        line, entry = points * _LINE_HEIGHT, points * (_CHARACTER_WIDTH * max(map(len, labels)) + _HANDLE_WIDTH)
        widest = min(_WIDEST_BESIDE * width, width - _NARROWEST_AXES_INCHES)
        is_beside = len(labels) * line <= _HIGHEST_BESIDE * height and entry <= widest
        columns = 1 if is_beside else max(1, min(len(labels), int(width / (entry + points * _COLUMN_GAP))))
        rows = -(-len(labels) // columns)
        most_rows = rows if may_grow or is_beside else max(1, int(_HIGHEST_BELOW * height / line))
        has_room = rows <= most_rows
        shown = len(labels) if has_room else most_rows * columns - 1
        return cls(is_beside, columns, font, rows * line + _MARGIN_INCHES, shown, has_room)

    def cut(self, handles: Sequence[Artist], labels: Sequence[str]) -> tuple[list[Artist], list[str]]:
        """Return the entries that have room, and one that counts the others."""
        if self.has_room:
            return list(handles), list(labels)
        rest = f"and {len(labels) - self.shown} more"
        return [*handles[: self.shown], Line2D([], [], linestyle="none")], [*labels[: self.shown], rest]
