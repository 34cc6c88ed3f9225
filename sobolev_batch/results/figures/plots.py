"""All plots of a store, written into a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from sobolev_batch.results.figures.convergence_plots import (
    convergence_figure,
    evolution_figure,
    moving_families,
)
from sobolev_batch.results.figures.pair_plots import has_pairs, map_figure, matrix_figure
from sobolev_batch.results.figures.pictures import Output, write_figures
from sobolev_batch.results.figures.spectra import MOST_MESHES, Spectra
from sobolev_batch.results.figures.spectrum_plots import energy_figure, spectrum_figure
from sobolev_batch.results.figures.style import notes_of
from sobolev_batch.results.figures.transform_plots import transform_figure
from sobolev_batch.results.tables.groups import Families, chosen_families, chosen_orders, finished_group
from sobolev_batch.results.tables.sizes import EDGE_LENGTH
from sobolev_batch.spectral.shells import Orders


@dataclass(frozen=True)
class Selection:
    """Choice of what plots show.

    Attributes:
        order: Orders of the norm; default all of the store.
        family: Families, by names or globs; default all.
        x: Horizontal axis of convergence.
    """

    order: Orders | None = None
    family: Families = None
    x: str = EDGE_LENGTH


@dataclass(frozen=True)
class WrittenPlots:
    """Files of plots.

    Attributes:
        paths: Paths of the pictures.
        notes: What each picture leaves out, by its name.
    """

    paths: tuple[Path, ...]
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)


def write_plots(
    tree: xr.DataTree, folder: str | Path, selection: Selection | None = None, output: Output | None = None
) -> WrittenPlots:
    """Write the plots of an open store into a folder, with a panel for each order or family.

    The files are convergence, transform, spectrum and energy, which has one panel; where the study asks for the
    distances of all pairs, matrix and map too, and where meshes have times, over-time. Each has the suffixes that the
    output asks for.

    Raises:
        InputError: The store has no tables yet, or lacks an order or a family.
        StoreError: The folder cannot be written.
    """
    selection, output = selection or Selection(), output or Output()
    with output.drawing():
        figures = _figures(tree, selection, output)
    paths = write_figures(figures, Path(folder), output)
    notes = {name: notes_of(figure) for name, figure in figures.items()}
    return WrittenPlots(paths, {name: lines for name, lines in notes.items() if lines})


def _figures(tree: xr.DataTree, selection: Selection, output: Output) -> dict[str, Figure]:
    orders = chosen_orders(finished_group(tree, "convergence"), selection.order)
    family, size = chosen_families(tree, selection.family), output.size
    figures = {"convergence": convergence_figure(tree, orders, selection.x, family, size)}
    if moving_families(tree, family):
        figures["over-time"] = evolution_figure(tree, orders, family, size)
    if (transforms := transform_figure(tree, family, size)) is not None:
        figures["transform"] = transforms
    if has_pairs(tree):
        figures["matrix"] = matrix_figure(tree, orders, family, size)
        figures["map"] = map_figure(tree, orders, family, size)
    if "similarity" in tree.attrs and (spectra := Spectra.of(tree, orders, MOST_MESHES, family)) is not None:
        figures["spectrum"] = spectrum_figure(spectra, orders, size)
        figures["energy"] = energy_figure(tree, spectra, size)
    return figures
