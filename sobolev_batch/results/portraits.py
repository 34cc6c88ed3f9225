"""Portraits of meshes: where each differs from the reference, as the norm sees it, for looking at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.batch.plan import members_of
from sobolev_batch.batch.study import Study
from sobolev_batch.errors import InputError, SobolevBatchError
from sobolev_batch.results.tables import convergence_frame, finished_group
from sobolev_batch.spectral.witness import witness
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Similarity
from sobolev_batch.surfaces.sources import Member

Reals = NDArray[np.float64]

MOST_PORTRAITS = 4
# Beyond, a page would take long to load and to turn.
_MOST_TRIANGLES = 12_000
_ENOUGH_TRIANGLES = 6_000
# Of all portraits together, at 4 bytes each.
_MOST_VALUES = 500_000
# Larger ones take minutes to be made again.
_LARGEST_MADE = 2_000_000


@dataclass(frozen=True)
class Portrait:
    """A mesh with its witness function.

    Attributes:
        label: of the mesh.
        vertices: (n, 3), in the study's unit of length.
        triangles: (m, 3), indices of vertices.
        values: (orders, n), positive where the mesh has area that the reference lacks; in 1 / unit length.
        orders: s, each.
        whole: the number of triangles of the mesh itself; these are a simplification where they are fewer, and
            cut them where they are more.
    """

    label: str
    vertices: Reals
    triangles: NDArray[np.int32]
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
    tree: xr.DataTree, table: Mapping[str, Any], folder: str | Path, wanted: Sequence[str] = ()
) -> Gallery:
    """Make a few meshes of a store again, by its study, and evaluate their witness functions on them.

    A mesh is shown only if it is, to the bit, the one whose field is stored: files may have changed, and a
    store may name files that its study never saw.

    Args:
        tree: an open store.
        table: the study as it was written.
        folder: where relative paths in it start.
        wanted: labels; by default the closest mesh of each family at the first order, and the farthest ones.

    Raises:
        InputError: a label that the store does not have, or too many.
    """
    meshes = tree["meshes"].to_dataset().load()
    known = meshes["mesh"].values.tolist()
    for label in wanted:
        if label not in known:
            raise InputError(f"the store has no mesh {label!r}, only such as {known[0]!r}")
    if len(wanted) > MOST_PORTRAITS:
        raise InputError(f"at most {MOST_PORTRAITS} meshes can be shown, found {len(wanted)}")
    labels = tuple(dict.fromkeys(wanted)) or tuple(_extremes(tree))
    try:
        members = members_of(Study.from_table(table, folder=folder))
    except SobolevBatchError as error:
        return Gallery((), dict.fromkeys(labels, f"the study's meshes cannot be listed here: {error}"))
    portraits, absent = [], {}
    for label in labels:
        try:
            about = meshes.sel(mesh=label)
            mesh = _made_again(label, members, about, Similarity(**_similarity(tree)))
            portraits.append(_portrait(tree, label, mesh, len(labels)))
        except SobolevBatchError as error:
            absent[label] = str(error)
    return Gallery(tuple(portraits), absent)


def _extremes(tree: xr.DataTree) -> Iterator[str]:
    """The mesh of each family that is closest to the reference, then those that are farthest, while there is room."""
    frame = convergence_frame(tree)
    frame = frame[(frame["order"] == frame["order"].iloc[0]) & (frame["distance"] > 0) & (frame["triangles"] > 0)]
    families = [lines for _, lines in frame.groupby("family", sort=False)]
    extremes = [lines["distance"].idxmin() for lines in families] + [lines["distance"].idxmax() for lines in families]
    yield from frame.loc[list(dict.fromkeys(extremes))[:MOST_PORTRAITS], "mesh"]


def _similarity(tree: xr.DataTree) -> dict[str, Any]:
    found = tree.attrs["similarity"]
    return {"scale": found["scale"], "origin": tuple(found["origin"])}


def _made_again(
    label: str, members: Mapping[str, tuple[str, Member]], about: xr.Dataset, similarity: Similarity
) -> Mesh:
    """The mesh of a label, in the study's unit.

    Raises:
        SobolevBatchError: it cannot be made, or is not the one that was computed.
    """
    if about["status"].item() != "complete":
        raise InputError(f"it is {about['status'].item()}")
    if label not in members:
        raise InputError("the study makes no such mesh here")
    if not about["triangles"].item():
        raise InputError("a surface in closed form has no triangles")
    if about["triangles"].item() > _LARGEST_MADE:
        raise InputError(f"it has {about['triangles'].item():,} triangles; up to {_LARGEST_MADE:,} are made again")
    surface = similarity.apply(members[label][1].load())
    if not isinstance(surface, Mesh) or surface.digest != about["digest"].item():
        raise InputError("what the study makes here is not the mesh that was computed; its files may have changed")
    return surface


def _portrait(tree: xr.DataTree, label: str, mesh: Mesh, count: int) -> Portrait:
    orders = tuple(finished_group(tree, "convergence")["order"].values.tolist())
    # A closed mesh has half as many vertices as triangles.
    room = 2 * _MOST_VALUES // (count * len(orders))
    vertices, triangles = _for_looking(mesh, min(_MOST_TRIANGLES, room))
    fields = tree["fourier"].to_dataset()["fourier"]
    reference = tree["convergence"].attrs["reference"]
    # Collapsed edges may leave the period by a hair where the mesh fills it.
    inside = np.clip(vertices, mesh.vertices.min(axis=0), mesh.vertices.max(axis=0))
    values = witness(fields.sel(mesh=label), fields.sel(mesh=reference), orders, inside, dtype="complex64")
    shown = np.asarray(values.to_numpy(), dtype=np.float64)
    return Portrait(label, inside, triangles, shown, orders, len(mesh.triangles))


def _for_looking(mesh: Mesh, most: int) -> tuple[Reals, NDArray[np.int32]]:
    """Not more triangles than a page bears, and enough to show what varies within one."""
    vertices, triangles = np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)
    if len(triangles) > most:
        found = fast_simplification.simplify(vertices, triangles, target_count=most)
        return np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int32)
    while 4 * len(triangles) <= min(most, _ENOUGH_TRIANGLES):
        vertices, triangles = trimesh.remesh.subdivide(vertices, triangles)
    return np.asarray(vertices), np.asarray(triangles, dtype=np.int32)
