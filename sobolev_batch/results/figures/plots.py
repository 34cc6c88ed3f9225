"""The plots of a store, one by one and all of them into a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.drawing import LEAGUE, PLOTS, computed_members
from sobolev_batch.results.figures.selection import Selection
from sobolev_batch.results.figures.style import PictureFormat, Size, drawing, notes_of, write_figures
from sobolev_batch.results.open import EDGE_LENGTH, AnyStore, Families, fields_read
from sobolev_batch.results.tables.league import League


def write_plots(
    selection: Selection, folder: str | Path, formats: Sequence[PictureFormat] = ("png",), size: Size | None = None
) -> tuple[tuple[Path, ...], Mapping[str, Sequence[str]]]:
    """Write the plots of a store into a folder, with a panel for each order or family.

    The files are convergence, transform, spectrum and energy, which has one panel; where the study requests the
    distances of all pairs, matrix and map too, and where meshes have times, over-time. Each has the suffixes of the
    formats.

    Returns:
        Paths of the pictures, and what each of them leaves out, by its name.

    Raises:
        InputError: The store lacks the horizontal axis.
        StoreError: The folder cannot be written.
    """
    with drawing(size):
        figures = {
            name: plot.figure(selection, items, size)
            for name, plot in PLOTS.items()
            if (items := plot.items(selection))
        }
    notes = {name: notes_of(figure) for name, figure in figures.items()}
    return write_figures(figures, folder, formats, size), {name: lines for name, lines in notes.items() if lines}


def _plotted(name: str, selection: Selection, axes: Axes | None) -> Axes:
    """Draw the first order of a selection, and return the axes."""
    return PLOTS[name].on(axes, selection, selection.orders[0])


def plot_convergence(
    store: AnyStore,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    x: str = EDGE_LENGTH,
    family: Families = None,
) -> Axes:
    """Plot the relative distance to the reference against the size or the cost of the meshes, family by family.

    Both axes are logarithmic. Bars show errors; a hollow marker is a distance that is not larger than its error.
    Families that go from coarse to fine are joined, and a dotted line has the slope of second-order convergence. The
    title counts the meshes that have no place in the plot. Without ``ax``, the plot
    has a figure of its own, ``ax.figure``, which pyplot does not know, with the legend beside it.

    Args:
        store: Path, URL or opened DataTree of the store.
        order: One of the store's orders; default its first.
        ax: Axes to draw on.
        x: Horizontal axis: "edge_length" (mean, in the study's unit), "triangles", "vertices", "seconds" that the tasks
            of the mesh took, or a number among the metadata of the meshes.
        family: Families to draw, by names or globs; default all.

    Returns:
        The axes.

    Raises:
        InputError: The store has no tables yet, or lacks the order, a family or the horizontal axis.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_convergence("storage/icosphere.zarr", order=-10)
    >>> ax.get_xlabel()
    "mean edge length in the study's unit"
    >>> ax.figure.savefig("convergence.pdf")
    >>> sb.plot_convergence("storage/icosphere.zarr", x="triangles", family="ico*").get_xlabel()
    'number of triangles'
    """
    return _plotted("convergence", Selection.from_store(store, order, family, x), ax)


def plot_evolution(
    store: AnyStore,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    truth: str | None = None,
    family: Families = None,
) -> Axes:
    """Plot the distances of moving meshes from the true surface over time, one line for each family.

    The vertical axis is logarithmic; bars show errors, and a dotted line marks the first time at which a new mesh pays.

    `plot_convergence` describes the arguments; ``truth`` is the family of the true surface at the same times, by
    default the study's reference.

    Raises:
        InputError: See `evolution`; or no family that moves is chosen.

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
    return _plotted("over-time", Selection.from_store(store, order, family, truth=truth), ax)


def plot_matrix(
    store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None
) -> Axes:
    """Plot the distances of all pairs as a heat map, with similar meshes beside each other.

    Colours are on a logarithmic scale; where a few distances lie far beyond the others, arrows end it. White pairs are
    equal. Up to 300 meshes are drawn: the first ones and the reference.

    `plot_convergence` describes the arguments; the figure of `ax` gets a colour bar too.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_matrix("storage/icosphere.zarr", order=-10)
    >>> len(ax.get_yticklabels())
    5
    """
    return _plotted("matrix", Selection.from_store(store, order, family), ax)


def plot_map(store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the meshes as points of a plane whose distances approximate the Sobolev distances.

    The plane shows most of the meshes' variance (classical scaling); distances in it are never larger than the true
    ones. Up to 300 meshes are drawn: the first ones and the reference.

    `plot_convergence` describes the arguments.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has distances to the reference alone.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_map("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.figure.legends[0].get_texts()]
    ['icosphere', 'reference']
    """
    return _plotted("map", Selection.from_store(store, order, family), ax)


def plot_spectrum(
    store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None
) -> Axes:
    """Plot the fractions of each mesh's squared distance to the reference by wavelength, as a heat map.

    The field of each mesh is read; up to 24 meshes are drawn, evenly through each family. The title says so.

    `plot_convergence` describes the arguments; the figure of `ax` gets a colour bar too.

    Raises:
        InputError: The store has no tables yet, lacks the order or a family, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_spectrum("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_yticklabels()]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3']
    """
    return _plotted("spectrum", Selection.from_store(store, order, family), ax)


def plot_energy(store: AnyStore, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the energy of each mesh's difference from the reference by wavelength, as a fraction of its limit.

    The energy is ∫_{|ξ|=r} |a^ - b^|² dS. For large |ξ| it tends to twice the area of both surfaces, if no parts of
    them coincide. A mesh agrees with the reference at the wavelengths where its line is far below 1. Where the line
    reaches 1, they have nothing in common. Both axes are logarithmic, and long wavelengths are on the left. Bars show
    standard errors. The field of each mesh is read; up to 24 meshes are drawn, evenly through each family. The title
    says so.

    `plot_convergence` describes the arguments.

    Raises:
        InputError: The store has no tables yet, lacks a family, or has no mesh to compare.
        DamageError: A field is damaged.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot_energy("storage/icosphere.zarr")
    >>> [text.get_text() for text in ax.figure.legends[0].get_texts()]
    ['limit', 'icosphere']
    """
    return _plotted("energy", Selection.from_store(store, None, family), ax)


def plot_transform(store: AnyStore, family: Families = None, ax: Axes | None = None) -> Axes:
    """Plot the real part of Fourier fields along the positive ξ_x axis, for some meshes and the reference.

    Args:
        store: Path, URL or opened DataTree of the store.
        family: Families of meshes, by names or globs; up to five are drawn; default the first family that has
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
    selection = Selection.from_store(store, None, family)
    members = list(computed_members(selection))
    if not members:
        known = computed_members(Selection.from_store(selection.tree))
        raise InputError(f"no mesh of the family is computed, only of: {', '.join(known) or 'none'}")
    with fields_read(store):
        return PLOTS["transform"].on(ax, selection, members[:1] if family is None else members)


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
