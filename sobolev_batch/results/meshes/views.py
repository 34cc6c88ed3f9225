"""Portraits of meshes: where each differs from the reference, as the norm sees it, for looking at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import fast_simplification
import numpy as np
import trimesh
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.meshes.rebuild import Remaker, require_known
from sobolev_batch.results.meshes.witness import witness_at, witness_at_vertices
from sobolev_batch.results.tables.convergence import convergence_frame, finished_group
from sobolev_batch.surfaces.shapes.mesh import Mesh

Reals = NDArray[np.float64]
Corners = NDArray[np.int32]

Axis = Literal["x", "y", "z"]
_AXES: tuple[Axis, ...] = get_args(Axis)

# Of a store, where none are named.
_MOST_EXTREMES = 4
_ENOUGH_TRIANGLES = 6_000
# Larger ones take minutes to be made again.
_LARGEST_MADE = 2_000_000


@dataclass(frozen=True)
class Detail:
    """How much may be shown.

    Attributes:
        meshes: at most.
        triangles: of each mesh; larger ones are simplified.
        values: of all meshes and orders together.
    """

    meshes: int
    triangles: int
    values: int


# Beyond, a page would take long to load and to turn; values take 4 bytes each.
PAGE = Detail(meshes=4, triangles=12_000, values=500_000)
# A picture has hardly more dots on a mesh; values take 8 bytes each, in memory.
PICTURES = Detail(meshes=100, triangles=200_000, values=50_000_000)


@dataclass(frozen=True)
class Portrait:
    """A mesh with its witness function.

    Attributes:
        label: of the mesh.
        vertices: (n, 3), in the study's unit of length, turned so that the third axis points upwards.
        triangles: (m, 3), indices of vertices.
        values: (orders, n), positive where the mesh has area that the reference lacks; in 1 / unit length.
        orders: s, each.
        whole: the number of triangles of the mesh itself; these are a simplification where they are fewer, and
            cut them where they are more.
    """

    label: str
    vertices: Reals
    triangles: Corners
    values: Reals
    orders: tuple[float, ...]
    whole: int


@dataclass(frozen=True)
class Gallery:
    """Portraits, and why there are none of others that were asked for.

    Attributes:
        portraits: in the order of the study.
        absent: the reason for each mesh without one.
    """

    portraits: tuple[Portrait, ...]
    absent: Mapping[str, str]


def make_gallery(
    tree: xr.DataTree,
    table: Mapping[str, Any],
    folder: str | Path,
    wanted: Sequence[str] = (),
    detail: Detail = PAGE,
    up: Axis = "z",
) -> Gallery:
    """Make a few meshes of a store again, by its study, and evaluate their witness functions on them.

    Args:
        tree: an open store.
        table: the study as it was written.
        folder: where relative paths in it start.
        wanted: labels; by default the closest mesh of each family at the first order, and the farthest ones.
        detail: how much may be shown.
        up: the axis that points upwards in the meshes' own coordinates.

    Raises:
        InputError: a label that the store does not have, or too many.
    """
    require_known(wanted, finished_group(tree, "meshes"))
    if len(wanted) > detail.meshes:
        raise InputError(f"at most {detail.meshes} meshes can be shown, found {len(wanted)}")
    labels = tuple(dict.fromkeys(wanted)) or tuple(_extremes(tree))
    try:
        remaker = Remaker.of(tree, table, folder)
    except InputError as error:
        return Gallery((), dict.fromkeys(labels, str(error)))
    orders = tuple(finished_group(tree, "convergence")["order"].values.tolist())
    portraits, absent = [], {}
    for label in labels:
        try:
            mesh = remaker.make(label, _LARGEST_MADE).scaled
            # A closed mesh has half as many vertices as triangles.
            room = 2 * detail.values // (len(labels) * len(orders))
            portraits.append(_portrait(tree, label, mesh, orders, min(detail.triangles, room), up))
        except SobolevBatchError as error:
            absent[label] = str(error)
    return Gallery(tuple(portraits), absent)


def _extremes(tree: xr.DataTree) -> Iterator[str]:
    """The mesh of each family that is closest to the reference, then those that are farthest, while there is room."""
    frame = convergence_frame(tree)
    frame = frame[(frame["order"] == frame["order"].iloc[0]) & (frame["distance"] > 0) & (frame["triangles"] > 0)]
    families = [lines for _, lines in frame.groupby("family", sort=False)]
    extremes = [lines["distance"].idxmin() for lines in families] + [lines["distance"].idxmax() for lines in families]
    yield from frame.loc[list(dict.fromkeys(extremes))[:_MOST_EXTREMES], "mesh"]


def _portrait(tree: xr.DataTree, label: str, mesh: Mesh, orders: tuple[float, ...], most: int, up: Axis) -> Portrait:
    used = mesh.used_vertices
    number = np.empty(len(mesh.vertices), dtype=np.int32)
    number[used] = np.arange(len(used))
    own, corners = mesh.vertices[used], number[mesh.triangles]
    vertices, triangles = _for_looking(own, corners, most)
    if vertices is own:
        values = witness_at_vertices(tree, label, mesh, orders)[:, used]
    else:
        # Collapsed edges may leave the period by a hair where the mesh fills it.
        vertices = np.clip(vertices, own.min(axis=0), own.max(axis=0))
        values = witness_at(tree, label, orders, vertices, dtype="complex64")
    # Axes change places in a circle, so that left stays left.
    upright = np.roll(vertices, _AXES.index("z") - _AXES.index(up), axis=1)
    return Portrait(label, upright, triangles, values, orders, len(corners))


def _for_looking(vertices: Reals, triangles: Corners, most: int) -> tuple[Reals, Corners]:
    """Not more triangles than may be shown, and enough to show what varies within one."""
    if len(triangles) > most:
        found = fast_simplification.simplify(vertices, triangles, target_count=most)
        return np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int32)
    while 4 * len(triangles) <= min(most, _ENOUGH_TRIANGLES):
        vertices, triangles = trimesh.remesh.subdivide(vertices, triangles)
    return np.asarray(vertices), np.asarray(triangles, dtype=np.int32)
