"""Pictures of a store: convergence on log axes, and transforms along one frequency axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sobolev_batch.errors import StoreError
from sobolev_batch.results.tables import convergence_frame

_WIDTH_INCHES = 6.4
_MOST_CURVES = 5


def plot_store(tree: xr.DataTree, folder: str | Path) -> tuple[Path, ...]:
    """Draw convergence.png and transform.png of an open store into a folder.

    Returns:
        The paths of the pictures.

    Raises:
        InputError: the store has no tables yet.
        StoreError: the folder cannot be written.
    """
    folder = Path(folder)
    pictures = {"convergence.png": convergence_figure(tree), "transform.png": transform_figure(tree)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in pictures.items():
            figure.savefig(folder / name, dpi=150)
    except OSError as error:
        raise StoreError(f"{folder}: pictures cannot be written there: {error.strerror or error}") from error
    return tuple(folder / name for name in pictures)


def convergence_figure(tree: xr.DataTree) -> Figure:
    """Relative distance to the reference against mean edge length, one panel per order."""
    frame = convergence_frame(tree)
    orders = list(dict.fromkeys(frame["order"]))
    figure = Figure(figsize=(_WIDTH_INCHES, 3.6 * len(orders)), layout="constrained")
    panels = figure.subplots(len(orders), 1, squeeze=False)[:, 0]
    for axes, order in zip(panels, orders, strict=True):
        chosen = frame[(frame["order"] == order) & (frame["relative"] > 0) & frame["edge_length"].notna()]
        for family, line in chosen.groupby("family", sort=False):
            ordered = line.sort_values("edge_length")
            style = "o-" if (ordered["level"] >= 0).all() else "o"
            axes.loglog(ordered["edge_length"], ordered["relative"], style, label=str(family), markersize=4)
        if len(chosen):
            _draw_slope(axes, chosen["edge_length"].to_numpy(), chosen["relative"].to_numpy())
            axes.legend(frameon=False)
        axes.set_title(f"order {order:g}")
        axes.set_xlabel("mean edge length")
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
            axes.plot(along["xi_x"], values, linewidth=1, label=str(meshes["mesh"].values[row]))
        place = meshes["mesh"].values.tolist().index(reference)
        if complete[place]:
            values = np.real(along.isel(mesh=place).to_numpy())
            axes.plot(along["xi_x"], values, "k--", linewidth=1.2, label=str(reference))
        axes.set_xlabel("ξ_x in cycles per unit length (ξ_y = ξ_z = 0)")
        axes.set_ylabel("Re of the transform")
        axes.legend(frameon=False, fontsize="small")
        axes.grid(visible=True, alpha=0.3)
    return figure


def _draw_slope(axes: Axes, sizes: np.ndarray, errors: np.ndarray) -> None:
    """A line of second order through the geometric middle of the points."""
    span = np.array([sizes.min(), sizes.max()])
    middle_size, middle_error = np.exp(np.log(sizes).mean()), np.exp(np.log(errors).mean())
    axes.loglog(span, middle_error * (span / middle_size) ** 2, "k:", linewidth=1, label="slope 2")
