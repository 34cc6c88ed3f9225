"""Meshes with their witness functions, or distances of vertices, for display: simplified, and in plots."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import MultiPoint

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.extras.figures.remade import StudyMeshes, fields_of, matching_labels, stem_of
from sobolev_batch.extras.figures.selection import Families, Selection, chosen_families
from sobolev_batch.extras.figures.style import (
    EXTENDS,
    WIDTH_INCHES,
    PictureFormat,
    Size,
    drawing,
    escaped,
    set_title,
    shortened,
    write_figures,
)
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.proximity import point_distances
from sobolev_batch.geometry.subdivision import subdivided
from sobolev_batch.geometry.surface import normals
from sobolev_batch.norms.causes import witness
from sobolev_batch.parameters import check_choice
from sobolev_batch.tables.convergence import table
from sobolev_batch.tables.open import finished_group
from sobolev_batch.testing.difference import witness_at_vertices

Triangles = NDArray[np.int32]
# The field of a surface, and that of what it is compared with.
Fields = tuple[xr.DataArray, xr.DataArray]

Axis = Literal["x", "y", "z"]
_AXES: tuple[Axis, ...] = get_args(Axis)
# Scales of colours of several meshes: one for each, or one for all.
Colors = Literal["own", "common"]

# Unit vector to the viewer of the usual view, with the third axis upwards.
FRONT: Reals = np.array([1.25, -1.4, 0.8]) / np.linalg.norm([1.25, -1.4, 0.8])
# Colours cover this fraction of the area, and all of it unless the largest value exceeds the others by the factor.
COVERED_AREA, _OUTLYING = 0.99, 1.25
# Places count by this power of their values: the worst ones alone decide.
_POWER = 4
# The worst places face one way if the mean of their normals is as long, and the usual view shows them if the cosine
# between both is as large. A view that is steeper than this height of the unit vector is turned to the usual one.
_ONE_WAY, _SHOWN, _STEEPEST = 0.5, 0.4, 0.9
# Triangles whose values are at least this fraction of the largest one are as bad as the worst.
_WORST = 0.99

# Points belong to the base that a mesh rests on up to this fraction of its height. The y axis points up only if the
# base below it covers this fraction of the bounding box, and more than the factor times what that of the z axis covers.
_BASE, _BROAD, _BROADER = 0.03, 0.1, 2.0

# A plot has this height, and at most so many orders of one mesh, panels in a row, and meshes beside each other.
_HEIGHT_INCHES, MOST_ORDERS, _PANELS_IN_A_ROW, _MOST_COMPARED = 5.0, 6, 3, 9
# So many meshes of a store are shown unless some are named.
_MOST_EXTREMES = 4
# Small meshes are divided into about as many triangles, since values vary within theirs.
_ENOUGH_TRIANGLES = 6_000
# Larger meshes take minutes to be made again.
_LARGEST_MADE = 2_000_000
# Meshes, triangles of each (larger ones are simplified), and values of all meshes and orders together. A page takes 4
# bytes for each value, and beyond these limits long to load and to turn.
PAGE_LIMITS = 4, 8_000, 300_000
# A picture shows hardly more triangles; values take 8 bytes each, in memory.
PICTURE_LIMITS = 100, 60_000, 50_000_000

# Upwards in a picture, to the light, which is above the viewer's left shoulder, and the part of light from all around:
# dim enough to keep colours distinct and bright enough for shapes.
_UP: Reals = np.array([0.0, 0.0, 1.0])
_LIGHT: Reals = np.array([-0.5, 0.7, 1.5]) / np.linalg.norm([-0.5, 0.7, 1.5])
_AMBIENT = 0.62


@dataclass(frozen=True)
class MeshView:
    """A mesh with its witness function, or with the distances of its vertices from another mesh.

    Attributes:
        vertices: Points (n, 3) in the study's unit of length, turned so that the third axis points upwards.
        triangles: Indices of vertices, (m, 3).
        values: Witness function (orders, n), positive where the mesh has area that the reference lacks, in
            1 / unit length; or distances (1, n).
        original_triangles: Number of triangles of the mesh itself; the view has fewer where it is a simplification,
            and more where it subdivides them.
        eye: Unit vector (3,) to the viewer of pictures.
        unit: Unit of length of values that are distances, with a sign where some are negative; None for a witness
            function.
    """

    label: str
    vertices: Reals
    triangles: Triangles
    values: Reals
    orders: tuple[float, ...]
    original_triangles: int
    eye: Reals = field(default_factory=FRONT.copy)
    unit: str | None = None

    @property
    def color_limits(self) -> Reals:
        """Ends (orders,) of scales of colours on which a few outliers do not make the rest white.

        The modulus that is not exceeded on 99 % of the area, or the largest one if that is hardly larger; 1 for zeros.
        For distances, the largest one.
        """
        # A third of each triangle belongs to each of its corners.
        areas = np.repeat(np.linalg.norm(normals(self.vertices, self.triangles), axis=1), 3)
        areas = np.bincount(self.triangles.ravel(), areas, minlength=len(self.vertices))
        limits = []
        for moduli in np.abs(self.values):
            covering, largest = np.quantile(moduli, COVERED_AREA, weights=areas, method="inverted_cdf"), moduli.max()
            is_whole = self.unit is not None or largest <= _OUTLYING * covering or covering == 0
            limits.append(largest if is_whole else covering)
        return np.array([float(limit) or 1.0 for limit in limits])

    def towards_worst(self) -> Self:
        """Return the view from the side of the worst places at the first order, if the usual view hides them.

        The worst triangle faces the eye of a view that is not the usual one.
        """
        moduli = np.abs(self.values[0])[self.triangles].mean(axis=1)
        strength = np.minimum(moduli / self.color_limits[0], 1.0) ** _POWER
        outwards = self._outwards()
        facing, worst = strength @ outwards, outwards[np.argmax(moduli)]
        shows_worst = np.any(outwards[moduli >= _WORST * moduli.max()] @ FRONT > 0)
        length, total = float(np.linalg.norm(facing)), strength @ np.linalg.norm(outwards, axis=1)
        goes_one_way = length > _ONE_WAY * total
        if shows_worst and (not goes_one_way or facing @ FRONT >= _SHOWN * length):
            return self
        eye = facing / length if goes_one_way and facing @ worst > 0 else worst / (np.linalg.norm(worst) or 1.0)
        if abs(eye[2]) > _STEEPEST:
            eye = eye + FRONT / 2
        return replace(self, eye=eye / np.linalg.norm(eye)) if eye @ worst > 0 else self

    def _outwards(self) -> Reals:
        """Return normals (m, 3) of twice the area that point outwards, as far as the mesh tells where that is."""
        own_normals, mesh = normals(self.vertices, self.triangles), Mesh(self.vertices, self.triangles)
        if np.isfinite(mesh.volume):
            return own_normals if mesh.volume > 0 else -own_normals
        # The orientation of others is not to be trusted: away from the middle of the mesh.
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        outwards = np.einsum("ij,ij->i", own_normals, self.vertices[self.triangles].mean(axis=1) - middle)
        return own_normals * np.where(outwards < 0, -1, 1)[:, None]


def make_views(
    tree: xr.DataTree,
    folder: str | Path,
    meshes: Sequence[str] = (),
    limits: tuple[int, int, int] = PAGE_LIMITS,
    up: Axis | None = None,
    orders: Sequence[float] | None = None,
    family: Families = None,
) -> tuple[list[MeshView], dict[str, str]]:
    """Make a few meshes of a store again, by its study, and evaluate their witness functions on them.

    By default they are the closest mesh of each chosen family at the first order, and the farthest ones; limits are
    those of `PAGE_LIMITS`. Return views in the order of the study, and the reason for each requested mesh without one,
    by its label. InputError where a label or family is unknown, or more meshes are named than may be shown.
    """
    if up is not None:
        check_choice("up", up, _AXES)
    most_meshes, most_triangles, most_values = limits
    named = matching_labels(tree, meshes)
    if len(named) > most_meshes:
        raise InputError(f"at most {most_meshes} meshes can be shown, found {len(named)}")
    chosen = tuple(finished_group(tree, "convergence")["order"].values.tolist() if orders is None else orders)
    labels = named
    if not named:
        frame = table(tree, chosen[0])
        is_chosen = frame["family"].isin(chosen_families(tree, family))
        frame = frame[is_chosen & (frame["distance"] > 0) & (frame["triangles"] > 0)]
        of_families = frame.groupby("family", sort=False)["distance"]
        extremes = dict.fromkeys([*of_families.idxmin(), *of_families.idxmax()])
        labels = tuple(frame.loc[[*extremes][:_MOST_EXTREMES], "mesh"])
    try:
        study_meshes = StudyMeshes.from_tree(tree, folder)
    except InputError as error:
        return [], dict.fromkeys(labels, str(error))
    # A closed mesh has half as many vertices as triangles.
    most_triangles = min(most_triangles, 2 * most_values // (max(1, len(labels)) * len(chosen)))
    views, missing = [], {}
    for label in labels:
        try:
            _, mesh = study_meshes.make(label, _LARGEST_MADE)
            views.append(_view(label, fields_of(tree, label), mesh, chosen, most_triangles))
        except SobolevBatchError as error:
            missing[label] = str(error)
    return _turned(views, up) if views else [], missing


def _turned(views: Sequence[MeshView], up: Axis | None = None) -> list[MeshView]:
    """Return views with one axis upwards, by a cyclic permutation of all, each from the side of its worst places."""
    turn = upwards(np.concatenate([view.vertices for view in views]), up)
    return [replace(view, vertices=np.roll(view.vertices, turn, axis=1)).towards_worst() for view in views]


def upwards(points: Reals, up: Axis | None = None) -> int:
    """Return by how many axes points (n, 3) are rolled until one axis, by default their `up_axis`, is the third."""
    return _AXES.index("z") - _AXES.index(up or up_axis(points))


def up_axis(points: Reals) -> Axis:
    """Return "y" if points (n, 3) stand firmly along the y axis, and not along the z axis; else "z".

    What rests on feet or on a flat base touches the ground over most of its breadth; from its other sides, a snout or
    a tail does. The measure is the area of the convex hull of the lowest points over that of the bounding box.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    if not extent.all():
        return "z"
    points = (points - low) / extent
    y, z = (MultiPoint(np.delete(points[points[:, axis] <= _BASE], axis, axis=1)).convex_hull.area for axis in (1, 2))
    return "y" if y > max(_BROAD, _BROADER * z) else "z"


def _view(label: str, fields: Fields, mesh: Mesh, orders: tuple[float, ...], most: int) -> MeshView:
    view = _shown(label, mesh, most)
    if len(view.triangles) == view.original_triangles:
        values = witness_at_vertices(*fields, orders, mesh)[:, mesh.used_vertices]
    else:
        values = witness(*fields, list(orders), view.vertices, dtype="complex64").to_numpy()
    return replace(view, values=values, orders=orders)


def _shown(label: str, mesh: Mesh, most: int, enough: int = _ENOUGH_TRIANGLES) -> MeshView:
    """Return a view of a mesh without values: its own vertices that are in use, in their order, or others.

    One of more triangles than the most is simplified, and a small one subdivided up to enough of them: values then vary
    within its triangles.
    """
    used = mesh.used_vertices
    number = np.empty(len(mesh.vertices), dtype=np.int32)
    number[used] = np.arange(len(used))
    vertices, triangles = mesh.vertices[used], number[mesh.triangles]
    # Without this extra, large meshes take longer to draw.
    if len(triangles) > most and find_spec("fast_simplification"):
        import fast_simplification

        simplified = fast_simplification.simplify(vertices, triangles, target_count=most)
        # Collapsed edges may leave the period by a hair where the mesh fills it.
        vertices = np.clip(simplified[0].astype(np.float64), vertices.min(axis=0), vertices.max(axis=0))
        triangles = simplified[1].astype(np.int32)
    else:
        while 4 * len(triangles) <= enough:
            finer = subdivided(Mesh(vertices, triangles))
            vertices, triangles = finer.vertices, finer.triangles.astype(np.int32)
    return MeshView(label, vertices, triangles, np.zeros((0, len(vertices))), (), len(mesh.triangles))


def distance_view(
    label: str,
    mesh: Mesh,
    other: Mesh,
    unit: str,
    most: int,
    scale: float = 1.0,
    *,
    enough: int | None = None,
    signed: bool = False,
) -> MeshView:
    """Return a view of a mesh with distances from another one, in a unit which is this scale in that of both.

    Triangles are divided up to enough of them, by default four times the most that a mesh keeps. Signed distances are
    positive outside of the other mesh and negative inside.
    """
    # All vertices of a simplified mesh may lie on the other one: what lies between them counts, too.
    view = _shown(label, mesh, most, 4 * most if enough is None else enough)
    if len(view.triangles) >= len(mesh.triangles):
        distances = point_distances(view.vertices, other, signed=signed)
    else:
        # Simplification moves vertices by more than what is to be seen. No vertex and no triangle gets lost.
        own = np.concatenate([mesh.vertices[mesh.used_vertices], np.mean(mesh.corners(), axis=0)])
        exact = point_distances(own, other, signed=signed)
        places = np.concatenate([np.arange(len(view.vertices)), cKDTree(view.vertices).query(own)[1]])
        values = np.concatenate([exact[cKDTree(own).query(view.vertices)[1]], exact])
        order, distances = np.argsort(np.abs(values)), np.empty(len(view.vertices))
        # Of those at one place, the last one stays: the largest.
        distances[places[order]] = values[order]
    return replace(view, values=distances[None] / scale, unit=unit)


def draw_mesh(axes: Axes, view: MeshView, index: int = 0, limit: float | None = None) -> None:
    """Draw a mesh on axes from the side of its eye, the farthest triangles first, so that nearer ones hide them.

    Red where the witness of the order of an index is positive and blue where it is negative: Matplotlib's "RdBu_r" from
    minus to plus a limit, by default that of `color_limits`. Distances go from pale to dark.
    """
    right = np.cross(_UP, view.eye)
    right /= np.linalg.norm(right)
    vertices = view.vertices @ np.stack([right, np.cross(view.eye, right), view.eye], axis=1)
    corners, across = vertices[view.triangles], normals(vertices, view.triangles)
    # The orientation of triangles is not to be trusted: all of them face the viewer.
    across *= np.where(across[:, 2:] < 0, -1, 1) / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(across @ _LIGHT, 0, 1)
    values = view.values[index][view.triangles].mean(axis=1)
    mapping = _mapping(view, view.color_limits[index] if limit is None else limit)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    faces, colors = list(corners[order, :, :2]), (mapping.to_rgba(values)[:, :3] * light[:, None])[order]
    axes.add_collection(PolyCollection(faces, facecolors=colors, edgecolors="face", linewidths=0.3, rasterized=True))
    # Axes that shrink to the mesh would mislead the layout, which then cuts their titles off.
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.set_axis_off()


def _mapping(view: MeshView, limit: float) -> ScalarMappable:
    low, colors = (-limit, "RdBu_r") if view.unit is None else (0.0, "YlOrRd")
    return ScalarMappable(Normalize(low, limit), colors)


def draw_witness(view: MeshView, axes: Axes | None = None, limit: float | None = None) -> Axes:
    """Draw a mesh at its first order on axes, or on those of a new figure, with its label above and a colour bar."""
    axes = axes or Figure(figsize=(WIDTH_INCHES, _HEIGHT_INCHES), layout="constrained").subplots()
    limit = view.color_limits[0] if limit is None else limit
    draw_mesh(axes, view, limit=limit)
    set_title(axes, escaped(view.label), _seen(view))
    _add_colorbar(axes, [view], limit, 0)
    return axes


def write_witness_plots(
    selection: Selection,
    output_folder: str | Path,
    folder: str | Path = ".",
    meshes: Sequence[str] = (),
    up: Axis | None = None,
    colors: Colors = "own",
    formats: Sequence[PictureFormat] = ("png",),
    size: Size | None = None,
) -> tuple[tuple[Path, ...], Mapping[str, str]]:
    """Draw meshes of an open store, coloured by their witness functions, into a folder; see `make_views`.

    Each mesh gets a file witness-*; several are also drawn beside each other in the file witness, seen from the front,
    at the first order. Return the paths of the pictures, and the reason for each mesh without one.
    """
    tree = selection.tree
    views, missing = make_views(tree, folder, meshes, PICTURE_LIMITS, up, selection.orders, selection.families)
    common = np.max([view.color_limits for view in views], axis=0) if views and colors == "common" else None
    with drawing(size):
        figures = {f"witness-{stem_of(tree, view.label)}": witness_figure(view, size, common) for view in views}
        if len(views) > 1:
            figures["witness"] = _comparison_figure(views, size, None if common is None else common[0])
    return write_figures(figures, output_folder, formats, size), missing


def witness_figure(view: MeshView, size: Size | None = None, limits: Reals | None = None) -> Figure:
    """Return a mesh seen from one side, with a panel for each of its first orders."""
    count = min(len(view.orders), MOST_ORDERS)
    limits = view.color_limits if limits is None else limits
    # Below each panel its colours, above all of them the name of the mesh.
    figure, panels = _panels(count, size, above=0.3, beside=0.8)
    for i, axes in enumerate(panels):
        draw_mesh(axes, view, i, limits[i])
        _add_colorbar(axes, [view], limits[i], i)
    omission = f"{count} of {len(view.orders)} orders" if count < len(view.orders) else ""
    figure.suptitle("\n".join(filter(None, (escaped(view.label), _seen(view), omission))), fontsize="medium")
    return figure


def _panels(count: int, size: Size | None, *, above: float, beside: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels in rows, of a size, or with inches for what is above and in each row.

    The panels of a row fill its width, so that no place remains empty.
    """
    rows = np.array_split(np.arange(count), -(-count // _PANELS_IN_A_ROW))
    height = above + len(rows) * (beside + min(WIDTH_INCHES / len(rows[0]), _HEIGHT_INCHES))
    figure = Figure(figsize=size or (WIDTH_INCHES, height), layout="constrained")
    columns = math.lcm(*map(len, rows))
    mosaic: list[Any] = [np.repeat(row, columns // len(row)).tolist() for row in rows]
    panels = figure.subplot_mosaic(mosaic)
    for axes in panels.values():
        axes.set_axis_off()
    return figure, list(panels.values())


def _seen(view: MeshView) -> str:
    return "" if np.array_equal(view.eye, FRONT) else "seen from the side of the largest values"


def _comparison_figure(views: Sequence[MeshView], size: Size | None, limit: float | None) -> Figure:
    """Return meshes beside each other, with their witness functions of the first order, on one scale if it is given."""
    shown = views[:_MOST_COMPARED]
    omission = f"{len(shown)} of {len(views)} meshes" if len(shown) < len(views) else ""
    figure, panels = _panels(len(shown), size, above=0.8 + 0.3 * bool(omission), beside=0.3 if limit else 0.8)
    for axes, view in zip(panels, shown, strict=True):
        draw_mesh(axes, replace(view, eye=FRONT), limit=limit)
        axes.set_title(f"{shortened(view.label)}\n{view.original_triangles:,} triangles", fontsize="small")
        if limit is None:
            _add_colorbar(axes, [view], view.color_limits[0], 0)
    if omission:
        figure.suptitle(omission, fontsize="medium")
    if limit is not None:
        _add_colorbar(panels, shown, limit, 0)
    return figure


def write_difference_picture(
    path: Path, meshes: Sequence[tuple[str, Mesh]], fields: Fields, order: float, distances: str | None, scale: float
) -> tuple[Path, ...]:
    """Draw one or two meshes with their names and the witness function of two fields, as a .png, .svg or .pdf.

    If a unit of distances is given, which is this scale in that of the meshes, a second row has the distance of each
    vertex from the other mesh. The meshes of a row have one scale of colours, and are seen from one side.
    """
    views = [_view(name, fields, mesh, (order,), PICTURE_LIMITS[1]) for name, mesh in meshes]
    rows = [_turned(views)]
    if distances is not None:
        pairs = zip(meshes, [mesh for _, mesh in reversed(meshes)], strict=True)
        # Distances vary more within triangles: fewer are enough, and each of these may be divided.
        most = PICTURE_LIMITS[1] // 4
        views = [distance_view(name, mesh, other, distances, most, scale) for (name, mesh), other in pairs]
        rows.append(_turned(views))
    with drawing(None):
        figure, panels = _panels(len(rows) * len(views), None, above=0.0, beside=1.2)
        for row in rows:
            in_row, panels = panels[: len(row)], panels[len(row) :]
            strongest = max(row, key=lambda view: float(view.color_limits[0]))
            for axes, view in zip(in_row, row, strict=True):
                draw_mesh(axes, replace(view, eye=strongest.eye), limit=strongest.color_limits[0])
                largest = "" if view.unit is None else f"points up to {view.values.max():.3g} {escaped(view.unit)} away"
                count = f"{view.original_triangles:,} triangles"
                set_title(axes, shortened(view.label), largest or count, _seen(strongest))
            for axes in in_row:
                axes.update_datalim(Bbox.union([axes.dataLim for axes in in_row]).corners())
                axes.autoscale_view()
            _add_colorbar(in_row, row, strongest.color_limits[0], 0)
    return write_figures({path.stem: figure}, path.parent, [path.suffix[1:]], None)  # type: ignore[list-item]


def _add_colorbar(panels: Axes | Sequence[Axes], views: Sequence[MeshView], limit: float, index: int) -> None:
    """Add the colours of some meshes at one of their orders, with arrows where values lie beyond them."""
    values, unit = np.concatenate([view.values[index] for view in views]), views[0].unit
    ends = bool(values.min() < -limit), bool(values.max() > limit)
    bar = (panels if isinstance(panels, Axes) else panels[0]).figure.colorbar(
        _mapping(views[0], limit),
        ax=panels,
        shrink=0.8,
        orientation="horizontal",
        ticks=MaxNLocator(4, symmetric=unit is None),
        format="{x:.4g}",
        aspect=20 if isinstance(panels, Axes) else 50,
        extend=EXTENDS[ends],
    )
    beyond = f"\narrows: up to {1 - COVERED_AREA:.0%} of the area" if any(ends) else ""
    if unit is None:
        order = f"witness, order {views[0].orders[index]:g}"
        text = f"missing area \N{LEFT RIGHT ARROW} extra area\n{order}{beyond}"
    else:
        text = f"distance to the closest point of the other mesh, in {escaped(unit)}"
    bar.set_label(text, fontsize="small")
    bar.ax.tick_params(labelsize="x-small")
