"""Plots of the distances of all pairs: a heat map, and a map of the meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.embedding import Embedding, clustered_order
from sobolev_batch.results.figures.legends import add_legend
from sobolev_batch.results.figures.pictures import panels
from sobolev_batch.results.figures.style import (
    EXTENDS,
    Reals,
    Size,
    escaped,
    family_styles,
    figure_of,
    hide_frame,
    inches,
    missing_glyphs_allowed,
    new_axes,
    set_title,
    shortened,
    vertical_label,
)
from sobolev_batch.results.figures.ticks import LogLabels, LogTicks
from sobolev_batch.results.open import AnyStore, as_tree
from sobolev_batch.results.tables.groups import (
    Families,
    chosen_families,
    chosen_order,
    complete_meshes,
    families_of,
    reference_of,
)
from sobolev_batch.results.tables.matrix import Matrix

# In matrices and on maps.
MOST_MESHES = 300
_MATRIX_INCHES, _MAP_INCHES = 5.6, 4.4
# Points of the font of labels beside a matrix; smaller ones are left out.
_SMALLEST_FONT, _LARGEST_FONT = 4.0, 8.0
# The colours of a matrix end at a percentile if the distances beyond it would take most of the scale.
_PERCENTILES = (2.0, 98.0)
# Names on a map: size of the font in points, and sizes of a character as multiples of it.
_NAME_POINTS, _NAME_WIDTH, _NAME_HEIGHT = 7.0, 0.6, 1.2
# Points between a mark and its name.
_NAME_GAP = 4.0


def plot_matrix(
    store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None
) -> Axes:
    """Plot the distances of all pairs as a heat map, with similar meshes beside each other.

    Colours are on a logarithmic scale; where a few distances lie far beyond the others, arrows end it. White pairs are
    equal. Up to 300 meshes are drawn: the first ones and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar too.
        family: Families to draw beside the reference, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_matrix("storage/icosphere.zarr", order=-10)
    >>> len(ax.get_yticklabels())
    5
    """
    axes = ax or new_axes(_MATRIX_INCHES, "compressed")
    tree = as_tree(store)
    _draw_matrix(tree, family, chosen_order(tree, order), axes)
    return axes


def plot_map(store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the meshes as points of a plane whose distances approximate the Sobolev distances.

    The plane shows most of the meshes' variance (classical scaling); distances in it are never larger than the true
    ones. Up to 300 meshes are drawn: the first ones and the reference. Points have names where there is room.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.
        family: Families to draw beside the reference, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_map("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['icosphere', 'reference']
    """
    axes = ax or new_axes(_MAP_INCHES)
    tree = as_tree(store)
    names = _draw_map(tree, family, chosen_order(tree, order), axes)
    add_legend(axes, may_grow=ax is None)
    _write_names([names])
    return axes


def matrix_figure(
    tree: xr.DataTree, orders: Sequence[float], family: Families = None, size: Size | None = None
) -> Figure:
    """Return `plot_matrix` for each order."""
    return panels(orders, _MATRIX_INCHES, partial(_draw_matrix, tree, family), size, layout="compressed")


def map_figure(tree: xr.DataTree, orders: Sequence[float], family: Families = None, size: Size | None = None) -> Figure:
    """Return `plot_map` for each order."""
    names: list[_Names] = []
    figure = panels(
        orders,
        _MAP_INCHES,
        lambda order, axes: names.append(_draw_map(tree, family, order, axes)),
        size,
        shares_legend=True,
    )
    _write_names(names)
    return figure


def has_pairs(tree: xr.DataTree) -> bool:
    """Return True if the store has the distances of all pairs of meshes."""
    return "distances" in tree.children and tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]


class _Chosen(NamedTuple):
    """Distances of some meshes, and a note on those left out."""

    matrix: Matrix
    omission: str


def _chosen(tree: xr.DataTree, order: float, family: Families) -> _Chosen:
    families, family_of, reference = chosen_families(tree, family), families_of(tree), reference_of(tree)
    meshes = [label for label in complete_meshes(tree) if family_of[label] in families or label == reference]
    matrix = Matrix.of(tree, order, MOST_MESHES, meshes)
    if matrix is None:
        raise InputError(
            'the store has distances to the reference alone; set pairs = "all" in [norm] and run the study again'
        )
    shown = len(matrix.labels)
    return _Chosen(matrix, f"the first {shown} of {len(meshes)} meshes" if shown < len(meshes) else "")


def _draw_matrix(tree: xr.DataTree, family: Families, order: float, axes: Axes) -> None:
    matrix, omission = _chosen(tree, order, family)
    arrangement = clustered_order(matrix.values)
    values = matrix.values[np.ix_(arrangement, arrangement)]
    set_title(axes, f"Sobolev distance of order {matrix.order:g}", omission)
    if not (values > 0).any():
        axes.text(0.5, 0.5, "no two meshes differ", ha="center")
        axes.set_axis_off()
        return
    low, high, extend = _color_range(values[values > 0])
    image = axes.imshow(np.ma.masked_less_equal(values, 0), norm=LogNorm(low, high), cmap="viridis", aspect="equal")
    axes.figure.colorbar(
        image,
        ax=axes,
        shrink=0.8,
        label=vertical_label(axes, "distance in the study's unit"),
        ticks=LogTicks(),
        format=LogLabels(),
        extend=extend,
    )
    labels = [shortened(matrix.labels[i]) for i in arrangement]
    # Below the matrix, the longest label takes its part of the height.
    points = 0.9 * 72 * min(inches(axes)) / (len(labels) + _NAME_WIDTH * max(map(len, labels)))
    if points >= _SMALLEST_FONT:
        font = min(points, _LARGEST_FONT)
        axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=font)
        axes.set_yticks(range(len(labels)), labels, fontsize=font)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(f"{len(labels)} meshes, similar ones beside each other")
    hide_frame(axes)


def _color_range(positive: Reals) -> tuple[float, float, str]:
    """Return the ends of the scale of colours, and the ends that get an arrow."""
    low, high = positive.min(), positive.max()
    inner_low, inner_high = np.percentile(positive, _PERCENTILES)
    most = max(inner_high / inner_low, 2.0)
    ends = bool(inner_low / low > most), bool(high / inner_high > most)
    extend = EXTENDS[ends]
    low, high = inner_low if ends[0] else low, inner_high if ends[1] else high
    # Equal ends would leave no scale.
    return (low, high, extend) if low < high else (low / 1.1, high * 1.1, extend)


@dataclass(frozen=True)
class _Names:
    """Names of the points of a map.

    Attributes:
        axes: Axes of the map.
        points: Points (meshes, 2) in its coordinates.
        names: Their names; an empty one is not written.
    """

    axes: Axes
    points: Reals
    names: Sequence[str]


def _draw_map(tree: xr.DataTree, family: Families, order: float, axes: Axes) -> _Names:
    (matrix, omission), reference = _chosen(tree, order, family), reference_of(tree)
    styles, family_of = family_styles(tree), families_of(tree)
    embedding = Embedding.of(matrix.values)
    families = [family_of[label] for label in matrix.labels]
    for name in dict.fromkeys(families):
        chosen = [i for i, label in enumerate(matrix.labels) if families[i] == name and label != reference]
        if chosen:
            places, style = embedding.points[chosen].T, styles[name]
            axes.plot(*places, style.marker, color=style.color, label=escaped(name), markersize=5, alpha=0.85)
    center = matrix.labels.index(reference) if reference in matrix.labels else None
    if center is not None:
        axes.plot(*embedding.points[center], "*", color="black", markersize=12, label=escaped(reference))
    explained = "" if np.isnan(embedding.explained) else f", {embedding.explained:.0%} of the variance"
    set_title(axes, f"map at order {matrix.order:g}{explained}", omission)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.grid(visible=True, alpha=0.3)
    axes.set_xlabel("in the unit of distances")
    names = ["" if i == center else shortened(label.partition("/")[2]) for i, label in enumerate(matrix.labels)]
    return _Names(axes, embedding.points, names)


def _write_names(maps: Sequence[_Names]) -> None:
    """Write names of points where they stay within the axes and hide neither a point nor another name."""
    # The layout decides how far apart points are on paper.
    for figure in {figure_of(names.axes) for names in maps}:
        with missing_glyphs_allowed():
            figure.draw_without_rendering()
    for names in maps:
        for i, is_left in _legible(names).items():
            names.axes.annotate(
                names.names[i],
                names.points[i],
                (-_NAME_GAP if is_left else _NAME_GAP, _NAME_GAP),
                ha="right" if is_left else "left",
                va="bottom",
                textcoords="offset points",
                fontsize=_NAME_POINTS,
                alpha=0.8,
            )


def _legible(names: _Names) -> dict[int, bool]:
    """Return the points whose names can be read, and True if the name stands to the left."""
    axes = names.axes
    per_point = figure_of(axes).dpi / 72
    places = axes.transData.transform(names.points) if len(names.points) else names.points
    kept: dict[int, bool] = {}
    boxes = np.zeros((0, 4))
    for i, name in enumerate(names.names):
        width, height = per_point * _NAME_POINTS * np.array([_NAME_WIDTH * len(name), _NAME_HEIGHT])
        for is_left in (False, True) if name else ():
            corner = places[i] + per_point * _NAME_GAP * np.array([-1 if is_left else 1, 1]) - [is_left * width, 0]
            low, high = corner, corner + np.array([width, height])
            is_within = (low >= axes.bbox.min).all() and (high <= axes.bbox.max).all()
            is_hiding = ((places > low) & (places < high)).all(axis=1).any()
            overlaps = ((low < boxes[:, 2:]) & (high > boxes[:, :2])).all(axis=1).any()
            if is_within and not is_hiding and not overlaps:
                kept[i] = is_left
                boxes = np.vstack([boxes, [*low, *high]])
                break
    return kept
