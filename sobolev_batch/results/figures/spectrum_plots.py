"""Plots of Fourier fields, and of the differences from the reference by wavelength."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from sobolev_batch.results.figures.selection import Selection, spread
from sobolev_batch.results.figures.style import (
    Reals,
    draw_curve,
    hide_frame,
    inches,
    set_log_scale,
    set_title,
    shortened,
    style_of,
)
from sobolev_batch.results.tables.groups import complete_meshes, families_of, reference_of

# Smaller fractions are not written into their cells.
_SMALLEST_SHARE = 0.005
_MOST_HORIZONTAL_BANDS = 6
# Points of the largest font of labels and of shares, and of the smallest that can be read.
_LABEL_POINTS, _SHARE_POINTS, _SMALLEST_POINTS = 7.5, 7.0, 4.0
# Meshes and families in pictures of transforms.
_MOST_CURVES, _MOST_PANELS = 5, 8


def draw_spectrum(selection: Selection, order: float, axes: Axes) -> None:
    """Draw the fractions of each squared distance to the reference by wavelength, as a heat map."""
    spectra, (width, height) = selection.spectra, inches(axes)
    shares = spectra.shares[:, spectra.orders.index(order)]
    image = axes.imshow(shares, vmin=0, cmap="Blues", aspect="auto")
    bar = axes.figure.colorbar(image, ax=axes, format=PercentFormatter(1.0, 0))
    bar.set_label("fraction of the\nsquared distance", fontsize="small")
    row_points, column_points = 72 * 0.8 * height / len(shares), 72 * 0.85 * width / len(spectra.bands)
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
    labels = [shortened(label) for label in spectra.labels]
    axes.set_yticks(range(len(labels)), labels, fontsize=min(_LABEL_POINTS, row_points))
    axes.set_xlabel("wavelength in the study's unit")
    set_title(axes, f"differences by wavelength, order {order:g}", spectra.omission)
    hide_frame(axes)


def _write_shares(axes: Axes, row: int, fractions: Reals, dark: float, font: float) -> None:
    """Write fractions into their cells; those above a limit are on dark cells."""
    for column, fraction in enumerate(fractions):
        if fraction >= _SMALLEST_SHARE:
            color = "white" if fraction > dark else "black"
            axes.text(column, row, f"{fraction:.0%}", ha="center", va="center", fontsize=font, color=color)


def draw_energy(selection: Selection, _item: object, axes: Axes) -> None:
    """Draw the energy of each difference from the reference by wavelength, as a fraction of its limit."""
    spectra = selection.spectra
    is_equal = ~(spectra.energies > 0).any(axis=1)
    equal = f"not drawn: {is_equal.sum()} equal to the reference" if is_equal.any() else ""
    set_title(axes, "energy of the differences from the reference", spectra.omission, equal)
    if is_equal.all():
        axes.text(0.5, 0.5, "no mesh differs from the reference", transform=axes.transAxes, ha="center")
        axes.set_axis_off()
        return
    family_of, named = families_of(selection.tree), set[str]()
    set_log_scale(axes, "xy")
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1, label="limit")
    for label, energies, errors in zip(spectra.labels, spectra.energies, spectra.energy_errors, strict=True):
        family, drawn = family_of[label], energies > 0
        if drawn.any():
            # One entry of the legend for each family.
            name = "_" if family in named else shortened(family)
            draw_curve(axes, spectra.wavelengths[drawn], energies[drawn], errors[drawn], selection.styles[family], name)
            named.add(family)
    axes.invert_xaxis()
    axes.set_xlabel("wavelength in the study's unit")
    axes.set_ylabel("energy over its limit")


def computed_members(selection: Selection) -> dict[str, list[str]]:
    """Return the computed meshes of each chosen family that has any besides the reference."""
    tree, chosen = selection.tree, selection.families
    reference, family_of = reference_of(tree), families_of(tree)
    members: dict[str, list[str]] = {}
    for label in complete_meshes(tree):
        if label != reference and family_of[label] in chosen:
            members.setdefault(family_of[label], []).append(label)
    return members


def transform_panels(selection: Selection) -> list[list[str]]:
    """Return the families of each panel: one, for up to eight of them."""
    return [[name] for name in spread(list(computed_members(selection)), _MOST_PANELS)]


def draw_transform(selection: Selection, families: Sequence[str], axes: Axes) -> None:
    """Draw the real part of some fields of families, and of the reference, along the positive ξ_x axis."""
    tree, members = selection.tree, computed_members(selection)
    labels = [label for name in families for label in members[name]]
    fields = tree["fourier"]["fourier"].sel(xi_y=0, xi_z=0, method="nearest")
    fields = fields.isel(xi_x=slice(fields.sizes["xi_x"] // 2, None))
    shown, reference = spread(labels, _MOST_CURVES), reference_of(tree)
    omission = f"{len(shown)} of {len(labels)} meshes" if len(shown) < len(labels) else ""
    for i, label in enumerate(shown):
        values = np.real(fields.sel(mesh=label).to_numpy())
        axes.plot(fields["xi_x"], values, color=style_of(i).color, linewidth=1.0, label=shortened(label))
    if reference in complete_meshes(tree):
        values = np.real(fields.sel(mesh=reference).to_numpy())
        axes.plot(fields["xi_x"], values, "k--", linewidth=1.2, label=shortened(reference))
    panels = transform_panels(selection)
    is_first = list(families) == panels[0] and len(panels) < len(members)
    note = f"{len(panels)} of {len(members)} families" if is_first else ""
    set_title(axes, shortened(", ".join(families), 60), note, omission)
    axes.legend(fontsize="small", loc="upper right")
    axes.set_xlabel("ξ_x in cycles per unit length (ξ_y = ξ_z = 0)")
    axes.set_ylabel("Re of the transform")
    axes.grid(visible=True, alpha=0.3)
