"""Plots of distances to the reference: against the size or cost of the meshes, over time, and means of methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import (
    Plot,
    Reals,
    draw_curve,
    escaped,
    set_log_scale,
    set_title,
    shortened,
    style_of,
)
from sobolev_batch.results.league.league import League
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.evolution import evolution
from sobolev_batch.results.tables.groups import finished_group, has_times, is_sequence, label_of, sizes_of

_HEIGHT_INCHES = 3.6
_MOST_NAMED = 3


@dataclass(frozen=True)
class _Axis:
    """A horizontal axis of the convergence plot.

    Attributes:
        missing: What a mesh lacks that has no place on the axis.
        slope: Slope of second-order convergence; None where it has none.
    """

    missing: str
    slope: int | None = None


_AXES: dict[str, _Axis] = {
    "edge_length": _Axis("edges", 2),
    "triangles": _Axis("triangles", -1),
    "vertices": _Axis("vertices", -1),
    "seconds": _Axis("a time"),
}


def _axis(x: str) -> _Axis:
    """Return a horizontal axis; what no table of this package knows is one of the metadata of meshes."""
    return _AXES.get(x) or _Axis(f"a number {x}")


def draw_convergence(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the relative distances of one order against the size or the cost of the meshes, family by family."""
    frame = table(selection.tree, order)
    frame = frame[frame["family"].isin(selection.families)]
    frame = frame.assign(x=sizes_of(frame, selection.x))
    drawn = frame[(frame["relative"] > 0) & (frame["x"] > 0)]
    set_log_scale(axes, "xy")
    sequences = []
    for name, rows in drawn.groupby("family", sort=False):
        # Refinement goes along edge lengths, whatever the axis.
        rows = rows.sort_values("edge_length")
        places, values, errors = (rows[column].to_numpy() for column in ("x", "relative", "relative_error"))
        style, is_joined = selection.styles[str(name)], is_sequence(rows)
        draw_curve(axes, places, values, errors, style, shortened(str(name)), is_joined=is_joined)
        hollow = rows[~rows["resolved"].astype(bool)]
        if len(hollow):
            look = {"color": style.color, "markerfacecolor": "white", "markersize": 4}
            axes.plot(hollow["x"], hollow["relative"], style.marker, **look)  # type: ignore[arg-type]
        sequences += [rows] if is_joined else []
    joined = pd.concat(sequences) if sequences else drawn.iloc[:0]
    if len(joined) > 1 and (slope := _axis(selection.x).slope):
        _draw_slope(axes, joined["x"].to_numpy(), joined["relative"].to_numpy(), slope)
    if not drawn["resolved"].all():
        axes.plot([], [], "o", color="gray", markerfacecolor="white", markersize=4, label="not above its error")
    if drawn.empty:
        axes.text(0.5, 0.5, "no mesh to draw", transform=axes.transAxes, ha="center")
    gone = [name for name in frame["family"].drop_duplicates() if name not in set(drawn["family"])]
    set_title(axes, f"order {order:g}", _absent(frame, _axis(selection.x)), _named("families not drawn: ", gone))
    axes.set_xlabel(escaped(label_of(selection.x)))
    axes.set_ylabel("relative Sobolev distance")


def _absent(frame: pd.DataFrame, axis: _Axis) -> str:
    """Return how many meshes have no place in the plot, and why."""
    is_complete = frame["status"] == "complete"
    has_place = frame["x"] > 0
    counts = {
        "not computed": (~is_complete).sum(),
        "equal to the reference": (is_complete & has_place & (frame["relative"] == 0)).sum(),
        f"without {axis.missing}": (is_complete & ~has_place).sum(),
        "not compared": (is_complete & has_place & frame["relative"].isna()).sum(),
    }
    reasons = [f"{count} {reason}" for reason, count in counts.items() if count]
    return f"not drawn: {', '.join(reasons)}" if reasons else ""


def _named(words: str, names: Sequence[str]) -> str:
    """Return words and after them the first few names; nothing without names."""
    shown = [shortened(name) for name in names[:_MOST_NAMED]]
    rest = [f"{len(names) - len(shown)} more"] if len(names) > len(shown) else []
    return words + ", ".join([*shown, *rest]) if names else ""


def _draw_slope(axes: Axes, places: Reals, values: Reals, slope: int) -> None:
    """Draw a line of a slope through the geometric mean of the points."""
    span = np.array([places.min(), places.max()])
    mean_place, mean_value = np.exp(np.log(places).mean()), np.exp(np.log(values).mean())
    axes.plot(span, mean_value * (span / mean_place) ** slope, "k:", linewidth=1, label=f"slope {slope}")


def draw_evolution(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the distances of moving meshes from the true surface over time, one line for each family."""
    distances = evolution(selection.tree, order, truth=selection.truth).isel(order=0)
    names = [name for name in moving_families(selection) if name in distances["family"].values]
    if not names:
        raise InputError(f"none of the chosen families moves, only {', '.join(distances['family'].values.tolist())}")
    set_log_scale(axes, "y")
    zeros, is_marked = 0, False
    for name in names:
        rows, style = distances.sel(family=name).dropna("time", subset=["distance"]), selection.styles[name]
        zeros += int((rows["distance"] == 0).sum())
        rows = rows.isel(time=(rows["distance"] > 0).values)
        times, values, errors = (rows[column].values for column in ("time", "distance", "error"))
        draw_curve(axes, times, values, errors, style, shortened(name))
        if np.isfinite(moment := rows["remesh_time"].item()):
            is_marked = True
            axes.axvline(moment, color=style.color, linestyle=":", linewidth=1)
    if is_marked:
        axes.plot([], [], ":", color="gray", linewidth=1, label="a new mesh pays")
    set_title(axes, f"order {order:g}", f"not drawn: {zeros} equal to the true surface" if zeros else "")
    axes.set_xlabel("time")
    axes.set_ylabel("Sobolev distance")


def moving_families(selection: Selection) -> list[str]:
    """Return those of the chosen families that have a mesh with a time."""
    if not has_times(selection.tree):
        return []
    meshes = finished_group(selection.tree, "meshes")
    moving = set(meshes["family"].values[~np.isnan(meshes["time"].values)].tolist())
    return [name for name in selection.families if name in moving]


def draw_league(_leagues: Sequence[League], league: League, axes: Axes) -> None:
    """Draw the mean relative distance of each method of a league against the mean size of its meshes."""
    set_log_scale(axes, "xy")
    for number, method in enumerate(league.scores.methods):
        mean = league.scores.mean_curve(method)
        draw_curve(axes, np.exp(mean.sizes), np.exp(mean.values), mean.bars, style_of(number), shortened(method))
    count = len(league.scores.objects)
    set_title(axes, f"order {league.order:g}, mean of {count} object{'s' if count > 1 else ''}")
    axes.set_xlabel(escaped(label_of(league.x)))
    axes.set_ylabel("relative Sobolev distance")


LEAGUE = Plot[Sequence[League]](
    draw_league, lambda leagues: leagues, _HEIGHT_INCHES, "Mean relative distance by method"
)
