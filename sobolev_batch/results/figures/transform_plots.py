"""Plots of Fourier fields along a frequency axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.legends import add_legend
from sobolev_batch.results.figures.pictures import panels
from sobolev_batch.results.figures.spectra import spread
from sobolev_batch.results.figures.style import Size, escaped, new_axes, set_title, shortened, style_of, vertical_label
from sobolev_batch.results.open import AnyStore, as_tree, fields_read
from sobolev_batch.results.tables.groups import (
    Families,
    chosen_families,
    complete_meshes,
    families_of,
    reference_of,
)

_HEIGHT_INCHES = 3.4
_MOST_CURVES = 5
# Families in a picture.
_MOST_PANELS = 8


def plot_transform(store: AnyStore, family: Families = None, ax: Axes | None = None) -> Axes:
    """Plot the real part of Fourier fields along the positive ξ_x axis, for some meshes and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        family: Families of meshes, by names or globs, of which up to five are drawn; default the first family that has
            any.
        ax: Axes to draw on.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, lacks a family, or has no computed mesh of it.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_transform("storage/icosphere.zarr")
    >>> [line.get_label() for line in ax.lines]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3', 'reference']
    """
    tree = as_tree(store)
    members = _members(tree, family)
    chosen = list(members)[:1] if family is None else list(members)
    if not chosen:
        raise InputError(f"no mesh of the family is computed, only of: {', '.join(_members(tree, None)) or 'none'}")
    axes = ax or new_axes(_HEIGHT_INCHES)
    with fields_read(store):
        _draw_transform(tree, [label for name in chosen for label in members[name]], ", ".join(chosen), axes)
    add_legend(axes, may_grow=ax is None)
    return axes


def transform_figure(tree: xr.DataTree, family: Families = None, size: Size | None = None) -> Figure | None:
    """Return `plot_transform` for each family, up to eight of them; None where no mesh is computed."""
    members = _members(tree, family)
    if not members:
        return None
    chosen = spread(list(members), _MOST_PANELS)

    def draw(name: str, axes: Axes) -> None:
        omission = f"{len(chosen)} of {len(members)} families" if len(chosen) < len(members) else ""
        _draw_transform(tree, members[name], name, axes, omission if name == chosen[0] else "")
        add_legend(axes)

    return panels(chosen, _HEIGHT_INCHES, draw, size)


def _members(tree: xr.DataTree, family: Families) -> dict[str, list[str]]:
    """Return the computed meshes of each chosen family that has any besides the reference."""
    chosen, reference, family_of = chosen_families(tree, family), reference_of(tree), families_of(tree)
    members: dict[str, list[str]] = {}
    for label in complete_meshes(tree):
        if label != reference and family_of[label] in chosen:
            members.setdefault(family_of[label], []).append(label)
    return members


def _draw_transform(tree: xr.DataTree, labels: Sequence[str], title: str, axes: Axes, note: str = "") -> None:
    fields = tree["fourier"]["fourier"].sel(xi_y=0, xi_z=0, method="nearest")
    fields = fields.isel(xi_x=slice(fields.sizes["xi_x"] // 2, None))
    shown, reference = spread(labels, _MOST_CURVES), reference_of(tree)
    omission = f"{len(shown)} of {len(labels)} meshes" if len(shown) < len(labels) else ""
    for i, label in enumerate(shown):
        values = np.real(fields.sel(mesh=label).to_numpy())
        axes.plot(fields["xi_x"], values, color=style_of(i).color, linewidth=1.0, label=escaped(label))
    if reference in complete_meshes(tree):
        values = np.real(fields.sel(mesh=reference).to_numpy())
        axes.plot(fields["xi_x"], values, "k--", linewidth=1.2, label=escaped(reference))
    set_title(axes, shortened(title, 60), note, omission)
    axes.set_xlabel("ξ_x in cycles per unit length (ξ_y = ξ_z = 0)")
    axes.set_ylabel(vertical_label(axes, "Re of the transform"))
    axes.grid(visible=True, alpha=0.3)
