"""Pictures of a store: convergence, transforms along one frequency axis, distance matrices, maps of the meshes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter, ScalarFormatter

from sobolev_batch.errors import InputError, StoreError
from sobolev_batch.results.figures.embedding import Map, alike_together
from sobolev_batch.results.figures.spectra import Wavelengths
from sobolev_batch.results.meshes.render import Pictures, render, scales
from sobolev_batch.results.meshes.views import PICTURES, Axis, Portrait, make_gallery
from sobolev_batch.results.tables.convergence import chosen_orders, convergence_frame, finished_group
from sobolev_batch.results.tables.matrix import Matrix
from sobolev_batch.surfaces.sources.names import file_stem

# P. Tol, "Colour schemes" (2021), "bright": told apart with every kind of colour vision. The report has them too.
COLORS = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#777777")
_MARKERS = "osD^vPX"
_WIDTH_INCHES = 6.4
# Of a mesh.
_HEIGHT_INCHES = 5.0
_MOST_CURVES = 5
# In matrices and on maps.
MOST_MESHES = 300
_MOST_TICKS = 40
_LONGEST_LABEL = 24
# Of the width of a map.
_NAMES_APART = 0.08
_LEGEND_ENTRIES = 12
# Smaller ones are not written into their cells.
_SMALLEST_SHARE = 0.005
_MOST_BANDS_LEVEL = 6
# Of a mesh, one for each of its first orders.
MOST_VIEWS = 6
_VIEWS_ABREAST = 3
# Meshes in one picture.
_MOST_ABREAST = 9


def plot_store(tree: xr.DataTree, folder: str | Path) -> tuple[Path, ...]:
    """Draw the pictures of an open store into a folder.

    convergence.png, transform.png and spectrum.png; where the study asks for the
    distances of all pairs, matrix.png and map.png too.

    Returns:
        The paths of the pictures.

    Raises:
        InputError: the store has no tables yet.
        StoreError: the folder cannot be written.
    """
    folder = Path(folder)
    pictures = {"convergence.png": convergence_figure(tree), "transform.png": transform_figure(tree)}
    if "distances" in tree.children and tree["distances"].sizes["mesh"] == tree["distances"].sizes["other"]:
        pictures |= {"matrix.png": matrix_figure(tree), "map.png": map_figure(tree)}
    if "similarity" in tree.attrs and (spectra := Wavelengths.of_store(tree)) is not None:
        pictures["spectrum.png"] = spectrum_figure(spectra, spectra.orders)
    return _write(pictures, folder)


def plot_witnesses(
    tree: xr.DataTree,
    output: str | Path,
    folder: str | Path = ".",
    wanted: Sequence[str] = (),
    up: Axis = "z",
) -> tuple[tuple[Path, ...], Mapping[str, str]]:
    """Draw meshes of an open store, coloured by their witness functions, into a folder.

    Each as witness-*.png with colours of its own; several also beside each other in witness.png, on one scale of
    colours, at the study's first order.

    Args:
        tree: an open store with tables.
        output: the folder of the pictures.
        folder: where relative paths in the study start; meshes are made again by it.
        wanted: labels; by default those that `make_gallery` chooses.
        up: the axis that points upwards in the meshes' own coordinates.

    Returns:
        The paths of the pictures, and for each mesh without one the reason.

    Raises:
        InputError: a label that the store does not have, or too many.
        StoreError: the folder cannot be written.
    """
    gallery = make_gallery(tree, tree.attrs["study"]["table"], folder, wanted, PICTURES, up)
    numbers = {label: i for i, label in enumerate(finished_group(tree, "meshes")["mesh"].values.tolist())}
    abreast = gallery.portraits[:_MOST_ABREAST]
    try:
        rendered = render(gallery.portraits, MOST_VIEWS)
        on_one_scale = render(abreast, 1, common=True)
    except InputError as error:
        return (), {**gallery.absent, **{portrait.label: str(error) for portrait in gallery.portraits}}
    figures = {
        f"witness-{file_stem(numbers[portrait.label], portrait.label)}.png": witness_figure(portrait, pictures)
        for portrait, pictures in zip(gallery.portraits, rendered, strict=True)
    }
    if len(abreast) > 1:
        figures["witness.png"] = witnesses_figure(abreast, [pictures[0] for pictures in on_one_scale])
    return _write(figures, Path(output)), gallery.absent


def _write(figures: Mapping[str, Figure], folder: Path) -> tuple[Path, ...]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            save(figure, folder / name)
    except OSError as error:
        raise StoreError(f"{folder}: pictures cannot be written there: {error.strerror or error}") from error
    return tuple(folder / name for name in figures)


def save(figure: Figure, target: object, **options: object) -> None:
    """Write a picture; characters that its font lacks become boxes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(target, dpi=150, **options)  # type: ignore[arg-type]


def convergence_figure(tree: xr.DataTree, orders: Sequence[float] | None = None) -> Figure:
    """Relative distance to the reference against mean edge length, one panel per order."""
    frame = convergence_frame(tree, orders)
    styles = _styles(tree)
    orders = list(dict.fromkeys(frame["order"]))
    figure = Figure(figsize=(_WIDTH_INCHES, 3.6 * len(orders)), layout="constrained")
    panels = figure.subplots(len(orders), 1, squeeze=False)[:, 0]
    for axes, order in zip(panels, orders, strict=True):
        chosen = frame[(frame["order"] == order) & (frame["relative"] > 0) & frame["edge_length"].notna()]
        for family, line in chosen.groupby("family", sort=False):
            ordered = line.sort_values("edge_length")
            color, marker = styles[str(family)]
            sizes, values, errors = (ordered[name].to_numpy() for name in ("edge_length", "relative", "relative_error"))
            style = f"{marker}-" if (ordered["level"] >= 0).all() else marker
            axes.loglog(sizes, values, style, color=color, label=_plain(str(family)), markersize=4, linewidth=1.2)
            axes.errorbar(sizes, values, yerr=_reach(values, errors), fmt="none", ecolor=color, elinewidth=0.8)
        if len(chosen):
            _draw_slope(axes, chosen["edge_length"].to_numpy(), chosen["relative"].to_numpy())
            _legend(axes)
        axes.set_title(f"order {order:g}")
        axes.set_xlabel("mean edge length in the study's unit")
        axes.set_ylabel("relative Sobolev distance")
        axes.grid(visible=True, which="major", alpha=0.3)
    return figure


def transform_figure(tree: xr.DataTree) -> Figure:
    """The real part of transforms along the positive ξ_x axis, reference and the levels of each family."""
    fields = tree["fourier"]["fourier"]
    meshes = tree["meshes"].to_dataset().load()
    reference = tree["convergence"].attrs["reference"]
    complete = meshes["status"].values == "complete"
    families = [
        family
        for family in dict.fromkeys(meshes["family"].values.tolist())
        if np.any(complete & (meshes["family"].values == family) & (meshes["mesh"].values != reference))
    ]
    figure = Figure(figsize=(_WIDTH_INCHES, 3.4 * max(1, len(families))), layout="constrained")
    panels = figure.subplots(max(1, len(families)), 1, squeeze=False)[:, 0]
    along = fields.sel(xi_y=0, xi_z=0, method="nearest")
    along = along.isel(xi_x=slice(fields.sizes["xi_x"] // 2, None))
    for axes, family in zip(panels, families, strict=False):
        rows = np.flatnonzero(complete & (meshes["family"].values == family) & (meshes["mesh"].values != reference))
        spread = np.unique(np.linspace(0, len(rows) - 1, min(_MOST_CURVES, len(rows))).round().astype(int))
        for row in rows[spread]:
            values = np.real(along.isel(mesh=int(row)).to_numpy())
            axes.plot(along["xi_x"], values, linewidth=1, label=_plain(str(meshes["mesh"].values[row])))
        place = meshes["mesh"].values.tolist().index(reference)
        if complete[place]:
            values = np.real(along.isel(mesh=place).to_numpy())
            axes.plot(along["xi_x"], values, "k--", linewidth=1.2, label=_plain(str(reference)))
        axes.set_xlabel("ξ_x in cycles per unit length (ξ_y = ξ_z = 0)")
        axes.set_ylabel("Re of the transform")
        axes.legend(frameon=False, fontsize="small")
        axes.grid(visible=True, alpha=0.3)
    return figure


def matrix_figure(tree: xr.DataTree, orders: Sequence[float] | None = None) -> Figure:
    """The distances of all pairs, one panel per order, meshes that are alike beside each other."""
    matrices = _matrices(tree, orders)
    figure = Figure(figsize=(_WIDTH_INCHES, 5.6 * len(matrices)), layout="constrained")
    panels = figure.subplots(len(matrices), 1, squeeze=False)[:, 0]
    for axes, matrix in zip(panels, matrices, strict=True):
        arranged = alike_together(matrix.values)
        values = matrix.values[np.ix_(arranged, arranged)]
        seen = values[values > 0]
        axes.set_title(f"Sobolev distance of order {matrix.order:g}{_cut(tree, matrix)}")
        if not seen.size:
            axes.text(0.5, 0.5, "no two meshes differ", ha="center")
            axes.set_axis_off()
            continue
        image = axes.imshow(
            np.ma.masked_less_equal(values, 0), norm=LogNorm(seen.min(), seen.max()), cmap="viridis", aspect="equal"
        )
        figure.colorbar(image, ax=axes, shrink=0.8, label="distance in the study's unit")
        labels = [_plain(_shortened(matrix.labels[i])) for i in arranged]
        size = float(np.clip(240 / len(labels), 4, 8))
        if len(labels) <= _MOST_TICKS:
            axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=size)
            axes.set_yticks(range(len(labels)), labels, fontsize=size)
        else:
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_xlabel(f"{len(labels)} meshes, those that are alike beside each other")
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    return figure


def map_figure(tree: xr.DataTree, orders: Sequence[float] | None = None) -> Figure:
    """The meshes as points whose distances are nearly the Sobolev distances, one panel per order."""
    matrices = _matrices(tree, orders)
    styles, family_of = _styles(tree), _families(tree)
    reference = tree["convergence"].attrs["reference"]
    figure = Figure(figsize=(_WIDTH_INCHES, 4.4 * len(matrices)), layout="constrained")
    panels = figure.subplots(len(matrices), 1, squeeze=False)[:, 0]
    for axes, matrix in zip(panels, matrices, strict=True):
        found = Map.of(matrix.values)
        families = [family_of[label] for label in matrix.labels]
        for family in dict.fromkeys(families):
            chosen = [i for i, label in enumerate(matrix.labels) if families[i] == family and label != reference]
            if chosen:
                color, marker = styles[family]
                axes.plot(*found.places[chosen].T, marker, color=color, label=_plain(family), markersize=5, alpha=0.85)
        if reference in matrix.labels:
            place = found.places[matrix.labels.index(reference)]
            axes.plot(*place, "*", color="black", markersize=12, label=_plain(reference))
        for i in _spread(found.places, first=matrix.labels.index(reference) if reference in matrix.labels else 0):
            if matrix.labels[i] == reference:
                continue
            name = matrix.labels[i].partition("/")[2] or matrix.labels[i]
            axes.annotate(
                _plain(_shortened(name)), found.places[i], (5, 4), textcoords="offset points", fontsize=7, alpha=0.8
            )
        share = "" if np.isnan(found.share) else f", {found.share:.0%} of the variance"
        axes.set_title(f"map of the meshes at order {matrix.order:g}{share}{_cut(tree, matrix)}", fontsize="medium")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.1)
        axes.grid(visible=True, alpha=0.3)
        axes.set_xlabel("in the unit of distances")
        if matrix.labels:
            _legend(axes)
    return figure


def spectrum_figure(spectra: Wavelengths, orders: Sequence[float]) -> Figure:
    """Which part of each mesh's squared distance lies at which wavelengths, one panel per order."""
    height = 1.6 + 0.24 * len(spectra.labels)
    figure = Figure(figsize=(_WIDTH_INCHES, height * len(orders)), layout="constrained")
    labels = [_plain(_shortened(label)) for label in spectra.labels]
    for axes, order in zip(figure.subplots(len(orders), 1, squeeze=False)[:, 0], orders, strict=True):
        shares = spectra.shares[:, spectra.orders.index(order)]
        image = axes.imshow(shares, vmin=0, cmap="Blues", aspect="auto")
        figure.colorbar(image, ax=axes, label="share of the squared distance", format=PercentFormatter(1.0, 0))
        for (i, j), share in np.ndenumerate(shares):
            if share >= _SMALLEST_SHARE:
                color = "white" if share > 0.6 * np.nanmax(shares) else "black"
                axes.text(j, i, f"{share:.0%}", ha="center", va="center", fontsize=7, color=color)
        # Long ones would run into each other.
        turned = {"rotation": 20, "ha": "right"} if len(spectra.bands) > _MOST_BANDS_LEVEL else {}
        axes.set_xticks(range(len(spectra.bands)), spectra.bands, fontsize=7.5, **turned)
        axes.set_yticks(range(len(labels)), labels, fontsize=7.5)
        axes.set_xlabel("wavelength in the study's unit")
        axes.set_title(f"where the differences lie, order {order:g}")
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    return figure


def witness_figure(portrait: Portrait, pictures: Pictures) -> Figure:
    """A mesh seen from one side, coloured by its witness function, one panel per order that was rendered."""
    columns = min(_VIEWS_ABREAST, len(pictures))
    rows = -(-len(pictures) // columns)
    _, high, wide, _ = pictures.shape
    # Below each panel its colours, above all of them the name of the mesh.
    panel = min(_WIDTH_INCHES / columns, _HEIGHT_INCHES * wide / high)
    figure = Figure(figsize=(_WIDTH_INCHES, 0.3 + rows * (0.7 + panel * high / wide)), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    (limits,) = scales([portrait], common=False)
    for axes, order, largest, picture in zip(panels, portrait.orders, limits, pictures, strict=False):
        axes.imshow(picture)
        _draw_scale(figure, axes, largest, order)
    figure.suptitle(_plain(portrait.label), fontsize="medium")
    return figure


def witnesses_figure(portraits: Sequence[Portrait], pictures: Sequence[np.ndarray]) -> Figure:
    """Meshes beside each other, coloured by their witness functions of the first order on one scale."""
    columns = min(_VIEWS_ABREAST, len(portraits))
    rows = -(-len(portraits) // columns)
    tallest = max(picture.shape[0] / picture.shape[1] for picture in pictures)
    size = (_WIDTH_INCHES, 0.8 + rows * (0.3 + tallest * _WIDTH_INCHES / columns))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.set_axis_off()
    for axes, portrait, picture in zip(panels.ravel(), portraits, pictures, strict=False):
        axes.imshow(picture)
        axes.set_title(f"{_plain(_shortened(portrait.label))}\n{portrait.whole:,} triangles", fontsize="small")
    _draw_scale(figure, panels, scales(portraits, common=True)[0][0], portraits[0].orders[0])
    return figure


def _draw_scale(figure: Figure, panels: Axes | np.ndarray, largest: float, order: float) -> None:
    """What the colours of one panel or of all mean."""
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


def _draw_slope(axes: Axes, sizes: np.ndarray, errors: np.ndarray) -> None:
    """A line of second order through the geometric middle of the points."""
    span = np.array([sizes.min(), sizes.max()])
    middle_size, middle_error = np.exp(np.log(sizes).mean()), np.exp(np.log(errors).mean())
    axes.loglog(span, middle_error * (span / middle_size) ** 2, "k:", linewidth=1, label="slope 2")


def _spread(places: np.ndarray, first: int) -> list[int]:
    """Points that are far enough from each other for their names to be read."""
    kept: list[int] = []
    apart = _NAMES_APART * np.ptp(places, axis=0).max(initial=0.0)
    for i in sorted(range(len(places)), key=lambda i: i != first):
        if all(np.linalg.norm(places[i] - places[j]) > apart for j in kept):
            kept.append(i)
    return kept


def _reach(values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """How far error bars go down and up; on a logarithmic axis not below zero."""
    known = np.nan_to_num(errors)
    return np.stack([np.minimum(known, 0.999 * values), known])


def _matrices(tree: xr.DataTree, orders: Sequence[float] | None) -> list[Matrix]:
    chosen = chosen_orders(finished_group(tree, "convergence"), orders)
    return [matrix for order in chosen if (matrix := Matrix.of(tree, order, MOST_MESHES)) is not None]


def _families(tree: xr.DataTree) -> dict[str, str]:
    """The family of each mesh."""
    meshes = tree["meshes"].to_dataset()
    return dict(zip(meshes["mesh"].values.tolist(), meshes["family"].values.tolist(), strict=True))


def _styles(tree: xr.DataTree) -> dict[str, tuple[str, str]]:
    """Colour and marker of each family; only both together are unique where there are many."""
    families = dict.fromkeys(_families(tree).values())
    return {
        family: (COLORS[i % len(COLORS)], _MARKERS[(i + i // len(COLORS)) % len(_MARKERS)])
        for i, family in enumerate(families)
    }


def _cut(tree: xr.DataTree, matrix: Matrix) -> str:
    complete = int(np.count_nonzero(tree["meshes"].to_dataset()["status"].values == "complete"))
    return f"\nthe first {len(matrix.labels)} of {complete} meshes" if len(matrix.labels) < complete else ""


def _legend(axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > _LEGEND_ENTRIES:
        # A longer one would hide the picture.
        kept = _LEGEND_ENTRIES - 1
        labels = [*labels[:kept], f"and {len(labels) - kept} more"]
        handles = handles[: kept + 1]
    axes.legend(handles, labels, frameon=False, fontsize="small")


def _shortened(label: str) -> str:
    """A label cut in its middle: labels of one family differ at their ends."""
    if len(label) <= _LONGEST_LABEL:
        return label
    return f"{label[: _LONGEST_LABEL // 2]}…{label[1 - _LONGEST_LABEL // 2 :]}"


def _plain(text: str) -> str:
    """A name as matplotlib shows it unchanged: dollars would begin a formula, a leading underscore hides it."""
    return re.sub(r"^_", "\u2009_", text.replace("$", r"\$"))
