"""Plots of spectra: shares of the squared distances by wavelength, and the energy of the differences."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.legends import add_legend
from sobolev_batch.results.figures.pictures import panels
from sobolev_batch.results.figures.spectra import MOST_MESHES, Spectra, spread
from sobolev_batch.results.figures.style import (
    Reals,
    Size,
    draw_error_bars,
    escaped,
    family_styles,
    hide_frame,
    inches,
    new_axes,
    set_title,
    shortened,
    vertical_label,
)
from sobolev_batch.results.figures.ticks import set_log_ticks
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import Families, chosen_order, families_of

# Smaller fractions are not written into their cells.
_SMALLEST_SHARE = 0.005
_MOST_HORIZONTAL_BANDS = 6
_ENERGY_INCHES = 3.6
# Heights of title, wavelengths and their label, and of a row.
_FRAME_INCHES, _ROW_INCHES, _LOWEST_ROW_INCHES = 1.6, 0.24, 0.1
# Points of the largest font of labels and of shares, and of the smallest that can be read.
_LABEL_POINTS, _SHARE_POINTS, _SMALLEST_POINTS = 7.5, 7.0, 4.0


def plot_spectrum(
    store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None
) -> Axes:
    """Plot the fractions of each mesh's squared distance to the reference by wavelength, as a heat map.

    The field of each mesh is read; up to 24 meshes are drawn, evenly through each family, and fewer on axes that are
    too low for them. The title says so.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar too.
        family: Families to draw, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_spectrum("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_yticklabels()]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3']
    """
    tree = as_tree(store)
    order = chosen_order(tree, order)
    spectra = _spectra_of(store, tree, order, family)
    axes = ax or new_axes(_spectrum_inches(spectra))
    _draw_spectrum(spectra, order, axes)
    return axes


def spectrum_figure(spectra: Spectra, orders: Sequence[float], size: Size | None = None) -> Figure:
    """Return `plot_spectrum` for each order."""
    return panels(orders, _spectrum_inches(spectra), partial(_draw_spectrum, spectra), size)


def _spectrum_inches(spectra: Spectra) -> float:
    return _FRAME_INCHES + _ROW_INCHES * len(spectra.labels)


def _draw_spectrum(spectra: Spectra, order: float, axes: Axes) -> None:
    width, height = inches(axes)
    room = max(height - _FRAME_INCHES / 2, 0.3 * height)
    rows = spread(range(len(spectra.labels)), max(2, int(room / _LOWEST_ROW_INCHES)))
    shares = spectra.shares[rows, spectra.orders.index(order)]
    image = axes.imshow(shares, vmin=0, cmap="Blues", aspect="auto")
    bar = axes.figure.colorbar(image, ax=axes, format=PercentFormatter(1.0, 0))
    bar.set_label("fraction of the\nsquared distance", fontsize="small")
    row_points, column_points = 72 * room / len(rows), 72 * 0.85 * width / len(spectra.bands)
    font = min(_SHARE_POINTS, 0.75 * row_points, 0.4 * column_points)
    for i, fractions in enumerate(shares):
        if np.isnan(fractions).all():
            middle = (len(fractions) - 1) / 2
            axes.text(middle, i, "equal to the reference", ha="center", va="center", fontsize=font)
        elif font >= _SMALLEST_POINTS:
            _write_shares(axes, i, fractions, 0.6 * np.nanmax(shares), font)
    # Long labels would run into each other.
    is_turned = len(spectra.bands) > _MOST_HORIZONTAL_BANDS or column_points < 0.6 * _LABEL_POINTS * max(
        map(len, spectra.bands)
    )
    rotation, alignment = (40, "right") if is_turned else (0, "center")
    axes.set_xticks(
        range(len(spectra.bands)),
        spectra.bands,
        fontsize=_LABEL_POINTS,
        rotation=rotation,
        ha=alignment,
        rotation_mode="anchor" if is_turned else "default",
    )
    labels = [shortened(spectra.labels[row]) for row in rows]
    axes.set_yticks(range(len(labels)), labels, fontsize=min(_LABEL_POINTS, row_points))
    axes.set_xlabel("wavelength in the study's unit")
    omission = f"{len(rows)} of {spectra.total} meshes" if len(rows) < spectra.total else ""
    set_title(axes, f"differences by wavelength, order {order:g}", omission)
    hide_frame(axes)


def _write_shares(axes: Axes, row: int, fractions: Reals, dark: float, font: float) -> None:
    """Write fractions into their cells; those above a limit are on dark cells."""
    for column, fraction in enumerate(fractions):
        if fraction >= _SMALLEST_SHARE:
            color = "white" if fraction > dark else "black"
            axes.text(column, row, f"{fraction:.0%}", ha="center", va="center", fontsize=font, color=color)


def plot_energy(store: AnyStore, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the energy of each mesh's difference from the reference by wavelength, as a fraction of its limit.

    The energy is ∫_{|ξ|=r} |a^ - b^|² dS. For large |ξ| it tends to twice the area of both surfaces, if no parts of
    them coincide. A mesh agrees with the reference at the wavelengths where its line is far below 1. Where the line
    reaches 1, they have nothing in common. Both axes are logarithmic, and long wavelengths are on the left. Bars show
    standard errors. The field of each mesh is read; up to 24 meshes are drawn, evenly through each family. The title
    says so.

    Args:
        store: Path, URL or opened DataTree of the store.
        ax: Axes to draw on.
        family: Families to draw, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks a family, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_energy("storage/icosphere.zarr")
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['limit', 'icosphere']
    """
    tree = as_tree(store)
    spectra = _spectra_of(store, tree, chosen_order(tree, None), family)
    axes = ax or new_axes(_ENERGY_INCHES)
    _draw_energy(tree, spectra, axes)
    add_legend(axes, may_grow=ax is None)
    return axes


def energy_figure(tree: xr.DataTree, spectra: Spectra, size: Size | None = None) -> Figure:
    """Return `plot_energy` as a figure."""
    return panels([spectra], _ENERGY_INCHES, partial(_draw_energy, tree), size, shares_legend=True)


def _draw_energy(tree: xr.DataTree, spectra: Spectra, axes: Axes) -> None:
    is_equal = ~(spectra.energies > 0).any(axis=1)
    equal = f"not drawn: {is_equal.sum()} equal to the reference" if is_equal.any() else ""
    set_title(axes, "energy of the differences from the reference", spectra.omission, equal)
    if is_equal.all():
        axes.text(0.5, 0.5, "no mesh differs from the reference", transform=axes.transAxes, ha="center")
        axes.set_axis_off()
        return
    styles, family_of, named = family_styles(tree), families_of(tree), set[str]()
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1, label="limit")
    for label, energies, errors in zip(spectra.labels, spectra.energies, spectra.energy_errors, strict=True):
        family, drawn = family_of[label], energies > 0
        style = styles[family]
        axes.plot(
            spectra.wavelengths[drawn],
            energies[drawn],
            marker=style.marker,
            linestyle=style.dashes,
            color=style.color,
            # One entry of the legend for each family.
            label="_" if family in named else escaped(family),
            markersize=3.5,
            linewidth=1,
            alpha=0.8,
        )
        if drawn.any():
            named.add(family)
            draw_error_bars(axes, spectra.wavelengths[drawn], energies[drawn], errors[drawn], style.color)
    axes.invert_xaxis()
    axes.set_xlabel("wavelength in the study's unit")
    axes.set_ylabel(vertical_label(axes, "energy over its limit"))
    axes.grid(visible=True, which="major", alpha=0.3)
    set_log_ticks(axes.xaxis)
    set_log_ticks(axes.yaxis)


def _spectra_of(store: AnyStore, tree: xr.DataTree, order: float, family: Families) -> Spectra:
    with fields_read(store):
        spectra = Spectra.of(tree, order, MOST_MESHES, family)
    if spectra is None:
        raise InputError("the store has no mesh to compare: the reference or all others are not computed")
    return spectra
