"""Plots of distances to the reference: against the size or cost of the meshes, and over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.legends import add_legend
from sobolev_batch.results.figures.pictures import panels
from sobolev_batch.results.figures.style import (
    Reals,
    Size,
    Style,
    draw_error_bars,
    escaped,
    family_styles,
    new_axes,
    set_title,
    shortened,
    vertical_label,
)
from sobolev_batch.results.figures.ticks import set_log_ticks
from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.evolution import evolution
from sobolev_batch.results.tables.groups import (
    Families,
    chosen_families,
    chosen_order,
    finished_group,
    has_times,
)
from sobolev_batch.results.tables.sizes import EDGE_LENGTH, is_sequence, label_of, sizes_of

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


def plot_convergence(
    store: AnyStore,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    x: str = EDGE_LENGTH,
    family: Families = None,
) -> Axes:
    """Plot the relative distance to the reference against the size or the cost of the meshes, family by family.

    Both axes are logarithmic. Bars show errors; a hollow marker is a distance that is not larger than its error.
    Families that go from coarse to fine are joined, and a dotted line has the slope of second-order convergence. The
    title counts the meshes that have no place in the plot. No function of this package touches pyplot: without ``ax``,
    the plot has a figure of its own, ``ax.figure``. The legend lies beside or below the axes; a figure of yours needs
    ``layout="constrained"`` to have room for it.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.
        x: Horizontal axis: "edge_length" (mean, in the study's unit), "triangles", "vertices", "seconds" that the tasks
            of the mesh took, or a number among the metadata of the meshes.
        family: Families to draw, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, or lacks the order, a family or the horizontal axis.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_convergence("storage/icosphere.zarr", order=-10)
    >>> ax.get_xlabel()
    "mean edge length in the study's unit"
    >>> ax.figure.savefig("convergence.pdf")
    >>> sb.plot_convergence("storage/icosphere.zarr", x="triangles", family="ico*").get_xlabel()
    'number of triangles'
    """
    tree = as_tree(store)
    axes = ax or new_axes(_HEIGHT_INCHES)
    _draw_convergence(tree, x, family, chosen_order(tree, order), axes)
    add_legend(axes, may_grow=ax is None)
    return axes


def convergence_figure(
    tree: xr.DataTree,
    orders: Sequence[float],
    x: str = EDGE_LENGTH,
    family: Families = None,
    size: Size | None = None,
) -> Figure:
    """Return `plot_convergence` for each order."""
    return panels(orders, _HEIGHT_INCHES, partial(_draw_convergence, tree, x, family), size, shares_legend=True)


def _draw_convergence(tree: xr.DataTree, x: str, family: Families, order: float, axes: Axes) -> None:
    frame, styles = _points(tree, order, x, chosen_families(tree, family)), family_styles(tree)
    drawn = frame[(frame["relative"] > 0) & (frame["x"] > 0)]
    axes.set_xscale("log")
    axes.set_yscale("log")
    for name, rows in drawn.groupby("family", sort=False):
        # Refinement goes along edge lengths, whatever the axis.
        _draw_family(axes, str(name), rows.sort_values("edge_length"), styles[str(name)])
    sequences = [rows for _, rows in drawn.groupby("family", sort=False) if is_sequence(rows)]
    joined = pd.concat(sequences) if sequences else drawn.iloc[:0]
    if len(joined) > 1 and (slope := _axis(x).slope):
        _draw_slope(axes, joined["x"].to_numpy(), joined["relative"].to_numpy(), slope)
    if not drawn["resolved"].all():
        axes.plot([], [], "o", color="gray", markerfacecolor="white", markersize=4, label="not above its error")
    if drawn.empty:
        axes.text(0.5, 0.5, "no mesh to draw", transform=axes.transAxes, ha="center")
    families = frame["family"].drop_duplicates()
    gone = [name for name in families if name not in set(drawn["family"])]
    set_title(axes, f"order {order:g}", _absent(frame, _axis(x)), _named("families not drawn: ", gone))
    axes.set_xlabel(escaped(label_of(x)))
    axes.set_ylabel(vertical_label(axes, "relative Sobolev distance"))
    axes.grid(visible=True, which="major", alpha=0.3)
    set_log_ticks(axes.xaxis)
    set_log_ticks(axes.yaxis)


def _points(tree: xr.DataTree, order: float, x: str, families: Sequence[str]) -> pd.DataFrame:
    """Return the table of one order and some families without the reference, with the values of the horizontal axis."""
    frame = table(tree, order)
    return frame[frame["family"].isin(families)].assign(x=sizes_of(frame, x))


def _draw_family(axes: Axes, name: str, rows: pd.DataFrame, style: Style) -> None:
    places, values, errors = (rows[column].to_numpy() for column in ("x", "relative", "relative_error"))
    axes.plot(
        places,
        values,
        marker=style.marker,
        linestyle=style.dashes if is_sequence(rows) else "none",
        color=style.color,
        label=escaped(name),
        markersize=4,
        linewidth=1.2,
    )
    draw_error_bars(axes, places, values, errors, style.color)
    _draw_hollow(axes, rows[~rows["resolved"].astype(bool)], style)


def _draw_hollow(axes: Axes, rows: pd.DataFrame, style: Style) -> None:
    if len(rows):
        axes.plot(rows["x"], rows["relative"], style.marker, color=style.color, markerfacecolor="white", markersize=4)


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


def plot_evolution(
    store: AnyStore,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    truth: str | None = None,
    family: Families = None,
) -> Axes:
    """Plot the distances of moving meshes from the true surface over time, one line for each family.

    The vertical axis is logarithmic; bars show errors, and a dotted line marks the first time at which a new mesh pays.

    Args:
        store: Path, URL or opened DataTree of a store whose meshes have times.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.
        truth: Family of the true surface at the same times; default the study's reference.
        family: Families to draw, by names or globs; default all that move.

    Returns:
        The axes.

    Raises:
        InputError: See `evolution`; or no family that moves is chosen.

    >>> import sobolev_batch as sb
    >>> ball = {"source": "icosphere", "levels": [2]}
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "carried"},
    ...     "lattice": {"xi_max": 2.0, "M": 20},
    ...     "norm": {"orders": [-4.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "carried", "source": "flow", "times": [0, 1, 2], "mesh": ball}],
    ... })
    >>> _ = sb.run(study, "memory://carried.zarr")
    >>> ax = sb.plot_evolution("memory://carried.zarr")
    >>> ax.get_xlabel()
    'time'
    """
    tree = as_tree(store)
    axes = ax or new_axes(_HEIGHT_INCHES)
    _draw_evolution(tree, truth, family, chosen_order(tree, order), axes)
    add_legend(axes, may_grow=ax is None)
    return axes


def evolution_figure(
    tree: xr.DataTree, orders: Sequence[float], family: Families = None, size: Size | None = None
) -> Figure:
    """Return `plot_evolution` for each order."""
    return panels(orders, _HEIGHT_INCHES, partial(_draw_evolution, tree, None, family), size, shares_legend=True)


def moving_families(tree: xr.DataTree, family: Families = None) -> list[str]:
    """Return those of the chosen families that have a mesh with a time."""
    if not has_times(tree):
        return []
    meshes = finished_group(tree, "meshes")
    moving = set(meshes["family"].values[~np.isnan(meshes["time"].values)].tolist())
    return [name for name in chosen_families(tree, family) if name in moving]


def _draw_evolution(tree: xr.DataTree, truth: str | None, family: Families, order: float, axes: Axes) -> None:
    found, styles = evolution(tree, order, truth=truth).isel(order=0), family_styles(tree)
    names = [name for name in moving_families(tree, family) if name in found["family"].values]
    if not names:
        raise InputError(f"none of the chosen families moves, only {', '.join(found['family'].values.tolist())}")
    axes.set_yscale("log")
    zeros, is_marked = 0, False
    for name in names:
        rows, style = found.sel(family=name).dropna("time", subset=["distance"]), styles[name]
        zeros += int((rows["distance"] == 0).sum())
        rows = rows.isel(time=(rows["distance"] > 0).values)
        times, values, errors = (rows[column].values for column in ("time", "distance", "error"))
        axes.plot(
            times,
            values,
            marker=style.marker,
            linestyle=style.dashes,
            color=style.color,
            label=escaped(name),
            markersize=4,
        )
        draw_error_bars(axes, times, values, errors, style.color)
        if np.isfinite(moment := rows["remesh_time"].item()):
            is_marked = True
            axes.axvline(moment, color=style.color, linestyle=":", linewidth=1)
    if is_marked:
        axes.plot([], [], ":", color="gray", linewidth=1, label="a new mesh pays")
    set_title(axes, f"order {order:g}", f"not drawn: {zeros} equal to the true surface" if zeros else "")
    axes.set_xlabel("time")
    axes.set_ylabel(vertical_label(axes, "Sobolev distance"))
    axes.grid(visible=True, which="major", alpha=0.3)
    set_log_ticks(axes.yaxis)
