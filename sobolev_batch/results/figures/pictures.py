"""Files of figures: their formats, their size, and bytes that depend on the results alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.legends import add_shared_legend
from sobolev_batch.results.figures.style import WIDTH_INCHES, Layout, Size, missing_glyphs_allowed
from sobolev_batch.surfaces.sources.names import quoted

Item = TypeVar("Item")
PictureFormat = Literal["png", "svg", "pdf"]

_NUMBER = r"(\d+\.?\d*|\.\d+)"
_PER_INCH = {"in": 1.0, "cm": 2.54, "mm": 25.4}
_SMALLEST_INCHES, _LARGEST_INCHES = 1.0, 40.0
# Dots per inch: of a PNG for screens, and of one for paper, where a size is asked for, and of images in PDF and SVG.
_SCREEN_DPI, _PAPER_DPI = 150, 300
# Points; figures narrower than a page have the smaller one.
_FONT_SIZE, _SMALL_FONT_SIZE, _NARROW_INCHES = 10.0, 8.0, 5.0
# Journals ask for fonts embedded as TrueType. Without a salt, the ids in an SVG are random.
_SAVING: dict[Any, Any] = {"pdf.fonttype": 42, "svg.hashsalt": "sobolev-batch"}
_METADATA: Mapping[str, dict[str, Any]] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class Output:
    """Formats and size of pictures.

    Attributes:
        formats: Formats of each picture.
        size: Width and height of each panel in inches; default those of the plots.
    """

    formats: tuple[PictureFormat, ...] = ("png",)
    size: Size | None = None

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Draw and save with text that can be read at this size, and edited in an SVG; nothing stays set afterwards."""
        is_narrow = self.size is not None and self.size[0] < _NARROW_INCHES
        settings: dict[Any, Any] = {"font.size": _SMALL_FONT_SIZE if is_narrow else _FONT_SIZE, "svg.fonttype": "none"}
        with mpl.rc_context(settings):
            yield


def parse_size(text: str) -> Size:
    """Return a size in inches from a text such as "8.4x6cm", "84x60mm" or "3.3x2.4in".

    Raises:
        InputError: It is no size, or below 1 or above 40 inches.

    >>> parse_size("3.3x2.4in"), parse_size("25.4x50.8mm")
    ((3.3, 2.4), (1.0, 2.0))
    """
    found = re.fullmatch(rf"\s*{_NUMBER}\s*[x×]\s*{_NUMBER}\s*(in|cm|mm)?\s*", text)
    if found is None:
        raise InputError(f"a size is WIDTHxHEIGHT in in, cm or mm, such as 8.4x6cm; found {quoted(text)}")
    width, height = (float(number) / _PER_INCH[found[3] or "in"] for number in found.groups()[:2])
    if not all(_SMALLEST_INCHES <= side <= _LARGEST_INCHES for side in (width, height)):
        raise InputError(f"a picture is 1 to 40 inches wide and high, found {width:.3g} x {height:.3g} inches")
    return width, height


def panels(
    items: Sequence[Item],
    height_inches: float,
    draw: Callable[[Item, Axes], object],
    size: Size | None = None,
    *,
    shares_legend: bool = False,
    layout: Layout = "constrained",
) -> Figure:
    """Return a figure with a panel for each item, below each other.

    Args:
        items: Items to draw.
        height_inches: Height of a panel of full width.
        draw: Function that draws an item on axes.
        size: Width and height of each panel in inches instead. Without it, a legend below makes the figure higher.
        shares_legend: Add one legend for all panels.
        layout: Layout of the figure.
    """
    width, height = size or (WIDTH_INCHES, height_inches)
    figure = Figure(figsize=(width, height * len(items)), layout=layout)
    axes = figure.subplots(len(items), 1, squeeze=False)[:, 0]
    for item, panel in zip(items, axes, strict=True):
        draw(item, panel)
    if shares_legend:
        add_shared_legend(figure, axes.tolist(), may_grow=size is None)
    return figure


def save(figure: Figure, target: object, style: PictureFormat, dpi: int = _SCREEN_DPI) -> None:
    """Write a figure without a date; characters that its font lacks become boxes."""
    with missing_glyphs_allowed(), mpl.rc_context(_SAVING):
        figure.savefig(target, format=style, dpi=dpi, metadata=_METADATA[style])  # type: ignore[arg-type]


def write_figures(figures: Mapping[str, Figure], folder: Path, output: Output | None = None) -> tuple[Path, ...]:
    """Write figures into a folder by their file names without suffix, and return the paths.

    Raises:
        StoreError: The folder cannot be written.
    """
    output = output or Output()
    paths = {
        folder / f"{stem}.{style}": (figure, style) for stem, figure in figures.items() for style in output.formats
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, (figure, style) in paths.items():
            with output.drawing():
                save(figure, path, style, _SCREEN_DPI if style == "png" and output.size is None else _PAPER_DPI)
    except OSError as error:
        raise StoreError(f"{folder}: pictures cannot be written there: {error.strerror or error}") from error
    return tuple(paths)
