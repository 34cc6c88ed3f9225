"""Plots of a store: convergence, transforms along one frequency axis, distance matrices, maps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.embedding import Embedding, clustered_order
from sobolev_batch.results.figures.spectra import Spectra, spread
from sobolev_batch.results.figures.spectrum_plots import energy_figure, spectrum_figure
from sobolev_batch.results.figures.style import (
    add_legend,
    error_bars,
    escaped,
    family_styles,
    hide_frame,
    new_axes,
    panels,
    shortened,
    write_figures,
)
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.convergence import table
from sobolev_batch.results.tables.evolution import evolution
from sobolev_batch.results.tables.groups import (
    chosen_orders,
    complete_meshes,
    families_of,
    finished_group,
    has_times,
    reference_of,
)
from sobolev_batch.results.tables.matrix import Matrix

# In matrices and on maps.
MOST_MESHES = 300
_MOST_CURVES = 5
_MOST_TICKS = 40
# Distance between names on a map, as a fraction of its width.
_NAMES_APART = 0.08
_CONVERGENCE_INCHES, _TRANSFORM_INCHES, _MATRIX_INCHES, _MAP_INCHES = 3.6, 3.4, 5.6, 4.4


def plot_convergence(store: AnyStore, order: float | None = None, ax: Axes | None = None) -> Axes:
    """Plot the relative distance to the reference against the mean edge length, one line for each family.

    Both axes are logarithmic; bars show errors, and a dotted line has slope 2. No function of this package touches
    pyplot: without ``ax``, the plot has a figure of its own, ``ax.figure``.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, or lacks the order.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_convergence("storage/icosphere.zarr", order=-10)
    >>> ax.get_xlabel()
    "mean edge length in the study's unit"
    >>> ax.figure.savefig("convergence.png")
    """
    tree = as_tree(store)
    order = _order_of(tree, order)
    axes = ax or new_axes(_CONVERGENCE_INCHES)
    frame, styles = table(tree, order), family_styles(tree)
    frame = frame[(frame["relative"] > 0) & frame["edge_length"].notna()]
    for family, rows in frame.groupby("family", sort=False):
        ordered = rows.sort_values("edge_length")
        color, marker = styles[str(family)]
        sizes, values, errors = (ordered[name].to_numpy() for name in ("edge_length", "relative", "relative_error"))
        style = f"{marker}-" if (ordered["level"] >= 0).all() else marker
        axes.loglog(sizes, values, style, color=color, label=escaped(str(family)), markersize=4, linewidth=1.2)
        axes.errorbar(sizes, values, yerr=error_bars(values, errors), fmt="none", ecolor=color, elinewidth=0.8)
    if len(frame):
        _draw_slope(axes, frame["edge_length"].to_numpy(), frame["relative"].to_numpy())
        add_legend(axes)
    axes.set_title(f"order {order:g}")
    axes.set_xlabel("mean edge length in the study's unit")
    axes.set_ylabel("relative Sobolev distance")
    axes.grid(visible=True, which="major", alpha=0.3)
    return axes


def plot_evolution(
    store: AnyStore, order: float | None = None, ax: Axes | None = None, *, truth: str | None = None
) -> Axes:
    """Plot the distances of moving meshes from the true surface over time, one line for each family.

    The vertical axis is logarithmic; bars show errors, and a dotted line marks the first time at which a new mesh pays.

    Args:
        store: Path, URL or opened DataTree of a store whose meshes have times.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.
        truth: Family of the true surface at the same times; default the study's reference.

    Returns:
        The axes.

    Raises:
        InputError: See `evolution`.

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
    found = evolution(tree, _order_of(tree, order), truth=truth).isel(order=0)
    axes, styles = ax or new_axes(_CONVERGENCE_INCHES), family_styles(tree)
    for family in found["family"].values.tolist():
        rows = found.sel(family=family).dropna("time", subset=["distance"])
        color, marker = styles[family]
        values, errors = rows["distance"].values, rows["error"].values
        axes.semilogy(rows["time"], values, f"{marker}-", color=color, label=escaped(family), markersize=4)
        axes.errorbar(rows["time"], values, yerr=error_bars(values, errors), fmt="none", ecolor=color, elinewidth=0.8)
        if np.isfinite(moment := rows["remesh_time"].item()):
            axes.axvline(moment, color=color, linestyle=":", linewidth=1)
    add_legend(axes)
    axes.set_title(f"order {found['order'].item():g}")
    axes.set_xlabel("time")
    axes.set_ylabel("Sobolev distance")
    axes.grid(visible=True, which="major", alpha=0.3)
    return axes


def plot_transform(store: AnyStore, family: str | None = None, ax: Axes | None = None) -> Axes:
    """Plot the real part of Fourier fields along the positive ξ_x axis, for a family and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        family: Family of meshes, of which up to five are drawn; default the first that has any.
        ax: Axes to draw on.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, or no computed mesh of the family.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_transform("storage/icosphere.zarr")
    >>> [line.get_label() for line in ax.lines]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3', 'reference']
    """
    tree = as_tree(store)
    members, reference = _complete_members(tree), reference_of(tree)
    family = next(iter(members), None) if family is None else family
    if family not in members:
        raise InputError(f"no mesh of the family {family!r} is computed, only of: {', '.join(members) or 'none'}")
    axes = ax or new_axes(_TRANSFORM_INCHES)
    fields = tree["fourier"]["fourier"].sel(xi_y=0, xi_z=0, method="nearest")
    fields = fields.isel(xi_x=slice(fields.sizes["xi_x"] // 2, None))
    curves = [(label, "-", 1.0) for label in spread(members[family], _MOST_CURVES)]
    if reference in complete_meshes(tree):
        curves.append((reference, "k--", 1.2))
    with fields_read(store):
        for label, style, width in curves:
            values = np.real(fields.sel(mesh=label).to_numpy())
            axes.plot(fields["xi_x"], values, style, linewidth=width, label=escaped(label))
    axes.set_xlabel("ξ_x in cycles per unit length (ξ_y = ξ_z = 0)")
    axes.set_ylabel("Re of the transform")
    axes.legend(frameon=False, fontsize="small")
    axes.grid(visible=True, alpha=0.3)
    return axes


def plot_matrix(store: AnyStore, order: float | None = None, ax: Axes | None = None) -> Axes:
    """Plot the distances of all pairs as a heat map, with similar meshes beside each other.

    Colours are on a logarithmic scale. Up to 300 meshes are drawn: the first ones and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar too.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_matrix("storage/icosphere.zarr", order=-10)
    >>> len(ax.get_yticklabels())
    5
    """
    tree = as_tree(store)
    matrix = _matrix_of(tree, order)
    axes = ax or new_axes(_MATRIX_INCHES)
    arrangement = clustered_order(matrix.values)
    values = matrix.values[np.ix_(arrangement, arrangement)]
    positive = values[values > 0]
    axes.set_title(f"Sobolev distance of order {matrix.order:g}{_omission(tree, matrix)}")
    if not positive.size:
        axes.text(0.5, 0.5, "no two meshes differ", ha="center")
        axes.set_axis_off()
        return axes
    norm = LogNorm(positive.min(), positive.max())
    image = axes.imshow(np.ma.masked_less_equal(values, 0), norm=norm, cmap="viridis", aspect="equal")
    axes.figure.colorbar(image, ax=axes, shrink=0.8, label="distance in the study's unit")
    labels = [shortened(matrix.labels[i]) for i in arrangement]
    size = float(np.clip(240 / len(labels), 4, 8))
    if len(labels) <= _MOST_TICKS:
        axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=size)
        axes.set_yticks(range(len(labels)), labels, fontsize=size)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(f"{len(labels)} meshes, similar ones beside each other")
    hide_frame(axes)
    return axes


def plot_map(store: AnyStore, order: float | None = None, ax: Axes | None = None) -> Axes:
    """Plot the meshes as points of a plane whose distances approximate the Sobolev distances.

    The plane shows most of the meshes' variance (classical scaling); distances in it are never larger than the true
    ones. Up to 300 meshes are drawn: the first ones and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_map("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['icosphere', 'reference']
    """
    tree = as_tree(store)
    matrix, reference = _matrix_of(tree, order), reference_of(tree)
    styles, family_of = family_styles(tree), families_of(tree)
    axes = ax or new_axes(_MAP_INCHES)
    embedding = Embedding.of(matrix.values)
    families = [family_of[label] for label in matrix.labels]
    for family in dict.fromkeys(families):
        chosen = [i for i, label in enumerate(matrix.labels) if families[i] == family and label != reference]
        if chosen:
            color, marker = styles[family]
            axes.plot(*embedding.points[chosen].T, marker, color=color, label=escaped(family), markersize=5, alpha=0.85)
    center = matrix.labels.index(reference) if reference in matrix.labels else None
    if center is not None:
        axes.plot(*embedding.points[center], "*", color="black", markersize=12, label=escaped(reference))
    for i in _legible(embedding.points, first=center or 0):
        if i != center:
            name = shortened(matrix.labels[i].partition("/")[2] or matrix.labels[i])
            axes.annotate(name, embedding.points[i], (5, 4), textcoords="offset points", fontsize=7, alpha=0.8)
    explained = "" if np.isnan(embedding.explained) else f", {embedding.explained:.0%} of the variance"
    axes.set_title(f"map at order {matrix.order:g}{explained}{_omission(tree, matrix)}", fontsize="medium")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.grid(visible=True, alpha=0.3)
    axes.set_xlabel("in the unit of distances")
    if matrix.labels:
        add_legend(axes)
    return axes


def write_plots(tree: xr.DataTree, folder: str | Path) -> tuple[Path, ...]:
    """Write the plots of an open store into a folder, with a panel for each order or family.

    The files are convergence.png, transform.png, spectrum.png and energy.png, which has one panel; where the study asks
    for the distances of all pairs, matrix.png and map.png too, and where meshes have times, over-time.png.

    Returns:
        Paths of the pictures.

    Raises:
        InputError: The store has no tables yet.
        StoreError: The folder cannot be written.
    """
    orders = chosen_orders(finished_group(tree, "convergence"), None)
    figures = {"convergence.png": convergence_figure(tree, orders)}
    if has_times(tree):
        figures["over-time.png"] = evolution_figure(tree, orders)
    if families := list(_complete_members(tree)):
        figures["transform.png"] = panels(families, _TRANSFORM_INCHES, partial(plot_transform, tree))
    if has_pairs(tree):
        figures |= {"matrix.png": matrix_figure(tree, orders), "map.png": map_figure(tree, orders)}
    if "similarity" in tree.attrs and (spectra := Spectra.of(tree)) is not None:
        figures |= {"spectrum.png": spectrum_figure(spectra, orders), "energy.png": energy_figure(tree, spectra)}
    return write_figures(figures, Path(folder))


def convergence_figure(tree: xr.DataTree, orders: Sequence[float]) -> Figure:
    """Return `plot_convergence` for each order."""
    return panels(orders, _CONVERGENCE_INCHES, partial(plot_convergence, tree))


def evolution_figure(tree: xr.DataTree, orders: Sequence[float]) -> Figure:
    """Return `plot_evolution` for each order."""
    return panels(orders, _CONVERGENCE_INCHES, partial(plot_evolution, tree))


def matrix_figure(tree: xr.DataTree, orders: Sequence[float]) -> Figure:
    """Return `plot_matrix` for each order."""
    return panels(orders, _MATRIX_INCHES, partial(plot_matrix, tree))


def map_figure(tree: xr.DataTree, orders: Sequence[float]) -> Figure:
    """Return `plot_map` for each order."""
    return panels(orders, _MAP_INCHES, partial(plot_map, tree))


def has_pairs(tree: xr.DataTree) -> bool:
    """Return True if the store has the distances of all pairs of meshes."""
    return "distances" in tree.children and tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]


def _order_of(tree: xr.DataTree, order: float | None) -> float:
    return chosen_orders(finished_group(tree, "convergence"), order)[0]


def _matrix_of(tree: xr.DataTree, order: float | None) -> Matrix:
    matrix = Matrix.of(tree, _order_of(tree, order), MOST_MESHES)
    if matrix is None:
        raise InputError(
            'the store has distances to the reference alone; set pairs = "all" in [norm] and run the study again'
        )
    return matrix


def _complete_members(tree: xr.DataTree) -> dict[str, list[str]]:
    """Return the computed meshes of each family that has any besides the reference."""
    reference, family_of = reference_of(tree), families_of(tree)
    members: dict[str, list[str]] = {}
    for label in complete_meshes(tree):
        if label != reference:
            members.setdefault(family_of[label], []).append(label)
    return members


def _draw_slope(axes: Axes, sizes: np.ndarray, errors: np.ndarray) -> None:
    """Draw a line of second order through the geometric mean of the points."""
    span = np.array([sizes.min(), sizes.max()])
    mean_size, mean_error = np.exp(np.log(sizes).mean()), np.exp(np.log(errors).mean())
    axes.loglog(span, mean_error * (span / mean_size) ** 2, "k:", linewidth=1, label="slope 2")


def _legible(points: np.ndarray, first: int) -> list[int]:
    """Return points that are far enough from each other for their names to be read."""
    kept: list[int] = []
    apart = _NAMES_APART * np.ptp(points, axis=0).max(initial=0.0)
    for i in sorted(range(len(points)), key=lambda i: i != first):
        if all(np.linalg.norm(points[i] - points[j]) > apart for j in kept):
            kept.append(i)
    return kept


def _omission(tree: xr.DataTree, matrix: Matrix) -> str:
    total = len(complete_meshes(tree))
    return f"\nthe first {len(matrix.labels)} of {total} meshes" if len(matrix.labels) < total else ""
