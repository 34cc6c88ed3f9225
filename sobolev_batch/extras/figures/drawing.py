"""What each plot draws on axes, and the table of plots."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.extras.figures.selection import Selection, families_of, has_pairs, is_sequence, pairs_of
from sobolev_batch.extras.figures.style import (
    EXTENDS,
    PictureFormat,
    Plot,
    Size,
    draw_curve,
    drawing,
    escaped,
    hide_frame,
    inches,
    notes_of,
    set_log_scale,
    set_title,
    shortened,
    style_of,
    write_figures,
)
from sobolev_batch.extras.leagues.costs import CostLeague, objects_text
from sobolev_batch.extras.leagues.evolution import evolution, has_times
from sobolev_batch.extras.leagues.league import RELATIVE, League
from sobolev_batch.extras.leagues.statistics import label_of, sizes_of
from sobolev_batch.shown import few_of
from sobolev_batch.tables.convergence import table, with_remarks
from sobolev_batch.tables.open import complete_meshes, finished_group, reference_of, study_unit, unit_of

# More labels along a front would overlap.
_MOST_LABELS = 20
# Each horizontal axis has what a mesh lacks that has no place on it, and the slope of second-order convergence.
_MISSING = {"edge_length": "edges", "triangles": "triangles", "vertices": "vertices", "seconds": "a time"}
_SLOPES = {"edge_length": 2, "triangles": -1, "vertices": -1}
# Smaller fractions are not written into their cells.
_SMALLEST_SHARE = 0.005
# Points of the largest font of labels and of shares, of the colour bar beside them, and between slanted labels.
_LABEL_POINTS, _SHARE_POINTS, _BAR_POINTS, _SLANTED_POINTS = 7.5, 7.0, 65.0, 12.0
MOST_MESHES = 300
# Points of the font of labels beside a matrix; smaller ones are left out.
_SMALLEST_FONT, _LARGEST_FONT = 4.0, 8.0
# Width of a character, as a multiple of the size of the font.
_CHARACTER_WIDTH = 0.6
# The colours of a matrix end at a percentile if the distances beyond it would take most of the scale.
_PERCENTILES = (2.0, 98.0)


def draw_convergence(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the relative distances of one order against the size or the cost of the meshes, family by family."""
    frame = with_remarks(table(selection.tree, order))
    frame = frame[frame["family"].isin(selection.families)]
    frame = frame.assign(x=sizes_of(frame, selection.x))
    drawn = frame[(frame["relative"] > 0) & (frame["x"] > 0)]
    set_log_scale(axes, "xy", " %")
    sequences = []
    for name, rows in drawn.groupby("family", sort=False):
        # Refinement goes along edge lengths, whatever the axis.
        rows = rows.sort_values("edge_length")
        places, values, errors = (rows[column].to_numpy() for column in ("x", "relative", "relative_error"))
        style, is_joined = selection.styles[str(name)], is_sequence(rows)
        draw_curve(axes, places, values, errors, style, shortened(str(name)), is_joined=is_joined)
        hollow = rows[~rows["resolved"].astype(bool)]
        if len(hollow):
            look = {**style, "linestyle": "none", "markerfacecolor": "white", "markersize": 4}
            axes.plot(hollow["x"], hollow["relative"], **look)
        sequences += [rows] if is_joined else []
    joined = pd.concat(sequences) if sequences else drawn.iloc[:0]
    if len(joined) > 1 and (slope := _SLOPES.get(selection.x)):
        _draw_slope(axes, joined["x"].to_numpy(), joined["relative"].to_numpy(), slope)
    if not drawn["resolved"].all():
        axes.plot([], [], "o", color="gray", markerfacecolor="white", markersize=4, label="not above its error")
    if drawn.empty:
        axes.text(0.5, 0.5, "no mesh to draw", transform=axes.transAxes, ha="center")
    gone = [shortened(name) for name in frame["family"].drop_duplicates() if name not in set(drawn["family"])]
    families = f"families not drawn: {few_of(gone)}" if gone else ""
    set_title(axes, f"order {order:g}", _absent(frame, selection.x), families)
    axes.set(xlabel=escaped(label_of(selection.x, unit_of(selection.tree)[0])), ylabel="relative Sobolev distance")


def draw_rates(found: xr.Dataset, order: float | None, axes: Axes) -> None:
    """Draw what `sobolev_batch.convergence` returns at one order, by default the first, from the finest mesh on."""
    orders = np.atleast_1d(found["order"].values).tolist()
    chosen = orders[0] if order is None else order
    if chosen not in orders:
        raise InputError(f"these meshes were not compared at order {chosen:g}, but at {', '.join(map(str, orders))}")
    rows = (found.sel(order=chosen) if "order" in found.dims else found).sortby("edge_length")
    rows = rows.isel(mesh=np.flatnonzero((rows["relative"] > 0) & (rows["edge_length"] > 0)))
    places, values = rows["edge_length"].values, rows["relative"].values
    set_log_scale(axes, "xy", " %")
    draw_curve(axes, places, values, rows["relative_error"].values, style_of(0), "meshes")
    if len(places) > 1:
        _draw_slope(axes, places, values, _SLOPES["edge_length"])
    set_title(axes, f"order {chosen:g}")
    axes.set(xlabel="mean edge length", ylabel="relative Sobolev distance")


def _absent(frame: pd.DataFrame, x: str) -> str:
    """Return how many meshes have no place in the plot, and why."""
    is_complete = frame["status"] == "complete"
    has_place = frame["x"] > 0
    counts = {
        "not computed": (~is_complete).sum(),
        "equal to the reference": (is_complete & has_place & (frame["relative"] == 0)).sum(),
        f"without {_MISSING.get(x, f'a number {x}')}": (is_complete & ~has_place).sum(),
        "not compared": (is_complete & has_place & frame["relative"].isna()).sum(),
    }
    reasons = [f"{count} {reason}" for reason, count in counts.items() if count]
    return f"not drawn: {', '.join(reasons)}" if reasons else ""


def _draw_slope(axes: Axes, places: Reals, values: Reals, slope: int) -> None:
    """Draw a line of a slope through the geometric mean of the points."""
    span = np.array([places.min(), places.max()])
    mean_place, mean_value = np.exp(np.log(places).mean()), np.exp(np.log(values).mean())
    axes.plot(span, mean_value * (span / mean_place) ** slope, "k:", linewidth=1, label=f"slope {slope}")


def draw_evolution(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the distances of moving meshes from the reference over time, one line for each family."""
    distances = evolution(selection.tree, order).isel(order=0)
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
            axes.axvline(moment, color=style["color"], linestyle=":", linewidth=1)
    if is_marked:
        axes.plot([], [], ":", color="gray", linewidth=1, label="a new mesh pays")
    set_title(axes, f"order {order:g}", f"not drawn: {zeros} equal to the reference" if zeros else "")
    axes.set(xlabel="time", ylabel="Sobolev distance")


def moving_families(selection: Selection) -> list[str]:
    """Return those of the chosen families that have a mesh with a time."""
    if not has_times(selection.tree):
        return []
    meshes = finished_group(selection.tree, "meshes")
    moving = set(meshes["family"].values[~np.isnan(meshes["time"].values)].tolist())
    return [name for name in selection.families if name in moving]


def draw_league(_leagues: Sequence[League], league: League, axes: Axes) -> None:
    """Draw the mean of each method of a league with its interval, and all meshes as dots, at their sizes."""
    set_log_scale(axes, "xy", " %" if league.y == RELATIVE else "")
    # The legend has the order of the table.
    for method in league.table["method"]:
        style, (sizes, means) = style_of(league.methods.index(method)), league.mean_curve(method)
        draw_curve(axes, sizes, means[:, 0], np.zeros(len(sizes)), style, shortened(method))
        axes.fill_between(sizes, means[:, 1], means[:, 2], color=style["color"], alpha=0.2, linewidth=0)
        for curve in (one[method] for one in league.curves.values() if method in one):
            axes.plot(np.exp(curve.sizes), np.exp(curve.values), ".", color=style["color"], alpha=0.5, markersize=3)
    _describe(axes, league)


def draw_cost_league(_leagues: Sequence[CostLeague], league: CostLeague, axes: Axes) -> None:
    """Draw the mean relative distance of each member of a league by cost against its mean cost, and their front."""
    set_log_scale(axes, "xy", " %")
    methods, means = league.meshes["method"].drop_duplicates().tolist(), league.means
    for number, method in enumerate(methods):
        rows = means[means["method"] == method]
        costs, values, errors = (rows[column].to_numpy() for column in (league.x, "relative", "relative_error"))
        draw_curve(axes, costs, values, errors, style_of(number), shortened(method), is_joined=False)
    front = means[means["front"]]
    axes.plot(front[league.x], front["relative"], "k:", linewidth=1, drawstyle="steps-post", label="front", zorder=1)
    for row in front.head(_MOST_LABELS).itertuples():
        place = getattr(row, league.x), row.relative
        axes.annotate(shortened(row.member), place, (3, 3), textcoords="offset points", fontsize="x-small")
    gone = len(league.meshes[["method", "member"]].drop_duplicates()) - len(means)
    note = f"not drawn: {gone} member{'s' if gone > 1 else ''} that not all objects have" if gone else ""
    if means.empty:
        axes.text(0.5, 0.5, "no member to draw", transform=axes.transAxes, ha="center")
    _describe(axes, league, note)


def _describe(axes: Axes, league: League | CostLeague, note: str = "") -> None:
    y = getattr(league, "y", RELATIVE)
    order = f"order {league.order:g}, " if y == RELATIVE else ""
    set_title(axes, f"{order}mean of {objects_text(len(league.objects))}", note)
    label = "relative Sobolev distance" if y == RELATIVE else escaped(label_of(y))
    axes.set(xlabel=escaped(label_of(league.x)), ylabel=label)


def draw_spectrum(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the fractions of each squared distance to the reference by wavelength, as a heat map."""
    spectra, (width, height) = selection.spectra, inches(axes)
    shares, bands = spectra["share"].sel(order=order).values, spectra["text"].values.tolist()
    image = axes.imshow(shares, vmin=0, cmap="Blues", aspect="auto")
    bar = axes.figure.colorbar(image, ax=axes, format=PercentFormatter(1.0, 0, " %"))
    bar.set_label("fraction of the\nsquared distance", fontsize="small")
    labels, row_points = [shortened(label) for label in spectra["mesh"].values], 72 * 0.8 * height / len(shares)
    label_points = min(_LABEL_POINTS, row_points)
    taken = _BAR_POINTS + _CHARACTER_WIDTH * label_points * max(map(len, labels))
    # The margins of a subplot, 22 % of its width, are room for labels.
    column_points = max(1.0, (72 * width / 0.78 - taken) / len(bands))
    font = min(_SHARE_POINTS, 0.75 * row_points, 0.4 * column_points)
    for i, fractions in enumerate(shares):
        if np.isnan(fractions).all():
            middle = (len(fractions) - 1) / 2
            axes.text(middle, i, "equal to the reference", ha="center", va="center", fontsize=label_points)
        for column, fraction in enumerate(fractions):
            if fraction >= _SMALLEST_SHARE and font >= _SMALLEST_FONT:
                color = "white" if fraction > 0.6 * np.nanmax(shares) else "black"
                axes.text(column, i, f"{fraction:.0%}", ha="center", va="center", fontsize=font, color=color)
    step = math.ceil(_SLANTED_POINTS / column_points)
    slanted: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(range(0, len(bands), step), bands[::step], fontsize=_LABEL_POINTS, **slanted)
    axes.set_yticks(range(len(labels)), labels, fontsize=label_points)
    axes.set_xlabel(escaped(f"wavelength in {study_unit(selection.tree)}"))
    set_title(axes, f"differences by wavelength, order {order:g}", spectra.attrs["omission"])
    hide_frame(axes)


def draw_energy(selection: Selection, _item: object, axes: Axes) -> None:
    """Draw the energy of each difference from the reference by wavelength, as a fraction of its limit."""
    spectra = selection.spectra
    is_equal = ~(spectra["energy"] > 0).any("band").values
    equal = f"not drawn: {is_equal.sum()} equal to the reference" if is_equal.any() else ""
    set_title(axes, "energy of the differences from the reference", spectra.attrs["omission"], equal)
    if is_equal.all():
        axes.text(0.5, 0.5, "no mesh differs from the reference", transform=axes.transAxes, ha="center")
        axes.set_axis_off()
        return
    family_of, named = families_of(selection.tree), set[str]()
    set_log_scale(axes, "xy")
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1, label="limit")
    for label in spectra["mesh"].values[~is_equal].tolist():
        family, bands = family_of[label], spectra.sel(mesh=label)
        bands = bands.isel(band=(bands["energy"] > 0).values)
        places, values, errors = (bands[column].values for column in ("wavelength", "energy", "energy_error"))
        # One entry of the legend for each family.
        name = "_" if family in named else shortened(family)
        draw_curve(axes, places, values, errors, selection.styles[family], name)
        named.add(family)
    axes.invert_xaxis()
    axes.set(xlabel=escaped(f"wavelength in {study_unit(selection.tree)}"), ylabel="energy over its limit")


def draw_matrix(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the distances of all pairs as a heat map, with similar meshes beside each other."""
    tree, reference = selection.tree, reference_of(selection.tree)
    chosen = {label for label, family in families_of(tree).items() if family in selection.families}
    complete = [label for label in complete_meshes(tree) if label in chosen or label == reference]
    pairs = pairs_of(tree, order, MOST_MESHES, complete)
    if pairs is None:
        raise InputError('there are distances to the reference alone; set pairs = "all" in [compare] and run the study')
    distances, meshes = pairs["distance"].values, pairs["mesh"].values.tolist()
    omission = f"the first {len(meshes)} of {len(complete)} meshes" if len(meshes) < len(complete) else ""
    arrangement = clustered_order(distances)
    values = distances[np.ix_(arrangement, arrangement)]
    set_title(axes, f"Sobolev distance of order {order:g}", omission)
    if not (values > 0).any():
        axes.text(0.5, 0.5, "no two meshes differ", ha="center")
        axes.set_axis_off()
        return
    low, high, extend = _color_range(values[values > 0])
    image = axes.imshow(np.ma.masked_less_equal(values, 0), norm=LogNorm(low, high), cmap="viridis", aspect="equal")
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, extend=extend)
    bar.set_label(f"distance, computed in\n{escaped(study_unit(tree))}", fontsize="small")
    bar.ax.tick_params(which="both", labelsize="small")
    labels = [shortened(meshes[i]) for i in arrangement]
    # Below the matrix, the longest label takes its part of the height.
    points = 0.9 * 72 * min(inches(axes)) / (len(labels) + _CHARACTER_WIDTH * max(map(len, labels)))
    if points >= _SMALLEST_FONT:
        font = min(points, _LARGEST_FONT)
        axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=font)
        axes.set_yticks(range(len(labels)), labels, fontsize=font)
    else:
        axes.set(xticks=[], yticks=[], xlabel=f"{len(labels)} meshes, similar ones beside each other")
    hide_frame(axes)


def _color_range(positive: Reals) -> tuple[float, float, str]:
    """Return the ends of the scale of colours, and the ends that get an arrow."""
    low, high = positive.min(), positive.max()
    inner_low, inner_high = np.percentile(positive, _PERCENTILES)
    most = max(inner_high / inner_low, 2.0)
    ends = bool(inner_low / low > most), bool(high / inner_high > most)
    low, high = inner_low if ends[0] else low, inner_high if ends[1] else high
    # Equal ends would leave no scale.
    low, high = (low, high) if low < high else (low / 1.1, high * 1.1)
    return low, high, EXTENDS[ends]


def clustered_order(distances: Reals) -> NDArray[np.intp]:
    """Return indices of meshes with similar ones beside each other, from distances (meshes, meshes) without NaN.

    Hierarchical clustering by mean distances, its leaves in the order that makes neighbours closest
    (Z. Bar-Joseph et al. 2001, doi:10.1093/bioinformatics/17.suppl_1.S22).
    """
    if len(distances) < 3:
        return np.arange(len(distances))
    pairs = squareform((distances + distances.T) / 2, checks=False)
    return np.asarray(leaves_list(linkage(pairs, method="average", optimal_ordering=True)), dtype=np.intp)


LEAGUE = Plot(draw_league, lambda leagues: leagues, 3.6)
COST_LEAGUE = Plot(draw_cost_league, lambda leagues: leagues, 3.6)
RATES = Plot(draw_rates, lambda found: found["order"].values.ravel(), 3.6)
# The plots have the names of their files. Each panel shows one order.
PLOTS: dict[str, Plot] = {
    "convergence": Plot(draw_convergence, lambda selection: selection.orders, 3.6),
    "over-time": Plot(draw_evolution, lambda selection: selection.orders if moving_families(selection) else (), 3.6),
    "matrix": Plot(draw_matrix, lambda selection: selection.orders if has_pairs(selection.tree) else (), 5.6),
    "spectrum": Plot(draw_spectrum, lambda selection: selection.orders if selection.has_spectra else (), 4.0),
    "energy": Plot(draw_energy, lambda selection: (None,) if selection.has_spectra else (), 3.6),
}


def write_plots(
    selection: Selection, folder: str | Path, formats: Sequence[PictureFormat] = ("png",), size: Size | None = None
) -> tuple[tuple[Path, ...], Mapping[str, Sequence[str]]]:
    """Write each kind of `plot` with results into a folder; return the paths, and what each leaves out, by name."""
    with drawing(size):
        of_kinds = {name: kind.items(selection) for name, kind in PLOTS.items()}
        figures = {name: PLOTS[name].figure(selection, items, size) for name, items in of_kinds.items() if items}
    notes = {name: notes_of(figure) for name, figure in figures.items()}
    return write_figures(figures, folder, formats, size), {name: lines for name, lines in notes.items() if lines}
