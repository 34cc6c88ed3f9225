"""The plots of a store, one by one and all of them into a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.drawing import LEAGUE, PLOTS
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import PictureFormat, Size, drawing, notes_of, write_figures
from sobolev_batch.results.open import EDGE_LENGTH, AnyStore, Families
from sobolev_batch.results.tables.league import League


def write_plots(
    selection: Selection, folder: str | Path, formats: Sequence[PictureFormat] = ("png",), size: Size | None = None
) -> tuple[tuple[Path, ...], Mapping[str, Sequence[str]]]:
    """Write the plots of a store into a folder, each with a panel for each order.

    The files are named after the kinds of `plot`; each kind that the store has results for is drawn in each format.

    Returns:
        Paths of the pictures, and what each of them leaves out, by its name.

    Raises:
        InputError: The store lacks the horizontal axis.
        StoreError: The folder cannot be written.
    """
    with drawing(size):
        figures = {
            name: kind.figure(selection, items, size)
            for name, kind in PLOTS.items()
            if (items := kind.items(selection))
        }
    notes = {name: notes_of(figure) for name, figure in figures.items()}
    return write_figures(figures, folder, formats, size), {name: lines for name, lines in notes.items() if lines}


def plot(
    store: AnyStore,
    kind: str = "convergence",
    order: float | None = None,
    ax: Axes | None = None,
    *,
    family: Families = None,
    x: str = EDGE_LENGTH,
    truth: str | None = None,
) -> Axes:
    """Plot results of a store.

    The kinds:

    - "convergence": the relative distance to the reference against the size or the cost of the meshes, on logarithmic
      axes. Bars show errors; a hollow marker is a distance that is not larger than its error. Families that go from
      coarse to fine are joined, and a dotted line has the slope of second-order convergence. The title counts the
      meshes that have no place in the plot.
    - "over-time": the distances of meshes that move, with a dotted line at the first time at which a new mesh pays.
    - "matrix": the distances of all pairs as a heat map, with similar meshes beside each other, on a logarithmic scale
      of colours. Where a few distances lie far beyond the others, arrows end it. White pairs are equal.
    - "spectrum": the fractions of each squared distance to the reference by wavelength, as a heat map.
    - "energy": ∫_{|ξ|=r} |a^ - b^|² dS for each difference from the reference, at all orders the same, as a fraction of
      its limit for large |ξ|: twice the area of both surfaces, if no parts of them coincide. A mesh agrees with the
      reference at the wavelengths where its line is far below 1; where it reaches 1, they have nothing in common.

    A matrix shows up to 300 meshes, the first ones and the reference. Spectrum and energy read the field of each mesh,
    and show up to 24, evenly through the study; the title says so.

    Args:
        store: Path, URL or opened DataTree of the store.
        kind: Kind of plot.
        order: One of the store's orders; default its first.
        ax: Axes to draw on; its figure gets a colour bar where the kind has one. Without it, the plot has a figure of
            its own, ``ax.figure``, which pyplot does not know, with the legend beside it.
        family: Families to draw, by names or globs; default all.
        x: Horizontal axis of "convergence": "edge_length" (mean, in the study's unit), "triangles", "vertices",
            "seconds" that the tasks of the mesh took, or a number among the metadata of the meshes.
        truth: For "over-time", the family of the true surface at the same times; default the study's reference.

    Returns:
        The axes.

    Raises:
        InputError: There is no such kind, or the store has no tables yet or lacks the order, a family, the horizontal
            axis, the distances of all pairs, a mesh to compare, or meshes that move.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot("storage/icosphere.zarr", order=-10)
    >>> ax.get_xlabel()
    "mean edge length in the study's unit"
    >>> ax.figure.savefig("convergence.pdf")
    >>> sb.plot("storage/icosphere.zarr", x="triangles", family="ico*").get_xlabel()
    'number of triangles'
    >>> [text.get_text() for text in sb.plot("storage/icosphere.zarr", "spectrum", order=-10).get_yticklabels()]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3']
    """
    if kind not in PLOTS:
        raise InputError(f"a kind of plot is one of {', '.join(PLOTS)}, found {kind!r}")
    selection = Selection.from_store(store, order, family, x, truth)
    return PLOTS[kind].on(ax, selection, selection.orders[0])


def plot_league(league: League, ax: Axes | None = None) -> Axes:
    """Plot the mean relative distance of each method of a league against the mean size of its meshes.

    The points are geometric means over the objects, at the sizes at which the table compares the methods. Bars show
    the errors of the distances. Both axes are logarithmic.

    Args:
        league: League at one order, see `league`.
        ax: Axes to draw on.

    Returns:
        The axes.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league({"sphere": "storage/icosphere.zarr"}, -10)
    >>> ax = sb.plot_league(at_order)
    >>> ax.get_xlabel()
    'number of triangles'
    """
    return LEAGUE.on(ax, [league], league)
