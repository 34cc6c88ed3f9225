"""Axes, colours, labels and legends that all plots share."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sobolev_batch.errors import StoreError
from sobolev_batch.results.tables.formatting import middle_cut
from sobolev_batch.results.tables.groups import families_of

Item = TypeVar("Item")

WIDTH_INCHES = 6.4
# P. Tol, "Colour schemes" (2021), "bright": distinct with every kind of colour vision. The report has them too.
_COLORS = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#777777")
_MARKERS = "osD^vPX"
_LONGEST_LABEL = 24
_LEGEND_ENTRIES = 12


def new_axes(height_inches: float) -> Axes:
    """Return axes in a figure of their own, which pyplot does not know."""
    return Figure(figsize=(WIDTH_INCHES, height_inches), layout="constrained").subplots()


def panels(items: Sequence[Item], height_inches: float, draw: Callable[[Item, Axes], object]) -> Figure:
    """Return a figure with a panel for each item, below each other."""
    figure = Figure(figsize=(WIDTH_INCHES, height_inches * len(items)), layout="constrained")
    for item, axes in zip(items, figure.subplots(len(items), 1, squeeze=False)[:, 0], strict=True):
        draw(item, axes)
    return figure


def hide_frame(axes: Axes) -> None:
    """Remove ticks and spines around an image."""
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def escaped(text: str) -> str:
    """Return a name as Matplotlib shows it unchanged: dollars would begin a formula, a leading underscore hides it."""
    return re.sub(r"^_", "\u2009_", text.replace("$", r"\$"))


def shortened(label: str) -> str:
    """Return a label for a place with little room."""
    return escaped(middle_cut(label, _LONGEST_LABEL))


def family_styles(tree: xr.DataTree) -> dict[str, tuple[str, str]]:
    """Return colour and marker of each family; only both together are unique where there are many."""
    return {
        family: (_COLORS[i % len(_COLORS)], _MARKERS[(i + i // len(_COLORS)) % len(_MARKERS)])
        for i, family in enumerate(dict.fromkeys(families_of(tree).values()))
    }


def add_legend(axes: Axes) -> None:
    """Add a legend that does not hide the plot."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > _LEGEND_ENTRIES:
        kept = _LEGEND_ENTRIES - 1
        labels = [*labels[:kept], f"and {len(labels) - kept} more"]
        handles = handles[: kept + 1]
    axes.legend(handles, labels, frameon=False, fontsize="small")


def error_bars(values: NDArray[np.float64], errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return error bars that stay above zero, as a logarithmic axis needs."""
    known = np.nan_to_num(errors)
    return np.stack([np.minimum(known, 0.999 * values), known])


def save(figure: Figure, target: object, **options: object) -> None:
    """Write a figure; characters that its font lacks become boxes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(target, dpi=150, **options)  # type: ignore[arg-type]


def write_figures(figures: Mapping[str, Figure], folder: Path) -> tuple[Path, ...]:
    """Write figures into a folder by their file names, and return the paths.

    Raises:
        StoreError: The folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            save(figure, folder / name)
    except OSError as error:
        raise StoreError(f"{folder}: pictures cannot be written there: {error.strerror or error}") from error
    return tuple(folder / name for name in figures)
