"""Axes, colours, labels and error bars that all plots share."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from sobolev_batch.results.tables.formatting import middle_cut
from sobolev_batch.results.tables.groups import families_of
from sobolev_batch.visible import visible

Reals = NDArray[np.float64]
# Width and height in inches.
Size = tuple[float, float]
# Layouts that leave room for labels and legends; the latter is for axes of a fixed aspect, such as images.
Layout = Literal["constrained", "compressed"]

WIDTH_INCHES = 6.4
# Arrows of a colour bar by whether values lie below it and above it.
EXTENDS = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
# P. Tol, "Colour schemes" (2021), "bright": distinct with every kind of colour vision. The report has them too.
_COLORS = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#777777")
_MARKERS = "osD^vPX"
_DASHES = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (1, 1)))
_LONGEST_LABEL = 24
_LOW_INCHES = 2.2
# An error bar makes the axis no longer than this below its value, as a fraction of it; the rest is cut off.
_SHOWN_OF_BARS = 0.25
# No logarithmic axis of a plot reaches this fraction of a value.
_OUT_OF_SIGHT = 1e-30


@dataclass(frozen=True)
class Style:
    """Colour, marker and dashes of a family; only all of them together are unique where there are many."""

    color: str
    marker: str
    dashes: str | tuple[int, tuple[float, ...]]


def new_axes(height_inches: float, layout: Layout = "constrained") -> Axes:
    """Return axes in a figure of their own, which pyplot does not know."""
    return Figure(figsize=(WIDTH_INCHES, height_inches), layout=layout).subplots()


def hide_frame(axes: Axes) -> None:
    """Remove ticks and spines around an image."""
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def figure_of(axes: Axes) -> Figure:
    """Return the figure of axes, which may lie in a part of it."""
    figure = axes.figure
    return figure.figure if isinstance(figure, SubFigure) else figure


def inches(axes: Axes) -> Size:
    """Return width and height of axes, before labels and legends take their part."""
    place, box, dpi = axes.get_position(original=True), axes.figure.bbox, figure_of(axes).dpi
    return float(place.width * box.width / dpi), float(place.height * box.height / dpi)


def vertical_label(axes: Axes, label: str) -> str:
    """Return a label of the vertical axis, on two lines where the axes are too low for one."""
    if inches(axes)[1] >= _LOW_INCHES:
        return label
    spaces = [i for i, character in enumerate(label) if character == " "]
    middle = min(spaces, key=lambda i: abs(i - len(label) / 2))
    return f"{label[:middle]}\n{label[middle + 1 :]}"


@contextmanager
def missing_glyphs_allowed() -> Iterator[None]:
    """Draw characters that the font lacks as boxes, without a warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def set_title(axes: Axes, title: str, *notes: str) -> None:
    """Set a title and below it, a line each, what a reader must know of the plot; empty notes are left out."""
    axes.set_title("\n".join(filter(None, (title, *notes))), fontsize="medium")


def notes_of(figure: Figure) -> list[str]:
    """Return the notes below the titles of a figure, each once."""
    lines = (line for axes in figure.axes for line in axes.get_title().splitlines()[1:])
    return list(dict.fromkeys(line.replace(r"\$", "$") for line in lines))


def escaped(text: str) -> str:
    """Return a name as Matplotlib shows it unchanged: dollars would begin a formula, a leading underscore hides it."""
    return re.sub(r"^_", "\u2009_", visible(text).replace("$", r"\$"))


def shortened(label: str, longest: int = _LONGEST_LABEL) -> str:
    """Return a label for a place with little room."""
    return escaped(middle_cut(visible(label), longest))


def family_styles(tree: xr.DataTree) -> Mapping[str, Style]:
    """Return the style of each family of the study, whichever of them are drawn."""
    return {family: style_of(i) for i, family in enumerate(dict.fromkeys(families_of(tree).values()))}


def style_of(i: int) -> Style:
    """Return the style of the i-th family."""
    turn = i // len(_COLORS)
    return Style(_COLORS[i % len(_COLORS)], _MARKERS[(i + turn) % len(_MARKERS)], _DASHES[turn % len(_DASHES)])


def draw_error_bars(axes: Axes, places: Reals, values: Reals, errors: Reals, color: str) -> None:
    """Draw error bars on a logarithmic axis, which they do not stretch: one that ends near zero is cut off."""
    known = np.nan_to_num(errors)
    low, high = np.maximum(values - known, _OUT_OF_SIGHT * values), values + known
    bars = np.stack([np.column_stack([places, low]), np.column_stack([places, high])], axis=1)
    axes.add_collection(LineCollection(list(bars), colors=color, linewidths=0.8), autolim=False)
    seen = np.concatenate([np.maximum(low, _SHOWN_OF_BARS * values), high])
    axes.update_datalim(np.column_stack([np.tile(places, 2), seen]))
    axes.autoscale_view()
