"""Plots of meshes, coloured by their witness functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.style import WIDTH_INCHES, escaped, new_axes, shortened, write_figures
from sobolev_batch.results.meshes.render import Pictures, color_limits, render
from sobolev_batch.results.meshes.views import PICTURES, Axis, MeshView, make_views
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import chosen_orders, finished_group
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

    The study makes the mesh again, and VTK draws it from the front and above; this needs the extra "vtk".

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
    (order,) = chosen_orders(finished_group(tree, "convergence"), order)[:1]
    with fields_read(store):
        made = make_views(tree, folder, [mesh], PICTURES, up, [order])
    if made.missing:
        raise InputError(f"{mesh}: {made.missing[mesh]}")
    (view,) = made.views
    ((picture,),) = render([view], 1)
    axes = ax or new_axes(_HEIGHT_INCHES)
    axes.set_axis_off()
    axes.imshow(picture)
    axes.set_title(escaped(mesh), fontsize="medium")
    _add_colorbar(axes.figure, axes, color_limits([view], common=False)[0][0], order)  # type: ignore[arg-type]
    return axes


def write_witness_plots(
    tree: xr.DataTree, output: str | Path, folder: str | Path = ".", meshes: Sequence[str] = (), up: Axis = "z"
) -> tuple[tuple[Path, ...], Mapping[str, str]]:
    """Draw meshes of an open store, coloured by their witness functions, into a folder.

    Each mesh gets a file witness-*.png with colours of its own; several also stand beside each other in witness.png,
    on one scale of colours, at the study's first order.

    Args:
        tree: Open store with tables.
        output: Folder of the pictures.
        folder: Folder where relative paths in the study start.
        meshes: Labels; by default those that `make_views` chooses.
        up: Axis that points upwards in the meshes' own coordinates.

    Returns:
        Paths of the pictures, and the reason for each mesh without one.

    Raises:
        InputError: A label is unknown, or too many are named.
        StoreError: The folder cannot be written.
    """
    made = make_views(tree, folder, meshes, PICTURES, up)
    numbers = {label: i for i, label in enumerate(finished_group(tree, "meshes")["mesh"].values.tolist())}
    compared = made.views[:_MOST_MESHES]
    try:
        rendered = render(made.views, MOST_ORDERS)
        on_one_scale = render(compared, 1, common=True)
    except InputError as error:
        return (), {**made.missing, **{view.label: str(error) for view in made.views}}
    figures = {
        f"witness-{file_stem(numbers[view.label], view.label)}.png": witness_figure(view, pictures)
        for view, pictures in zip(made.views, rendered, strict=True)
    }
    if len(compared) > 1:
        figures["witness.png"] = _comparison_figure(compared, [pictures[0] for pictures in on_one_scale])
    return write_figures(figures, Path(output)), made.missing


def witness_figure(view: MeshView, pictures: Pictures) -> Figure:
    """Return a mesh seen from one side, with a panel for each order that was rendered."""
    columns = min(_PANELS_IN_A_ROW, len(pictures))
    rows = -(-len(pictures) // columns)
    _, height, width, _ = pictures.shape
    # Below each panel its colours, above all of them the name of the mesh.
    panel = min(WIDTH_INCHES / columns, _HEIGHT_INCHES * width / height)
    figure = Figure(figsize=(WIDTH_INCHES, 0.3 + rows * (0.7 + panel * height / width)), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    (limits,) = color_limits([view], common=False)
    for axes, order, largest, picture in zip(panels, view.orders, limits, pictures, strict=False):
        axes.imshow(picture)
        _add_colorbar(figure, axes, largest, order)
    figure.suptitle(escaped(view.label), fontsize="medium")
    return figure


def _comparison_figure(views: Sequence[MeshView], pictures: Sequence[np.ndarray]) -> Figure:
    """Return meshes beside each other, with their witness functions of the first order on one scale."""
    columns = min(_PANELS_IN_A_ROW, len(views))
    rows = -(-len(views) // columns)
    tallest = max(picture.shape[0] / picture.shape[1] for picture in pictures)
    size = (WIDTH_INCHES, 0.8 + rows * (0.3 + tallest * WIDTH_INCHES / columns))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.set_axis_off()
    for axes, view, picture in zip(panels.ravel(), views, pictures, strict=False):
        axes.imshow(picture)
        axes.set_title(f"{shortened(view.label)}\n{view.original_triangles:,} triangles", fontsize="small")
    _add_colorbar(figure, panels, color_limits(views, common=True)[0][0], views[0].orders[0])
    return figure


def _add_colorbar(figure: Figure, panels: Axes | np.ndarray, largest: float, order: float) -> None:
    numbers = ScalarFormatter()
    numbers.set_powerlimits((-2, 3))
    bar = figure.colorbar(
        ScalarMappable(Normalize(-largest, largest), "RdBu_r"),
        ax=panels,
        shrink=0.8,
        orientation="horizontal",
        ticks=MaxNLocator(4, symmetric=True),
        format=numbers,
        aspect=20 if isinstance(panels, Axes) else 50,
    )
    bar.set_label(f"witness, order {order:g}", fontsize="small")
    bar.ax.tick_params(labelsize="x-small")
    bar.ax.xaxis.get_offset_text().set_fontsize("x-small")
