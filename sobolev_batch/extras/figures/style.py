"""What all plots share: colours, titles, legends, error bars, panels, and files of a format and size."""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterSciNotation

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError, write_file, written
from sobolev_batch.sources.names import quoted
from sobolev_batch.tables.text import middle_cut, number_text
from sobolev_batch.visible import visible

# Width and height in inches.
Size = tuple[float, float]
PictureFormat = Literal["png", "svg", "pdf"]

WIDTH_INCHES = 6.4
# Arrows of a colour bar by whether values lie below it and above it.
EXTENDS = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
# P. Tol, "Colour schemes" (2021), "bright": distinct with every kind of colour vision. The report has them too.
_COLORS = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#777777")
_MARKERS = "osD^vPX"
_DASHES = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (1, 1)))
_LONGEST_LABEL = 24
# Inches: a legend is drawn beside the panels of a figure of this width, else below them; sizes of a line, of a handle
# and of a character; and the fractions of the height that it may take.
LEGEND_BESIDE, _LEGEND_LINE, _LEGEND_HANDLE, _LEGEND_CHARACTER = 5.0, 0.17, 0.5, 0.07
_HIGHEST_BESIDE, _HIGHEST_BELOW = 0.9, 0.4
# An error bar makes the axis no longer than this below its value, as a fraction of it; the rest is cut off.
_SHOWN_OF_BARS = 0.25
# No logarithmic axis of a plot reaches this fraction of a value.
_OUT_OF_SIGHT = 1e-30
_NUMBER = r"(\d+\.?\d*|\.\d+)"
_PER_INCH = {"in": 1.0, "cm": 2.54, "mm": 25.4}
_SMALLEST_INCHES, _LARGEST_INCHES = 1.0, 40.0
# Dots per inch: of a PNG for screens, and of one for paper, where a size is requested, and of images in PDF and SVG.
_SCREEN_DPI, _PAPER_DPI = 150, 300
# Points; figures narrower than a page have the smaller one.
_FONT_SIZE, _SMALL_FONT_SIZE = 10.0, 8.0
# Journals ask for fonts embedded as TrueType. Without a salt, the ids in an SVG are random.
_SAVING: dict[Any, Any] = {"pdf.fonttype": 42, "svg.hashsalt": "sobolev-batch"}
_METADATA: Mapping[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}


# Colour, marker and dashes of a family, by the names that Matplotlib has for them.
Style = Mapping[str, Any]


def style_of(i: int) -> Style:
    """Return the style of the i-th family; only all of its parts together are unique where there are many families."""
    turn = i // len(_COLORS)
    return {
        "color": _COLORS[i % len(_COLORS)],
        "marker": _MARKERS[(i + turn) % len(_MARKERS)],
        "linestyle": _DASHES[turn % len(_DASHES)],
    }


@dataclass(frozen=True)
class Plot:
    """A kind of plot, which has a panel for each item of a subject, such as a `Selection`.

    Attributes:
        draw: Function that draws an item of the subject on axes.
        items: Function that returns the items, such as orders; none where the subject has nothing to draw.
        height: Height of a panel in inches.
    """

    draw: Callable[[Any, Any, Axes], None]
    items: Callable[[Any], Sequence[Any]]
    height: float

    def figure(self, subject: Any, items: Sequence[Any] | None = None, size: Size | None = None) -> Figure:
        """Return a figure with a panel of a size for each item, default all, below each other, and one legend."""
        items = self.items(subject) if items is None else items
        width, height = size or (WIDTH_INCHES, self.height)
        figure = Figure(figsize=(width, height * len(items)), layout="constrained")
        for item, axes in zip(items, figure.subplots(len(items), 1, squeeze=False)[:, 0], strict=True):
            self.draw(subject, item, axes)
        _add_legend(figure)
        return figure

    def on(self, axes: Axes | None, subject: Any, item: Any) -> Axes:
        """Draw one item on axes with a legend within them, or on axes of a new figure, and return the axes."""
        if axes is None:
            return self.figure(subject, [item]).axes[0]
        self.draw(subject, item, axes)
        if axes.get_legend() is None and axes.get_legend_handles_labels()[1]:
            axes.legend(fontsize="small")
        return axes


def _add_legend(figure: Figure) -> None:
    """Add one legend for all panels that have none, with as many entries as there is room for."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        if axes.get_legend() is None:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(label, handle)
    if not entries:
        return
    width, height = figure.get_size_inches()
    lines = int(_HIGHEST_BESIDE * height / _LEGEND_LINE)
    is_beside = width >= LEGEND_BESIDE and len(entries) <= lines
    column = _LEGEND_HANDLE + _LEGEND_CHARACTER * max(map(len, entries))
    columns = 1 if is_beside else max(1, int(width / column))
    most = lines if is_beside else max(2, columns * int(_HIGHEST_BELOW * height / _LEGEND_LINE))
    if len(entries) > most:
        kept = list(entries.items())[: most - 1]
        entries = {**dict(kept), f"and {len(entries) - len(kept)} more": Line2D([], [], linestyle="none")}
    place: Literal["outside right upper", "outside lower center"] = (
        "outside right upper" if is_beside else "outside lower center"
    )
    figure.legend([*entries.values()], [*entries], loc=place, ncols=columns, fontsize="small", frameon=False)


def hide_frame(axes: Axes) -> None:
    """Remove ticks and spines around an image."""
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def inches(axes: Axes) -> Size:
    """Return width and height of axes, before labels and legends take their part."""
    place, figure = axes.get_position(original=True), axes.figure
    return float(place.width * figure.bbox.width / figure.dpi), float(place.height * figure.bbox.height / figure.dpi)


class _PlainNumbers(LogFormatterSciNotation):
    """Labels of a logarithmic axis without powers of ten where they can be read, of fractions in per cent."""

    unit = ""

    def __call__(self, x: float, pos: int | None = None) -> str:
        value = 100 * x if self.unit else x
        text = super().__call__(value, pos)
        return f"{number_text(value) if 1e-4 <= value < 1e6 else text}{self.unit}" if text else ""


def set_log_scale(axes: Axes, names: Literal["x", "y", "xy"], unit: Literal["", " %"] = "") -> None:
    """Make axes logarithmic, with small labels between powers of ten, and a grid; the vertical one may be in %."""
    for name in names:
        axes.set(**{f"{name}scale": "log"})
        for set_formatter in (axis := getattr(axes, f"{name}axis")).set_major_formatter, axis.set_minor_formatter:
            set_formatter(numbers := _PlainNumbers())
            numbers.unit = unit if name == "y" else ""
        axes.tick_params(axis=name, which="both", labelsize="small")  # type: ignore[arg-type]
    # Labels of less than a decade would overlap.
    axes.tick_params(axis="x", which="minor", labelsize="xx-small")
    axes.grid(visible=True, which="major", alpha=0.3)


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


def shortened(label: str) -> str:
    """Return a label for a place with little room."""
    return escaped(middle_cut(visible(label), _LONGEST_LABEL))


def draw_curve(
    axes: Axes, places: Reals, values: Reals, errors: Reals, style: Style, label: str, *, is_joined: bool = True
) -> None:
    """Draw the values of a family with error bars, on a logarithmic axis which the bars do not stretch."""
    dashes = {} if is_joined else {"linestyle": "none"}
    axes.plot(places, values, **{**style, **dashes}, label=label, markersize=4, linewidth=1.2)
    known = np.nan_to_num(errors)
    # A bar that ends near zero is cut off.
    low, high = np.maximum(values - known, _OUT_OF_SIGHT * values), values + known
    bars = np.stack([np.column_stack([places, low]), np.column_stack([places, high])], axis=1)
    axes.add_collection(LineCollection(list(bars), colors=style["color"], linewidths=0.8), autolim=False)
    seen = np.concatenate([np.maximum(low, _SHOWN_OF_BARS * values), high])
    axes.update_datalim(np.column_stack([np.tile(places, 2), seen]))
    axes.autoscale_view()


@contextmanager
def drawing(size: Size | None) -> Iterator[None]:
    """Draw and save with text that can be read at a size of panels, and edited in an SVG; nothing stays set."""
    is_narrow = size is not None and size[0] < LEGEND_BESIDE
    settings: dict[Any, Any] = {"font.size": _SMALL_FONT_SIZE if is_narrow else _FONT_SIZE, "svg.fonttype": "none"}
    with mpl.rc_context(settings):
        yield


def write_figures(
    figures: Mapping[str, Figure], folder: str | Path, formats: Sequence[PictureFormat], size: Size | None
) -> tuple[Path, ...]:
    """Write figures, made while `drawing` with a size of panels, into a folder; StoreError where that fails.

    They have no date. Characters that a font lacks become boxes.
    """
    folder, paths = Path(folder), []
    with written(folder, "pictures"):
        folder.mkdir(parents=True, exist_ok=True)
        for stem, figure in figures.items():
            for style in formats:
                dpi = _SCREEN_DPI if style == "png" and size is None else _PAPER_DPI
                picture = BytesIO()
                with drawing(size), mpl.rc_context(_SAVING), warnings.catch_warnings():
                    warnings.filterwarnings("ignore", message="Glyph .* missing from")
                    figure.savefig(picture, format=style, dpi=dpi, metadata=_METADATA.get(style))
                paths.append(folder / f"{stem}.{style}")
                write_file(paths[-1], picture.getbuffer(), "the picture")
    return tuple(paths)


def parse_size(text: str) -> Size:
    """Return a size in inches from a text; InputError where it is none, or below 1 or above 40 inches.

    >>> parse_size("3.3x2.4in"), parse_size("25.4x50.8mm")
    ((3.3, 2.4), (1.0, 2.0))
    """
    match = re.fullmatch(rf"\s*{_NUMBER}\s*[x×]\s*{_NUMBER}\s*(in|cm|mm)?\s*", text)
    if match is None:
        raise InputError(f"a size is WIDTHxHEIGHT in in, cm or mm, such as 8.4x6cm; found {quoted(text)}")
    width, height = (float(number) / _PER_INCH[match[3] or "in"] for number in match.groups()[:2])
    if not all(_SMALLEST_INCHES <= side <= _LARGEST_INCHES for side in (width, height)):
        raise InputError(f"a picture is 1 to 40 inches wide and high, found {width:.3g} x {height:.3g} inches")
    return width, height
