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
from sobolev_batch.results.figures.spectra import Spectra
from sobolev_batch.results.figures.style import (
    add_legend,
    error_bars,
    escaped,
    family_styles,
    hide_frame,
    new_axes,
    panels,
    shortened,
)
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import chosen_orders, families_of, finished_group

# Smaller fractions are not written into their cells.
_SMALLEST_SHARE = 0.005
_MOST_HORIZONTAL_BANDS = 6
_ENERGY_INCHES = 3.6


def plot_spectrum(store: AnyStore, order: float | None = None, ax: Axes | None = None) -> Axes:
    """Plot the fractions of each mesh's squared distance to the reference by wavelength, as a heat map.

    The field of each mesh is read; up to 24 meshes are drawn, evenly through the study.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar too.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks the order, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_spectrum("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_yticklabels()]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3']
    """
    tree = as_tree(store)
    order = chosen_orders(finished_group(tree, "convergence"), order)[0]
    return draw_spectrum(_spectra_of(store, tree, order), order, ax)


def draw_spectrum(spectra: Spectra, order: float, ax: Axes | None = None) -> Axes:
    """Plot spectra of one order; see `plot_spectrum`."""
    axes = ax or new_axes(spectrum_inches(spectra))
    shares = spectra.shares[:, spectra.orders.index(order)]
    image = axes.imshow(shares, vmin=0, cmap="Blues", aspect="auto")
    axes.figure.colorbar(image, ax=axes, label="fraction of the squared distance", format=PercentFormatter(1.0, 0))
    for (i, j), share in np.ndenumerate(shares):
        if share >= _SMALLEST_SHARE:
            color = "white" if share > 0.6 * np.nanmax(shares) else "black"
            axes.text(j, i, f"{share:.0%}", ha="center", va="center", fontsize=7, color=color)
    # Long labels would run into each other.
    is_turned = len(spectra.bands) > _MOST_HORIZONTAL_BANDS
    rotation, alignment = (20, "right") if is_turned else (0, "center")
    axes.set_xticks(range(len(spectra.bands)), spectra.bands, fontsize=7.5, rotation=rotation, ha=alignment)
    axes.set_yticks(range(len(spectra.labels)), [shortened(label) for label in spectra.labels], fontsize=7.5)
    axes.set_xlabel("wavelength in the study's unit")
    axes.set_title(f"differences by wavelength, order {order:g}")
    hide_frame(axes)
    return axes


def spectrum_inches(spectra: Spectra) -> float:
    """Return the height of a plot of spectra."""
    return 1.6 + 0.24 * len(spectra.labels)


def spectrum_figure(spectra: Spectra, orders: Sequence[float]) -> Figure:
    """Return `plot_spectrum` for each order."""
    return panels(orders, spectrum_inches(spectra), partial(draw_spectrum, spectra))


def plot_energy(store: AnyStore, ax: Axes | None = None) -> Axes:
    """Plot the energy of each mesh's difference from the reference by wavelength, as a fraction of its limit.

    The energy is ∫_{|ξ|=r} |a^ - b^|² dS. For large |ξ| it tends to twice the area of both surfaces, if no parts of
    them coincide. A mesh agrees with the reference at the wavelengths where its line is far below 1. Where the line
    reaches 1, they have nothing in common. Both axes are logarithmic, and long wavelengths are on the left. Bars show
    standard errors. The field of each mesh is read; up to 24 meshes are drawn, evenly through the study.

    Args:
        store: Path, URL or opened DataTree of the store.
        ax: Axes to draw on.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_energy("storage/icosphere.zarr")
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['limit', 'icosphere']
    """
    tree = as_tree(store)
    order = chosen_orders(finished_group(tree, "convergence"), None)[0]
    return draw_energy(tree, _spectra_of(store, tree, order), ax)


def draw_energy(tree: xr.DataTree, spectra: Spectra, ax: Axes | None = None) -> Axes:
    """Plot the energies of spectra; see `plot_energy`."""
    axes = ax or new_axes(_ENERGY_INCHES)
    if not (spectra.energies > 0).any():
        axes.text(0.5, 0.5, "no mesh differs from the reference", transform=axes.transAxes, ha="center")
        axes.set_axis_off()
        return axes
    styles, family_of, shown = family_styles(tree), families_of(tree), set[str]()
    for label, energies, errors in zip(spectra.labels, spectra.energies, spectra.energy_errors, strict=True):
        family = family_of[label]
        color, marker = styles[family]
        name = "_" if family in shown else escaped(family)
        shown.add(family)
        axes.errorbar(
            spectra.wavelengths,
            energies,
            error_bars(energies, errors),
            fmt=f"{marker}-",
            color=color,
            label=name,
            markersize=3.5,
            linewidth=1,
            alpha=0.8,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1, label="limit")
    axes.invert_xaxis()
    axes.set_xlabel("wavelength in the study's unit")
    axes.set_ylabel("energy over its limit")
    axes.set_title("energy of the differences from the reference")
    axes.grid(visible=True, which="major", alpha=0.3)
    add_legend(axes)
    return axes


def energy_figure(tree: xr.DataTree, spectra: Spectra) -> Figure:
    """Return `plot_energy` as a figure."""
    return panels([spectra], _ENERGY_INCHES, partial(draw_energy, tree))


def _spectra_of(store: AnyStore, tree: xr.DataTree, order: float) -> Spectra:
    with fields_read(store):
        spectra = Spectra.of(tree, order)
    if spectra is None:
        raise InputError("the store has no mesh to compare: the reference or all others are not computed")
    return spectra
