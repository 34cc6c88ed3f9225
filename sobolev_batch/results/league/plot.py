"""The plot of a league: the mean distance of each method against the size of its meshes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sobolev_batch.results.figures.legends import add_legend
from sobolev_batch.results.figures.pictures import Output, panels, write_figures
from sobolev_batch.results.figures.style import (
    Size,
    draw_error_bars,
    escaped,
    new_axes,
    set_title,
    style_of,
    vertical_label,
)
from sobolev_batch.results.figures.ticks import set_log_ticks
from sobolev_batch.results.league.curves import Curve, Reals
from sobolev_batch.results.league.league import League
from sobolev_batch.results.tables.sizes import label_of

_HEIGHT_INCHES = 3.6
# Of a logarithm; a bar beyond it would leave no room for the distances.
_LARGEST_ERROR = 3.0


def plot_league(league: League, ax: Axes | None = None) -> Axes:
    """Plot the mean relative distance of each method of a league against the mean size of its meshes.

    The points are geometric means over the objects: of the coarsest meshes, of the next ones, and so on. Bars show the
    errors of the distances. Both axes are logarithmic. No function of this package touches pyplot: without ``ax``, the
    plot has a figure of its own, ``ax.figure``.

    Args:
        league: League at one order, see `league`.
        ax: Axes to draw on.

    Returns:
        The axes.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league({"sphere": "storage/icosphere.zarr"}, -10)
    >>> ax = sb.plot_league(at_order)
    >>> ax.get_xlabel()
    'number of triangles'
    """
    axes = ax or new_axes(_HEIGHT_INCHES)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for number, method in enumerate(league.scores.methods):
        mean = mean_curve(league, method)
        style, places, values = style_of(number), np.exp(mean.sizes), np.exp(mean.values)
        axes.plot(
            places,
            values,
            marker=style.marker,
            linestyle=style.dashes,
            color=style.color,
            label=escaped(method),
            markersize=4,
            linewidth=1.2,
        )
        draw_error_bars(axes, places, values, bars_of(mean), style.color)
    count = len(league.scores.objects)
    set_title(axes, f"order {league.order:g}, mean of {count} object{'s' if count > 1 else ''}")
    axes.set_xlabel(escaped(label_of(league.x)))
    axes.set_ylabel(vertical_label(axes, "relative Sobolev distance"))
    axes.grid(visible=True, which="major", alpha=0.3)
    set_log_ticks(axes.xaxis)
    set_log_ticks(axes.yaxis)
    add_legend(axes, may_grow=ax is None)
    return axes


def league_figure(leagues: Sequence[League], size: Size | None = None) -> Figure:
    """Return a figure with a panel for each league; the size is that of a panel in inches."""
    return panels(leagues, _HEIGHT_INCHES, plot_league, size)


def write_league_plots(leagues: Sequence[League], folder: str | Path, output: Output | None = None) -> tuple[Path, ...]:
    """Write the plot of leagues into a folder, with a panel for each order, and return the paths.

    Raises:
        StoreError: The folder cannot be written.
    """
    output = output or Output()
    with output.drawing():
        figure = league_figure(leagues, output.size)
    return write_figures({"league": figure}, Path(folder), output)


def mean_curve(league: League, method: str) -> Curve:
    """Return the mean of a method's curves over the objects, point by point, as far as all of them go."""
    curves = [league.curves[name][method] for name in league.scores.objects]
    count = min(len(curve.sizes) for curve in curves)
    columns = ([getattr(curve, name)[:count] for curve in curves] for name in ("sizes", "values", "errors"))
    return Curve(*(np.mean(column, axis=0) for column in columns))


def bars_of(curve: Curve) -> Reals:
    """Return the errors (n,) of a curve's distances; where nothing bounds one, it is as large as the distance."""
    factors = np.where(np.isfinite(curve.errors), np.expm1(np.minimum(curve.errors, _LARGEST_ERROR)), 1.0)
    return np.exp(curve.values) * factors
