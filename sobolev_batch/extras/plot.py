"""Plots of a store, and of leagues, on Matplotlib axes.

Each function returns the axes. Without `ax`, the plot has a figure of its own, ``axes.figure``, which pyplot does not
know, with the legend beside it. `order` is any order below -1/2, default the first of the store; others are computed
from what it holds. `family` are names or globs of families, default all. All functions raise an `InputError` where the
store has no tables yet or lacks a family, and a `DamageError` where what they read of a store is damaged, unless plain
xarray opened it.
"""

from pathlib import Path

import xarray as xr

from sobolev_batch.errors import InputError, from_extra
from sobolev_batch.extras.leagues.costs import CostLeague
from sobolev_batch.extras.leagues.league import League
from sobolev_batch.extras.leagues.statistics import EDGE_LENGTH
from sobolev_batch.geometry.surface import is_finite_number
from sobolev_batch.tables.open import AnyStore, as_tree, finished_group

with from_extra("plot", "a plot needs"):
    from matplotlib.axes import Axes

    from sobolev_batch.extras.figures.drawing import COST_LEAGUE, LEAGUE, PLOTS, RATES
    from sobolev_batch.extras.figures.selection import Families, Selection
    from sobolev_batch.extras.figures.views import PICTURE_LIMITS, Axis, draw_witness, make_views

__all__ = ["convergence", "energy", "league", "matrix", "over_time", "spectrum", "witness"]


def convergence(
    store: AnyStore | xr.Dataset,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    family: Families = None,
    x: str = EDGE_LENGTH,
) -> Axes:
    """Plot the relative distances to the reference against the size or the cost of the meshes, on logarithmic axes.

    Bars show errors; a hollow marker is a distance that is not larger than its error. Families that go from coarse to
    fine are joined, and a dotted line has the slope of second-order convergence. The title counts the meshes that have
    no place in the plot.

    Args:
        store: Path, URL or opened DataTree of the store, or what `sobolev_batch.convergence` returns, of which all
            meshes are drawn.
        order: Order of the norm.
        ax: Axes to draw on.
        family: Families to draw.
        x: Horizontal axis: "edge_length" (mean, in the unit of the files), "triangles", "vertices", "seconds" that the
            tasks of the mesh took, or a number among the metadata of the meshes.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot.convergence("storage/icosphere.zarr", order=-10)
    >>> ax.get_xlabel()
    'mean edge length in file units'
    >>> ax.figure.savefig("convergence.pdf")
    >>> sb.plot.convergence("storage/icosphere.zarr", x="triangles", family="ico*").get_xlabel()
    'number of triangles'
    >>> from sobolev_batch.shapes import Sphere, icosphere
    >>> rates = sb.convergence([icosphere(1), icosphere(2)], Sphere(), -4.0, lattice=sb.Lattice(3.0, 24))
    >>> sb.plot.convergence(rates).get_ylabel()
    'relative Sobolev distance'
    """
    if isinstance(store, xr.Dataset):
        return RATES.on(_checked(ax), store, order)
    return _plot("convergence", Selection.from_store(store, order, family, x), ax)


def over_time(store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the distances of meshes that move, with a dotted line at the first time at which a new mesh pays.

    The parameters are those of `convergence`.

    >>> import sobolev_batch as sb
    >>> sb.plot.over_time("storage/icosphere.zarr", order=-10)
    Traceback (most recent call last):
        ...
    sobolev_batch.errors.InputError: ...
    """
    return _plot("over-time", Selection.from_store(store, order, family), ax)


def matrix(store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the distances of all pairs as a heat map, with similar meshes beside each other.

    The scale of colours is logarithmic; arrows end it where a few distances lie far beyond the others. White pairs are
    equal. It shows up to 300 meshes, the first ones and the reference. The store needs the distances of all pairs; the
    parameters are those of `convergence`, and the figure of the axes gets a colour bar.

    >>> import sobolev_batch as sb
    >>> sb.plot.matrix("storage/icosphere.zarr", order=-10).get_title()
    'Sobolev distance of order -10'
    """
    return _plot("matrix", Selection.from_store(store, order, family), ax)


def spectrum(store: AnyStore, order: float | None = None, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot the fractions of each squared distance to the reference by wavelength, as a heat map.

    It reads the field of each mesh, and shows up to 24, evenly through the study; the title says so. The
    parameters are those of `convergence`; the figure of the axes gets a colour bar.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot.spectrum("storage/icosphere.zarr", order=-10)
    >>> [text.get_text() for text in ax.get_yticklabels()]
    ['icosphere/0', 'icosphere/1', 'icosphere/2', 'icosphere/3']
    """
    return _plot("spectrum", Selection.from_store(store, order, family), ax)


def energy(store: AnyStore, ax: Axes | None = None, *, family: Families = None) -> Axes:
    """Plot ∫_{|ξ|=r} |a^ - b^|² dS of each difference from the reference by wavelength, at all orders the same.

    It is a fraction of its limit for large |ξ|: twice the area of both surfaces, if no parts of them coincide. A mesh
    agrees with the reference at the wavelengths where its line is far below 1; where it reaches 1, they have nothing in
    common. Like `spectrum` it shows up to 24 meshes. The parameters are those of `convergence`.

    >>> import sobolev_batch as sb
    >>> sb.plot.energy("storage/icosphere.zarr").get_ylabel()
    'energy over its limit'
    """
    return _plot("energy", Selection.from_store(store, None, family), ax)


def league(league: League | CostLeague, ax: Axes | None = None) -> Axes:
    """Plot the mean relative distance of each method of a league against the mean size of its meshes.

    The points are geometric means over the objects, at the sizes at which the table compares the methods. Bands show
    their 95 % intervals, and dots all meshes. Both axes are logarithmic. In a league by cost the points are the members
    that all objects have, at their mean costs, with the errors of the distances; a dotted line joins those that no
    other one beats in both means.

    Args:
        league: League at one order, see `sobolev_batch.league`.
        ax: Axes to draw on.

    >>> import sobolev_batch as sb
    >>> (at_order,) = sb.league({"sphere": "storage/icosphere.zarr"}, -10)
    >>> sb.plot.league(at_order).get_xlabel()
    'number of triangles'
    """
    if not isinstance(league, League | CostLeague):
        raise InputError(f"league must be one of those that sobolev_batch.league returns, found {league!r}")
    return (LEAGUE if isinstance(league, League) else COST_LEAGUE).on(_checked(ax), [league], league)


def witness(
    store: AnyStore,
    mesh: str,
    order: float | None = None,
    ax: Axes | None = None,
    *,
    folder: str | Path = ".",
    up: Axis | None = None,
    limit: float | None = None,
) -> Axes:
    """Plot a mesh coloured by its witness function: red where it has area that the reference lacks, else blue.

    The study makes the mesh again. It is seen from the front and above, or from the side of the worst places if these
    are hidden there; then the title says so. Where a few values are far larger than all others, the colours end below
    them: the colour bar has arrows, with at most 1 % of the area beyond.

    Args:
        store: Path, URL or opened DataTree of the store.
        mesh: Label of the mesh, such as "family/name".
        order: Order of the norm.
        ax: Axes to draw on; its figure gets a colour bar.
        folder: Folder where relative paths in the study start.
        up: Axis that points upwards in the mesh's own coordinates; default the one that it seems to rest on, y or z.
        limit: End of the scale of colours, in 1 / unit length of the study. Meshes are compared on a common one.

    Raises:
        InputError: The label is unknown, or the mesh cannot be made again, or is not the one that was computed.

    >>> import sobolev_batch as sb
    >>> ax = sb.plot.witness("storage/icosphere.zarr", "icosphere/1", order=-4)  # doctest: +SKIP
    """
    tree = as_tree(store)
    if limit is not None and not (is_finite_number(limit) and limit > 0):
        raise InputError(f"limit must be a positive number, found {limit!r}")
    orders = finished_group(tree, "convergence")["order"].values[:1].tolist() if order is None else [order]
    views, missing = make_views(tree, folder, [mesh], PICTURE_LIMITS, up, orders)
    if len(views) + len(missing) > 1:
        raise InputError(f"{mesh!r} stands for several meshes, and one is plotted; give its label")
    for label, reason in missing.items():
        raise InputError(f"{label}: {reason}")
    return draw_witness(views[0], _checked(ax), limit)


def _plot(kind: str, selection: Selection, axes: Axes | None) -> Axes:
    return PLOTS[kind].on(_checked(axes), selection, selection.orders[0])


def _checked(axes: Axes | None) -> Axes | None:
    if not isinstance(axes, Axes | None):
        raise InputError(f"ax must be axes of Matplotlib, found {axes!r}")
    return axes
