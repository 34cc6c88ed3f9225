"""Plots of meshes, coloured by their witness functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import (
    EXTENDS,
    WIDTH_INCHES,
    PictureFormat,
    Size,
    drawing,
    escaped,
    set_title,
    shortened,
    write_figures,
)
from sobolev_batch.results.figures.views import (
    COVERED_AREA,
    FRONT,
    PICTURE_LIMITS,
    Axis,
    MeshView,
    Pictures,
    color_limits,
    make_views,
    render,
)
from sobolev_batch.results.open import AnyStore, as_tree, chosen_order, fields_read, finished_group
from sobolev_batch.surfaces.sources.names import file_stem

_HEIGHT_INCHES = 5.0
# Orders of one mesh in a picture.
MOST_ORDERS = 6
_PANELS_IN_A_ROW = 3
# Meshes in a picture.
_MOST_MESHES = 9


def plot_witness(
    store: AnyStore,
    mesh: str,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    folder: str | Path = ".",
    up: Axis = "z",
) -> Axes:
    """Plot a mesh coloured by its witness function: red where it has area that the reference lacks, else blue.

    The study makes the mesh again, and VTK draws it; this needs the extra "vtk". It is seen from the front and above,
    or from the side of the worst places if these are hidden there; then the title says so. Where a few values are far
    larger than all others, the colours end below them: the colour bar has arrows, with at most 1 % of the area beyond.

    Args:
        store: Path, URL or opened DataTree of the store.
        mesh: Label of the mesh, such as "family/name".
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar too.
        folder: Folder where relative paths in the study start.
        up: Axis that points upwards in the mesh's own coordinates.

    Returns:
        The axes.

    Raises:
        InputError: The label is unknown, or the mesh cannot be made again, is not the one that was computed, or
            cannot be drawn on this machine.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_witness("storage/icosphere.zarr", "icosphere/1", order=-4)  # doctest: +SKIP
    """
    tree = as_tree(store)
    order = chosen_order(tree, order)
    with fields_read(store):
        views, missing = make_views(tree, folder, [mesh], PICTURE_LIMITS, up, [order])
    if len(views) + len(missing) > 1:
        raise InputError(f"{mesh!r} stands for several meshes, and one is plotted; give its label")
    for label, reason in missing.items():
        raise InputError(f"{label}: {reason}")
    (view,) = views
    ((picture,),) = render([view], 1)
    axes = ax or Figure(figsize=(WIDTH_INCHES, _HEIGHT_INCHES), layout="constrained").subplots()
    axes.set_axis_off()
    axes.imshow(picture)
    set_title(axes, escaped(mesh), _seen(view))
    _add_colorbar(axes.figure, axes, [view], view.color_limits[0], 0)  # type: ignore[arg-type]
    return axes


def write_witness_plots(
    selection: Selection,
    output_folder: str | Path,
    folder: str | Path = ".",
    meshes: Sequence[str] = (),
    up: Axis = "z",
    formats: Sequence[PictureFormat] = ("png",),
    size: Size | None = None,
) -> tuple[tuple[Path, ...], Mapping[str, str]]:
    """Draw meshes of an open store, coloured by their witness functions, into a folder.

    Each mesh gets a file witness-* with colours and a view of its own; several are also drawn beside each other in the
    file witness, seen from the front and on one scale of colours, at the first order.

    Args:
        selection: Store, orders, and families to choose from.
        output_folder: Folder of the pictures.
        folder: Folder where relative paths in the study start.
        meshes: Labels, or patterns such as "scans/*"; by default those that `make_views` chooses.
        up: Axis that points upwards in the meshes' own coordinates.
        formats: Formats of each picture.
        size: Width and height of each picture in inches; default those of the plots.

    Returns:
        Paths of the pictures, and the reason for each mesh without one.

    Raises:
        InputError: A label, order or family is unknown, or too many meshes are named.
        StoreError: The folder cannot be written.
    """
    tree = selection.tree
    views, missing = make_views(tree, folder, meshes, PICTURE_LIMITS, up, selection.orders, selection.families)
    numbers = {label: i for i, label in enumerate(finished_group(tree, "meshes")["mesh"].values.tolist())}
    compared = [replace(view, eye=FRONT) for view in views[:_MOST_MESHES]]
    try:
        rendered = render(views, MOST_ORDERS)
        on_one_scale = render(compared, 1, common=True) if len(compared) > 1 else []
    except InputError as error:
        return (), {**missing, **{view.label: str(error) for view in views}}
    with drawing(size):
        figures = {
            f"witness-{file_stem(numbers[view.label], view.label)}": witness_figure(view, pictures, size)
            for view, pictures in zip(views, rendered, strict=True)
        }
        if on_one_scale:
            pictures = [one_order for (one_order, *_) in on_one_scale]
            figures["witness"] = _comparison_figure(compared, pictures, len(views), size)
    return write_figures(figures, output_folder, formats, size), missing


def witness_figure(view: MeshView, pictures: Pictures, size: Size | None = None) -> Figure:
    """Return a mesh seen from one side, with a panel for each order that was rendered."""
    columns = min(_PANELS_IN_A_ROW, len(pictures))
    rows = -(-len(pictures) // columns)
    _, height, width, _ = pictures.shape
    # Below each panel its colours, above all of them the name of the mesh.
    panel = min(WIDTH_INCHES / columns, _HEIGHT_INCHES * width / height)
    own_size = (WIDTH_INCHES, 0.3 + rows * (0.7 + panel * height / width))
    figure = Figure(figsize=size or own_size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for i, (axes, picture) in enumerate(zip(panels, pictures, strict=False)):
        axes.imshow(picture)
        _add_colorbar(figure, axes, [view], view.color_limits[i], i)
    omission = f"{len(pictures)} of {len(view.orders)} orders" if len(pictures) < len(view.orders) else ""
    figure.suptitle("\n".join(filter(None, (escaped(view.label), _seen(view), omission))), fontsize="medium")
    return figure


def _seen(view: MeshView) -> str:
    return "" if np.array_equal(view.eye, FRONT) else "seen from the side of the largest values"


def _comparison_figure(
    views: Sequence[MeshView], pictures: Sequence[np.ndarray], total: int, size: Size | None
) -> Figure:
    """Return meshes beside each other, with their witness functions of the first order on one scale."""
    columns = min(_PANELS_IN_A_ROW, len(views))
    rows = -(-len(views) // columns)
    omission = f"{len(views)} of {total} meshes" if len(views) < total else ""
    tallest = max(picture.shape[0] / picture.shape[1] for picture in pictures)
    own_size = (WIDTH_INCHES, 0.8 + 0.3 * bool(omission) + rows * (0.3 + tallest * WIDTH_INCHES / columns))
    figure = Figure(figsize=size or own_size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.set_axis_off()
    for axes, view, picture in zip(panels.ravel(), views, pictures, strict=False):
        axes.imshow(picture)
        axes.set_title(f"{shortened(view.label)}\n{view.original_triangles:,} triangles", fontsize="small")
    if omission:
        figure.suptitle(omission, fontsize="medium")
    _add_colorbar(figure, panels, views, color_limits(views, common=True)[0][0], 0)
    return figure


def _add_colorbar(
    figure: Figure, panels: Axes | np.ndarray, views: Sequence[MeshView], limit: float, index: int
) -> None:
    """Add the colours of some meshes at one of their orders, with arrows where values lie beyond them."""
    numbers = ScalarFormatter()
    numbers.set_powerlimits((-2, 3))
    ends = (
        min(view.values[index].min() for view in views) < -limit,
        max(view.values[index].max() for view in views) > limit,
    )
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), "RdBu_r"),
        ax=panels,
        shrink=0.8,
        orientation="horizontal",
        ticks=MaxNLocator(4, symmetric=True),
        format=numbers,
        aspect=20 if isinstance(panels, Axes) else 50,
        extend=EXTENDS[ends],
    )
    beyond = f"\narrows: up to {1 - COVERED_AREA:.0%} of the area" if any(ends) else ""
    bar.set_label(f"witness, order {views[0].orders[index]:g}{beyond}", fontsize="small")
    bar.ax.tick_params(labelsize="x-small")
    bar.ax.xaxis.get_offset_text().set_fontsize("x-small")
